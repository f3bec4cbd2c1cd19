"""What goes wrong while a plan is carried out: late grippers, unsteady joints, standing still."""

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
        variant: its `late`, `noise` and `stop` are applied.
        robot: whose joints they are.
        rng: draws the noise.
    """
    period = float(plan.times[1] - plan.times[0])
    grippers = [
        robot.joint_names.index(tool.gripper_joint)
        for tool in robot.tools
        if tool.gripper_joint is not None
    ]
    positions = _late(np.array(plan.positions), grippers, round(variant.late / period))
    times = np.arange(len(positions), dtype=np.float64) * period
    if variant.noise:
        error = _slow_noise(times, len(robot.joint_names), variant.noise, rng)
        error[:, grippers] = 0.0
        positions = np.clip(positions + error, robot.lower, robot.upper)
    if variant.stop < 1:
        last = int(variant.stop * (len(positions) - 1))
        positions[last:] = positions[last]
    return JointTrajectory(
        joint_names=plan.joint_names,
        times=times,
        positions=positions,
        velocities=np.gradient(positions, period, axis=0),
    )


def _late(positions: FloatArray, grippers: list[int], num: int) -> FloatArray:
    """(T + num, J): the grippers follow `num` samples later, the arms wait for them at the end."""
    whole = np.concatenate([positions, np.repeat(positions[-1:], num, axis=0)])
    delayed = np.concatenate([np.repeat(positions[:1], num, axis=0), positions])
    whole[:, grippers] = delayed[:, grippers]
    return whole


def _slow_noise(
    times: FloatArray, num_joints: int, deviation: float, rng: np.random.Generator
) -> FloatArray:
    """(T, J) errors, none at first, drawn anew every half second and linear in between."""
    knots = np.arange(0.0, times[-1] + 2 * _NOISE_KNOT_S, _NOISE_KNOT_S)
    drawn = rng.normal(0.0, deviation, (len(knots), num_joints))
    drawn[0] = 0.0
    return np.stack([np.interp(times, knots, column) for column in drawn.T], axis=1)
