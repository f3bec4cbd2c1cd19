"""Actions that several faults consist of: pushes, shakes, rocking, circles around the grasp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.faults.move_plan import MovePlan
from mtv_world_ros.simulation.way_points import Stops, WayPoint

#: distance of pushing fingers behind the object's centre at the start of a push [m]
_PUSH_START_M = 0.07
#: distance of the tool from the end of a push: half a finger and half a small object lie between
#: the tool and the object's centre [m]
_PUSH_END_M = 0.03
#: duration of one lean of a rocking wrist [s]
_ROCK_S = 0.2


def push(
    stop: WayPoint,
    to: FloatArray,
    rise: FloatArray,
    *,
    far: float,
    before: float = 0.0,
    stroke_s: float | None = None,
) -> Stops:
    """Return four way points of closed fingers: above, behind an object, past it, and above.

    Args:
        stop: way point at the object.
        to: direction (3,) of the push.
        rise: way (3,) up, before and after [m].
        far: distance to which the object is pushed past its place [m].
        before: distance by which the push begins and the object lies before its place [m].
        stroke_s: duration of the push [s]; None = by the arm's speed.
    """
    stop = replace(stop, phase='above', opening=0.0)
    away = -(before + _PUSH_START_M) * to
    end = stop.moved((far - _PUSH_END_M) * to)
    if stroke_s is not None:
        end = replace(end, seconds=stroke_s)
    end_up = stop.moved((far - _PUSH_END_M) * to + rise)
    return [stop.moved(away + rise), stop.moved(away), end, end_up]


def shake(stop: WayPoint, way: FloatArray, times: int) -> Stops:
    """Return way points to both sides of a way point, several times, and back at it."""
    return [*(stop.moved(side * way) for side in (1, -1) * times), stop]


def rock(
    stop: WayPoint, size: float, rng: np.random.Generator, *, times: int = 3, least: float = 0.6
) -> Stops:
    """Return a way point leaning to both sides, several times, and as it was.

    Args:
        stop: the way point.
        size: largest lean [rad].
        rng: generator that draws the leans to either side.
        times: number of leans to each side.
        least: smallest lean [fraction of the largest].
    """
    left, right = size * rng.uniform(least, 1.0, 2)
    leans = (stop.lean + lean for lean in (*(left, -right) * times, 0.0))
    return [replace(stop, lean=lean, seconds=_ROCK_S) for lean in leans]


def circle(
    move: MovePlan,
    radius: tuple[float, float],
    first: float,
    angles: FloatArray,
    seconds: float,
    *,
    turns: bool = False,
) -> Stops:
    """Return way points at the height of the grasp on a circle, or a spiral, about it.

    Args:
        move: the move.
        radius: radius at the first and at the last way point [m].
        first: angle at which it begins, from x [rad].
        angles: angles (N,) of the way points from there [rad].
        seconds: duration of a segment [s].
        turns: the tool turns with the circle.
    """
    begin, end = radius
    far = begin + (end - begin) * np.linspace(0.0, 1.0, len(angles))
    ways = far * np.array([np.cos(first + angles), np.sin(first + angles), 0 * angles])
    grasp = move.like('grasp', phase='above')
    return [
        replace(grasp, seconds=seconds, yaw=grasp.yaw + turns * turn).moved(way)
        for turn, way in zip(angles, ways.T, strict=True)
    ]


def circle_shut(
    move: MovePlan,
    radius: tuple[float, float],
    first: float,
    angles: FloatArray,
    seconds: float,
    *,
    turns: bool = False,
) -> Stops:
    """Return a circle of closed fingers, with the way down to it and up again; see `circle`."""
    ring = [
        replace(s, opening=0.0) for s in circle(move, radius, first, angles, seconds, turns=turns)
    ]
    ring[0] = replace(ring[0], seconds=None)
    over, left = (replace(stop, seconds=None).moved(move.rise) for stop in (ring[0], ring[-1]))
    return [over, *ring, left]
