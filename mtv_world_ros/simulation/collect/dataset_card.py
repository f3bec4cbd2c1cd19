"""The card of a data set as data: counts, expert success, splits, one entry per episode."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass
import json
from pathlib import Path
import re
import shutil
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import make_reader
import numpy as np

from mtv_world_ros.core.bounded_input import parse_json, read_json
from mtv_world_ros.core.errors import EpisodeError, SimulatorError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.data.episode import METADATA_NAME, TASK_DEFINITION
from mtv_world_ros.simulation.scenes.tasks import own_definition, Task
from mtv_world_ros.success.task import stored_task

CARD_FILE = 'dataset.json'
#: name of the set of episodes that show the tasks
TASKS_SET = 'tasks'
#: name of the set of episodes from unseen camera poses
ZERO_SHOT_SET = 'zero_shot'
#: folder of an episode in progress: its task, number, and a random word of the bag's writer
_IN_PROGRESS = re.compile(r'\.\w+_\d{5}\.[a-z0-9_]{8}\.tmp')
#: what to do where something cannot be written
GO_ON = 'finished episodes are kept, so run the same command again once there is room'


@dataclass(frozen=True, slots=True, kw_only=True)
class CardEntry:
    """One episode of a data set, as its MCAP file describes it.

    Attributes:
        name: folder of the episode.
        task: name of the task.
        index: number within the task, in a zero-shot set within its kind and task.
        split: `train` (even index) or `test` (odd index, and all of a zero-shot set).
        zero_shot: `view`, `task` or `object`; None = an ordinary episode.
        outcome: `success` or `failure`.
        seed: reproduces the scene.
        attempt: seeds dropped before this one.
        num_frames: number of frames of each view.
        duration_s: duration from the first to the last message [s].
        instruction: the language instruction.
        objects: names, in the order of the mask ids.
        scene: name of the scene that it shares with its siblings; empty = it has none.
        task_definition: definition of a task that is not bundled, as JSON; empty = it is bundled.
            The card holds it once for each task.
    """

    name: str
    task: str
    index: int
    split: str
    zero_shot: str | None
    outcome: str
    seed: int
    attempt: int
    num_frames: int
    duration_s: float
    instruction: str
    objects: tuple[str, ...]
    scene: str = ''
    task_definition: str = ''


def read_entry(path: Path) -> CardEntry:
    """Return the entry of a finished episode folder.

    Raises:
        EpisodeError: the folder holds no episode of the simulator.
    """
    file = path / f'{path.name}_0.mcap'
    try:
        with file.open('rb') as stream:
            reader = make_reader(stream)
            summary = reader.get_summary()
            described = {r.name: r.metadata for r in reader.iter_metadata()}[METADATA_NAME]
        if summary is None or summary.statistics is None:
            raise ValueError('the MCAP file has no summary')
        counts = summary.statistics.channel_message_counts
        images = [i for i, c in summary.channels.items() if '/image_raw' in c.topic]
        spans = summary.statistics.message_start_time, summary.statistics.message_end_time
        definition = described.get(TASK_DEFINITION, '')
        if definition:
            parse_json(definition, f"'{TASK_DEFINITION}'")
        index, zero_shot = int(described['index']), described.get('zero_shot')
        return CardEntry(
            name=path.name,
            task=described['task'],
            index=index,
            split='test' if index % 2 or zero_shot else 'train',
            zero_shot=zero_shot,
            outcome=described['outcome'],
            seed=int(described['seed']),
            attempt=int(described['attempt']),
            num_frames=max(counts[channel] for channel in images),
            duration_s=round((spans[1] - spans[0]) * 1e-9, 3),
            instruction=described['instruction'],
            objects=tuple(parse_json(described['objects'], "'objects'")),
            scene=described.get('scene', ''),
            task_definition=definition,
        )
    except (OSError, KeyError, ValueError, McapError) as error:
        raise EpisodeError(
            f"'{path}' is not an episode that `collect` made ({error}); move it away, or collect "
            'into another folder'
        ) from error


def read_entries(out: Path, wanted: Collection[str]) -> dict[str, CardEntry]:
    """Return the finished episodes of a data set by name, also those that are not wanted now.

    Raises:
        EpisodeError: something else has the name of a wanted episode.
    """
    entries = {}
    for path in sorted(out.iterdir()):
        if path.name.startswith('.') or not (path.is_dir() or path.name in wanted):
            continue
        try:
            entries[path.name] = read_entry(path)
        except EpisodeError:
            if path.name in wanted:
                raise
    return entries


def check_same_set(out: Path, kind: str, seed: int, config: dict[str, Any]) -> None:
    """Refuse to add to a data set that was made from another seed or configuration.

    Raises:
        SimulatorError: says what differs.
    """
    card = out / CARD_FILE
    if not card.is_file():
        return
    try:
        there = read_json(card)
        seed_there, config_there = there['seed'], there['config']
        kind_there = there.get('kind', TASKS_SET)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SimulatorError(f"'{card}' is not a data set card: {error!r}") from error
    if kind_there != kind:
        raise SimulatorError(
            f"'{out}' holds a data set of the kind '{kind_there}', not '{kind}'; zero-shot sets "
            'are kept apart from the others: choose another --out'
        )
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


def check_same_tasks(out: Path, entries: Iterable[CardEntry], tasks: Iterable[Task]) -> None:
    """Refuse to add episodes of a task to episodes of another task of the same name.

    Args:
        out: folder of the data set.
        entries: episodes of the data set.
        tasks: tasks of the episodes that are to be made.

    Raises:
        SimulatorError: names the task and an episode of the other definition.
        ConfigError: an episode holds a definition that cannot be used.
    """
    wanted = {task.name: task for task in tasks}
    for entry in entries:
        task = wanted.get(entry.task)
        if task is None or _is_of(entry, task, f"'{TASK_DEFINITION}' of '{out / entry.name}'"):
            continue
        raise SimulatorError(
            f"'{out / entry.name}' is of another definition of the task '{entry.task}'; give this "
            'one another name in its file, or choose another --out'
        )


def _is_of(entry: CardEntry, task: Task, where: str) -> bool:
    """Return whether an episode is of a task, and not of another one of the same name."""
    own = own_definition(task)
    if not (own and entry.task_definition):
        return own == entry.task_definition
    return stored_task(entry.task_definition, where) == task.definition


def remove_leftovers(out: Path) -> None:
    """Remove the hidden folders of episodes whose recording was killed."""
    for folder in out.glob('.*_*.tmp'):
        if _IN_PROGRESS.fullmatch(folder.name):
            shutil.rmtree(folder, ignore_errors=True)


def _counts(entries: Sequence[CardEntry]) -> dict[str, Any]:
    successes = [entry for entry in entries if entry.outcome == 'success']
    attempts = sum(entry.attempt + 1 for entry in successes)
    return {
        'episodes': len(entries),
        'success': len(successes),
        'failure': len(entries) - len(successes),
        'success_attempts': attempts,
        'expert_success_rate': round(len(successes) / attempts, 4) if attempts else None,
        'mean_duration_s': round(float(np.mean([e.duration_s for e in entries])), 3),
        'mean_frames': round(float(np.mean([e.num_frames for e in entries])), 1),
    }


def _by(key: str, entries: Sequence[CardEntry]) -> dict[str, Any]:
    values = dict.fromkeys(getattr(entry, key) for entry in entries)
    return {value: _counts([e for e in entries if getattr(e, key) == value]) for value in values}


def card_of(
    kind: str, seed: int, config: dict[str, Any], entries: Iterable[CardEntry]
) -> dict[str, Any]:
    """Return the card as plain data, in the order of the episodes' names."""
    listed = sorted(entries, key=lambda entry: entry.name)
    splits = {
        split: [entry.name for entry in listed if entry.split == split]
        for split in ('train', 'test')
    }
    own = {e.task: json.loads(e.task_definition) for e in listed if e.task_definition}
    return {
        'kind': kind,
        'seed': seed,
        'config': config,
        'num_episodes': len(listed),
        # absent where all tasks are bundled, as in cards of earlier versions
        **({'task_definitions': own} if own else {}),
        'tasks': _by('task', listed),
        'zero_shot': _by('zero_shot', [entry for entry in listed if entry.zero_shot]),
        'splits': splits,
        'episodes': [_listed(entry) for entry in listed],
    }


def _listed(entry: CardEntry) -> dict[str, Any]:
    values = asdict(entry)
    del values['task_definition']
    return values


def write_card(out: Path, card: dict[str, Any]) -> None:
    """Write `dataset.json`, whole or not at all."""
    write_file(out / CARD_FILE, (json.dumps(card, indent=1) + '\n').encode())


def write_file(path: Path, data: bytes) -> None:
    """Write a file, whole or not at all.

    Raises:
        SimulatorError: it cannot be written; what was there before is still there.
    """
    try:
        write_whole(path, data)
    except OSError as error:
        raise SimulatorError(f"cannot write '{path}': {error}; {GO_ON}") from error
