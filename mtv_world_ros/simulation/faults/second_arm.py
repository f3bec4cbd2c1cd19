"""Motion of a second arm during a move of the first arm: a visit to a place, at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from mtv_world_ros.core.config import ListOf, Schema, Wait
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.expert.way_points import Draws, Stops, WayPoint
from mtv_world_ros.simulation.faults.edited_move import EditedMove, FLAT, UP
from mtv_world_ros.simulation.faults.edits import changed, made_of

#: shortest stay where it waits for the other one [s]
_STAYS_S = 0.4
#: standard deviation of the horizontal offset of a roaming arm from an object [m]
_ROAM_OFFSET_M = 0.04
#: minimum height of a roaming arm [m]
_MIN_ROAM_HEIGHT_M = 0.02
#: height above a place from which a roaming arm approaches and to which it retreats [m]
_ROAM_RISE_M = 0.07


class SecondArm(Schema):
    """Visit of a second arm during a move: an entry of `config/faults`.

    Attributes:
        to: name of the place that it visits.
        share: fraction of the path to that place.
        level: whether the share shortens its way in the plane alone.
        like: way point of the first arm that the second arm copies; empty = its own rest position.
        but: changes of that copy.
        rows: way points of the visit, as differences from that copy.
        before: way point of the first arm before which `done` of the rows are done.
        after: way point after which they are done, or a number of way points.
        done: number of rows.
        late: time from there [s].
        waits: the first arm waits at its first way point if the second one takes longer.
        roams: through places near objects, as many as the size says.
        follows: whether it goes to the first arm's places.
    """

    to: str = ''
    share: Annotated[float, Field(ge=0, le=1)] | Literal['size'] = 1.0
    level: bool = False
    like: str = ''
    but: dict[str, Any] = {}
    rows: ListOf[dict[str, Any]] = ()
    before: str = ''
    after: str | int = 0
    done: int = 0
    late: Wait = 0.0
    waits: bool = False
    roams: bool = False
    follows: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Visit:
    """A visit of a second arm in one move.

    Attributes:
        ways: way points of the visit up to the rest position, for a share of the way there.
        share: share of the way that the arm goes; less where the place is out of reach.
        meets: time at which `done` way points are done, from the begin of the move, before scaling
            [s].
        done: number of way points that are done at that time.
        waits: the first arm waits at its first way point if the second one takes longer.
        is_timed: whether that time is that of a way point of the first arm.
    """

    ways: Callable[[float], Stops]
    share: float
    meets: float
    done: int
    waits: bool = False
    is_timed: bool = True


def visit_of(
    spec: SecondArm,
    stops: Stops,
    size: float,
    draws: Draws,
    home: WayPoint,
    times: Sequence[float],
) -> Visit:
    """Return the visit of a second arm during a move of the first arm.

    Args:
        spec: description of its visit.
        stops: way points of the first arm.
        size: the fault's size.
        draws: random draws for the move.
        home: way point at which the second arm rests.
        times: times of the first arm's way points, before scaling [s].
    """
    move = EditedMove(stops, size, draws)
    ways = partial(_rows_of, spec, move, home, times)
    if spec.roams:
        ways = partial(_roaming, _roamed(round(size), draws), home)
    elif spec.follows:
        ways = partial(_following, stops, home, times)
    number = move.index(spec.before) if spec.before else spec.after
    if isinstance(number, str):
        number = move.index(number) + 1
    return Visit(
        ways=ways,
        share=move.length(spec.share),
        meets=sum(times[:number]) + spec.late,
        done=spec.done,
        waits=spec.waits,
        is_timed=bool(spec.before or spec.after),
    )


def _rows_of(
    spec: SecondArm, given: EditedMove, home: WayPoint, times: Sequence[float], share: float
) -> Stops:
    move = EditedMove(given.stops, given.size, given.draws)  # directions are drawn anew
    place = move.place(spec.to)
    there = replace(home, phase='above', position=home.position + share * (place - home.position))
    if spec.level:
        short = (1 - share) * (home.position - place) * FLAT
        there = replace(there, position=place + short)
    if spec.like:
        there = replace(move.stop(spec.like), position=there.position)
    move.there, move.home = there, home
    move.there = changed(there, move, **spec.but)
    rows = []
    for row in spec.rows:
        is_until = row.get('seconds') == 'meanwhile'
        rows.append({**row, 'seconds': _between(move, times)} if is_until else row)
    return [*made_of(move, rows, 'there', (1,), {}), home]


def _between(move: EditedMove, times: Sequence[float]) -> float:
    """Time from where the first arm has closed until it is over its goal [s]."""
    closed = move.index('close')
    over = max(move.index('over'), closed)
    return max(sum(times[closed + 1 : over + 1]), _STAYS_S)


def _roamed(count: int, draws: Draws) -> list[FloatArray]:
    """Return the places (3,) near objects [m], drawn."""
    places, rng = list[FloatArray](), draws.play
    for _ in range(count):
        x, y, z = draws.objects[int(rng.integers(len(draws.objects)))]
        beside = rng.normal(0.0, _ROAM_OFFSET_M, 2)
        places.append(np.array([x + beside[0], y + beside[1], max(z, _MIN_ROAM_HEIGHT_M)]))
    return places


def _roaming(places: Sequence[FloatArray], home: WayPoint, share: float) -> Stops:
    """Through places, low and open, a share of the way to each."""
    low = []
    for place in places:
        begin = home.position * FLAT + place * UP
        at = begin + share * (place - begin)
        low.append(replace(home, phase='above', position=at))
    rise = _ROAM_RISE_M * UP
    return [low[0].moved(rise), *low, low[-1].moved(rise), home]


def _following(stops: Stops, home: WayPoint, times: Sequence[float], share: float) -> Stops:
    """To the same places at the same times, a share of the way to each in the plane."""
    same = [replace(s, seconds=time) for s, time in zip(stops, times, strict=True)]
    moved = [s.moved((1 - share) * (home.position - s.position) * FLAT) for s in same[:-1]]
    return [*moved, replace(home, seconds=times[-1])]
