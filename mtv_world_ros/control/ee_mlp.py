"""Control `ee_mlp`: the end-effector pose of each frame, seen by that frame alone.

Shape letters: A arms, N states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.action_scaling import ActionScaling
from mtv_world_ros.control.control import (
    Control,
    ControlInputs,
    ControlOptions,
    ControlScene,
    FrameInput,
    InputLayout,
)
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.robot.model import RobotModel

#: Ctrl-World clips at the percentiles
CLIP = 1.0
#: width of Ctrl-World's MLP
HIDDEN_SIZE = 1024
#: numbers of an arm
PARTS = ('x', 'y', 'z', 'roll', 'pitch', 'yaw', 'opening')
#: cosine of the pitch below which yaw is not told from roll
VERTICAL = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class EndEffectorMlp(Control):
    """Ctrl-World's control: pose and opening of every gripper, a vector a frame.

    Absolute poses (x, y, z, Euler angles) and openings are scaled by the 1st and 99th percentile
    to [-1, 1] and clipped; an MLP a frame; each frame cross-attends to its own vector alone; 5 %
    of the training samples go without.

    Attributes:
        scaling: percentiles in the training set.
    """

    dropout: ClassVar[float] = 0.05  # type: ignore[misc]

    scaling: ActionScaling

    @classmethod
    def create(cls, options: ControlOptions) -> Self:
        """Return the control of a robot, with poses not yet scaled."""
        return cls(scaling=ActionScaling.unfitted(feature_names(options.robot), CLIP))

    @property
    def layout(self) -> InputLayout:
        """A vector of 7 numbers an arm for each frame."""
        size = len(self.scaling.names)
        return InputLayout(frame=FrameInput(vector_size=size, hidden_size=HIDDEN_SIZE))

    def make(self, scene: ControlScene) -> ControlInputs:
        """Return (1 + T, 7 A) scaled numbers."""
        self.scaling.check(feature_names(scene.motion.robot))
        scaled = self.scaling.apply(tool_features(scene.motion))
        return ControlInputs(num_frames=len(scaled) - 1, frame=scaled.astype(np.float32))

    def fitted(self, motions: Sequence[Motion]) -> Self:
        """Return the control scaled by the commanded poses of the training set's chunks."""
        found = [tool_features(motion)[1:] for motion in motions]
        return replace(self, scaling=self.scaling.fitted(found))

    def state(self) -> dict[str, Any]:
        """Return the percentiles."""
        return self.scaling.state()

    def restored(self, state: Mapping[str, Any]) -> Self:
        """Return the control with stored percentiles."""
        return replace(self, scaling=self.scaling.restored(state))


def feature_names(robot: RobotModel) -> tuple[str, ...]:
    """Return the 7 A names of what `tool_features` returns."""
    return tuple(f'{tool.arm} {part}' for tool in robot.tools for part in PARTS)


def tool_features(motion: Motion) -> FloatArray:
    """Return (N, 7 A): per arm x, y, z [m], roll, pitch, yaw [rad] and opening in [0, 1].

    Poses are those of the tool points in the base frame. Angles jump at +-pi, as they do in
    Ctrl-World.
    """
    angles = roll_pitch_yaw(motion.tools[..., :3, :3])
    rows = np.concatenate([motion.tool_points, angles, motion.openings[..., None]], axis=-1)
    return rows.swapaxes(0, 1).reshape(len(motion.positions), -1)


def roll_pitch_yaw(rotations: FloatArray) -> FloatArray:
    """Return (..., 3) angles [rad] of rotations (..., 3, 3): R = Rz(yaw) Ry(pitch) Rx(roll).

    Where roll and yaw turn about the same axis, straight up and down, yaw is zero.
    """
    r = rotations
    level = np.hypot(r[..., 0, 0], r[..., 1, 0])
    pitch = np.arctan2(-r[..., 2, 0], level)
    yaw = np.where(level < VERTICAL, 0.0, np.arctan2(r[..., 1, 0], r[..., 0, 0]))
    sine, cosine = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(
        sine * r[..., 0, 2] - cosine * r[..., 1, 2], cosine * r[..., 1, 1] - sine * r[..., 0, 1]
    )
    return np.stack([roll, pitch, yaw], axis=-1)
