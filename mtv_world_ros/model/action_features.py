"""Actions as numbers: joint positions or tool poses of a chunk, scaled by what training saw.

Shape letters: T frames of a chunk, J joints, A arms, D numbers an action.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import CheckpointError, ConfigError, nearest

if TYPE_CHECKING:
    from mtv_world_ros.geometry.robot import RobotModel

#: how actions may enter the model: the paper's method and its three baselines
CONTROLS = ('trajectory_video', 'policy2vec', 'ee_mlp', 'fast_tokens')
TRAJECTORY_VIDEO, POLICY2VEC, EE_MLP, FAST_TOKENS = CONTROLS

#: tokens of `fast_tokens`
VOCABULARY = 1024
#: these percentiles become -1 and 1
PERCENTILES = (1.0, 99.0)
#: how far outside of them a scaled number may lie. Ctrl-World clips at the percentiles. The others
#: need a bound too: the range of a joint that rarely moves is next to nothing
CLIP = {POLICY2VEC: 1.5, EE_MLP: 1.0, FAST_TOKENS: 1.5}
#: half of the least range that is stretched to [-1, 1] [m or rad]: below is noise
_LEAST_HALF_RANGE = 1e-3
#: cosine of the pitch from which on yaw is not told from roll
_VERTICAL = 1e-9


def check_control(name: str) -> str:
    """Returns the name; raises ConfigError if it is none of `CONTROLS`."""
    if name not in CONTROLS:
        raise ConfigError(
            f"control '{name}' is not one of {', '.join(CONTROLS)}{nearest(str(name), CONTROLS)}; "
            'set video.control or --control'
        )
    return name


def action_names(control: str, robot: RobotModel) -> tuple[str, ...]:
    """Returns the D names of what an action consists of."""
    if control != EE_MLP:
        return robot.joint_names
    parts = ('x', 'y', 'z', 'roll', 'pitch', 'yaw', 'opening')
    return tuple(f'{tool.arm} {part}' for tool in robot.tools for part in parts)


def action_features(control: str, robot: RobotModel, positions: FloatArray) -> FloatArray:
    """Returns (T, D) unscaled actions of joint positions (T, J) [rad or m]."""
    return tool_features(robot, positions) if control == EE_MLP else np.asarray(positions, float)


def tool_features(robot: RobotModel, positions: FloatArray) -> FloatArray:
    """Returns (T, 7 A): per arm x, y, z [m], roll, pitch, yaw [rad] and the opening in [0, 1].

    The poses are those of the tool points in the base frame. Angles jump at +-pi, as they do in
    Ctrl-World, which takes them like this.
    """
    poses = robot.tool_poses(positions)
    openings = robot.gripper_openings(positions)[..., None]
    angles = roll_pitch_yaw(poses[..., :3, :3])
    rows = np.concatenate([poses[..., :3, 3], angles, openings], axis=-1)
    return rows.swapaxes(0, 1).reshape(len(positions), -1)


def roll_pitch_yaw(rotations: FloatArray) -> FloatArray:
    """Returns (..., 3) angles [rad] of (..., 3, 3): R = Rz(yaw) Ry(pitch) Rx(roll).

    Straight up and down, where roll and yaw turn about the same axis, yaw is zero.
    """
    r = rotations
    level = np.hypot(r[..., 0, 0], r[..., 1, 0])
    pitch = np.arctan2(-r[..., 2, 0], level)
    yaw = np.where(level < _VERTICAL, 0.0, np.arctan2(r[..., 1, 0], r[..., 0, 0]))
    sine, cosine = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(
        sine * r[..., 0, 2] - cosine * r[..., 1, 2], cosine * r[..., 1, 1] - sine * r[..., 0, 1]
    )
    return np.stack([roll, pitch, yaw], axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionScaling:
    """Stretches each number of an action so that its 1st and 99th percentile become -1 and 1.

    Attributes:
        names: D names.
        low: (D,) 1st percentiles.
        high: (D,) 99th percentiles.
        clip: scaled numbers stay in [-clip, clip].
    """

    names: tuple[str, ...]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    clip: float

    @staticmethod
    def fit(control: str, robot: RobotModel, features: Sequence[FloatArray]) -> ActionScaling:
        """Returns the scaling of features, each (T, D)."""
        low, high = np.percentile(np.concatenate(features), PERCENTILES, axis=0)
        names = action_names(control, robot)
        return ActionScaling(names=names, low=low, high=high, clip=CLIP[control])

    def apply(self, features: FloatArray) -> FloatArray:
        """Returns (..., D) scaled numbers."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        scaled = (features - middle) / np.maximum(half, _LEAST_HALF_RANGE)
        return scaled.clip(-self.clip, self.clip)

    def check(self, names: tuple[str, ...]) -> None:
        """Raises CheckpointError if these are not the numbers that it was made for."""
        if names != self.names:
            raise CheckpointError(
                f'the model was trained on actions {list(self.names)}, the robot has '
                f"{list(names)}; set 'robot_file' to the robot it was trained with"
            )
