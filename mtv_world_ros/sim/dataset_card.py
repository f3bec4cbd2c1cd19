"""The card of a data set: counts, expert success, splits, one entry per episode."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
import json
import os
from pathlib import Path
import shutil
import time
from typing import Any

from mcap.reader import make_reader

from mtv_world_ros.data.episode import METADATA_NAME
from mtv_world_ros.errors import EpisodeError, SimulatorError

CARD_FILE = 'dataset.json'
#: an unfinished recording that nothing was written to for this long is taken for dead [s]
LEFTOVER_AGE_S = 600


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeEntry:
    """One episode of a data set, as its MCAP metadata describes it.

    Attributes:
        name: its folder.
        task: name of the task.
        index: number within the task.
        split: `train` (even index) or `test` (odd index).
        outcome: `success` or `failure`.
        seed: reproduces the scene.
        attempt: seeds dropped before this one.
        instruction: what the robot is told.
        objects: names, in the order of the mask ids.
    """

    name: str
    task: str
    index: int
    split: str
    outcome: str
    seed: int
    attempt: int
    instruction: str
    objects: tuple[str, ...]


def read_entry(path: Path) -> EpisodeEntry:
    """Returns the entry of a finished episode folder.

    Raises:
        EpisodeError: the folder holds no episode of the simulator.
    """
    file = path / f'{path.name}_0.mcap'
    try:
        with file.open('rb') as stream:
            records = {r.name: r.metadata for r in make_reader(stream).iter_metadata()}
        described = records[METADATA_NAME]
        index = int(described['index'])
        return EpisodeEntry(
            name=path.name,
            task=described['task'],
            index=index,
            split='test' if index % 2 else 'train',
            outcome=described['outcome'],
            seed=int(described['seed']),
            attempt=int(described['attempt']),
            instruction=described['instruction'],
            objects=tuple(json.loads(described['objects'])),
        )
    except (OSError, KeyError, ValueError) as error:
        raise EpisodeError(
            f"'{path}' is not an episode that `collect` made ({error}); move it away, or collect "
            'into another folder'
        ) from error


def check_same_set(out: Path, seed: int, config: dict[str, Any]) -> None:
    """Refuses to add to a data set that was made from another seed or configuration.

    Raises:
        SimulatorError: says what differs.
    """
    card = out / CARD_FILE
    if not card.is_file():
        return
    try:
        there = json.loads(card.read_text())
        seed_there, config_there = there['seed'], there.get('config', config)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise SimulatorError(f"'{card}' is not a data set card: {error}") from error
    if seed_there != seed:
        raise SimulatorError(
            f"'{out}' holds a data set of seed {seed_there}, not {seed}; set --seed {seed_there} "
            'to continue it, or another --out'
        )
    if config_there != config:
        raise SimulatorError(
            f"'{out}' holds a data set of another configuration (see 'config' in '{card}'); "
            'choose another --out'
        )


def remove_leftovers(out: Path) -> None:
    """Removes the hidden folders of episodes whose recording was killed."""
    for folder in out.glob('.*_*.tmp'):
        if time.time() - folder.stat().st_mtime > LEFTOVER_AGE_S:
            shutil.rmtree(folder, ignore_errors=True)


def card_of(seed: int, config: dict[str, Any], entries: Iterable[EpisodeEntry]) -> dict[str, Any]:
    """Returns the card as plain data, in the order of the episodes' names."""
    listed = sorted(entries, key=lambda entry: entry.name)
    tasks: dict[str, dict[str, Any]] = {}
    for entry in listed:
        counts = tasks.setdefault(
            entry.task, {'episodes': 0, 'success': 0, 'failure': 0, 'success_attempts': 0}
        )
        counts['episodes'] += 1
        counts[entry.outcome] += 1
        counts['success_attempts'] += entry.attempt + 1 if entry.outcome == 'success' else 0
    for counts in tasks.values():
        attempts = counts['success_attempts']
        counts['expert_success_rate'] = (
            round(counts['success'] / attempts, 4) if attempts else None
        )
    splits = {
        split: [entry.name for entry in listed if entry.split == split]
        for split in ('train', 'test')
    }
    return {
        'seed': seed,
        'config': config,
        'num_episodes': len(listed),
        'tasks': tasks,
        'splits': splits,
        'episodes': [asdict(entry) for entry in listed],
    }


def write_card(
    out: Path, seed: int, config: dict[str, Any], entries: Iterable[EpisodeEntry]
) -> None:
    """Writes `dataset.json`, whole or not at all."""
    beside = out / f'.{CARD_FILE}.part'
    beside.write_text(json.dumps(card_of(seed, config, entries), indent=1) + '\n')
    os.replace(beside, out / CARD_FILE)
