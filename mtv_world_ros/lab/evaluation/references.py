"""What scores are compared with: other actions, the held first frame, the round trip."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from mtv_world_ros.data.recording import Recording
from mtv_world_ros.data_types import (
    ByteArray,
    FloatArray,
    JointTrajectory,
)
from mtv_world_ros.errors import ConfigError, nearest, RobotError
from mtv_world_ros.geometry.robot.model import RobotModel, Tool
from mtv_world_ros.lab.evaluation.imagined_stretches import Stretch
from mtv_world_ros.pipeline import WorldModel

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


#: true: the recorded ones; shuffled: another episode's; zero: the joints stay where they are at
#: the start of the rollout; mirrored: each arm does what the other did, mirrored at x = 0
ACTIONS = ('true', 'shuffled', 'zero', 'mirrored')
#: sends (V, 1 + T, H, W, 3) uint8 RGB frames through the autoencoder; returns the last T
Reconstruct = Callable[[ByteArray], ByteArray]


def check_actions(actions: Sequence[str]) -> None:
    """Raises ConfigError unless all are of `ACTIONS` and the true ones are among them."""
    for name in actions:
        if name not in ACTIONS:
            raise ConfigError(
                f"actions '{name}'{nearest(name, ACTIONS)} is not one of {', '.join(ACTIONS)}"
            )
    if 'true' not in actions:
        raise ConfigError(
            f"actions are {', '.join(actions) or 'empty'}; 'true' must be among them, since the "
            'others are compared with it'
        )


def with_actions(
    name: str,
    recording: Recording,
    stretch: Stretch,
    donor: Recording | None,
    robot: RobotModel,
) -> Recording | None:
    """Returns the episode whose commands are executed; None without an episode to lend them.

    Args:
        name: of `ACTIONS`.
        recording: the episode that is imagined.
        stretch: the part of it that is imagined.
        donor: lends its commands for `shuffled`.
        robot: of the episode.

    Raises:
        RobotError: `mirrored`, and the robot has no mirror image.
    """
    commands = recording.commands
    if name == 'shuffled':
        return donor
    if name == 'zero':
        held = np.repeat(recording.positions[stretch.start][None], len(commands.times), axis=0)
        return _commanding(recording, held)
    if name == 'mirrored':
        return _commanding(recording, mirrored(robot, commands.positions))
    return recording


def _commanding(recording: Recording, positions: FloatArray) -> Recording:
    commands = recording.commands
    other = JointTrajectory(
        joint_names=commands.joint_names, times=commands.times, positions=positions
    )
    return replace(recording, commands=other)


def round_trip(world_model: WorldModel) -> Reconstruct | None:
    """Returns the round trip through a world model's autoencoder; None if it has none.

    The frames go through in chunks, each after the real frame before it and the last one filled
    up with its last frame, so that the autoencoder sees what it sees in the model.
    """
    autoencoder = getattr(world_model, 'autoencoder', None)
    if autoencoder is None:
        return None
    length = world_model.spec.num_frames

    def reconstruct(frames: ByteArray) -> ByteArray:
        starts = range(0, frames.shape[1] - 1, length)
        chunks = [_through(autoencoder, frames[:, k : k + length + 1], length) for k in starts]
        return np.concatenate(chunks, axis=1)

    return reconstruct


def _through(autoencoder: Any, frames: ByteArray, length: int) -> ByteArray:
    import torch

    from mtv_world_ros.model.conditioning import decode_frames, encode_chunk

    num_frames = frames.shape[1] - 1
    rest = np.repeat(frames[:, -1:], length - num_frames, axis=1)
    chunk = torch.from_numpy(np.concatenate([frames, rest], axis=1))[None].to(autoencoder.device)
    with torch.inference_mode():
        back = decode_frames(autoencoder, encode_chunk(autoencoder, chunk))
    return back[0, :, :num_frames].cpu().numpy()
