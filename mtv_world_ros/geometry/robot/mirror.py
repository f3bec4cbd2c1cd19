"""Motions mirrored at a plane of the base: the right arm does what the left one did."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import RobotError
from mtv_world_ros.geometry.robot.model import RobotModel, Tool

#: joint axes and tool points that differ by less than this from the mirrored ones agree [m, 1]
_TOLERANCE = 1e-4


def mirrored(robot: RobotModel, positions: FloatArray, *, axis: int = 0) -> FloatArray:
    """Returns positions (T, J) whose tool points are the mirrored ones of `positions`.

    Each arm's joints go to the arm that stands where its mirror image would stand; an arm on the
    plane is its own image. Which joints change their sign follows from the joint axes: a twist
    (v, w) is mirrored to (M v, -M w), M the reflection, and by the product of exponentials the
    mirrored motion runs about the mirrored axes. Grippers keep their opening. The result may
    exceed joint limits that are not mirrored themselves.

    Args:
        robot: its arms stand mirrored to each other in the base link's frame.
        positions: (T, J) [rad or m].
        axis: of the base link that is normal to the plane: 0 = the plane x = 0.

    Raises:
        RobotError: an arm has no mirror image.
    """
    positions = np.asarray(positions, float)
    twists, points = _at_zero(robot)
    reflection = np.ones(3)
    reflection[axis] = -1
    chains = [_arm_joints(robot, tool) for tool in robot.tools]
    images = (points * reflection, twists * np.concatenate([reflection, -reflection]))
    result = positions.copy()
    for arm, tool in enumerate(robot.tools):
        other, signs = _image_of(robot, arm, chains, (points, twists), images)
        result[:, chains[other]] = signs * positions[:, chains[arm]]
        _copy_opening(robot, tool, robot.tools[other], positions, result)
    return result


def _at_zero(robot: RobotModel) -> tuple[FloatArray, FloatArray]:
    """(J, 6) twists (v, w) of the joints and (A, 3) tool points, in the base at zero."""
    model = robot.pinocchio_model
    data = model.createData()
    jacobian = pin.computeJointJacobians(model, data, pin.neutral(model))
    base = pin.updateFramePlacement(model, data, model.getFrameId(robot.base_link))
    columns = [
        model.joints[model.getJointId(name)].idx_v  # type: ignore[attr-defined]
        for name in robot.joint_names
    ]
    twists = np.stack([base.actInv(pin.Motion(jacobian[:, c])).vector for c in columns])
    points = robot.tool_poses(np.zeros((1, len(columns))))[:, 0, :3, 3]
    return twists, points


def _arm_joints(robot: RobotModel, tool: Tool) -> list[int]:
    """Columns of the commanded joints between the base and a tool's link, in their order."""
    model = robot.pinocchio_model
    frame = model.frames[model.getFrameId(tool.link, pin.FrameType.BODY)]
    names = [model.names[joint] for joint in model.supports[frame.parentJoint]]
    return [robot.joint_names.index(name) for name in names if name in robot.joint_names]


def _image_of(
    robot: RobotModel,
    arm: int,
    chains: list[list[int]],
    real: tuple[FloatArray, FloatArray],
    images: tuple[FloatArray, FloatArray],
) -> tuple[int, FloatArray]:
    """The arm that stands where the mirror image of `arm` would, and the signs of its joints."""
    wanted = images[1][chains[arm]]
    for other, chain in enumerate(chains):
        have = real[1][chain]
        if len(chain) != len(chains[arm]):
            continue
        signs = np.where((have * wanted).sum(1) < 0, -1.0, 1.0)
        apart = [real[0][other] - images[0][arm], (signs[:, None] * have - wanted).ravel()]
        if np.abs(np.concatenate(apart)).max() < _TOLERANCE:
            return other, signs
    raise RobotError(
        f"arm '{robot.tools[arm].arm}' of robot '{robot.name}' has no mirror image: with all "
        'joints at zero no arm has its joint axes and tool point mirrored at the plane; mirrored '
        'actions need a robot whose description is symmetric'
    )


def _copy_opening(
    robot: RobotModel, tool: Tool, other: Tool, positions: FloatArray, result: FloatArray
) -> None:
    if tool.gripper_joint is None or other.gripper_joint is None:
        return
    values = positions[:, robot.joint_names.index(tool.gripper_joint)]
    opening = (values - tool.gripper_closed) / (tool.gripper_open - tool.gripper_closed)
    travel = other.gripper_open - other.gripper_closed
    result[:, robot.joint_names.index(other.gripper_joint)] = other.gripper_closed + (
        opening * travel
    )
