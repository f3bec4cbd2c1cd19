"""What faults of a policy make of the commands of a plan.

Shape letters: T commands, J joints, G grippers.
"""

from __future__ import annotations

import numpy as np

from mtv_world_ros.bench.expert.faults import PolicyVariant
from mtv_world_ros.bench.expert.glitches import Commands, crossed, with_glitches
from mtv_world_ros.data_types import BoolArray, FloatArray, JointTrajectory
from mtv_world_ros.errors import PolicyError
from mtv_world_ros.geometry.robot.model import RobotModel

#: between the draws that a slow error of the joints is interpolated from [s]
_NOISE_KNOT_S = 0.5
#: time in which an arm goes back to where it repeats its commands from [s]
_BACK_S = 0.4
#: time in which the robot goes back to where it rests, and starts all over [s]
_RESTART_S = 0.8
#: periods of a wavy error over one turn of a joint
_NUM_WAVES = 4
#: time in which arms that give way sink, lie, and rise again [s]; a step to find out which joint
#: lowers the tool by how much [rad]; squares of those that are too small to sink by [m2/rad2]
_SLUMP_S, _STEP_RAD, _LEAST_SLOPE = (0.3, 0.4, 0.6), 1e-4, 1e-3
#: period of waves on which all tools go up and down [s]
_HEAVE_S = 2.0
#: time in which a constant error sets in [s]
_SET_IN_S = 1.0
#: how often commands are lost
_NUM_LOST = 3
#: outliers of a plan, and how long each lasts [s]
_NUM_SPIKES, _SPIKE_S = 3, 0.4
#: in which a jump of the commands is carried out [s]
_JUMP_S = 0.1
#: from one jerk of a gripper to the next [s]
_TWITCH_EVERY_S = 0.8
#: from shut to open or back as a gripper flickers [s]; how often at most; how long before it
#: passes its middle it is still open, or shut [s]
_FLICKER_S, _NUM_FLICKERS, _BEFORE_S = (0.1, 0.3), 30, 0.6
#: way of a tool up to which its arm is at rest [m]
_RESTS_M = 1e-6
#: of an oscillation [Hz]
_TREMBLE_HZ = 2.5
#: length of a chunk of commands [s]
_CHUNK_S = 0.8
#: part of a plan in which one joint comes to stand still, or skips, as shares of it
_BRAKES = (0.1, 0.7)
#: of arms that swing, as a share of the critical damping
_DAMPING = 0.2
#: time in which the arms begin to swap their commands, and in which they do [s]
_SWAP_S = (0.2, 0.4)
#: kinds in which one arm does what another should
_OF_TWO_ARMS = (
    'mirror',
    'swap',
    'crowd',
    'rival',
    'poach',
    'budge',
    'tug',
    'vise',
    'slap',
    'roam',
    'tail',
    'hinder',
)
#: kinds of what a gripper does
_OF_GRIPPERS = (
    'starve',
    'splay',
    'putt',
    'topple',
    'tinker',
    'drag',
    'chatter',
    'grind',
    'perch',
    'offbeat',
    'paw',
    'waggle',
    'nibble',
    'falter',
    'rake',
    'decoy',
    'leak',
    'jiggle',
    'hurl',
    'swoop',
    'thump',
    'taut',
    'lob',
    'smear',
    'gnaw',
    'dip',
    'swat',
    'swirl',
    'jostle',
    'toss',
    'kick',
    'peck',
    'haul',
    'flinch',
    'crank',
    'poach',
    'hop',
    'hunt',
    'rock',
    'yawn',
    'waver',
    'droop',
    'budge',
    'tug',
    'vise',
    'slap',
    'dribble',
    'bowl',
    'rattle',
    'tail',
    'flap',
    'shed',
    'yank',
    'heap',
    'hinder',
)
#: arms flinch as a gripper passes this opening; it stands still where it moves less than this from
#: one command to the next, both as shares of its range; how much faster they go back
_FLINCH_OPEN, _STANDS, _FLINCH_SPEED = 0.1, 1e-3, 2
#: joints of a wrist, the last ones of an arm
_NUM_WRIST = 3
#: travel from which on an arm joint takes part in a plan [rad]
_MOVES_RAD = 0.2


def with_faults(
    plan: JointTrajectory, variant: PolicyVariant, robot: RobotModel, rng: np.random.Generator
) -> JointTrajectory:
    """Returns the plan (T, J) as a variant carries it out; joints stay within their limits.

    Args:
        plan: equally spaced.
        variant: its faults of timing and speed are applied.
        robot: whose joints they are.
        rng: draws the noise.

    Raises:
        PolicyError: a fault of two arms, of a robot that has one, or of a gripper, of a robot
            that has none.
    """
    _refuse(variant, robot)
    period = float(plan.times[1] - plan.times[0])
    grippers, (_, travel) = _grippers(robot), _strokes(robot)
    positions = _late(np.array(plan.positions), grippers, round(variant.size('late') / period))
    positions = _early(positions, grippers, round(variant.size('early') / period))
    positions = _hang(positions, grippers, np.sign(travel), round(variant.size('hang') / period))
    positions = _soft(positions, grippers, variant.size('soft') / period)
    positions = _limp(positions, grippers, len(robot.tools), variant.size('limp') / period)
    positions = _opening_faults(positions, variant, robot, period, rng)
    if variant.size('hurl'):
        is_shut = robot.gripper_openings(positions).min(axis=0) < 0.5
        positions = _hurl(positions, is_shut, variant.size('hurl'))
    if variant.size('stall'):
        share = _own(rng).uniform(0.15, 0.6)
        positions = _stall(
            positions, grippers, float(share), round(variant.size('stall') / period)
        )
    positions = _controller_faults(positions, variant, robot, grippers, period, rng)
    positions = _at_speed(positions, 1 / (1 + variant.size('slow')))
    positions = _at_speed(positions, 1 + variant.size('fast'))
    times = np.arange(len(positions), dtype=np.float64) * period
    if variant.size('noise'):
        error = _slow_noise(times, len(robot.joint_names), variant.size('noise'), rng)
        error[:, grippers] = 0.0
        positions = np.clip(positions + error, robot.lower, robot.upper)
    if variant.size('fumble'):
        error = _slow_noise(times, len(robot.joint_names), variant.size('fumble'), rng)
        positions[:, grippers] = np.clip(
            positions[:, grippers] + error[:, grippers] * travel,
            robot.lower[grippers],
            robot.upper[grippers],
        )
    if variant.size('stop') < 1:
        last = int(variant.size('stop') * (len(positions) - 1))
        positions[last:] = positions[last]
    return JointTrajectory(
        joint_names=plan.joint_names,
        times=times,
        positions=positions,
        velocities=np.gradient(positions, period, axis=0),
    )


def _refuse(variant: PolicyVariant, robot: RobotModel) -> None:
    """Refuses faults that a robot cannot have."""
    of_two = [kind for kind in variant.kinds if kind in _OF_TWO_ARMS]
    if of_two and len(robot.tools) < 2:
        raise PolicyError(
            f"policy '{variant.name}': {', '.join(of_two)} takes two arms, robot '{robot.name}' "
            f'has {len(robot.tools)}; leave it out'
        )
    of_grippers = [kind for kind in variant.kinds if kind in _OF_GRIPPERS]
    if of_grippers and all(tool.gripper_joint is None for tool in robot.tools):
        raise PolicyError(
            f"policy '{variant.name}': {', '.join(of_grippers)} takes a gripper, robot "
            f"'{robot.name}' has none; leave it out"
        )


def _grippers(robot: RobotModel) -> list[int]:
    """Columns of the grippers."""
    joints = [tool.gripper_joint for tool in robot.tools]
    return [robot.joint_names.index(joint) for joint in joints if joint is not None]


def _strokes(robot: RobotModel) -> tuple[FloatArray, FloatArray]:
    """(G,) position of every gripper when shut, and its travel from there to open."""
    tools = [tool for tool in robot.tools if tool.gripper_joint is not None]
    closed = np.array([tool.gripper_closed for tool in tools])
    return closed, np.array([tool.gripper_open for tool in tools]) - closed


def _own(rng: np.random.Generator) -> np.random.Generator:
    """A fault's own generator: whatever it draws, those after it draw the same."""
    return np.random.default_rng(rng.integers(2**32))


def _opening_faults(
    positions: FloatArray,
    variant: PolicyVariant,
    robot: RobotModel,
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J): grippers that jerk, give way, flicker, stand still or open slowly."""
    grippers, (closed, travel) = _grippers(robot), _strokes(robot)
    opens, middles = np.sign(travel), closed + travel / 2
    if variant.size('twitch'):
        jerks = closed + variant.size('twitch') * travel * _twitches(len(positions), period)
        positions = _opened(positions, grippers, opens, jerks)
    if variant.size('starve'):
        haste = _haste(positions, grippers, len(robot.tools))
        gives = closed + variant.size('starve') * travel * haste
        positions = _opened(positions, grippers, opens, gives)
    if variant.size('chatter'):
        own, lasts = _own(rng), variant.size('chatter')
        positions = _chatter(positions, grippers, middles, lasts, period, own)
    num = round(variant.size('falter') / period)
    positions = _falter(positions, grippers, middles, num, period)
    if variant.size('leak'):
        since = _shut_since(positions, grippers, middles, opens) * period
        leaks = closed + np.minimum(variant.size('leak') * since, 1.0) * travel
        positions = _opened(positions, grippers, opens, leaks)
    if variant.size('taut'):
        yields = closed + variant.size('taut') * travel * _reach(positions, grippers, robot)
        positions = _opened(positions, grippers, opens, yields)
    return positions


def _controller_faults(
    positions: FloatArray,
    variant: PolicyVariant,
    robot: RobotModel,
    grippers: list[int],
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T', J): repeats, scales, smooths and offsets the commands (T, J), one each `period` [s].

    Each fault draws from a generator of its own, so that another size draws the same.
    """
    if variant.size('loop'):
        share = _own(rng).uniform(0.35, 0.75)
        positions = _loop(positions, float(share), round(variant.size('loop') / period), period)
    if variant.size('skip'):
        share = _own(rng).uniform(0.15, 0.65)
        positions = _skip(positions, float(share), round(variant.size('skip') / period), period)
    if variant.size('flinch'):
        own = _own(rng)
        positions = _flinch(positions, robot, round(variant.size('flinch') / period), own)
    if variant.size('blur'):
        share = _own(rng).uniform()
        positions = _blur(positions, round(share * variant.size('blur') / period))
    positions = _out_of_time(positions, variant, grippers, period, rng)
    positions = _choppy(positions, round(variant.size('choppy') / period), period)
    if variant.size('coarse'):
        positions = _coarse(positions, grippers, variant.size('coarse'), period)
        positions = np.clip(positions, robot.lower, robot.upper)
    positions = _lash(positions, grippers, variant.size('lash') / 2)
    positions = _stick(positions, grippers, variant.size('stick'), period)
    positions = _one_joint(positions, variant, robot, grippers, period, rng)
    positions = _smooth(positions, grippers, round(variant.size('smooth') / period))
    positions = _sluggish(positions, grippers, variant.size('sluggish'))
    positions = _off_course(positions, variant, robot, grippers, period, rng)
    if variant.size('freeze'):
        own = _own(rng)
        positions = _freeze(positions, round(variant.size('freeze') / period), own)
    if variant.size('glitch'):
        closed, travel = _strokes(robot)
        commands = Commands(
            positions=positions,
            period=period,
            grippers=grippers,
            closed=closed,
            travel=travel,
            num_arms=len(robot.tools),
        )
        own = _own(rng)
        positions = with_glitches(commands, round(variant.size('glitch')), own)
        positions = np.clip(positions, robot.lower, robot.upper)
    error = _errors(positions, variant, robot, period, rng)
    error[:, grippers] = 0.0
    return np.clip(positions + error, robot.lower, robot.upper) if error.any() else positions


def _out_of_time(
    positions: FloatArray,
    variant: PolicyVariant,
    grippers: list[int],
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T', J): all starts over; chunks in the wrong order; chunks, joints or grippers off time."""
    if variant.size('restart'):
        share = variant.size('restart') * _own(rng).uniform()
        positions = _restart(positions, float(share), round(_RESTART_S / period))
    if variant.size('shuffle'):
        share, num = _own(rng).uniform(), round(variant.size('shuffle') / period)
        positions = _shuffle(positions, float(share), num, period)
    if variant.size('seams'):
        own = _own(rng)
        positions = _seams(positions, variant.size('seams') / period, period, own)
    if variant.size('ragged'):
        own = _own(rng)
        positions = _ragged(positions, grippers, variant.size('ragged') / period, own)
    if variant.size('offbeat'):
        own = _own(rng)
        positions = _offbeat(positions, grippers, variant.size('offbeat'), own)
    return positions


def _one_joint(
    positions: FloatArray,
    variant: PolicyVariant,
    robot: RobotModel,
    grippers: list[int],
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J): one joint moves less than the others, not at all, sticks, or skips; or all lose."""
    if variant.size('weak'):
        own = _own(rng)
        positions = _weak(positions, grippers, variant.size('weak'), own)
    if variant.size('brake'):
        own = _own(rng)
        positions = _brake(positions, grippers, round(variant.size('brake') / period), period, own)
    if variant.size('clamp'):
        own = _own(rng)
        positions = _clamp(positions, grippers, variant.size('clamp'), own)
    if variant.size('bind'):
        own = _own(rng)
        positions = _bind(positions, grippers, variant.size('bind'), period, own)
    if variant.size('cog'):
        own = _own(rng)
        positions = _cog(positions, grippers, variant.size('cog'), period, own)
        positions = np.clip(positions, robot.lower, robot.upper)
    if variant.size('tow'):
        own = _own(rng)
        positions = _tow(positions, grippers, len(robot.tools), variant.size('tow'), own)
        positions = np.clip(positions, robot.lower, robot.upper)
    if variant.size('ratchet'):
        own = _own(rng)
        positions = _ratchet(positions, grippers, variant.size('ratchet'), own)
        positions = np.clip(positions, robot.lower, robot.upper)
    return positions


def _off_course(
    positions: FloatArray,
    variant: PolicyVariant,
    robot: RobotModel,
    grippers: list[int],
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J): away from the commands for a while or for good, within the joints' limits."""
    if variant.size('lapse'):
        share = _own(rng).uniform(*_BRAKES)
        positions = _lapse(
            positions, grippers, float(share), round(variant.size('lapse') / period)
        )
        positions = np.clip(positions, robot.lower, robot.upper)
    if variant.size('slump'):
        share, depth = _own(rng).uniform(*_BRAKES), variant.size('slump')
        positions = _slump(positions, robot, float(share), depth, period)
        positions = np.clip(positions, robot.lower, robot.upper)
    if variant.size('heave'):
        phase, amplitude = _own(rng).uniform(0.0, 2 * np.pi), variant.size('heave')
        positions = _heave(positions, robot, amplitude, float(phase), period)
        positions = np.clip(positions, robot.lower, robot.upper)
    positions = _wane(positions, grippers, variant.size('wane'))
    if variant.size('warp'):
        positions = _warp(positions, grippers, variant.size('warp'), _own(rng))
        positions = np.clip(positions, robot.lower, robot.upper)
    if variant.size('swap'):
        share = _own(rng).uniform(0.1, 0.9)
        weights = variant.size('swap') * _swap_weights(len(positions), float(share), period)
        others = positions[0] + crossed(positions, positions.shape[1] // len(robot.tools))
        positions = positions + weights * (others - positions)
        positions = np.clip(positions, robot.lower, robot.upper)
    if variant.size('ring'):
        positions = _ring(positions, grippers, 2 * np.pi * period / variant.size('ring'))
        positions = np.clip(positions, robot.lower, robot.upper)
    return positions


def _errors(
    positions: FloatArray,
    variant: PolicyVariant,
    robot: RobotModel,
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J) that is added to the commands (T, J)."""
    error = np.zeros_like(positions)
    rows, joints = error.shape
    if variant.size('zero'):
        error += _offset(rows, joints, variant.size('zero'), period, rng)
    if variant.size('drift'):
        speeds = _own(rng).normal(0.0, variant.size('drift'), joints)
        error += period * np.arange(rows)[:, None] * speeds
    if variant.size('mirror'):
        error += variant.size('mirror') * _mirrored(positions, len(robot.tools), period)
    if variant.size('tremble'):
        error += _tremble(rows, joints, variant.size('tremble'), period, rng)
    if variant.size('spike'):
        error += _spikes(rows, joints, variant.size('spike'), period, rng)
    if variant.size('kick'):
        is_open = robot.gripper_openings(positions) > 0.5
        error += _kicks(is_open, joints, variant.size('kick'), period, _own(rng))
    if variant.size('couple'):
        shut = 1 - robot.gripper_openings(positions).T
        drawn = _own(rng).normal(0.0, variant.size('couple'), joints)
        error += np.repeat(shut, joints // len(robot.tools), axis=1) * drawn
    return error


def _delayed(positions: FloatArray, num: int) -> tuple[FloatArray, FloatArray]:
    """(T + num, J) twice: as it is with the end held, and `num` samples later."""
    whole = np.concatenate([positions, np.repeat(positions[-1:], num, axis=0)])
    delayed = np.concatenate([np.repeat(positions[:1], num, axis=0), positions])
    return whole, delayed


def _late(positions: FloatArray, grippers: list[int], num: int) -> FloatArray:
    """(T + num, J): the grippers follow `num` samples later, the arms wait for them at the end."""
    whole, delayed = _delayed(positions, num)
    whole[:, grippers] = delayed[:, grippers]
    return whole


def _early(positions: FloatArray, grippers: list[int], num: int) -> FloatArray:
    """(T, J): the grippers go `num` samples ahead of the arms."""
    ahead = np.minimum(np.arange(len(positions)) + num, len(positions) - 1)
    whole = positions.copy()
    whole[:, grippers] = positions[ahead][:, grippers]
    return whole


def _hang(positions: FloatArray, grippers: list[int], opens: FloatArray, num: int) -> FloatArray:
    """(T + num, J): the grippers close in time and open `num` samples later.

    Args:
        positions: (T, J).
        grippers: their columns.
        opens: of each, +1 where a larger value is more open, else -1.
        num: samples.
    """
    whole, delayed = _delayed(positions, num)
    both = np.stack([whole[:, grippers], delayed[:, grippers]]) * opens
    whole[:, grippers] = both.min(axis=0) * opens
    return whole


def _soft(positions: FloatArray, columns: list[int], constant: float) -> FloatArray:
    """(T, J): columns follow with a first-order lag, its time constant in samples."""
    if not constant:
        return positions
    whole, share = positions.copy(), 1 - np.exp(-1 / constant)
    for row in range(1, len(whole)):
        last = whole[row - 1, columns]
        whole[row, columns] = last + share * (positions[row, columns] - last)
    return whole


def _limp(
    positions: FloatArray, grippers: list[int], num_arms: int, constant: float
) -> FloatArray:
    """(T, J): the last joints of every arm follow with a lag, its time constant in samples."""
    if not constant:
        return positions
    arms = np.delete(np.arange(positions.shape[1]), grippers).reshape(num_arms, -1)
    return _soft(positions, arms[:, -_NUM_WRIST:].ravel().tolist(), constant)


def _falter(
    positions: FloatArray, grippers: list[int], middles: FloatArray, num: int, period: float
) -> FloatArray:
    """(T, J): whenever a gripper passes its middle, it stands there for `num` samples first."""
    if not num:
        return positions
    whole = positions.copy()
    for column, middle in zip(grippers, middles, strict=True):
        own = positions[:, column]
        for change in np.flatnonzero(np.diff(own > middle)) + 1:
            after = np.maximum(np.arange(len(own) - change) - num, 0)
            blend = np.minimum(after * period / _JUMP_S, 1.0)
            whole[change:, column] = middle + blend * (own[change:] - middle)
    return whole


def _shut_since(
    positions: FloatArray, grippers: list[int], middles: FloatArray, opens: FloatArray
) -> FloatArray:
    """(T, G): for how many samples a gripper has been more shut than open."""
    rows = np.arange(len(positions), dtype=np.float64)[:, None]
    is_open = (positions[:, grippers] - middles) * opens > 0
    return rows - np.maximum.accumulate(np.where(is_open, rows, 0))


def _hurl(positions: FloatArray, is_shut: BoolArray, more: float) -> FloatArray:
    """(T', J): while a gripper is shut, all goes faster, by a share."""
    rows = np.arange(len(positions))
    times = np.cumsum(np.where(is_shut, 1 / (1 + more), 1.0)) - 1
    at = np.interp(np.arange(int(times[-1]) + 1), times, rows)
    return np.stack([np.interp(at, rows, column) for column in positions.T], axis=1)


def _stall(positions: FloatArray, grippers: list[int], share: float, num: int) -> FloatArray:
    """(T + num, J): from a share of the plan on the arms are `num` samples behind the grippers."""
    first = int(share * len(positions))
    arms = np.concatenate(
        [
            positions[:first],
            np.repeat(positions[first : first + 1], num, axis=0),
            positions[first:],
        ]
    )
    whole, _ = _delayed(positions, num)
    arms[:, grippers] = whole[:, grippers]
    return arms


def _loop(positions: FloatArray, share: float, num: int, period: float) -> FloatArray:
    """(T + num, J): at a share of the plan, its last `num` samples are carried out once more.

    The way back to where they begin is blended in.
    """
    end = int(share * len(positions))
    begin = max(end - num, 0)
    again = positions[begin:].copy()
    back = min(round(_BACK_S / period), len(again))
    blend = (np.arange(1, back + 1) / back)[:, None]
    again[:back] = (1 - blend) * positions[end - 1] + blend * again[:back]
    return np.concatenate([positions[:end], again])


def _skip(positions: FloatArray, share: float, num: int, period: float) -> FloatArray:
    """(T - num, J): at a share of the plan, it jumps ahead by `num` samples."""
    begin = int(share * len(positions))
    rest = positions[begin + num :].copy()
    jump = min(round(_JUMP_S / period), len(rest))
    blend = (np.arange(1, jump + 1) / jump)[:, None]
    rest[:jump] = (1 - blend) * positions[begin - 1] + blend * rest[:jump]
    return np.concatenate([positions[:begin], rest])


def _lapse(positions: FloatArray, grippers: list[int], share: float, num: int) -> FloatArray:
    """(T, J): at a share of the plan, `num` steps of the arms are lost, which are off since."""
    steps, begin = np.diff(positions, axis=0), int(share * len(positions))
    lost = np.zeros_like(positions)
    lost[begin + 1 : begin + 1 + num] = steps[begin : begin + num]
    whole = positions - np.cumsum(lost, axis=0)
    whole[:, grippers] = positions[:, grippers]
    return whole


def _restart(positions: FloatArray, share: float, num: int) -> FloatArray:
    """(T', J): at a share of the plan, it goes back in `num` samples, and carries it all out."""
    end = 1 + int(share * (len(positions) - 1))
    blend = (np.arange(1, num + 1) / num)[:, None]
    back = (1 - blend) * positions[end - 1] + blend * positions[0]
    return np.concatenate([positions[:end], back, positions[1:]])


def _shuffle(positions: FloatArray, share: float, num: int, period: float) -> FloatArray:
    """(T, J): the later one of two chunks of `num` samples comes first, at a share of the plan."""
    rows = np.arange(len(positions))
    num = min(num, (len(rows) - 1) // 2)
    begin = 1 + int(share * (len(rows) - 1 - 2 * num))
    middle, end = begin + num, begin + 2 * num
    order = np.concatenate([rows[:begin], rows[middle:end], rows[begin:middle], rows[end:]])
    whole = positions[order]
    jump = min(round(_JUMP_S / period), num)
    for first in (begin, middle, end):
        after = whole[first : first + jump].copy()
        blend = (np.arange(1, len(after) + 1) / jump)[:, None]
        whole[first : first + jump] = (1 - blend) * whole[first - 1] + blend * after
    return whole


def _choppy(positions: FloatArray, num: int, period: float) -> FloatArray:
    """(T, J): the first of every `num` samples is held until the next."""
    if num < 2:
        return positions
    rows = np.arange(len(positions))
    held = rows // num * num
    blend = np.minimum((rows - held + 1) * period / _JUMP_S, 1.0)[:, None]
    return (1 - blend) * positions[np.maximum(held - num, 0)] + blend * positions[held]


def _coarse(positions: FloatArray, grippers: list[int], step: float, period: float) -> FloatArray:
    """(T, J): the arms are at multiples of `step` from the first row on, and jump between them."""
    away = positions - positions[0]
    whole = _smooth(positions[0] + step * np.rint(away / step), [], round(_JUMP_S / period))
    whole[:, grippers] = positions[:, grippers]
    return whole


def _lash(positions: FloatArray, grippers: list[int], slack: float) -> FloatArray:
    """(T, J): an arm joint stays where it is until its command is more than `slack` off."""
    if not slack:
        return positions
    whole = positions.copy()
    for row in range(1, len(whole)):
        whole[row] = np.clip(whole[row - 1], positions[row] - slack, positions[row] + slack)
    whole[:, grippers] = positions[:, grippers]
    return whole


def _stick(positions: FloatArray, grippers: list[int], most: float, period: float) -> FloatArray:
    """(T, J): an arm joint stands until its command is more than `most` off, and jumps there."""
    if not most:
        return positions
    whole = positions.copy()
    for row in range(1, len(whole)):
        stays = np.abs(positions[row] - whole[row - 1]) <= most
        whole[row] = np.where(stays, whole[row - 1], positions[row])
    whole = _smooth(whole, [], round(_JUMP_S / period))
    whole[:, grippers] = positions[:, grippers]
    return whole


def _seams(
    positions: FloatArray, most: float, period: float, rng: np.random.Generator
) -> FloatArray:
    """(T', J): every chunk but the first is ahead or behind, by up to `most` samples."""
    whole, _ = _delayed(positions, int(np.ceil(most)))
    rows, num = np.arange(len(whole)), round(_CHUNK_S / period)
    chunks = rows // num
    ahead = np.rint(most * rng.uniform(-1.0, 1.0, chunks[-1] + 1)).astype(int)
    ahead[0] = 0
    before, now = (
        whole[np.clip(rows + ahead[numbers], 0, len(whole) - 1)]
        for numbers in (np.maximum(chunks - 1, 0), chunks)
    )
    blend = np.minimum((rows % num + 1) * period / _JUMP_S, 1.0)[:, None]
    return (1 - blend) * before + blend * now


def _ragged(
    positions: FloatArray, grippers: list[int], most: float, rng: np.random.Generator
) -> FloatArray:
    """(T', J): every arm joint is behind, by up to `most` samples."""
    whole, _ = _delayed(positions, int(np.ceil(most)))
    rows, behind = np.arange(len(whole)), most * rng.uniform(size=whole.shape[1])
    behind[grippers] = 0.0
    columns = zip(behind, whole.T, strict=True)
    return np.stack([np.interp(rows - by, rows, column) for by, column in columns], axis=1)


def _offbeat(
    positions: FloatArray, grippers: list[int], most: float, rng: np.random.Generator
) -> FloatArray:
    """(T', J): the grippers are faster than the arms, or slower, by a share of up to `most`."""
    share = most * rng.uniform(-1.0, 1.0)
    tempo = 1 + share if share > 0 else 1 / (1 - share)
    whole, _ = _delayed(positions, int(np.ceil(max(-share, 0.0) * len(positions))))
    rows = np.arange(len(whole))
    for column in grippers:
        whole[:, column] = np.interp(tempo * rows, rows, whole[:, column])
    return whole


def _flinch(
    positions: FloatArray, robot: RobotModel, num: int, rng: np.random.Generator
) -> FloatArray:
    """(T', J): once, as a gripper opens or closes, the arms go back by `num` samples, and return.

    The gripper goes on, and stands still at the end of its way until they are there again.
    """
    ways = []
    for opening in robot.gripper_openings(positions):
        stands = np.append(np.abs(np.diff(opening)) < _STANDS, True)
        for change in np.flatnonzero(np.diff(opening > _FLINCH_OPEN)):
            begin = int(change - np.argmax(stands[change::-1]))
            ways.append((begin, int(change + np.argmax(stands[change:]))))
    if not ways:
        return positions
    begin, end = ways[int(rng.integers(len(ways)))]
    back = np.arange(begin, max(begin - num, 0), -_FLINCH_SPEED)
    rows = np.arange(len(positions))
    arms = np.insert(rows, begin, [*back, *back[::-1]])
    hands = np.insert(rows, end, np.full(2 * len(back), end))
    whole, grippers = positions[arms], _grippers(robot)
    whole[:, grippers] = positions[hands][:, grippers]
    return whole


def _blur(positions: FloatArray, num: int) -> FloatArray:
    """(T + num, J): the mean of what is commanded now and `num` samples before."""
    whole, delayed = _delayed(positions, num)
    return (whole + delayed) / 2


def _ring(positions: FloatArray, grippers: list[int], angle: float) -> FloatArray:
    """(T, J): the arms follow as masses on springs do, which swing by `angle` [rad] a sample."""
    damped = angle * np.sqrt(1 - _DAMPING**2)
    decay, cos, sin = np.exp(-_DAMPING * angle), np.cos(damped), np.sin(damped)
    lag = _DAMPING * angle / damped
    whole, speed = positions.copy(), np.zeros_like(positions[0])
    for row in range(1, len(whole)):
        away = whole[row - 1] - positions[row]
        whole[row] += decay * ((cos + lag * sin) * away + sin / damped * speed)
        speed = decay * ((cos - lag * sin) * speed - angle**2 / damped * sin * away)
    whole[:, grippers] = positions[:, grippers]
    return whole


def _opened(
    positions: FloatArray, grippers: list[int], opens: FloatArray, least: FloatArray
) -> FloatArray:
    """(T, J): the grippers are at least as far open as at their positions `least` (T, G)."""
    whole = positions.copy()
    both = np.stack([positions[:, grippers], least]) * opens
    whole[:, grippers] = both.max(axis=0) * opens
    return whole


def _twitches(num: int, period: float) -> FloatArray:
    """(T, 1) from 0, which is most of the time, to 1."""
    times = np.arange(num) * period % _TWITCH_EVERY_S
    return np.interp(times, _JUMP_S * np.arange(4), [0.0, 1.0, 1.0, 0.0])[:, None]


def _reach(positions: FloatArray, grippers: list[int], robot: RobotModel) -> FloatArray:
    """(T, G) from 0 to 1: how far the arm of each gripper reaches over the table, of its most."""
    tools = np.stack([poses[:, :2, 3] for poses in robot.tool_poses(positions)], axis=1)
    ways = np.linalg.norm(tools - tools[0], axis=2)
    most = ways.max(axis=0)
    num_joints = positions.shape[1] // len(robot.tools)
    return (ways / np.where(most > _RESTS_M, most, 1.0))[:, np.array(grippers) // num_joints]


def _haste(positions: FloatArray, grippers: list[int], num_arms: int) -> FloatArray:
    """(T, G) from 0 to 1: how fast the arm of each gripper moves, of its top speed."""
    num_joints = positions.shape[1] // num_arms
    steps = np.gradient(positions, axis=0)
    steps[:, grippers] = 0.0
    speeds = np.linalg.norm(steps.reshape(len(steps), num_arms, num_joints), axis=2)
    top = speeds.max(axis=0)
    return (speeds / np.where(top > 0, top, 1.0))[:, np.array(grippers) // num_joints]


def _chatter(
    positions: FloatArray,
    grippers: list[int],
    middles: FloatArray,
    lasts: float,
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J): for `lasts` [s] after a gripper has passed its middle, it goes back and forth."""
    whole, times = positions.copy(), np.arange(len(positions)) * period
    for column, middle in zip(grippers, middles, strict=True):
        for change in np.flatnonzero(np.diff(positions[:, column] > middle)) + 1:
            since = times - times[change]
            knots = np.cumsum(rng.uniform(*_FLICKER_S, _NUM_FLICKERS))
            back = np.interp(since, knots, np.arange(_NUM_FLICKERS) % 2)
            back *= np.clip((lasts - since) / _JUMP_S + 1, 0.0, 1.0)
            before = positions[max(change - round(_BEFORE_S / period), 0), column]
            whole[:, column] += back * (before - whole[:, column])
    return whole


def _sluggish(positions: FloatArray, grippers: list[int], lacking: float) -> FloatArray:
    """(T, J): no arm joint turns faster than at a part of its top speed, and so it is behind."""
    if not lacking:
        return positions
    whole = positions.copy()
    most = (1 - lacking) * np.abs(np.diff(positions, axis=0)).max(axis=0)
    for row in range(1, len(whole)):
        whole[row] = whole[row - 1] + np.clip(positions[row] - whole[row - 1], -most, most)
    whole[:, grippers] = positions[:, grippers]
    return whole


def _mirrored(positions: FloatArray, num_arms: int, period: float) -> FloatArray:
    """(T, J) errors: of arms at rest, the motion of the arm before in the order of the joints."""
    is_still = positions == positions[0]
    at_rest = _smooth(is_still.astype(np.float64), [], round(_SET_IN_S / period))
    return at_rest * crossed(positions, positions.shape[1] // num_arms)


def _swap_weights(num: int, share: float, period: float) -> FloatArray:
    """(T, 1) from 0 to 1 and back, once, from a share of the plan on."""
    (begins, lasts), first = _SWAP_S, int(share * num)
    knots = np.cumsum([0.0, begins, lasts, begins])
    times = (np.arange(num) - first) * period
    return np.interp(times, knots, [0.0, 1.0, 1.0, 0.0])[:, None]


def _tremble(
    num: int, num_joints: int, amplitude: float, period: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J) errors: waves, each joint's with a phase of its own, once they have set in."""
    phases = _own(rng).uniform(0.0, 2 * np.pi, num_joints)
    times = np.arange(num)[:, None] * period
    waves = np.sin(2 * np.pi * _TREMBLE_HZ * times + phases)
    return amplitude * np.minimum(times / _SET_IN_S, 1.0) * waves


def _weak(
    positions: FloatArray, grippers: list[int], lacking: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J): one of the arm joints that move moves only part of its way from the first row."""
    joint, whole = _moving(positions, grippers, rng), positions.copy()
    whole[:, joint] -= lacking * (whole[:, joint] - whole[0, joint])
    return whole


def _moving(positions: FloatArray, grippers: list[int], rng: np.random.Generator) -> int:
    """One of the arm joints that move, drawn."""
    travel = np.ptp(positions, axis=0)
    travel[grippers] = 0.0
    return int(rng.choice(np.flatnonzero(travel >= min(_MOVES_RAD, travel.max()))))


def _brake(
    positions: FloatArray,
    grippers: list[int],
    num: int,
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J): one of the arm joints that move stands still for `num` samples, then catches up."""
    joint, whole = _moving(positions, grippers, rng), positions.copy()
    first = int(rng.uniform(*_BRAKES) * len(positions))
    stands = whole[first, joint]
    after = np.maximum(np.arange(len(whole)) - first - num, 0)
    blend = np.minimum(after * period / _JUMP_S, 1.0)[first:]
    whole[first:, joint] = stands + blend * (positions[first:, joint] - stands)
    return whole


def _ratchet(
    positions: FloatArray, grippers: list[int], lost: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J): an arm joint loses a share of its way to one side, drawn, and its error adds up."""
    steps, sides = np.diff(positions, axis=0), rng.choice((-1.0, 1.0), positions.shape[1])
    behind = np.cumsum(np.where(steps * sides > 0, lost * steps, 0.0), axis=0)
    whole = positions.copy()
    whole[1:] -= behind
    whole[:, grippers] = positions[:, grippers]
    return whole


def _clamp(
    positions: FloatArray, grippers: list[int], lacking: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J): one of the arm joints that move does not come to the ends of its travel."""
    joint, whole = _moving(positions, grippers, rng), positions.copy()
    way = whole[:, joint] - whole[0, joint]
    least, most = (1 - lacking) * way.min(), (1 - lacking) * way.max()
    whole[:, joint] = whole[0, joint] + np.clip(way, least, most)
    return whole


def _cog(
    positions: FloatArray,
    grippers: list[int],
    angle: float,
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J): one of the arm joints that move skips to one side, and is off from there on."""
    joint, whole = _moving(positions, grippers, rng), positions.copy()
    first = int(rng.uniform(*_BRAKES) * len(positions))
    since = np.maximum(np.arange(len(whole)) - first, 0) * period
    whole[:, joint] += rng.choice((-angle, angle)) * np.minimum(since / _JUMP_S, 1.0)
    return whole


def _bind(
    positions: FloatArray,
    grippers: list[int],
    most: float,
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J): one of the arm joints that move sticks at one place of its travel, drawn.

    It jumps to where it should be once that is `most` on.
    """
    joint, whole = _moving(positions, grippers, rng), positions.copy()
    own = positions[:, joint]
    away = own - rng.uniform(own.min(), own.max())
    side = away[0]
    for row, far in enumerate(away):
        if far * side < 0 and abs(far) < most:
            whole[row, joint] -= far
        elif far:
            side = far
    whole[:, joint] = _smooth(whole, [], round(_JUMP_S / period))[:, joint]
    return whole


def _tow(
    positions: FloatArray,
    grippers: list[int],
    num_arms: int,
    share: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J): a joint takes the next one of its arm along, by a share, to a side that is drawn."""
    whole, ways = positions.copy(), share * (positions - positions[0])
    for arm in np.delete(np.arange(positions.shape[1]), grippers).reshape(num_arms, -1):
        whole[:, arm[1:]] += ways[:, arm[:-1]] * rng.choice((-1.0, 1.0), len(arm) - 1)
    return whole


def _slump(
    positions: FloatArray, robot: RobotModel, share: float, depth: float, period: float
) -> FloatArray:
    """(T, J): at a share of the plan, all tools sink, and rise again."""
    since = (np.arange(len(positions)) - share * len(positions)) * period
    sunk = depth * np.interp(since, np.cumsum([0.0, *_SLUMP_S]), [0.0, 1.0, 1.0, 0.0])
    return _lowered(positions, robot, sunk)


def _heave(
    positions: FloatArray, robot: RobotModel, amplitude: float, phase: float, period: float
) -> FloatArray:
    """(T, J): all tools go up and down in waves, once they have set in."""
    times = np.arange(len(positions)) * period
    waves = np.minimum(times / _SET_IN_S, 1.0) * np.sin(2 * np.pi * times / _HEAVE_S + phase)
    return _lowered(positions, robot, amplitude * waves)


def _lowered(positions: FloatArray, robot: RobotModel, sunk: FloatArray) -> FloatArray:
    """(T, J): all tools are lower by `sunk` (T,) [m].

    A joint gives way by as much as its arm's weight turns it: by how much it lowers the tool.
    """

    def heights(at: FloatArray) -> FloatArray:
        return np.stack([poses[:, 2, 3] for poses in robot.tool_poses(at)], axis=1)

    now, slopes = heights(positions), np.zeros((len(robot.tools), *positions.shape))
    for joint in np.delete(np.arange(positions.shape[1]), _grippers(robot)):
        step = _STEP_RAD * (np.arange(positions.shape[1]) == joint)
        slopes[:, :, joint] = ((heights(positions + step) - now) / _STEP_RAD).T
    squares = np.maximum((slopes**2).sum(axis=2, keepdims=True), _LEAST_SLOPE)
    return positions - (sunk[:, None] * slopes / squares).sum(axis=0)


def _wane(positions: FloatArray, grippers: list[int], lacking: float) -> FloatArray:
    """(T, J): the later it is, the less far all arm joints go, by a share at the end."""
    if not lacking:
        return positions
    shares = np.linspace(0.0, lacking, len(positions))[:, None]
    whole = positions - shares * (positions - positions[0])
    whole[:, grippers] = positions[:, grippers]
    return whole


def _warp(
    positions: FloatArray, grippers: list[int], amplitude: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J): an arm joint is off by a wave over its angle; the plan begins where the arms are."""
    waves = np.sin(_NUM_WAVES * positions + rng.uniform(0.0, 2 * np.pi, positions.shape[1]))
    whole = positions + amplitude * (waves - waves[0])
    whole[:, grippers] = positions[:, grippers]
    return whole


def _offset(
    num: int, num_joints: int, deviation: float, period: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J) errors: the same from `_SET_IN_S` on; the plan begins where the arms are."""
    drawn = _own(rng).normal(0.0, deviation, num_joints)
    return np.minimum(np.arange(num) * period / _SET_IN_S, 1.0)[:, None] * drawn


def _spikes(
    num: int, num_joints: int, deviation: float, period: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J) errors: a few short triangles, anywhere in the plan; none between them."""
    rng = _own(rng)
    middles = rng.uniform(0.1, 0.9, _NUM_SPIKES) * num
    return _triangles(num, middles, num_joints, deviation, period, rng)


def _kicks(
    is_open: BoolArray, num_joints: int, deviation: float, period: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J) errors: whenever a gripper (G, T) opens or closes, its arm jerks, once."""
    num_grippers, num = is_open.shape
    changes = (np.flatnonzero(np.diff(own)).astype(np.float64) for own in is_open)
    arm = num_joints // num_grippers
    return np.hstack([_triangles(num, rows, arm, deviation, period, rng) for rows in changes])


def _triangles(
    num: int,
    middles: FloatArray,
    num_joints: int,
    deviation: float,
    period: float,
    rng: np.random.Generator,
) -> FloatArray:
    """(T, J) errors: short triangles about some rows, each as large as drawn for each joint."""
    away = np.abs(np.arange(num)[:, None] - middles) * period / (_SPIKE_S / 2)
    return np.maximum(1 - away, 0.0) @ rng.normal(0.0, deviation, (len(middles), num_joints))


def _freeze(positions: FloatArray, num: int, rng: np.random.Generator) -> FloatArray:
    """(T, J): `num` commands in a row are lost at a few places, where the last one holds."""
    held = np.arange(len(positions))
    for first in (rng.uniform(0.1, 0.9, _NUM_LOST) * len(positions)).astype(int):
        held[first : first + num] = held[first]
    return positions[held]


def _smooth(positions: FloatArray, grippers: list[int], num: int) -> FloatArray:
    """(T, J): the arms' commands are a moving average, `num` samples about each."""
    if num < 2:
        return positions
    before = np.repeat(positions[:1], num // 2, axis=0)
    after = np.repeat(positions[-1:], num - 1 - num // 2, axis=0)
    padded = np.concatenate([before, positions, after])
    whole = np.lib.stride_tricks.sliding_window_view(padded, num, axis=0).mean(axis=-1)
    whole[:, grippers] = positions[:, grippers]
    return whole


def _at_speed(positions: FloatArray, speed: float) -> FloatArray:
    """(T, J): carried out `speed` times as fast, cut off or held at the end."""
    if speed == 1:
        return positions
    last = len(positions) - 1
    at = np.minimum(np.arange(last + 1) * speed, last)
    return np.stack([np.interp(at, np.arange(last + 1), column) for column in positions.T], axis=1)


def _slow_noise(
    times: FloatArray, num_joints: int, deviation: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J) errors, none at first, drawn anew every half second and linear in between."""
    knots = np.arange(0.0, times[-1] + 2 * _NOISE_KNOT_S, _NOISE_KNOT_S)
    drawn = rng.normal(0.0, deviation, (len(knots), num_joints))
    drawn[0] = 0.0
    return np.stack([np.interp(times, knots, column) for column in drawn.T], axis=1)
