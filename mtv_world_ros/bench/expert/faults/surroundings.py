"""Directions and places by the names that fault programs use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mtv_world_ros.bench.expert.way_points import WayPoint
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.geometry.transforms import rotation

if TYPE_CHECKING:
    from mtv_world_ros.bench.expert.faults.edits import Move

#: objects nearer to where it grasps are the one that it grasps [m]
_OWN_M = 0.06
#: another object by its goal is at most this far from that, and from where its arm rests, or this
#: much farther from there than its goal; one by its own from where its arm rests [m]
_GOAL_M, _ARM_M, _MORE_M = 0.2, 0.27, 0.03
#: the lowest that a tool is carried over where it grasped; how far from its goal shut fingers come
#: down at most under where it lets go; gap over what an object is put on [m]
_LOWEST_M, _UNDER_M, _GAP_M = 0.004, 0.02, 0.005

FLAT, UP = np.array([1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def _ring(angle: float) -> FloatArray:
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _left(way: FloatArray) -> FloatArray:
    return np.array([-way[1], way[0], 0.0])


def _between(move: Move, begin: str, end: str) -> FloatArray:
    return move.stop(end).position - move.stop(begin).position


def _drawn(move: Move) -> FloatArray:
    return _ring(move.draws.play.uniform(0.0, 2 * np.pi))


def _anywhere(move: Move) -> FloatArray:
    return _ring(move.draws.angle)


def _along(move: Move) -> FloatArray:
    return move.draws.sign * _ring(move.draws.yaw)


def _across(move: Move) -> FloatArray:
    return move.draws.sign * _left(_ring(move.draws.yaw))


def _anew(move: Move) -> float:
    return float(move.draws.play.choice((-1.0, 1.0)))


def _towards(move: Move, begin: str, end: str, other: Callable[[Move], FloatArray]) -> FloatArray:
    """Unit vector in the plane to another way point; `other` where it is nearer than the size."""
    way = _between(move, begin, end) * FLAT
    distance = float(np.linalg.norm(way))
    return way / distance if distance > move.size else other(move)


def _to_other(move: Move) -> FloatArray:
    """In the plane from its grasp to the nearest other object; none where there is none."""
    ways = [(place - move.stop('close').position) * FLAT for place in move.draws.objects]
    others = [way for way in ways if np.linalg.norm(way) > _OWN_M]
    return min(others, key=np.linalg.norm, default=np.zeros(3))


def _shortened(way: FloatArray, size: float) -> FloatArray:
    """Unit vector of a way, or less where that is shorter than the size."""
    return way / max(float(np.linalg.norm(way)), size)


def _inwards(move: Move) -> FloatArray:
    way, home = _anywhere(move), move.stops[-1].position
    return -way if float((home - move.stop('retreat').position) @ way) < 0 else way


def _to_floor(move: Move) -> FloatArray:
    height = move.stop('lower').position[2] - move.stop('grasp').position[2]
    return -min(_UNDER_M, max(height, 0.0)) * UP


def _other_arm(move: Move) -> FloatArray:
    """Unit vector in the plane from where its arm rests to where another one does."""
    other = move.draws.other_home
    return np.zeros(3) if other is None else unit((other - move.stops[-1].position) * FLAT)


def unit(way: FloatArray) -> FloatArray:
    """Returns the unit vector of a way; none where there is no way."""
    return way / max(float(np.linalg.norm(way)), 1e-9)


def _wandering(move: Move, stop: WayPoint) -> FloatArray:
    """An error of its own, by the size, but not below the lowest way point."""
    number = next(i for i, other in enumerate(move.stops) if other is stop)
    x, y, z = move.size * move.draws.errors[number]
    floor = min(other.position[2] for other in move.stops)
    return np.array([x, y, max(stop.position[2] + z, floor) - stop.position[2]])


def _lowered(move: Move, stop: WayPoint) -> FloatArray:
    """Lower by the size, but not below where it grasped."""
    floor, z = move.stop('close').position[2] + _LOWEST_M, stop.position[2]
    return (max(z - move.size, min(z, floor)) - z) * UP


def _to_fence(move: Move, stop: WayPoint) -> FloatArray:
    """Back to where it reaches: the size is the share that lacks of its farthest place."""
    home = move.stops[-1].position
    farthest = max(np.linalg.norm((other.position - home) * FLAT) for other in move.stops)
    way, most = (stop.position - home) * FLAT, (1 - move.size) * farthest
    return -max(1 - most / max(float(np.linalg.norm(way)), most), 0.0) * way


def _about_home(move: Move, stop: WayPoint) -> FloatArray:
    """To where it is if all is turned about where the arm rests, by the size."""
    angle = move.draws.sign * move.size / 2
    turn = rotation((0.0, 0.0, np.sin(angle), np.cos(angle)))
    way = stop.position - move.stops[-1].position
    return turn @ way - way


def _to_grid(move: Move, stop: WayPoint) -> FloatArray:
    return (move.size * np.rint(stop.position / move.size) - stop.position) * FLAT


@dataclass(frozen=True, slots=True)
class Way:
    """A direction (3,), or a way; `of_stop`: each way point has its own.

    Attributes:
        make: returns it for a move and a way point.
        of_stop: not the same for all way points.
    """

    make: Callable[[Move, WayPoint], FloatArray]
    of_stop: bool = False


def _way(make: Callable[[Move], FloatArray]) -> Way:
    return Way(lambda move, stop: make(move))


def _same(name: str) -> Callable[[Move], FloatArray]:
    """A direction that another one is made of: both are the same draw."""
    return lambda move: move.way({name: 1}, move.stops[0])


#: directions: up and in the plane, drawn for the move or anew for every plan (`drawn`); and ways
WAYS: Mapping[str, Way] = {
    'up': _way(lambda move: UP),
    'along': _way(_along),
    'across': _way(_across),
    'anywhere': _way(_anywhere),
    'inwards': _way(_inwards),
    'drawn': _way(_drawn),
    'drawn_left': _way(lambda move: _left(_same('drawn')(move))),
    'drawn_along': _way(lambda move: _anew(move) * _along(move)),
    'drawn_across': _way(lambda move: _anew(move) * _across(move)),
    'drawn_share_across': _way(lambda m: m.draws.play.uniform(-0.5, 0.5) * _across(m)),
    'goal': _way(lambda move: _towards(move, 'grasp', 'lower', _anywhere)),
    'goal_left': _way(lambda move: _left(_same('goal')(move))),
    'goal_or_drawn': _way(lambda move: _towards(move, 'grasp', 'lower', _drawn)),
    'backwards': _way(lambda move: _towards(move, 'open', 'grasp', _anywhere)),
    'back': _way(lambda move: _shortened(_between(move, 'lower', 'grasp') * FLAT, move.size)),
    'other_arm': _way(_other_arm),
    'away_from_home': _way(lambda m: unit((m.there.position - m.home.position) * FLAT)),
    'home': _way(lambda m: _shortened((m.home.position - m.there.position) * FLAT, m.size)),
    'descent': _way(lambda move: _between(move, 'start', 'grasp')),
    'rise': _way(lambda move: _between(move, 'grasp', 'start')),
    'retreat_rise': _way(lambda move: _between(move, 'open', 'retreat')),
    'carry_way': _way(lambda move: _between(move, 'lift', 'lower') * FLAT),
    'goal_way': _way(lambda move: _between(move, 'close', 'lower') * FLAT),
    'lift_down': _way(lambda move: _between(move, 'lift', 'close') * UP),
    'other': _way(_to_other),
    'to_floor': _way(_to_floor),
    'over_next': _way(lambda m: (_next_to_goal(m) - m.stop('retreat').position) * FLAT),
    'next_down': _way(lambda m: (_next_to_goal(m) - m.stop('retreat').position) * UP),
    'wandering': Way(_wandering, of_stop=True),
    'lowered': Way(_lowered, of_stop=True),
    'to_fence': Way(_to_fence, of_stop=True),
    'to_grid': Way(_to_grid, of_stop=True),
    'about_home': Way(_about_home, of_stop=True),
    'outwards': Way(lambda m, stop: (stop.position - m.stops[-1].position) * FLAT, of_stop=True),
}


def _distance(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm((a - b)[:2]))


def _next_to_goal(move: Move) -> FloatArray:
    """The other object next to its goal; its goal where its arm is near none."""
    return _object_by_goal(move, move.stop('open').position)


def _object_by_goal(move: Move, other: FloatArray) -> FloatArray:
    own, goal, home = move.stop('close').position, move.stop('open').position, move.stops[-1]
    farthest = max(_ARM_M, _MORE_M + _distance(goal, home.position))
    nears = [
        place
        for place in move.draws.objects
        if _distance(place, own) > _OWN_M
        and _distance(place, goal) < _GOAL_M
        and _distance(place, home.position) < farthest
    ]
    return min(nears, key=lambda place: _distance(place, goal), default=other)


def _on_next_to_goal(move: Move) -> FloatArray:
    """On it, as high as its own was grasped; what lies on the table is twice as high."""
    at = _object_by_goal(move, move.stop('open').position * FLAT)
    return at * (1, 1, 2) + move.stop('close').position[2] * UP


def _next_to_own(move: Move) -> FloatArray:
    """The other object next to its own; where it grasps if its arm is near none."""
    own, home = move.stop('close').position, move.stops[-1].position
    others = [
        place
        for place in move.draws.objects
        if _distance(place, own) > _OWN_M and _distance(place, home) < _ARM_M
    ]
    grasp = move.stop('grasp').position
    return min(others, key=lambda place: _distance(place, own), default=grasp)


def _on_own(move: Move) -> FloatArray:
    grasp = move.stop('grasp').position
    own = min(move.draws.objects, key=lambda place: _distance(place, grasp))
    return own * (1, 1, 2) + (_next_to_own(move)[2] + _GAP_M) * UP


def _nearest_to_goal(move: Move) -> FloatArray:
    """The object nearest to its goal; its own where there is no other."""
    own, goal = move.stop('close').position, move.stop('open').position
    others = [place for place in move.draws.objects if _distance(place, own) > _OWN_M]
    return min(others, key=lambda place: _distance(place, goal), default=own)


#: places (3,) [m], beside those of way points
PLACES: Mapping[str, Callable[[Move], FloatArray]] = {
    'next_to_goal': _next_to_goal,
    'on_next_to_goal': _on_next_to_goal,
    'nearest_to_goal': _nearest_to_goal,
    'next_to_own': _next_to_own,
    'on_own': _on_own,
    'high_beside_own': lambda move: _next_to_own(move) * FLAT + _on_own(move) * UP,
    'half_way': lambda m: (m.stop('close').position + m.stop('over').position) / 2,
}
