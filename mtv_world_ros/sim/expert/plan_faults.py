"""What goes wrong while a plan is carried out: grippers out of step, unsteady joints, tempo."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.sim.expert.faults import PolicyVariant

#: between the draws that a slow error of the joints is interpolated from [s]
_NOISE_KNOT_S = 0.5


def with_faults(
    plan: JointTrajectory, variant: PolicyVariant, robot: RobotModel, rng: np.random.Generator
) -> JointTrajectory:
    """Returns the plan (T, J) as a variant carries it out; joints stay within their limits.

    Args:
        plan: equally spaced.
        variant: its faults of timing and speed are applied.
        robot: whose joints they are.
        rng: draws the noise.
    """
    period = float(plan.times[1] - plan.times[0])
    tools = [tool for tool in robot.tools if tool.gripper_joint is not None]
    grippers = [robot.joint_names.index(tool.gripper_joint or '') for tool in tools]
    opens = np.array([np.sign(tool.gripper_open - tool.gripper_closed) for tool in tools])
    positions = _late(np.array(plan.positions), grippers, round(variant.size('late') / period))
    positions = _early(positions, grippers, round(variant.size('early') / period))
    positions = _hang(positions, grippers, opens, round(variant.size('hang') / period))
    if variant.size('stall'):
        share = np.random.default_rng(rng.integers(2**32)).uniform(0.15, 0.6)
        positions = _stall(
            positions, grippers, float(share), round(variant.size('stall') / period)
        )
    positions = _at_speed(positions, 1 / (1 + variant.size('slow')))
    positions = _at_speed(positions, 1 + variant.size('fast'))
    times = np.arange(len(positions), dtype=np.float64) * period
    if variant.size('noise'):
        error = _slow_noise(times, len(robot.joint_names), variant.size('noise'), rng)
        error[:, grippers] = 0.0
        positions = np.clip(positions + error, robot.lower, robot.upper)
    if variant.size('fumble'):
        error = _slow_noise(times, len(robot.joint_names), variant.size('fumble'), rng)
        travel = np.array([tool.gripper_open - tool.gripper_closed for tool in tools])
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
