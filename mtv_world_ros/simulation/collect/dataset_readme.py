"""The card of a data set as text: README.md, from its card and from a written episode."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.documents import render, Table
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode import METADATA_NAME
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.simulation.collect.contact_sheet import SHEET_FILE
from mtv_world_ros.simulation.collect.dataset_card import CardEntry, write_file, ZERO_SHOT_SET
from mtv_world_ros.simulation.collect.episode_maker import CollectConfig, plain_config
from mtv_world_ros.simulation.scenes.tasks import TASKS

README_FILE = 'README.md'
KEYS = {
    'task': 'name of the task',
    'task_definition': 'JSON of a task that is not among the bundled ones, with its scene',
    'instruction': 'what the robot is told, also on `/instruction`',
    'objects': 'JSON list of names; masks number them from 1',
    'outcome': '`success`: the task was done at some frame and in the last five; else `failure`',
    'ever': 'the task was done at some frame',
    'final': 'it held in each of the last five frames',
    'seed': 'of the episode; it alone reproduces the scene and the motion',
    'attempt': 'seeds dropped before this one',
    'index': 'number within the task',
    'policy': 'what acted in place of the expert',
    'fault_split': 'splits of its fault kinds; nothing may learn from `test`',
    'robot': 'name of the robot, `config/robots/`',
    'zero_shot': '`view`, `task` or `object`: what no training or test episode shows',
}


def _counts(
    first: str, groups: Mapping[str, Mapping[str, Any]], *, is_filtered: bool = True
) -> Table:
    head = (first, 'episodes', 'success', 'failure', 'expert success before filtering', 'length')
    rows = []
    for name, counts in groups.items():
        rate, attempts = counts['expert_success_rate'], counts['success_attempts']
        rows.append(
            (
                name, counts['episodes'], counts['success'], counts['failure'],
                '-' if rate is None or not is_filtered else f'{100 * rate:.0f} % of {attempts}',
                f'{counts["mean_duration_s"]:.1f} s, {counts["mean_frames"]:.0f} frames',
            )
        )  # fmt: skip
    return Table(head=head, rows=rows)


def commands(card: Mapping[str, Any], entries: Iterable[CardEntry]) -> list[str]:
    """Return the commands that make the data set again; several where tasks differ in number."""
    config = card['config']
    plain = plain_config(CollectConfig(robot=_robot(config)))
    given = {
        'robot': config.get('robot'),
        **{side: config['randomization'][side] for side in ('width', 'height')},
        'fps': f'{1 / config["record"]["frame_period_s"]:g}',
        'moved-cameras': config['moved_share'],
        'policies': ','.join(config['policies']),
        'faults': ','.join(config['kinds']),
        'pictures': config['record']['pictures'],
    }
    usual = {
        'robot': CollectConfig().robot,
        **plain['randomization'],
        'fps': f'{1 / plain["record"]["frame_period_s"]:g}',
        'pictures': plain['record']['pictures'],
    }
    options = ''.join(
        f' --{name} {value}' for name, value in given.items() if value and value != usual.get(name)
    )
    end = f'--seed {card["seed"]}{options} --out DIR'
    if card['kind'] == ZERO_SHOT_SET:
        return [f'mtv-world collect --zero-shot {kinds} --episodes {number} {end}'
                for kinds, number in _zero_shot_numbers(card['zero_shot'])]  # fmt: skip
    numbers: dict[int, list[str]] = {}
    for task in card['tasks']:
        highest = max(entry.index for entry in entries if entry.task == task)
        numbers.setdefault(highest + 1, []).append(task)
    ordinary = {name for name, task in TASKS.items() if not task.zero_shot}
    return [
        f'mtv-world collect --task {"all" if set(names) == ordinary else _named(names)} '
        f'--episodes {number} {end}'
        for number, names in numbers.items()
    ]


def _named(names: Sequence[str]) -> str:
    """Return the names of tasks as an option; a task that is not a bundled one as its file."""
    return ','.join(name if name in TASKS else f'{name}.yaml' for name in names)


def _zero_shot_numbers(groups: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, int]]:
    """Return one command where the kinds took turns, else one for each kind."""
    kinds = sorted(groups, key=lambda kind: -groups[kind]['episodes'])
    numbers = [groups[kind]['episodes'] for kind in kinds]
    if max(numbers) - min(numbers) <= 1:
        return [(','.join(kinds), sum(numbers))]
    return list(zip(kinds, numbers, strict=True))


def _robot(config: Mapping[str, Any]) -> str:
    return config.get('robot', CollectConfig().robot)


def _is_usual(config: Mapping[str, Any]) -> bool:
    """Return True if the configuration is that of the command without options."""
    usual = plain_config(CollectConfig(robot=_robot(config)))
    for key in ('moved_share', 'policies', 'kinds'):
        usual |= {key: config[key]} if key in config else {}
    for key in ('pictures', 'frame_period_s'):
        usual['record'][key] = config['record'][key]
    for side in ('width', 'height'):
        usual['randomization'][side] = config['randomization'][side]
    return config == usual


def _cameras(cameras: Mapping[str, CameraModel]) -> Table:
    rows = []
    for view, camera in cameras.items():
        place = ', '.join(f'{value:.2f}' for value in camera.T_mount_camera[:3, 3])
        ahead = camera.T_mount_camera[:3, 2]
        down = np.rad2deg(np.arcsin(-ahead[2]))
        rows.append(
            (view, f'{camera.width} x {camera.height} px', f'{camera.K[0, 0]:.0f} px',
             f'({place}) m', f'{down:.0f} deg')
        )  # fmt: skip
    return Table(head=('view', 'image', 'focal length', 'position', 'looking down'), rows=rows)


def _objects(entries: Iterable[CardEntry]) -> Table:
    """Return the nouns and colours of all objects, by how often they occur."""
    nouns: Counter[str] = Counter()
    colours: dict[str, set[str]] = {}
    for entry in entries:
        for name in entry.objects:
            colour, _, noun = name.partition(' ')
            nouns[noun] += 1
            colours.setdefault(noun, set()).add(colour)
    # by number, then by name: episodes may have been finished in any order
    listed = sorted(nouns.items(), key=lambda item: (-item[1], item[0]))
    rows = [(noun, count, ', '.join(sorted(colours[noun]))) for noun, count in listed]
    return Table(head=('object', 'times', 'colours'), rows=rows)


def readme(out: Path, card: Mapping[str, Any], entries: Sequence[CardEntry]) -> str:
    """Return the text of the card.

    Args:
        out: folder of the data set.
        card: card of the data set, see `card_of`.
        entries: episodes of the data set, at least one.
    """
    first = out / min(entry.name for entry in entries)
    bag = BagReader(first)
    topics = Counter((message.topic, message.msgtype) for message in bag.messages())
    config, is_zero_shot = card['config'], card['kind'] == ZERO_SHOT_SET
    return render(
        'dataset.md.j2',
        is_zero_shot=is_zero_shot,
        config=config,
        is_usual=_is_usual(config),
        num_episodes=len(entries),
        num_tasks=len(card['tasks']),
        outcomes=Counter(entry.outcome for entry in entries),
        sheet=SHEET_FILE,
        commands=commands(card, entries),
        tasks=_counts('task', card['tasks'], is_filtered=not config['policies']),
        zero_shot=_counts('zero-shot set', card['zero_shot']) if is_zero_shot else None,
        splits=card['splits'],
        cameras=_cameras(read_episode(first, with_masks=False).cameras),
        objects=_objects(entries),
        first=first.name,
        topics=sorted(topics.items()),
        metadata_name=METADATA_NAME,
        metadata=bag.metadata[METADATA_NAME],
        meanings=KEYS,
    )


def write_readme(out: Path, card: Mapping[str, Any], entries: Sequence[CardEntry]) -> None:
    """Write `README.md`, whole or not at all."""
    write_file(out / README_FILE, readme(out, card, entries).encode())
