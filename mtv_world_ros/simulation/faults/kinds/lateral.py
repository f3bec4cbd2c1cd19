"""Faults of scripted policies: where the tool is in the plane."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.core.transforms import rotation
from mtv_world_ros.simulation.faults.fault import Family, FaultSize, GRIPPER
from mtv_world_ros.simulation.faults.move_plan import GRASP, MovePlan
from mtv_world_ros.simulation.way_points import FLAT, WayPoint

fault = Family('lateral')

fault.enter(
    'object_position_noise',
    'shift',
    FaultSize(0.015, 0.1, (0.015,), 'm'),
    text='standard deviation, in x and y, of where objects are seen',
)


@fault.way_points('aside', FaultSize(0.025, 0.08, (0.025,), 'm'))
def grasp_offset_across(move: MovePlan, size: float) -> MovePlan:
    """A grasp is shifted across the fingers."""
    return move.shift(GRASP, size * move.across)


@fault.way_points('along', FaultSize(0.015, 0.08, (0.012, 0.018, 0.03), 'm'), split='calibrate')
def grasp_offset_along(move: MovePlan, size: float) -> MovePlan:
    """A grasp is shifted along the fingers' travel."""
    return move.shift(GRASP, size * move.along)


@fault.way_points('slide', FaultSize(0.02, 0.08, (0.015, 0.02), 'm'))
def approach_offset_along(move: MovePlan, size: float) -> MovePlan:
    """It comes down this far off along the fingers' travel and moves in while they close."""
    return move.shift(('above', 'grasp'), size * move.along)


@fault.way_points('wander', FaultSize(0.015, 0.08, (0.02,), 'm'))
def way_point_noise(move: MovePlan, size: float) -> MovePlan:
    """Standard deviation of every way point, in x, y, z."""
    floor = move.floor

    def wandering(stop: WayPoint) -> WayPoint:
        x, y, z = size * move.draws.errors[move.number_of(stop)]
        height = stop.position[2]
        return stop.moved(np.array([x, y, max(height + z, floor) - height]))

    return move.edit(('moving',), wandering)


@fault.way_points('askew', FaultSize(0.12, 0.3, (0.12, 0.14), 'rad'), split='calibrate')
def base_turned(move: MovePlan, size: float) -> MovePlan:
    """All places are turned about where the arm rests."""
    angle = move.draws.sign * size
    turn = rotation((0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)))

    def turned(stop: WayPoint) -> WayPoint:
        way = stop.position - move.rest
        return stop.moved(turn @ way - way).turned(yaw=angle)

    return move.edit(('moving',), turned)


@fault.way_points('fence', FaultSize(0.17, 0.6, (0.16, 0.18)))
def reach_limited(move: MovePlan, size: float) -> MovePlan:
    """Share that lacks of how far the arm reaches from where it rests; it stops there."""
    farthest = max(np.linalg.norm((stop.position - move.rest) * FLAT) for stop in move.stops)
    most = (1 - size) * farthest

    def stopped(stop: WayPoint) -> WayPoint:
        way = (stop.position - move.rest) * FLAT
        return stop.moved(-max(1 - most / max(float(np.linalg.norm(way)), most), 0.0) * way)

    return move.edit(('all',), stopped)


@fault.way_points('slope', FaultSize(0.8, 2, (0.7, 1)))
def offset_with_height(move: MovePlan, size: float) -> MovePlan:
    """Share of its height over the grasp by which a place is off, to one side."""
    way, grasp = size * move.drawn(), move.position('grasp')
    return move.edit(('moving',), lambda s: s.moved(float(s.position[2] - grasp[2]) * way))


@fault.way_points('stretch', FaultSize(0.15, 0.3, (0.13, 0.16)), split='calibrate')
def reach_scaled(move: MovePlan, size: float) -> MovePlan:
    """Share by which all places are farther from where the arm rests, or nearer to there."""
    share = move.side() * size
    return move.edit(('all',), lambda s: s.moved(share * ((s.position - move.rest) * FLAT)))


@fault.way_points(
    'hunt', FaultSize(0.04, 0.1, (0.035, 0.045), 'm'), needs=GRIPPER, keeps_tempo=True
)
def swing_while_descending(move: MovePlan, size: float) -> MovePlan:
    """On its way down, it swings from side to side with open fingers, this far."""
    above, down, aside = (
        move.like('start', seconds=0.25),
        move.between('start', 'grasp'),
        size * move.drawn(),
    )
    swings = ((0.2, -1), (0.4, 1), (0.6, -1), (0.8, 1), (1, -1))
    stops = [above.moved(share * down + side * aside) for share, side in swings]
    return move.insert(move.index('grasp'), stops)


@fault.way_points('grid', FaultSize(0.05, 0.15, (0.05, 0.06), 'm'), split='calibrate')
def places_on_grid(move: MovePlan, size: float) -> MovePlan:
    """All places are those of a grid in the plane with cells of this width."""
    return move.edit(
        ('moving',),
        lambda s: s.moved((size * np.rint(s.position / size) - s.position) * FLAT),
    )
