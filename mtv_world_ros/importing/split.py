"""Split of imported episodes into those to train on and those to test on."""

from __future__ import annotations

from collections.abc import Mapping
import hashlib
import json
from pathlib import Path
import re

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.data.splits import CARD_FILE, splits_of

TRAIN, TEST = 'train', 'test'
#: percentage of the recordings to train on where none is asked for
DEFAULT_PERCENT = 75
#: number of recordings from which a split is made without being asked for
MIN_RECORDINGS = 4


def parse_split(text: str) -> int:
    """Return the percentage to train on of a text such as `75:25`; 100 = `off`.

    Raises:
        ConfigError: the text is neither.
    """
    if text == 'off':
        return 100
    parts = re.fullmatch(r'(\d+):(\d+)', text)
    train, test = (int(part) for part in parts.groups()) if parts else (0, 0)
    if not train or not test:
        raise ConfigError(
            f"--split is '{text}', must be the shares to train and to test on, e.g. 75:25, or off"
        )
    return round(100 * train / (train + test))


def write_split(out: Path, groups: Mapping[str, str], percent: int | None) -> str:
    """Write the splits of imported episodes into `dataset.json`; return a line about them.

    Episodes that have a split keep it, also when others are imported later: nothing moves from
    what was trained on to what is tested on. Parts of one recording are in one split.

    Args:
        out: folder of the episodes.
        groups: recording of each episode, by the episode's name.
        percent: recordings to train on; None = `DEFAULT_PERCENT` from `MIN_RECORDINGS` on.
    """
    splits = {name: list(names) for name, names in splits_of(out).items()}
    known = {episode: name for name, names in splits.items() for episode in names}
    is_off = percent == 100 or (percent is None and _are_few(groups))
    if not groups or (is_off and not splits):
        return ''
    wanted = DEFAULT_PERCENT if percent is None else percent
    placed = {groups[episode]: name for episode, name in known.items() if episode in groups}
    fresh = sorted({group for group in groups.values() if group not in placed}, key=_drawn)
    due = _num_test(len({*placed, *fresh}), wanted)
    due -= sum(split == TEST for split in placed.values())
    placed |= {group: TEST if k < due else TRAIN for k, group in enumerate(fresh)}
    for name in (TRAIN, TEST):
        more = [e for e, group in groups.items() if e not in known and placed[group] == name]
        splits[name] = sorted([*splits.get(name, []), *more])
    file = out / CARD_FILE
    card = read_json(file) if file.is_file() else {}
    write_whole(file, json.dumps({**card, 'splits': splits}, indent=1) + '\n')
    return (
        f'split: {len(splits[TRAIN])} to train on, {len(splits[TEST])} to test on '
        f'({", ".join(splits[TEST]) or "none"}): {file}'
    )


def _are_few(groups: Mapping[str, str]) -> bool:
    return len(set(groups.values())) < MIN_RECORDINGS


def _num_test(count: int, percent: int) -> int:
    """Return the number of recordings to test on: some, and never all."""
    wanted = round(count * (100 - percent) / 100)
    return min(max(wanted, int(percent < 100)), count - 1)


def _drawn(name: str) -> str:
    """Return the key by which recordings are shuffled: the same on each machine and call."""
    return hashlib.sha256(name.encode()).hexdigest()
