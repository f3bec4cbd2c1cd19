"""Fault kinds composed from a seed: steps with a drawn phase, direction and size.

A drawn kind is called `drawn_SEED_NUMBER`, and its name alone gives it again. It belongs to the
split `test`: nothing learns from it. A kind `drawn_contact_SEED_NUMBER` changes a grasp, a hold or
a release a little, so that what is touched decides.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

#: kinds of a set
NUM_DRAWN = 12
#: the sizes of a drawn kind are factors of what was drawn: in rankings, and the largest
RANKED, LARGEST = (0.6, 1.2), 3.0
_NAME = re.compile(r'(drawn|drawn_contact)_(\d{1,9})_(\d{1,3})')
#: sets that a seed draws
DRAWN_SETS = ('drawn', 'drawn_contact')
#: way points that are changed together; where rows are inserted, like which way point, and in
#: which phase
_GROUPS = (
    *(('above', 'grasp', 'close'), ('grasp', 'close'), ('close',), ('lift', 'carry')),
    *(('carry', 'lower', 'open', 'retreat'), ('open', 'retreat'), ('retreat',)),
)
_MOMENTS = (
    *(('start', 'grasp', 'above'), ('before close', 'grasp', 'above')),
    *(('after lift', 'lift', 'carry'), ('before open', 'lower', 'carry')),
    *(('after open', 'open', 'retreat'), ('after retreat', 'retreat', 'retreat')),
)
_DIRECTIONS = ('up', 'along', 'across', 'anywhere', 'drawn', 'other')
#: primitives of commands, their options, and the range of what is drawn
_COMMANDS: tuple[tuple[str, dict[str, Any], tuple[float, float]], ...] = (
    ('delay', {}, (0.2, 0.8)),
    ('delay', {'only': 'opening'}, (0.3, 1.0)),
    ('lead', {}, (0.2, 0.6)),
    ('lag', {'joints': 'grippers'}, (0.2, 0.8)),
    ('lag', {'joints': 'wrists'}, (0.1, 0.3)),
    ('give_way', {'by': 'speed'}, (0.2, 0.6)),
    ('give_way', {'by': 'reach'}, (0.3, 0.7)),
    ('pause', {}, (0.4, 1.2)),
    ('jump', {'between': [0.2, 0.7], 'back': True, 'seconds': 0.4}, (1.0, 2.0)),
    ('delay_each', {}, (0.15, 0.4)),
    ('error', {'of': 'offsets'}, (0.02, 0.06)),
    ('error', {'of': 'tremors'}, (0.02, 0.04)),
    ('error', {'of': 'grippers'}, (0.05, 0.12)),
    ('quantise', {}, (0.06, 0.14)),
    ('limit_speed', {}, (0.3, 0.3)),
)
#: way points of a grasp, of what is held, and of the way down
_GRASP, _HELD, _DOWN = ('above', 'grasp', 'close'), ('close', 'lift', 'carry', 'lower'), ('lower',)
#: what a drawn kind of contact does, and the range of what is drawn
_CONTACT: tuple[tuple[str, tuple[float, float]], ...] = (
    ('the grasp is {:g} m off along the fingers', (0.008, 0.025)),
    ('the grasp is {:g} m off across the fingers', (0.008, 0.025)),
    ('the grasp is {:g} m too high', (0.01, 0.035)),
    ('the grasp is turned by {:g} rad', (0.3, 0.9)),
    ('the gripper holds at least {:g} open', (0.3, 0.8)),
    ('on the way down it opens {:g}', (0.5, 1.0)),
    ('while it opens it goes {:g} m aside', (0.02, 0.07)),
    ('what is held is shaken by {:g} m', (0.03, 0.08)),
)


def drawn_names(seed: int, drawn: str = 'drawn') -> tuple[str, ...]:
    """Returns the names of the kinds of a seed, in one of the sets."""
    return tuple(f'{drawn}_{seed}_{number}' for number in range(NUM_DRAWN))


def is_drawn(name: str) -> bool:
    """Returns whether it is the name of a drawn kind."""
    return _NAME.fullmatch(name) is not None


def drawn_values(name: str) -> dict[str, Any]:
    """Returns the entry of a drawn kind, as `config/faults` has those of the others.

    Steps are one edit of way points, or two, or one of them and one of commands; of contact one
    edit or two different ones.
    """
    match = _NAME.fullmatch(name)
    assert match is not None, name
    drawn, seed, number = match[1], int(match[2]), int(match[3])
    rng = np.random.default_rng([seed, number, *([1] if drawn == 'drawn_contact' else [])])
    edits, commands, said = [], [], []
    if drawn == 'drawn_contact':
        for which in rng.choice(len(_CONTACT), int(rng.integers(1, 3)), replace=False):
            step, text = _touched(int(which), rng)
            edits.append(step)
            said.append(text)
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
    """A step that changes way points, and its description."""
    way = str(rng.choice(_DIRECTIONS))
    far = _round(rng.uniform(0.2, 0.8) if way == 'other' else rng.uniform(0.015, 0.06))
    group = list(_GROUPS[int(rng.integers(len(_GROUPS)))])
    at, like, phase = _MOMENTS[int(rng.integers(len(_MOMENTS)))]
    where = {'at': at, 'like': like, 'phase': phase}
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


def _touched(which: int, rng: np.random.Generator) -> tuple[dict[str, Any], str]:
    """A step of a kind of contact, and its description."""
    text, (least, most) = _CONTACT[which]
    far = _round(rng.uniform(least, most))
    size = [0.0, far]
    match which:
        case 0 | 1 | 2:
            way = ('along', 'across', 'up')[which]
            step = {'edit': {'phases': list(_GRASP), 'by': {way: size}}}
        case 3:
            step = {'edit': {'phases': list(_GRASP), 'yaw': {'add': size, 'side': 'drawn'}}}
        case 4 | 5:
            held = list(_HELD if which == 4 else _DOWN)
            step = {'edit': {'phases': held, 'opening': {'least': size}}}
        case 6:
            step = {'edit': {'phases': ['open', 'retreat'], 'by': {'anywhere': size}}}
        case _:
            rows = [{'by': {'drawn': [0.0, sign * far]}} for sign in (1, -1, 1)]
            where = {'at': 'after lift', 'like': 'lift', 'phase': 'carry', 'seconds': 0.2}
            step = {'insert': {**where, 'rows': [*rows, {}]}}
    return step, text.format(far)


def _command(rng: np.random.Generator) -> tuple[dict[str, Any], str]:
    """A step that changes commands, and its description."""
    name, options, (least, most) = _COMMANDS[int(rng.integers(len(_COMMANDS)))]
    typical = _round(rng.uniform(least, most))
    of = ' '.join(str(v) for v in options.values() if isinstance(v, str))
    step = {name: {**options, 'scale': typical}}
    return step, f'{name} {of}'.strip() + f' by {typical:g}'


def _round(value: float) -> float:
    return float(f'{value:.2g}')
