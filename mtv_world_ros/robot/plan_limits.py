"""Limits of plans: positions and speeds of joints, at the points and between them."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, FloatArray, JointTrajectory
from mtv_world_ros.core.errors import PlanError, PlanFault
from mtv_world_ros.robot.model import LIMIT_TOLERANCE, RobotModel
from mtv_world_ros.robot.resample import resample

#: commands may run ahead of a joint that lags: they are refused from this many times its speed on
SPEED_RATIO = 2.0
#: speed limit of a revolute joint whose description gives none [rad/s]
DEFAULT_TURN = 10.0
#: speed limit of a prismatic joint whose description gives none [m/s]
DEFAULT_SLIDE = 2.0
#: an arm that lags is not where a plan begins: it has at least this long to get there [s]
CATCH_UP_S = 0.2
#: a curve between two points may swing out of the limits by this share of their range
_SWING = 0.05


def speed_limits(robot: RobotModel) -> FloatArray:
    """Return (J,) the largest speeds that a plan may ask for [rad/s or m/s].

    They are `SPEED_RATIO` times those of the robot's description, or of `DEFAULT_TURN` and
    `DEFAULT_SLIDE`. Policies command a gripper to open or close from one row to the next, so its
    speed has no limit.
    """
    limits = SPEED_RATIO * joint_speeds(robot)
    grippers = [tool.gripper_joint or '' for tool in robot.tools]
    return np.where(np.isin(robot.joint_names, grippers), np.inf, limits)


def joint_speeds(robot: RobotModel) -> FloatArray:
    """Return (J,) the speed limits of the description, or the defaults [rad/s or m/s]."""
    given = robot.velocity_limits
    free = np.where(robot.slides, DEFAULT_SLIDE, DEFAULT_TURN)
    return np.where(np.isfinite(given), given, free)


def check_speeds(
    robot: RobotModel,
    plan: JointTrajectory,
    start_positions: FloatArray,
    *,
    tolerance: float = LIMIT_TOLERANCE,
) -> None:
    """Check the speeds of a plan from time 0 on, and its curve between points.

    Points before time 0 are past.

    Args:
        robot: the robot.
        plan: trajectory of the robot's joints in its order, within their limits; times count from
            now [s].
        start_positions: (J,) present positions of the joints [rad or m].
        tolerance: distance outside the limits up to which points are accepted [rad or m].

    Raises:
        PlanError: names the joint, its speed or the end of its swing, and the limit.
    """
    limits = speed_limits(robot)
    _check_way_there(robot, plan, start_positions, limits)
    if len(plan.times) < 2:
        return
    widths, ways = np.diff(plan.times)[:, None], np.diff(plan.positions, axis=0)
    ahead = plan.times[1:] > 0
    if plan.velocities is None:
        _refuse_faster(robot, (np.abs(ways) / widths)[ahead], limits, plan.times[1:][ahead])
        return
    _refuse_faster(robot, np.abs(plan.velocities), limits, plan.times)
    starts, ends = plan.velocities[:-1], plan.velocities[1:]
    # the speed in a segment of a cubic is a parabola over its share s: starts + s b + s^2 c
    c = 3 * (starts + ends) - 6 * ways / widths
    b = ends - starts - c
    middle = np.clip(_ratio(-b, 2 * c), 0.0, 1.0)
    fastest = np.abs(starts + middle * (b + middle * c))
    _refuse_faster(robot, fastest[ahead], limits, plan.times[1:][ahead])
    root = np.sqrt(np.maximum(b * b - 4 * c * starts, 0.0))
    turns = [_ratio(-b + root, 2 * c), _ratio(-b - root, 2 * c), _ratio(-starts, b)]
    for share in turns:
        share = np.clip(share, 0.0, 1.0)
        part = starts + share * (b / 2 + share * c / 3)
        peaks = plan.positions[:-1] + widths * share * part
        slack = tolerance + _SWING * (robot.upper - robot.lower)
        _refuse_wider(robot, peaks[ahead], slack, plan.times[1:][ahead])


def _ratio(over: FloatArray, under: FloatArray) -> FloatArray:
    """Return the ratio of two numbers, 0 where it is not a number."""
    return np.divide(over, under, out=np.zeros_like(over), where=np.abs(under) > 1e-12)


def _check_way_there(
    robot: RobotModel, plan: JointTrajectory, start_positions: FloatArray, limits: FloatArray
) -> None:
    """Check the way from where the joints are to where the plan has them next."""
    first_s = max(float(plan.times[0]), 0.0)
    first = resample(plan, start_positions, np.array([first_s]))
    speeds = np.abs(first - start_positions) / max(first_s, CATCH_UP_S)
    _refuse_faster(robot, speeds, limits, np.array([first_s]))


def _refuse_faster(
    robot: RobotModel, speeds: FloatArray, limits: FloatArray, times: FloatArray
) -> None:
    wrong: BoolArray = ~(speeds <= limits)
    if wrong.any():
        row, joint = np.argwhere(wrong)[0]
        unit = 'm/s' if robot.slides[joint] else 'rad/s'
        raise PlanError(
            PlanFault.SPEEDS,
            f"joint '{robot.joint_names[joint]}' is to move at {speeds[row, joint]:.4g} {unit} "
            f'before {times[row]:.4g} s; at most {limits[joint]:.4g} {unit} are accepted, '
            f"{SPEED_RATIO:g} times its limit (set in the description of robot '{robot.name}'; "
            f'where it has none, {DEFAULT_TURN:g} rad/s or {DEFAULT_SLIDE:g} m/s)',
        )


def _refuse_wider(
    robot: RobotModel, peaks: FloatArray, slack: FloatArray, times: FloatArray
) -> None:
    wrong = (peaks < robot.lower - slack) | (peaks > robot.upper + slack)
    if wrong.any():
        row, joint = np.argwhere(wrong)[0]
        raise PlanError(
            PlanFault.SPEEDS,
            f"joint '{robot.joint_names[joint]}' swings to {peaks[row, joint]:.5g} before "
            f'{times[row]:.4g} s, by the velocities of the points; its limits are '
            f'{robot.lower[joint]:.5g} .. {robot.upper[joint]:.5g}',
        )
