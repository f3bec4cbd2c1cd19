"""Fault kinds composed from a seed: steps with a drawn phase, direction and size.

A drawn kind is called `drawn_SEED_NUMBER`, and its name alone gives it again. It belongs to the
split `test`: nothing learns from it. A kind `drawn_contact_SEED_NUMBER` changes a grasp, a hold or
a release a little, so that what is touched decides.
"""

from __future__ import annotations

from functools import cache
import re
from typing import Any

import numpy as np

from mtv_world_ros.core.config import read_yaml
from mtv_world_ros.core.files import share_path

#: kinds of a set
NUM_DRAWN = 12
#: sizes of a drawn kind in rankings, as factors of the sampled size
RANKED = (0.6, 1.2)
#: largest size of a drawn kind, as a factor of the sampled size
LARGEST = 3.0
_NAME = re.compile(r'(drawn|drawn_contact)_(\d{1,9})_(\d{1,3})')
#: sets that a seed draws
DRAWN_SETS = ('drawn', 'drawn_contact')


@cache
def _parts() -> dict[str, Any]:
    """Return the parts of drawn kinds: `config/faults/drawn.yaml`."""
    return read_yaml(share_path('config', 'faults', 'drawn.yaml'), 'fault file', 'config/faults')


def drawn_names(seed: int, drawn: str = 'drawn') -> tuple[str, ...]:
    """Return the names of the kinds of a seed, in one of the sets."""
    return tuple(f'{drawn}_{seed}_{number}' for number in range(NUM_DRAWN))


def is_drawn(name: str) -> bool:
    """Return whether it is the name of a drawn kind."""
    return _NAME.fullmatch(name) is not None


def drawn_values(name: str) -> dict[str, Any]:
    """Return the entry of a drawn kind, in the format of the entries of `config/faults`.

    Its steps are one or two edits of way points, or an edit of way points and one of commands.
    A drawn kind of contact has one edit or two different ones.
    """
    match = _NAME.fullmatch(name)
    assert match is not None, name
    drawn, seed, number = match[1], int(match[2]), int(match[3])
    rng = np.random.default_rng([seed, number, *([1] if drawn == 'drawn_contact' else [])])
    edits, commands, said = [], [], []
    if drawn == 'drawn_contact':
        contacts = _parts()['contact']
        for which in rng.choice(len(contacts), int(rng.integers(1, 3)), replace=False):
            far = _round(rng.uniform(*contacts[which]['range']))
            edits.append(_scaled(contacts[which]['step'], far))
            said.append(contacts[which]['text'].format(far))
    else:
        for is_edit in ((True,), (True, True), (True, False), (False,))[int(rng.integers(4))]:
            step, text = _edit(rng) if is_edit else _command(rng)
            (edits if is_edit else commands).append(step)
            said.append(text)
    return {
        'family': 'drawn',
        'split': 'test',
        'size': {'typical': 1.0, 'largest': LARGEST, 'ranked': list(RANKED)},
        'text': f'factor of what was drawn: {"; ".join(said)}',
        'needs': ['gripper'],
        'keeps_tempo': True,
        'edits': edits,
        'commands': commands,
    }


def _edit(rng: np.random.Generator) -> tuple[dict[str, Any], str]:
    """Return a step that changes way points, and its description."""
    parts = _parts()
    way = str(rng.choice(parts['directions']))
    far = _round(rng.uniform(0.2, 0.8) if way == 'other' else rng.uniform(0.015, 0.06))
    group = parts['groups'][int(rng.integers(len(parts['groups'])))]
    where = parts['moments'][int(rng.integers(len(parts['moments'])))]
    at = where['at']
    angle, opening = _round(rng.uniform(0.2, 0.7)), _round(rng.uniform(0.2, 0.7))
    match int(rng.integers(6)):
        case 0 | 1:
            by = f'{", ".join(group)} are {far:g} m off, {way}'
            return {'edit': {'phases': group, 'by': {way: [0.0, far]}}}, by
        case 2:
            turn = str(rng.choice(['lean', 'yaw']))
            text = f'{turn} of {", ".join(group)} is {angle:g} rad off'
            change = {'add': [0.0, angle], 'side': 'drawn'}
            return {'edit': {'phases': group, turn: change}}, text
        case 3:
            text = f'the gripper is at least {opening:g} open at {", ".join(group)}'
            return {'edit': {'phases': group, 'opening': {'least': [0.0, opening]}}}, text
        case 4:
            row = {'by': {way: [0.0, far]}, 'opening': float(rng.integers(2))}
            options = {**where, 'seconds': None, 'rows': [row, {}]}
            return {'insert': options}, f'{at}, it goes {far:g} m aside, {way}, and back'
        case _:
            seconds = _round(rng.uniform(0.15, 0.3))
            rows = [{'by': {'drawn': [0.0, sign * far]}} for sign in (1, -1, 1)]
            options = {**where, 'seconds': seconds, 'rows': [*rows, {}]}
            return {'insert': options}, f'{at}, it goes to and fro by {far:g} m'


def _scaled(step: Any, far: float) -> Any:
    """Return a step whose lengths [0, k] are [0, k * far]."""
    match step:
        case dict():
            return {key: _scaled(value, far) for key, value in step.items()}
        case [0, factor]:
            return [0.0, factor * far]
        case list():
            return [_scaled(value, far) for value in step]
    return step


def _command(rng: np.random.Generator) -> tuple[dict[str, Any], str]:
    """Return a step that changes commands, and its description."""
    commands = _parts()['commands']
    drawn = commands[int(rng.integers(len(commands)))]
    name, options = drawn['step'], drawn.get('options', {})
    typical = _round(rng.uniform(*drawn['range']))
    of = ' '.join(str(v) for v in options.values() if isinstance(v, str))
    step = {name: {**options, 'scale': typical}}
    return step, f'{name} {of}'.strip() + f' by {typical:g}'


def _round(value: float) -> float:
    return float(f'{value:.2g}')
