"""Fault kinds composed from a seed: changes with a drawn phase, direction and size.

A drawn kind is called `drawn_SEED_NUMBER`, and its name alone gives it again. It belongs to the
split `test`: nothing learns from it. A kind `drawn_contact_SEED_NUMBER` changes a grasp, a hold or
a release a little, so that what is touched decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
import re

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.faults.commands import (
    CommandChange,
    delay,
    delay_each,
    error,
    give_way,
    gripper_errors,
    haste,
    jump,
    lag,
    lead,
    limit_speed,
    offsets,
    order_of,
    pause,
    quantise,
    reach,
    tremors,
)
from mtv_world_ros.simulation.faults.fault import FaultKind, FaultSize, GRIPPER
from mtv_world_ros.simulation.faults.move_plan import GRASP, MovePlan
from mtv_world_ros.simulation.way_points import UP

#: kinds of a set
NUM_DRAWN = 12
#: sizes of a drawn kind: factors of the sampled size
SIZE = FaultSize(1.0, 3.0, (0.6, 1.2))
_NAME = re.compile(r'(drawn|drawn_contact)_(\d{1,9})_(\d{1,3})')
#: sets that a seed draws
DRAWN_SETS = ('drawn', 'drawn_contact')


class _Directions:
    """Directions (3,) of a kind in one plan: each is drawn once."""

    def __init__(self) -> None:
        self._known: dict[str, FloatArray] = {}
        self._side = 0.0

    def of(self, name: str, move: MovePlan) -> FloatArray:
        """Return a direction by name."""
        if name not in self._known:
            self._known[name] = _DIRECTIONS[name](move)
        return self._known[name]

    def side(self, move: MovePlan) -> float:
        """Return +1 or -1."""
        self._side = self._side or move.side()
        return self._side


#: changes way points, by the factor of what was drawn
_Step = Callable[[MovePlan, float, _Directions], MovePlan]
_DIRECTIONS: Mapping[str, Callable[[MovePlan], FloatArray]] = {
    'up': lambda move: UP,
    'along': lambda move: move.along,
    'across': lambda move: move.across,
    'anywhere': lambda move: move.anywhere,
    'drawn': MovePlan.drawn,
    'other': lambda move: move.to_other_object,
}
#: phases of way points that are changed together
_GROUPS = (
    *(GRASP, ('grasp', 'close'), ('close',), ('lift', 'carry')),
    *(('carry', 'lower', 'open', 'retreat'), ('open', 'retreat'), ('retreat',)),
)


@dataclass(frozen=True, slots=True)
class _Moment:
    """Place between way points where others are inserted: like which one, in which phase."""

    text: str
    at: Callable[[MovePlan], int]
    like: str
    phase: str


_MOMENTS = (
    _Moment('start', lambda move: 0, 'grasp', 'above'),
    _Moment('before close', lambda move: move.index('close'), 'grasp', 'above'),
    _Moment('after lift', lambda move: move.after('lift'), 'lift', 'carry'),
    _Moment('before open', lambda move: move.index('open'), 'lower', 'carry'),
    _Moment('after open', lambda move: move.after('open'), 'open', 'retreat'),
    _Moment('after retreat', lambda move: move.after('retreat'), 'retreat', 'retreat'),
)
#: changes of commands: text, change, range of the size
_COMMANDS: tuple[tuple[str, CommandChange, tuple[float, float]], ...] = (
    ('delay', delay, (0.2, 0.8)),
    ('delay opening', partial(delay, only='opening'), (0.3, 1.0)),
    ('lead', lead, (0.2, 0.6)),
    ('lag grippers', partial(lag, joints='grippers'), (0.2, 0.8)),
    ('lag wrists', partial(lag, joints='wrists'), (0.1, 0.3)),
    ('give_way speed', partial(give_way, by=haste), (0.2, 0.6)),
    ('give_way reach', partial(give_way, by=reach), (0.3, 0.7)),
    ('pause', pause, (0.4, 1.2)),
    ('jump', partial(jump, between=(0.2, 0.7), back=True, seconds=0.4), (1.0, 2.0)),
    ('delay_each', delay_each, (0.15, 0.4)),
    ('error offsets', partial(error, of=offsets), (0.02, 0.06)),
    ('error tremors', partial(error, of=tremors), (0.02, 0.04)),
    ('error grippers', partial(error, of=gripper_errors), (0.05, 0.12)),
    ('quantise', quantise, (0.06, 0.14)),
    ('limit_speed', limit_speed, (0.3, 0.3)),
)


def _off(names: Sequence[str], way: str, far: float) -> _Step:
    """Return the step that shifts way points by `far` [m] in a direction."""
    return lambda move, size, ways: move.shift(names, far * size * ways.of(way, move))


def _turned(names: Sequence[str], turn: str, angle: float) -> _Step:
    """Return the step that turns way points by an angle [rad] to a side: `yaw` or `lean`."""

    def step(move: MovePlan, size: float, ways: _Directions) -> MovePlan:
        by = {turn: ways.side(move) * (angle * size)}
        return move.edit(names, lambda stop: stop.turned(**by))

    return step


def _opened(names: Sequence[str], least: float) -> _Step:
    """Return the step that opens the gripper to at least a fraction of its range."""
    return lambda move, size, ways: move.edit(names, lambda stop: stop.opened(least * size))


def _aside(moment: _Moment, way: str, far: float, opening: float) -> _Step:
    """Return the step that inserts a way aside, by `far` [m], and back."""

    def step(move: MovePlan, size: float, ways: _Directions) -> MovePlan:
        there = move.like(moment.like, phase=moment.phase, seconds=None)
        off = replace(there.moved(far * size * ways.of(way, move)), opening=opening)
        return move.insert(moment.at(move), [off, there])

    return step


def _to_and_fro(moment: _Moment, far: float, seconds: float) -> _Step:
    """Return the step that inserts swings by `far` [m], each of some seconds."""

    def step(move: MovePlan, size: float, ways: _Directions) -> MovePlan:
        there = move.like(moment.like, phase=moment.phase, seconds=seconds)
        way = far * size * ways.of('drawn', move)
        return move.insert(moment.at(move), [*(there.moved(s * way) for s in (1, -1, 1)), there])

    return step


#: changes that contact decides: text, range of the size, step by the size
_CONTACT: tuple[tuple[str, tuple[float, float], Callable[[float], _Step]], ...] = (
    ('the grasp is {:g} m off along the fingers', (0.008, 0.025), partial(_off, GRASP, 'along')),
    ('the grasp is {:g} m off across the fingers', (0.008, 0.025), partial(_off, GRASP, 'across')),
    ('the grasp is {:g} m too high', (0.01, 0.035), partial(_off, GRASP, 'up')),
    ('the grasp is turned by {:g} rad', (0.3, 0.9), partial(_turned, GRASP, 'yaw')),
    (
        'the gripper holds at least {:g} open',
        (0.3, 0.8),
        partial(_opened, ('close', 'lift', 'carry', 'lower')),
    ),
    ('on the way down it opens {:g}', (0.5, 1.0), partial(_opened, ('lower',))),
    (
        'while it opens it goes {:g} m aside',
        (0.02, 0.07),
        partial(_off, ('open', 'retreat'), 'anywhere'),
    ),
    (
        'what is held is shaken by {:g} m',
        (0.03, 0.08),
        lambda far: _to_and_fro(_MOMENTS[2], far, 0.2),
    ),
)


def drawn_names(seed: int, drawn: str = 'drawn') -> tuple[str, ...]:
    """Return the names of the kinds of a seed, in one of the sets."""
    return tuple(f'{drawn}_{seed}_{number}' for number in range(NUM_DRAWN))


def is_drawn(name: str) -> bool:
    """Return whether it is the name of a drawn kind."""
    return _NAME.fullmatch(name) is not None


@cache
def drawn_kind(name: str) -> FaultKind:
    """Return the kind of a name.

    It consists of one or two changes of way points, or of one of way points and one of commands,
    or of one of commands. A drawn kind of contact has one change of way points or two different
    ones.
    """
    match = _NAME.fullmatch(name)
    assert match is not None, name
    drawn, seed, number = match[1], int(match[2]), int(match[3])
    rng = np.random.default_rng([seed, number, *([1] if drawn == 'drawn_contact' else [])])
    steps, said = list[_Step](), list[str]()
    commands, scale = None, 1.0
    if drawn == 'drawn_contact':
        for which in rng.choice(len(_CONTACT), int(rng.integers(1, 3)), replace=False):
            text, sizes, step = _CONTACT[which]
            far = _round(rng.uniform(*sizes))
            steps.append(step(far))
            said.append(text.format(far))
    else:
        for is_edit in ((True,), (True, True), (True, False), (False,))[int(rng.integers(4))]:
            if is_edit:
                step, text = _edit(rng)
                steps.append(step)
            else:
                text, commands, sizes = _COMMANDS[int(rng.integers(len(_COMMANDS)))]
                scale = _round(rng.uniform(*sizes))
                text = f'{text} by {scale:g}'
            said.append(text)
    return FaultKind(
        family='drawn',
        split='test',
        size=SIZE,
        text=f'factor of what was drawn: {"; ".join(said)}',
        needs=GRIPPER,
        keeps_tempo=True,
        way_points=partial(_changed, steps) if steps else None,
        commands=commands,
        order=order_of(commands) if commands else 0,
        scale=scale,
    )


def _changed(steps: Sequence[_Step], move: MovePlan, size: float) -> MovePlan:
    ways = _Directions()
    for step in steps:
        move = step(move, size, ways)
    return move


def _edit(rng: np.random.Generator) -> tuple[_Step, str]:
    """Return a change of way points, and its description."""
    way = str(rng.choice(list(_DIRECTIONS)))
    far = _round(rng.uniform(0.2, 0.8) if way == 'other' else rng.uniform(0.015, 0.06))
    group = _GROUPS[int(rng.integers(len(_GROUPS)))]
    moment = _MOMENTS[int(rng.integers(len(_MOMENTS)))]
    angle, opening = _round(rng.uniform(0.2, 0.7)), _round(rng.uniform(0.2, 0.7))
    names = ', '.join(group)
    match int(rng.integers(6)):
        case 0 | 1:
            return _off(group, way, far), f'{names} are {far:g} m off, {way}'
        case 2:
            turn = str(rng.choice(['lean', 'yaw']))
            return _turned(group, turn, angle), f'{turn} of {names} is {angle:g} rad off'
        case 3:
            text = f'the gripper is at least {opening:g} open at {names}'
            return _opened(group, opening), text
        case 4:
            text = f'{moment.text}, it goes {far:g} m aside, {way}, and back'
            return _aside(moment, way, far, float(rng.integers(2))), text
        case _:
            seconds = _round(rng.uniform(0.15, 0.3))
            text = f'{moment.text}, it goes to and fro by {far:g} m'
            return _to_and_fro(moment, far, seconds), text


def _round(value: float) -> float:
    return float(f'{value:.2g}')
