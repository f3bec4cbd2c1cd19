"""Faults of scripted policies: when things happen."""

from __future__ import annotations

from functools import partial

from mtv_world_ros.simulation.faults.commands import (
    delay,
    delay_each,
    error,
    flinch,
    gripper_tempo,
    jump,
    lag,
    lead,
    lose_steps,
    mix,
    restart,
    seams,
    shuffle,
    slow_noise,
)
from mtv_world_ros.simulation.faults.fault import Family, FaultSize, GRIPPER
from mtv_world_ros.simulation.faults.move_plan import MovePlan
from mtv_world_ros.simulation.way_points import UP

fault = Family('timing')

fault.commands(
    'joint_noise',
    'noise',
    FaultSize(0.04, 0.5, (0.04,), 'rad'),
    partial(error, of=slow_noise),
    'standard deviation of a slow error of every joint',
    family='speed',
)

fault.enter(
    'grasp_missed',
    'miss',
    FaultSize(1, 1, (1,)),
    text='probability of a grasp that closes beside its object',
    family='lateral',
)

fault.commands(
    'gripper_delay',
    'late',
    FaultSize(0.6, 3, (0.6,), 's'),
    delay,
    'the grippers follow this much later',
)

fault.commands(
    'gripper_lead',
    'early',
    FaultSize(0.5, 2, (0.3, 0.5), 's'),
    lead,
    'the grippers go this much ahead',
)


@fault.way_points('hasty', FaultSize(0.03, 0.1, (0.03, 0.05), 'm'))
def rise_while_closing(move: MovePlan, size: float) -> MovePlan:
    """It rises this far while the fingers close."""
    return move.shift(('close',), size * UP)


@fault.way_points('snap', FaultSize(0.045, 0.09, (0.04, 0.045), 'm'))
def close_while_descending(move: MovePlan, size: float) -> MovePlan:
    """The fingers close over the last part of the way down."""
    return move.shift(('grasp',), size * UP)


fault.commands(
    'gripper_lag',
    'soft',
    FaultSize(0.6, 1.5, (0.5, 0.8), 's'),
    partial(lag, joints='grippers'),
    'time constant with which the grippers follow',
)

fault.commands(
    'release_delay',
    'hang',
    FaultSize(0.8, 2, (0.8, 1, 1.2), 's'),
    partial(delay, only='opening'),
    'the gripper opens this much later',
    split='calibrate',
)

fault.commands(
    'commands_repeated',
    'loop',
    FaultSize(2, 4, (2,), 's'),
    partial(jump, between=(0.35, 0.75), back=True, seconds=0.4),
    'commands of this length are repeated once',
)

fault.commands(
    'commands_skipped',
    'skip',
    FaultSize(1.4, 3, (1.2, 1.6), 's'),
    partial(jump, between=(0.15, 0.65), back=False, seconds=0.1),
    'commands of this length are left out',
)

fault.commands(
    'joint_delays',
    'ragged',
    FaultSize(0.3, 2, (0.3, 0.4), 's'),
    delay_each,
    'each arm joint is late, by up to this',
    split='calibrate',
)

fault.commands(
    'chunk_offsets',
    'seams',
    FaultSize(0.8, 2, (0.8, 0.9), 's'),
    seams,
    'every chunk of commands is up to this long off its time',
    split='calibrate',
)

fault.commands(
    'chunks_swapped',
    'shuffle',
    FaultSize(0.8, 2, (0.8, 1), 's'),
    shuffle,
    'two chunks of commands of this length are carried out in the wrong order, once',
    split='calibrate',
)

fault.commands(
    'gripper_tempo',
    'offbeat',
    FaultSize(0.4, 1, (0.35, 0.45)),
    gripper_tempo,
    'share by which the grippers are faster or slower than the arms, at most',
    split='calibrate',
    needs=GRIPPER,
)


@fault.way_points('swoop', FaultSize(0.36, 0.5, (0.3, 0.36), 'm'), needs=GRIPPER)
def close_while_passing(move: MovePlan, size: float) -> MovePlan:
    """It passes its object on a way of up to this length, and the fingers close as it goes."""
    way = move.rng.uniform(-0.5, 0.5) * move.across
    return move.shift(('above', 'grasp'), -size * way).shift(('close', 'lift'), size * way)


fault.commands(
    'arm_reverses_at_grip',
    'flinch',
    FaultSize(0.5, 2, (0.3, 0.5), 's'),
    flinch,
    'once, as a gripper opens or closes, the arms go back this long on their way, and return',
    split='calibrate',
    needs=GRIPPER,
)

fault.commands(
    'commands_mixed_with_past',
    'blur',
    FaultSize(1, 3, (0.9, 1.2), 's'),
    mix,
    'all commands are the mean of those of now and of a while ago, up to this long',
    split='calibrate',
)

fault.commands(
    'steps_lost',
    'lapse',
    FaultSize(0.35, 2, (0.3, 0.4), 's'),
    lose_steps,
    'steps of the arms over this time are lost, once, and never made up for',
)

fault.commands(
    'plan_restarted',
    'restart',
    FaultSize(0.9, 1, (0.8, 1)),
    partial(restart, seconds=0.8),
    'share of the plan up to which it starts all over, once',
    split='calibrate',
)
