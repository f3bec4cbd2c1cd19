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
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.robot.model import RobotModel

#: Ctrl-World clips at the percentiles
CLIP = 1.0
#: width of Ctrl-World's MLP
HIDDEN_SIZE = 1024
#: numbers of an arm: place, first two columns of the rotation, opening
PARTS = (
    'x', 'y', 'z',
    'x_axis_x', 'x_axis_y', 'x_axis_z', 'y_axis_x', 'y_axis_y', 'y_axis_z',
    'opening',
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class EndEffectorMlp(Control):
    """Ctrl-World's control: pose and opening of every gripper, a vector a frame.

    Absolute poses and openings are scaled by the 1st and 99th percentile to [-1, 1] and clipped;
    an MLP of three layers, 1,024 wide; each frame cross-attends to its own vector alone; 5 % of
    the training samples go without, so that `sampling.guidance_scale` guides on the control.
    Rotations are two columns of their matrix: the Euler angles of Ctrl-World jump by 2 pi where
    tools point straight down.

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
        """A vector of 10 numbers an arm for each frame."""
        size = len(self.scaling.names)
        return InputLayout(frame=FrameInput(vector_size=size, hidden_size=HIDDEN_SIZE))

    def make(self, scene: ControlScene) -> ControlInputs:
        """Return (1 + T, 10 A) scaled numbers."""
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
        """Return the control with stored percentiles.

        Raises:
            CheckpointError: they are of another robot, or of Euler angles.
        """
        names = [str(name) for name in state['names']]
        if any(name.endswith(' roll') for name in names):
            raise CheckpointError(
                f'the control ee_mlp of this checkpoint has Euler angles ({names}); two columns '
                'of the rotation are in their place now. Train it again'
            )
        return replace(self, scaling=self.scaling.restored(state))


def feature_names(robot: RobotModel) -> tuple[str, ...]:
    """Return the names of the 10 A features of `tool_features`."""
    return tuple(f'{tool.arm} {part}' for tool in robot.tools for part in PARTS)


def tool_features(motion: Motion) -> FloatArray:
    """Return (N, 10 A): per arm x, y, z [m], two columns of the rotation, opening in [0, 1].

    Poses are those of the tool points in the base frame.
    """
    columns = motion.tools[..., :3, :2].swapaxes(-1, -2)
    axes = columns.reshape(*columns.shape[:-2], 6)
    rows = np.concatenate([motion.tool_points, axes, motion.openings[..., None]], axis=-1)
    return rows.swapaxes(0, 1).reshape(len(motion.positions), -1)
