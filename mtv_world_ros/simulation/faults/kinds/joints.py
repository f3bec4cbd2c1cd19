"""Faults of scripted policies: what joints do with their commands."""

from __future__ import annotations

from functools import partial

from mtv_world_ros.simulation.faults.commands import (
    bind_one,
    drifts,
    error,
    fade,
    gripper_errors,
    limit_one,
    lose_one_way,
    offsets,
    play,
    quantise,
    scale_one,
    slip_one,
    stick,
    stop_one,
    swap_arms,
    tow,
    tremors,
    warp,
)
from mtv_world_ros.simulation.faults.fault import Family, FaultSize, TWO_ARMS

fault = Family('joint', 'calibrate')

fault.commands(
    'joint_offsets',
    'zero',
    FaultSize(0.04, 0.2, (0.06, 0.08), 'rad'),
    partial(error, of=offsets),
    'standard deviation of a constant error of every joint',
)

fault.commands(
    'one_joint_scaled',
    'weak',
    FaultSize(0.25, 0.5, (0.3, 0.4)),
    scale_one,
    'share that lacks of the travel of one joint',
)

fault.commands(
    'joint_tremor',
    'tremble',
    FaultSize(0.03, 0.3, (0.03, 0.04), 'rad'),
    partial(error, of=tremors),
    'amplitude of a fast oscillation of every joint',
)

fault.commands(
    'arms_swap_commands',
    'swap',
    FaultSize(0.4, 1, (0.4, 0.5)),
    swap_arms,
    "share that the arms take of each other's commands, once",
    needs=TWO_ARMS,
)

fault.commands(
    'joints_move_with_gripper',
    'couple',
    FaultSize(0.1, 0.3, (0.1, 0.12), 'rad'),
    partial(error, of=gripper_errors),
    'standard deviation of how far each joint of an arm goes along as its gripper closes',
)

fault.commands(
    'joint_resolution',
    'coarse',
    FaultSize(0.12, 0.4, (0.12, 0.16), 'rad'),
    quantise,
    'every arm joint knows only multiples of this',
)

fault.commands(
    'joint_backlash',
    'lash',
    FaultSize(0.09, 0.4, (0.07, 0.1), 'rad'),
    play,
    'play of every arm joint',
)

fault.commands(
    'one_joint_stops',
    'brake',
    FaultSize(3, 5, (2, 3), 's'),
    stop_one,
    'one joint stands still for this long, the others do not',
)

fault.commands(
    'joints_lose_one_way',
    'ratchet',
    FaultSize(0.1, 0.5, (0.09, 0.11)),
    lose_one_way,
    'share that every joint loses of the way that it turns to one side',
)

fault.commands(
    'one_joint_range_limited',
    'clamp',
    FaultSize(0.2, 0.6, (0.2, 0.25)),
    limit_one,
    'share that lacks at both ends of the travel of one joint, which stops there',
)

fault.commands(
    'joints_coupled',
    'tow',
    FaultSize(0.12, 0.5, (0.11, 0.13)),
    tow,
    'share of its motion by which every joint takes along the next one of its arm',
    split='train',
)

fault.commands(
    'one_joint_slips',
    'cog',
    FaultSize(0.15, 0.5, (0.15, 0.2), 'rad'),
    slip_one,
    'one joint skips by this, once, and is off from there on',
)

fault.commands(
    'one_joint_binds',
    'bind',
    FaultSize(0.3, 1, (0.25, 0.4), 'rad'),
    bind_one,
    'one joint sticks at one place until its command is this far on, and jumps there',
)

fault.commands(
    'joint_drift',
    'drift',
    FaultSize(0.014, 0.2, (0.01, 0.014), 'rad/s'),
    partial(error, of=drifts),
    'standard deviation of how fast every arm joint drifts off',
)

fault.commands(
    'joint_nonlinearity',
    'warp',
    FaultSize(0.05, 0.5, (0.045, 0.055), 'rad'),
    warp,
    'every arm joint is off by a wave over its angle, with this amplitude',
)

fault.commands(
    'joint_range_fades',
    'wane',
    FaultSize(0.2, 0.5, (0.18, 0.22)),
    fade,
    'share that all arm joints lack of their travel at the end; at first they lack none',
)

fault.commands(
    'joint_stiction',
    'stick',
    FaultSize(0.06, 0.4, (0.055, 0.06), 'rad'),
    stick,
    'every arm joint stands until its command is this far off, and jumps there',
    split='test',
)
