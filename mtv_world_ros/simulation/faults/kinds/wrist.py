"""Faults of scripted policies: how the tool is turned."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from mtv_world_ros.simulation.faults.actions import rock
from mtv_world_ros.simulation.faults.commands import lag
from mtv_world_ros.simulation.faults.fault import Family, FaultSize, GRIPPER
from mtv_world_ros.simulation.faults.move_plan import GRASP, MovePlan

fault = Family('wrist')


@fault.way_points('turn', FaultSize(0.8, 1.6, (0.8,), 'rad'))
def grasp_yaw(move: MovePlan, size: float) -> MovePlan:
    """The wrist is turned about the vertical."""
    return move.edit(GRASP, lambda stop: stop.turned(yaw=move.draws.sign * size))


@fault.way_points('lean', FaultSize(0.4, 0.9, (0.3, 0.45), 'rad'))
def grasp_lean(move: MovePlan, size: float) -> MovePlan:
    """The wrist leans in a grasp."""
    return move.edit(GRASP, lambda stop: stop.turned(lean=move.draws.sign * size))


@fault.way_points('scoop', FaultSize(0.6, 0.9, (0.57, 0.6), 'rad'))
def approach_lean(move: MovePlan, size: float) -> MovePlan:
    """It comes down leaning, upright as the fingers close."""
    lean = move.side() * size
    return move.edit(('above', 'grasp'), lambda stop: stop.turned(lean=lean))


fault.commands(
    'wrist_lag',
    'limp',
    FaultSize(0.2, 1, (0.2, 0.22), 's'),
    partial(lag, joints='wrists'),
    'time constant with which the joints of the wrist follow',
    split='calibrate',
)


@fault.way_points(
    'nod', FaultSize(0.5, 0.6, (0.4, 0.5), 'rad'), split='calibrate', keeps_tempo=True
)
def rocking_before_grasp(move: MovePlan, size: float) -> MovePlan:
    """Down at the object, it leans to and fro, up to this far, before the fingers close."""
    at = move.index('close')
    down = replace(move.stops[at - 1], phase='above')
    return move.insert(at, rock(down, size, move.rng))


@fault.way_points('rock', FaultSize(0.45, 0.6, (0.42, 0.48), 'rad'), needs=GRIPPER)
def rocking_before_release(move: MovePlan, size: float) -> MovePlan:
    """The held object rocks on its goal by up to this angle before it is released."""
    at = move.index('open')
    return move.insert(at, rock(move.stops[at - 1], size, move.rng))


@fault.way_points('list', FaultSize(0.65, 0.9, (0.6, 0.7), 'rad'))
def lean_with_reach(move: MovePlan, size: float) -> MovePlan:
    """The wrist leans with the reach of its arm, by this angle where it reaches farthest."""
    side, farthest = move.side(), max(map(move.reach, move.stops))
    return move.edit(
        ('all',), lambda stop: stop.turned(lean=move.reach(stop) / farthest * side * size)
    )


@fault.way_points(
    'flap', FaultSize(0.8, 0.9, (0.75, 0.9), 'rad'), split='test', needs=GRIPPER, keeps_tempo=True
)
def rocking_after_release(move: MovePlan, size: float) -> MovePlan:
    """Having let go, the wrist leans to and fro where it is, four times, up to this far."""
    leans = rock(move.like('open', phase='retreat'), size, move.rng, times=4, least=0.3)
    return move.insert(move.after('open'), leans)
