"""Faults of scripted policies: how fast and how smoothly the robot moves."""

from __future__ import annotations

from functools import partial

from mtv_world_ros.simulation.faults.actions import push, shake
from mtv_world_ros.simulation.faults.commands import (
    average,
    error,
    freeze,
    hold_all,
    hurry,
    kicks,
    limit_speed,
    pause,
    spikes,
    stop,
    swing,
    tempo,
)
from mtv_world_ros.simulation.faults.fault import Family, FaultSize, GRIPPER
from mtv_world_ros.simulation.faults.move_plan import MovePlan

fault = Family('speed', 'calibrate')

fault.commands(
    'motion_slow',
    'slow',
    FaultSize(0.25, 3, (0.25,)),
    partial(tempo, faster=False),
    'it takes this share longer and is cut off',
    split='train',
    contact=False,
)

fault.commands(
    'motion_stops',
    'stop',
    FaultSize(0.5, 1, (0.5,), none=1),
    stop,
    'share of the plan after which the arms stand still; 0 = they never move',
    split='train',
    contact=False,
)

fault.commands(
    'motion_fast',
    'fast',
    FaultSize(1, 3, (2, 3)),
    partial(tempo, faster=True),
    'it is this share faster',
)

fault.commands(
    'commands_frozen',
    'freeze',
    FaultSize(0.9, 3, (0.7, 1), 's'),
    freeze,
    'commands of this length are lost, three times',
)

fault.commands(
    'arms_pause',
    'stall',
    FaultSize(0.8, 3, (0.4, 1.2), 's'),
    pause,
    'the arms stand still for a while, the grippers do not',
    split='train',
)

fault.commands(
    'commands_smoothed',
    'smooth',
    FaultSize(1.5, 3, (1.5, 1.6), 's'),
    average,
    'the commands of the arms are averaged over this long',
)

fault.commands(
    'joint_spikes',
    'spike',
    FaultSize(0.3, 1, (0.25, 0.3), 'rad'),
    partial(error, of=spikes),
    'standard deviation of short outliers of every joint',
)

fault.commands(
    'commands_seldom',
    'choppy',
    FaultSize(0.6, 2, (0.5, 0.7), 's'),
    hold_all,
    'it gets a command this seldom, and jumps to it',
)

fault.commands(
    'arms_oscillate',
    'ring',
    FaultSize(0.9, 3, (0.9, 0.95), 's'),
    swing,
    'period with which the arms swing about their commands',
)

fault.commands(
    'joint_speed_limited',
    'sluggish',
    FaultSize(0.67, 0.95, (0.67, 0.69)),
    limit_speed,
    'share that lacks of the top speed of every arm joint; the grippers are in time',
)


@fault.way_points(
    'waggle',
    FaultSize(0.1, 0.12, (0.09, 0.1), 'm'),
    split='train',
    needs=GRIPPER,
    keeps_tempo=True,
)
def waved_after_lift(move: MovePlan, size: float) -> MovePlan:
    """Once lifted, it waves what it holds to and fro, this far."""
    stop = move.like('lift', phase='carry', seconds=0.2)
    return move.insert(move.after('lift'), shake(stop, size * move.drawn(), times=4))


fault.commands(
    'fast_while_holding',
    'hurl',
    FaultSize(5, 9, (5, 6)),
    hurry,
    'all is this share faster for as long as a gripper is shut',
    needs=GRIPPER,
)


@fault.way_points(
    'swat',
    FaultSize(0.01, 0.1, (0.005, 0.01), 'm'),
    split='train',
    needs=GRIPPER,
    keeps_tempo=True,
)
def struck_before_grasp(move: MovePlan, size: float) -> MovePlan:
    """Shut fingers hit the object in one quick stroke, this far."""
    stops = push(move.like('grasp'), move.drawn(), move.rise, far=size, stroke_s=0.3)
    return move.insert(0, stops)


fault.commands(
    'arm_jerks_at_grip',
    'kick',
    FaultSize(0.06, 0.3, (0.05, 0.08), 'rad'),
    partial(error, of=kicks),
    'standard deviation of how far an arm jerks as its gripper opens or closes',
    split='train',
    needs=GRIPPER,
)
