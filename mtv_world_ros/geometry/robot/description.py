"""The robot as its driver describes it (/robot_description), held against the one expected."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import RobotError
from mtv_world_ros.geometry.robot.file import parse_urdf
from mtv_world_ros.geometry.robot.model import RobotModel

#: a calibrated robot differs from its nominal description by less than this [m], [rad]
_LARGEST_OFFSET = 0.05
_LARGEST_TURN = 0.2
_NUM_CONFIGURATIONS = 64


class DescribedRobot(NamedTuple):
    """A robot read from its description.

    Attributes:
        robot: with the joints and tools that were expected, and the described kinematics.
        offset_m: most that a tool point is off the expected one, over the joints' range [m].
    """

    robot: RobotModel
    offset_m: float


def described_robot(expected: RobotModel, urdf: str) -> DescribedRobot:
    """Reads the description of an expected robot: its own lengths, offsets and limits.

    Args:
        expected: names the joints, tools and base link.
        urdf: the description.

    Raises:
        RobotError: it is no URDF, or it describes another robot: joints or links are missing, or
            its tools are elsewhere by more than a calibration explains.
    """
    model, mimics, _ = parse_urdf(urdf, 'the robot description')
    followers = {mimic.joint for mimic in mimics}
    mimics += [mimic for mimic in expected.mimics if mimic.joint not in followers]
    try:
        robot = RobotModel(
            name=expected.name,
            model=model,
            joint_names=expected.joint_names,
            tools=expected.tools,
            base_link=expected.base_link,
            mimics=mimics,
            file=expected.file,
        )
    except RobotError as error:
        raise RobotError(
            f"the description is of another robot ('{model.name}'), not of '{expected.name}': "
            f'{error}'
        ) from error
    offset_m, turn = _tool_differences(expected, robot)
    if offset_m > _LARGEST_OFFSET or turn > _LARGEST_TURN:
        raise RobotError(
            f"the description is of another robot ('{model.name}'), not of '{expected.name}': "
            f'with the same joint positions its tools are up to {offset_m:.3f} m and {turn:.2f} '
            f'rad elsewhere; a calibration explains {_LARGEST_OFFSET:g} m and {_LARGEST_TURN:g} '
            'rad'
        )
    return DescribedRobot(robot, offset_m)


def _tool_differences(one: RobotModel, other: RobotModel) -> tuple[float, float]:
    """Greatest distance [m] and angle [rad] between the tools of two robots in one posture."""
    positions = _spread_positions(one)
    a, b = one.tool_poses(positions), other.tool_poses(positions)
    distance = np.linalg.norm(a[..., :3, 3] - b[..., :3, 3], axis=-1)
    trace = np.einsum('...ij,...ij->...', a[..., :3, :3], b[..., :3, :3])
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    return float(distance.max()), float(angle.max())


def _spread_positions(robot: RobotModel) -> FloatArray:
    """(N, J) positions spread over the joints' range; endless joints over a turn."""
    lower = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
    upper = np.where(np.isfinite(robot.upper), robot.upper, np.pi)
    shares = np.random.default_rng(0).random((_NUM_CONFIGURATIONS, len(lower)))
    return lower + shares * (upper - lower)
