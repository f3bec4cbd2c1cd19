"""The plan of one pick-and-place move, which faults change: way points, directions, draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.way_points import FLAT, ring, Stops, UP, WayPoint

#: phases of a grasp, with the way down to it
GRASP = ('above', 'grasp', 'close')
#: way points of a grasp from the first one
GRASP_FROM_START = ('start', 'grasp', 'close')
#: an object nearer to the grasp than this is the grasped one [m]
OWN_M = 0.06


@dataclass(frozen=True, slots=True, kw_only=True)
class Draws:
    """Random draws for a faulty move: side, direction and errors of way points.

    Attributes:
        yaw: yaw of the grasp [rad]; the fingers travel along it.
        sign: +1 or -1.
        angle: angle of a direction in the plane [rad].
        errors: (N, 3) errors of way points, standard normal.
        openings: (N,) errors of the gripper openings, standard normal.
        rng: generator of what is drawn anew for every plan that is tried.
        objects: (3,) centre of every object of the scene [m].
        other_home: (3,) rest position of another arm's tool [m].
    """

    yaw: float
    sign: float
    angle: float
    errors: FloatArray
    openings: FloatArray
    rng: np.random.Generator
    objects: Sequence[FloatArray]
    other_home: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class MovePlan:
    """Way points of one move, and the random draws for it.

    Methods that change way points return another plan. Way points go by name: `start` is the
    first, `carry_end` the last before the object is lowered, `over` the one from which it is
    lowered, and a phase stands for the first of its way points.

    Attributes:
        stops: way points; the last is where the arm rests.
        draws: random draws for the move.
    """

    stops: Stops
    draws: Draws

    @property
    def rng(self) -> np.random.Generator:
        """Generator of what is drawn anew for every plan that is tried."""
        return self.draws.rng

    @property
    def floor(self) -> float:
        """Height of the lowest way point [m]."""
        return min(stop.position[2] for stop in self.stops)

    @property
    def rest(self) -> FloatArray:
        """Position (3,) at which the arm rests [m]."""
        return self.stops[-1].position

    def index(self, name: str) -> int:
        """Return the number of a way point."""
        match name:
            case 'start':
                return 0
            case 'carry_end':
                return self.index('lower') - 1
            case 'over':
                return max(self.index('open') - 2, 0)
        return next(i for i, stop in enumerate(self.stops) if stop.phase == name)

    def after(self, name: str) -> int:
        """Return the number of the place behind a way point."""
        return self.index(name) + 1

    def reach(self, stop: WayPoint) -> float:
        """Return the horizontal distance of a way point from the arm's rest [m]."""
        return float(np.linalg.norm((stop.position - self.rest)[:2]))

    def number_of(self, stop: WayPoint) -> int:
        """Return the number of a way point."""
        return next(i for i, other in enumerate(self.stops) if other is stop)

    def like(self, name: str, **changes: Any) -> WayPoint:
        """Return a copy of a way point, with other values of its fields."""
        return replace(self.stops[self.index(name)], **changes)

    def position(self, name: str) -> FloatArray:
        """Return the position (3,) of a way point [m]."""
        return self.stops[self.index(name)].position

    def seconds(self, name: str) -> float | None:
        """Return the duration of the segment to a way point [s]."""
        return self.stops[self.index(name)].seconds

    def opening(self, name: str) -> float:
        """Return the opening of the gripper at a way point, 0..1."""
        return self.stops[self.index(name)].opening

    def between(self, begin: str, end: str) -> FloatArray:
        """Return the way (3,) between two way points [m]."""
        return self.position(end) - self.position(begin)

    def edit(
        self, names: Sequence[str] | range, change: Callable[[WayPoint], WayPoint]
    ) -> MovePlan:
        """Return the plan with some way points changed.

        Args:
            names: phases, of which all way points are changed, `start`, `carry_end`, `all`, or
                `moving` (all but the last); or numbers.
            change: returns the way point in place of another one.
        """
        numbers = names if isinstance(names, range) else self._numbers(names)
        stops = [change(s) if k in numbers else s for k, s in enumerate(self.stops)]
        return replace(self, stops=stops)

    def _numbers(self, names: Sequence[str]) -> set[int]:
        if 'all' in names or 'moving' in names:
            return {*range(len(self.stops) - ('moving' in names))}
        single = {self.index(name) for name in names if name in ('start', 'carry_end')}
        return single | {k for k, stop in enumerate(self.stops) if stop.phase in names}

    def span(self, first: str, last: str) -> range:
        """Return the numbers of the way points from one to another."""
        return range(self.index(first), self.index(last) + 1)

    def shift(self, names: Sequence[str] | range, way: FloatArray) -> MovePlan:
        """Return the plan with some way points shifted by (3,) [m]; see `edit`."""
        return self.edit(names, lambda stop: stop.moved(way))

    def insert(self, at: int, stops: Stops, drop: int = 0) -> MovePlan:
        """Return the plan with more way points, in place of `drop` that follow."""
        return replace(self, stops=[*self.stops[:at], *stops, *self.stops[at + drop :]])

    # directions: unit vectors (3,) in the plane; of the move, or drawn anew for every plan

    @property
    def along(self) -> FloatArray:
        """Direction of the fingers' travel, to the side of the move."""
        return self.draws.sign * ring(self.draws.yaw)

    @property
    def across(self) -> FloatArray:
        """Direction across the fingers' travel, to the side of the move."""
        return self.draws.sign * left_of(ring(self.draws.yaw))

    @property
    def anywhere(self) -> FloatArray:
        """Direction of the move: any."""
        return ring(self.draws.angle)

    def drawn(self) -> FloatArray:
        """Draw any direction."""
        return ring(self.rng.uniform(0.0, 2 * np.pi))

    def side(self) -> float:
        """Draw +1 or -1."""
        return float(self.rng.choice((-1.0, 1.0)))

    def towards(
        self, begin: str, end: str, size: float, otherwise: Callable[[], FloatArray]
    ) -> FloatArray:
        """Return the direction from one way point to another.

        Args:
            begin: name of the first way point.
            end: name of the second one.
            size: distance up to which they are at the same place [m].
            otherwise: gives the direction then.
        """
        way = self.between(begin, end) * FLAT
        distance = float(np.linalg.norm(way))
        return way / distance if distance > size else otherwise()

    def to_goal(self, size: float) -> FloatArray:
        """Return the direction from the grasp to the goal; any where these are within `size`."""
        return self.towards('grasp', 'lower', size, lambda: self.anywhere)

    def to_goal_or_drawn(self, size: float) -> FloatArray:
        """Return the direction from the grasp to the goal; drawn where these are within `size`."""
        return self.towards('grasp', 'lower', size, self.drawn)

    @property
    def to_other_arm(self) -> FloatArray:
        """Direction from the arm's rest to the other arm's; zero without another arm."""
        other = self.draws.other_home
        return np.zeros(3) if other is None else unit((other - self.rest) * FLAT)

    # ways (3,) [m]

    @property
    def rise(self) -> FloatArray:
        """Way from the grasp to the first way point."""
        return self.between('grasp', 'start')

    @property
    def carry_way(self) -> FloatArray:
        """Way in the plane on which the object is carried."""
        return self.between('lift', 'lower') * FLAT

    @property
    def lift_down(self) -> FloatArray:
        """Way down from the lift to the grasp."""
        return self.between('lift', 'close') * UP

    @property
    def to_other_object(self) -> FloatArray:
        """Way in the plane from the grasp to the nearest other object; zero without one."""
        ways = [(place - self.position('close')) * FLAT for place in self.draws.objects]
        others = [way for way in ways if np.linalg.norm(way) > OWN_M]
        return min(others, key=np.linalg.norm, default=np.zeros(3))


def left_of(way: FloatArray) -> FloatArray:
    """Return a way (3,) in the plane, turned to the left."""
    return np.array([-way[1], way[0], 0.0])


def unit(way: FloatArray) -> FloatArray:
    """Return the unit vector of a way; none where there is no way."""
    return way / max(float(np.linalg.norm(way)), 1e-9)


def shortened(way: FloatArray, size: float) -> FloatArray:
    """Return the unit vector of a way, or less where that is shorter than the size."""
    return way / max(float(np.linalg.norm(way)), size)
