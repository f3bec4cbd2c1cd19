"""A pick-and-place move under edit, with its directions and places by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.transforms import rotation
from mtv_world_ros.simulation.expert.way_points import Draws, Stops, WayPoint

#: lengths by direction
By = Mapping[str, Any]
#: an object nearer to the grasp than this is the grasped one [m]
_OWN_M = 0.06
#: maximum distance of a neighbour from the goal [m]
_MAX_GOAL_DISTANCE_M = 0.2
#: maximum distance of a neighbour from the rest position of the arm [m]
_MAX_REACH_M = 0.27
#: a neighbour of the goal may be this much farther from the rest position than the goal [m]
_EXTRA_REACH_M = 0.03
#: minimum height of a carried tool over the grasp [m]
_MIN_CARRY_HEIGHT_M = 0.004
#: maximum depth of closed fingers below the release [m]
_MAX_CLOSED_DEPTH_M = 0.02
#: gap between an object and the object that it is put on [m]
_STACKING_GAP_M = 0.005

#: mask of the horizontal components of a vector
FLAT = np.array([1.0, 1.0, 0.0])
#: unit vector upwards
UP = np.array([0.0, 0.0, 1.0])


class EditedMove:
    """A move under edit: its way points, and what a program refers to by name.

    Attributes:
        stops: way points of the move.
        size: the fault's size.
        draws: random draws for the move.
        end: behind the way points that were inserted last.
        there, home: way points of a second arm: where it works, and where it rests.
    """

    def __init__(self, stops: Stops, size: float, draws: Draws) -> None:
        self.stops, self.size, self.draws = list(stops), size, draws
        self.end = 0
        self.there = self.home = stops[-1]
        self._ways: dict[str, FloatArray] = {}
        self._side = 0.0

    @property
    def floor(self) -> float:
        """Height of the lowest way point [m]."""
        return min(stop.position[2] for stop in self.stops)

    def index(self, name: str) -> int:
        """Return the number of a way point: `start`, `carry_end`, `over`, or a phase's first."""
        match name:
            case 'start':
                return 0
            case 'carry_end':
                return self.index('lower') - 1
            case 'over':
                return max(self.index('open') - 2, 0)
        return next(i for i, stop in enumerate(self.stops) if stop.phase == name)

    def number_of(self, stop: WayPoint) -> int:
        """Return the number of a way point."""
        return next(i for i, other in enumerate(self.stops) if other is stop)

    def stop(self, name: str) -> WayPoint:
        """Return a way point by name."""
        return self.there if name == 'there' else self.stops[self.index(name)]

    def at(self, where: str) -> int:
        """Return where way points are inserted: `start`, `before X`, `after X`, `after last`."""
        if where == 'start':
            return 0
        word, name = where.split()
        return self.end if name == 'last' else self.index(name) + (word == 'after')

    def put(self, where: str, stops: Stops, drop: int = 0) -> None:
        """Insert way points, in place of `drop` that follow."""
        number = self.at(where)
        self.stops = [*self.stops[:number], *stops, *self.stops[number + drop :]]
        self.end = number + len(stops)

    def place(self, name: str) -> FloatArray:
        """Return a place (3,) by name [m]: of an object, or of a way point."""
        return PLACES[name](self) if name in PLACES else self.stop(name).position

    def length(self, value: Any) -> float:
        """Return a length, angle or opening."""
        match value:
            case 'size':
                return self.size
            case [base, share]:
                return base + share * self.size
            case {'normal': deviation}:
                return float(self.draws.play.normal(0.0, deviation))
            case {'side': far}:
                return self.draws.sign * far
            case {'drawn_side': far}:
                return self.side('drawn') * self.length(far)
        return float(value)

    def way(self, by: By, stop: WayPoint, factor: float = 1.0) -> FloatArray:
        """Return a way (3,) as lengths along directions; each of those is drawn once."""
        total = np.zeros(3)
        for name, far in by.items():
            way = self._direction(name, stop)
            total = total + self.length(far) * factor * way
        return total

    def _direction(self, name: str, stop: WayPoint) -> FloatArray:
        """Return a direction or way (3,) by name.

        `drawn_1` and `drawn_2` are two draws of `drawn`.
        """
        of = name.rstrip('_123')
        if of in WAYS_OF_STOPS:
            return WAYS_OF_STOPS[of](self, stop)
        if name not in self._ways:
            self._ways[name] = WAYS[of](self)
        return self._ways[name]

    def side(self, which: str) -> float:
        """Return +1 or -1: the move's, or one that every draw of a plan has anew."""
        if which == 'given':
            return self.draws.sign
        self._side = self._side or float(self.draws.play.choice((-1.0, 1.0)))
        return self._side


OfMove = Callable[[EditedMove], FloatArray]


def ring(angle: float) -> FloatArray:
    """Return the unit vector (3,) in the plane at an angle [rad] from x."""
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _left(way: FloatArray) -> FloatArray:
    return np.array([-way[1], way[0], 0.0])


def _between(move: EditedMove, begin: str, end: str) -> FloatArray:
    return move.stop(end).position - move.stop(begin).position


def _drawn(move: EditedMove) -> FloatArray:
    return ring(move.draws.play.uniform(0.0, 2 * np.pi))


def _anywhere(move: EditedMove) -> FloatArray:
    return ring(move.draws.angle)


def _along(move: EditedMove) -> FloatArray:
    return move.draws.sign * ring(move.draws.yaw)


def _across(move: EditedMove) -> FloatArray:
    return move.draws.sign * _left(ring(move.draws.yaw))


def _anew(move: EditedMove) -> float:
    return float(move.draws.play.choice((-1.0, 1.0)))


def _towards(move: EditedMove, begin: str, end: str, other: OfMove) -> FloatArray:
    """Return the unit vector in the plane between way points.

    `other` if they are within the size.
    """
    way = _between(move, begin, end) * FLAT
    distance = float(np.linalg.norm(way))
    return way / distance if distance > move.size else other(move)


def _to_other(move: EditedMove) -> FloatArray:
    """Return the way in the plane from the grasp to the nearest other object; zero without one."""
    ways = [(place - move.stop('close').position) * FLAT for place in move.draws.objects]
    others = [way for way in ways if np.linalg.norm(way) > _OWN_M]
    return min(others, key=np.linalg.norm, default=np.zeros(3))


def _shortened(way: FloatArray, size: float) -> FloatArray:
    """Return the unit vector of a way, or less where that is shorter than the size."""
    return way / max(float(np.linalg.norm(way)), size)


def _inwards(move: EditedMove) -> FloatArray:
    way, home = _anywhere(move), move.stops[-1].position
    return -way if float((home - move.stop('retreat').position) @ way) < 0 else way


def _to_floor(move: EditedMove) -> FloatArray:
    height = move.stop('lower').position[2] - move.stop('grasp').position[2]
    return -min(_MAX_CLOSED_DEPTH_M, max(height, 0.0)) * UP


def _other_arm(move: EditedMove) -> FloatArray:
    """Return the unit vector in the plane from the arm's rest to the other arm's."""
    other = move.draws.other_home
    return np.zeros(3) if other is None else unit((other - move.stops[-1].position) * FLAT)


def unit(way: FloatArray) -> FloatArray:
    """Return the unit vector of a way; none where there is no way."""
    return way / max(float(np.linalg.norm(way)), 1e-9)


def _wandering(move: EditedMove, stop: WayPoint) -> FloatArray:
    """Return the error of a way point, times the size, not below the lowest way point."""
    x, y, z = move.size * move.draws.errors[move.number_of(stop)]
    return np.array([x, y, max(stop.position[2] + z, move.floor) - stop.position[2]])


def _lowered(move: EditedMove, stop: WayPoint) -> FloatArray:
    """Return the displacement down by the size, not below the grasp."""
    floor, z = move.stop('close').position[2] + _MIN_CARRY_HEIGHT_M, stop.position[2]
    return (max(z - move.size, min(z, floor)) - z) * UP


def _to_fence(move: EditedMove, stop: WayPoint) -> FloatArray:
    """Back into reach: the size is the missing share of the farthest place."""
    home = move.stops[-1].position
    farthest = max(np.linalg.norm((other.position - home) * FLAT) for other in move.stops)
    way, most = (stop.position - home) * FLAT, (1 - move.size) * farthest
    return -max(1 - most / max(float(np.linalg.norm(way)), most), 0.0) * way


def _about_home(move: EditedMove, stop: WayPoint) -> FloatArray:
    """Return the displacement if all is turned about the arm's rest, by the size."""
    angle = move.draws.sign * move.size / 2
    turn = rotation((0.0, 0.0, np.sin(angle), np.cos(angle)))
    way = stop.position - move.stops[-1].position
    return turn @ way - way


def _to_grid(move: EditedMove, stop: WayPoint) -> FloatArray:
    return (move.size * np.rint(stop.position / move.size) - stop.position) * FLAT


def _same(move: EditedMove, name: str) -> FloatArray:
    """Return a direction that another one is derived from: both use the same draw."""
    return move.way({name: 1}, move.stops[0])


#: directions: up and in the plane, drawn for the move or anew for every plan (`drawn`); and ways
WAYS: Mapping[str, OfMove] = {
    'up': lambda move: UP,
    'along': _along,
    'across': _across,
    'anywhere': _anywhere,
    'inwards': _inwards,
    'drawn': _drawn,
    'drawn_left': lambda move: _left(_same(move, 'drawn')),
    'drawn_along': lambda move: _anew(move) * _along(move),
    'drawn_across': lambda move: _anew(move) * _across(move),
    'drawn_share_across': lambda m: m.draws.play.uniform(-0.5, 0.5) * _across(m),
    'goal': lambda move: _towards(move, 'grasp', 'lower', _anywhere),
    'goal_left': lambda move: _left(_same(move, 'goal')),
    'goal_or_drawn': lambda move: _towards(move, 'grasp', 'lower', _drawn),
    'backwards': lambda move: _towards(move, 'open', 'grasp', _anywhere),
    'back': lambda move: _shortened(_between(move, 'lower', 'grasp') * FLAT, move.size),
    'other_arm': _other_arm,
    'away_from_home': lambda m: unit((m.there.position - m.home.position) * FLAT),
    'home': lambda m: _shortened((m.home.position - m.there.position) * FLAT, m.size),
    'descent': lambda move: _between(move, 'start', 'grasp'),
    'rise': lambda move: _between(move, 'grasp', 'start'),
    'retreat_rise': lambda move: _between(move, 'open', 'retreat'),
    'carry_way': lambda move: _between(move, 'lift', 'lower') * FLAT,
    'goal_way': lambda move: _between(move, 'close', 'lower') * FLAT,
    'lift_down': lambda move: _between(move, 'lift', 'close') * UP,
    'other': _to_other,
    'to_floor': _to_floor,
    'over_next': lambda m: (_next_to_goal(m) - m.stop('retreat').position) * FLAT,
    'next_down': lambda m: (_next_to_goal(m) - m.stop('retreat').position) * UP,
}
#: ways that are another one for each way point
WAYS_OF_STOPS: Mapping[str, Callable[[EditedMove, WayPoint], FloatArray]] = {
    'wandering': _wandering,
    'lowered': _lowered,
    'to_fence': _to_fence,
    'to_grid': _to_grid,
    'about_home': _about_home,
    'outwards': lambda m, stop: (stop.position - m.stops[-1].position) * FLAT,
}


def _distance(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm((a - b)[:2]))


def _others(move: EditedMove, own: FloatArray) -> list[FloatArray]:
    return [place for place in move.draws.objects if _distance(place, own) > _OWN_M]


def _next_to_goal(move: EditedMove) -> FloatArray:
    """Return the position of the object next to the goal, else the goal."""
    return _object_by_goal(move, move.stop('open').position)


def _object_by_goal(move: EditedMove, other: FloatArray) -> FloatArray:
    own, goal, home = move.stop('close').position, move.stop('open').position, move.stops[-1]
    farthest = max(_MAX_REACH_M, _EXTRA_REACH_M + _distance(goal, home.position))
    nears = [
        place
        for place in _others(move, own)
        if _distance(place, goal) < _MAX_GOAL_DISTANCE_M
        and _distance(place, home.position) < farthest
    ]
    return min(nears, key=lambda place: _distance(place, goal), default=other)


def _on_next_to_goal(move: EditedMove) -> FloatArray:
    """On top of the object next to the goal, which is twice as high as its centre."""
    at = _object_by_goal(move, move.stop('open').position * FLAT)
    return at * (1, 1, 2) + move.stop('close').position[2] * UP


def _next_to_own(move: EditedMove) -> FloatArray:
    """Return the position of the object next to the grasped one, else the grasp."""
    own, home = move.stop('close').position, move.stops[-1].position
    others = [place for place in _others(move, own) if _distance(place, home) < _MAX_REACH_M]
    grasp = move.stop('grasp').position
    return min(others, key=lambda place: _distance(place, own), default=grasp)


def _on_own(move: EditedMove) -> FloatArray:
    grasp = move.stop('grasp').position
    own = min(move.draws.objects, key=lambda place: _distance(place, grasp))
    return own * (1, 1, 2) + (_next_to_own(move)[2] + _STACKING_GAP_M) * UP


def _nearest_to_goal(move: EditedMove) -> FloatArray:
    """Return the position of the object nearest to the goal, else the grasped one's."""
    own, goal = move.stop('close').position, move.stop('open').position
    return min(_others(move, own), key=lambda place: _distance(place, goal), default=own)


#: named places (3,) [m]; the names of way points are places, too
PLACES: Mapping[str, OfMove] = {
    'next_to_goal': _next_to_goal,
    'on_next_to_goal': _on_next_to_goal,
    'nearest_to_goal': _nearest_to_goal,
    'next_to_own': _next_to_own,
    'on_own': _on_own,
    'high_beside_own': lambda move: _next_to_own(move) * FLAT + _on_own(move) * UP,
    'half_way': lambda m: (m.stop('close').position + m.stop('over').position) / 2,
}
