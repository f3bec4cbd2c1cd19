"""Programs that edit the way points of one pick-and-place move, as `config/faults` has them.

A program is a list of steps; each names a primitive and says where and by how much. A length is a
number, `size` (of the fault), or [a, b] for a + b * size; docs/ranking.md has the language.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np

from mtv_world_ros.simulation.expert.way_points import Draws, Stops, WayPoint
from mtv_world_ros.simulation.faults.edited_move import By, EditedMove
from mtv_world_ros.simulation.faults.random_edits import RANDOM_EDITS

#: a program of `config/faults`: steps of one primitive and its options
Program = Sequence[Mapping[str, Mapping[str, Any]]]
#: distance of pushing fingers behind the object's centre at the start of a push [m]
_PUSH_START_M = 0.07
#: distance of the tool from the end of a push: half a finger and half a small object lie between
#: the tool and the object's centre [m]
_PUSH_END_M = 0.03
_KEPT: Any = object()
#: options of a row: what `changed` takes
ROW = ('place', 'by', 'phase', 'seconds', 'opening', 'yaw', 'lean')


def _number(spec: Any, old: float, move: EditedMove, stop: WayPoint, weight: float) -> float:
    """Return an opening, yaw or lean: a length, or a change of the old value."""
    if not isinstance(spec, dict):
        return move.length(spec)
    old = move.stop(spec['like']).opening if 'like' in spec else old
    match spec:
        case {'least': value}:
            return max(old, min(move.length(value), 1.0))  # of openings: it opens no further
        case {'times': value}:
            return old * move.length(value)
        case {'add': value, 'side': side}:
            return old + weight * move.side(side) * move.length(value)
        case {'noise': value}:
            error = move.draws.openings[move.number_of(stop)]
            return float(np.clip(old + move.length(value) * error, 0.0, 1.0))
    return old


def changed(
    stop: WayPoint,
    move: EditedMove,
    factor: float = 1.0,
    weight: float = 1.0,
    *,
    place: str = '',
    by: By | None = None,
    phase: str = '',
    seconds: Any = _KEPT,
    **shape: Any,
) -> WayPoint:
    """Return a copy of a way point, changed by a row of a program.

    Args:
        stop: way point that is copied.
        move: the move that it belongs to.
        factor: factor of the lengths in `by`.
        weight: factor of the lengths in `by` and of angles that are added.
        place: name of the place that it is moved to.
        by: displacement, as lengths by direction [m].
        phase: phase of the move.
        seconds: time of the way point [s]; the name of a way point = as long as that one.
        **shape: `opening`, `yaw` and `lean`.
    """
    new = replace(stop, position=move.place(place)) if place else stop
    if by:
        new = new.moved(weight * move.way(by, stop, factor))
    values: dict[str, Any] = {
        key: _number(spec, getattr(stop, key), move, stop, weight) for key, spec in shape.items()
    }
    if seconds is not _KEPT:
        is_name = isinstance(seconds, str) and seconds != 'size'
        values['seconds'] = move.stop(seconds).seconds if is_name else seconds
    if isinstance(seconds, list):
        values['seconds'] = move.length(seconds)
    return replace(new, **values, **({'phase': phase} if phase else {}))


def edit(
    move: EditedMove,
    *,
    phases: Sequence[str] = (),
    span: Sequence[str] = (),
    weight: str = '',
    **row: Any,
) -> None:
    """Change way points: by phase or name, `moving` (all but the last), `all`, or a span."""
    numbers = range(len(move.stops) - ('moving' in phases))
    if span:
        first, last = map(move.index, span)
        numbers = range(first, last + 1)
    named = {move.index(name) for name in phases if name in ('start', 'carry_end')}
    stops = []
    for number, stop in enumerate(move.stops):
        is_meant = number in named or stop.phase in phases or span or {'all', 'moving'} & {*phases}
        if number in numbers and is_meant:
            share = WEIGHTS[weight](move, number) if weight else 1.0
            stop = changed(stop, move, 1.0, share, **row)
        stops.append(stop)
    move.stops = stops


def insert(
    move: EditedMove,
    *,
    at: str,
    rows: Sequence[Mapping[str, Any]],
    like: str = 'grasp',
    repeat: Sequence[float | str] = (1,),
    drop: int = 0,
    **base: Any,
) -> None:
    """Insert way points: copies of a named one, or of the `last`, each changed by a row.

    `base` changes all new way points. Rows are repeated with shorter paths; the `drop` way points
    that follow are removed.
    """
    move.put(at, made_of(move, rows, like, repeat, base), drop)


def made_of(
    move: EditedMove,
    rows: Sequence[Mapping[str, Any]],
    like: str,
    repeat: Sequence[float | str],
    base: Mapping[str, Any],
) -> Stops:
    """Return the way points of the rows."""
    made: Stops = []
    for factor in repeat:
        for row in rows:
            name, changes = row.get('like', like), {k: v for k, v in row.items() if k != 'like'}
            origin = made[-1] if name == 'last' else changed(move.stop(name), move, **base)
            made.append(changed(origin, move, float(Fraction(factor)), **changes))
    return made


def push(
    move: EditedMove,
    *,
    at: str,
    to: By,
    rise: By,
    like: str = 'grasp',
    far: Any = 'size',
    before: Any = 0.0,
    stroke: float | None = None,
    **base: Any,
) -> None:
    """Push an object with closed fingers: four way points behind it, along the push, and above.

    They come `before` farther off and go `far` past where it is; `stroke` is the push's time [s].
    """
    stop = move.stop(like)
    way = move.way(to, stop)
    stop = changed(stop, move, phase='above', opening=0.0, **base)
    away = -(move.length(before) + _PUSH_START_M) * way
    end = (move.length(far) - _PUSH_END_M) * way
    up = move.way(rise, stop)
    rows = [stop.moved(away + up), stop.moved(away), stop.moved(end), stop.moved(end + up)]
    if stroke is not None:
        rows[2] = replace(rows[2], seconds=stroke)
    move.put(at, rows)


def shake(move: EditedMove, *, at: str, to: str, times: int, **row: Any) -> None:
    """Move to both sides of the previous way point by `size` and back, several times."""
    stop = changed(move.stops[move.at(at) - 1], move, **row)
    way = move.size * move.way({to: 1}, stop)
    move.put(at, [*(stop.moved(side * way) for side in (1, -1) * times), stop])


def rock(move: EditedMove, *, at: str, times: int = 3, least: float = 0.6, **row: Any) -> None:
    """Lean to both sides at the previous way point, by random angles up to `size`, and back."""
    stop = changed(move.stops[move.at(at) - 1], move, **row)
    left, right = move.size * move.draws.play.uniform(least, 1.0, 2)
    leans = (stop.lean + lean for lean in (*(left, -right) * times, 0.0))
    move.put(at, [replace(stop, lean=lean, seconds=0.2) for lean in leans])


def circle(
    move: EditedMove,
    *,
    at: str,
    radius: Sequence[Any],
    begin: str,
    sense: str,
    seconds: float,
    arc: Sequence[Any] = (0.0, 2 * np.pi),
    count: int = 9,
    turns: bool = False,
    shut: bool = False,
) -> None:
    """Circle around the grasp, from one radius to another, after a descent with closed fingers."""
    play, (first, last) = move.draws.play, map(move.length, radius)
    angle = play.uniform(0.0, 2 * np.pi) if begin == 'drawn' else move.draws.angle
    angles = move.side(sense) * np.linspace(move.length(arc[0]), move.length(arc[1]), count)
    far = first + (last - first) * np.linspace(0.0, 1.0, count)
    ways = far * np.array([np.cos(angle + angles), np.sin(angle + angles), 0 * angles])
    grasp = replace(move.stop('grasp'), phase='above')
    ring = [
        replace(grasp, seconds=seconds, yaw=grasp.yaw + turns * turn).moved(way)
        for turn, way in zip(angles, ways.T, strict=True)
    ]
    if shut:
        rise = move.way({'rise': 1}, grasp)
        ring = [replace(stop, opening=0.0) for stop in ring]
        ring[0] = replace(ring[0], seconds=None)
        over, left = (replace(stop, seconds=None).moved(rise) for stop in (ring[0], ring[-1]))
        ring = [over, *ring, left]
    else:
        ring.append(replace(grasp, seconds=seconds))
    move.put(at, ring)


def release_on_the_way(move: EditedMove) -> None:
    """Open the gripper before the last `size` of the path from the lift to the goal."""
    stops, (begin, end) = move.stops, map(move.index, ('lift', 'lower'))
    at = begin + (1 - move.size) * (end - begin)
    number = min(int(at), end - 1)
    share = at - number
    here, after = stops[number : number + 2]
    place = here.position + share * (after.position - here.position)
    point = replace(after, position=place, yaw=here.yaw + share * (after.yaw - here.yaw))
    let_go = [point, replace(point, opening=1.0, seconds=0.3)]
    is_held = ('lift', 'carry', 'lower', 'open')
    rest = (replace(s, opening=1.0) if s.phase in is_held else s for s in stops[number + 1 :])
    move.stops = [*stops[: number + 1], *let_go, *rest]


def _reach(move: EditedMove, number: int) -> float:
    return float(np.linalg.norm((move.stops[number].position - move.stops[-1].position)[:2]))


def _reach_share(move: EditedMove, number: int) -> float:
    return _reach(move, number) / max(_reach(move, k) for k in range(len(move.stops)))


def _height(move: EditedMove, number: int) -> float:
    return float(move.stops[number].position[2] - move.stop('grasp').position[2])


def _carried(move: EditedMove, number: int) -> float:
    pairs = pairwise(move.stops[move.index('lift') - 1 : number + 1])
    return sum(float(np.linalg.norm((b.position - a.position)[:2])) for a, b in pairs)


#: weights of an edit by way point [m], or as shares
WEIGHTS: Mapping[str, Callable[[EditedMove, int], float]] = {
    'reach': _reach,
    'reach_share': _reach_share,
    'height': _height,
    'carried': _carried,
}


PRIMITIVES: Mapping[str, Callable[..., None]] = {
    **{step.__name__: step for step in (edit, insert, push, shake, rock, circle)},
    'release_on_the_way': release_on_the_way,
    **RANDOM_EDITS,
}


def edited(program: Program, stops: Stops, size: float, draws: Draws) -> Stops:
    """Return the way points of a move, changed by a program."""
    move = EditedMove(stops, size, draws)
    for step in program:
        for name, options in step.items():
            PRIMITIVES[name](move, **options)
    return move.stops
