"""Control `policy2vec`: one vector for all actions of a chunk, added to every text token."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.action_scaling import ActionScaling, joint_features
from mtv_world_ros.control.control import (
    ContextInput,
    Control,
    ControlInputs,
    ControlOptions,
    ControlScene,
    InputLayout,
)

#: the range of a joint that rarely moves is next to nothing, so that scaled numbers need a bound
CLIP = 1.5
#: width of WorldEval's MLP for fewer than 500 numbers (wan_video_dit_act_embed.py)
HIDDEN_SIZE = 1280


@dataclass(frozen=True, slots=True, kw_only=True)
class Policy2Vec(Control):
    """World-Eval's control: the mean joint command of a chunk, as one context vector.

    The mean passes through an MLP of three layers, 1,280 wide, and is added to every text token
    with a learned scale (0.1 at first), in both branches of guidance. WorldEval itself feeds a
    latent of its policy; the mean command is the reading of the MTV-World paper.

    Attributes:
        scaling: percentiles of the joint positions in the training set.
    """

    scaling: ActionScaling

    @classmethod
    def create(cls, options: ControlOptions) -> Self:
        """Return the control of a robot, with joints not yet scaled."""
        return cls(scaling=ActionScaling.unfitted(options.robot.joint_names, CLIP))

    @property
    def layout(self) -> InputLayout:
        """One vector that is added to every text token."""
        size = len(self.scaling.names)
        return InputLayout(
            context=ContextInput(vector_size=size, joins='add', hidden_size=HIDDEN_SIZE)
        )

    def make(self, scene: ControlScene) -> ControlInputs:
        """Return the mean of the chunk's commands, (1, J)."""
        self.scaling.check(scene.motion.robot.joint_names)
        scaled = self.scaling.apply(joint_features(scene.motion)[1:])
        return ControlInputs(
            num_frames=len(scaled), context=scaled.mean(0, keepdims=True).astype(np.float32)
        )

    def fitted(self, motions: Sequence[Motion]) -> Self:
        """Return the control scaled by the commands of the training set's chunks."""
        found = [joint_features(motion)[1:] for motion in motions]
        return replace(self, scaling=self.scaling.fitted(found))

    def state(self) -> dict[str, Any]:
        """Return the percentiles."""
        return self.scaling.state()

    def restored(self, state: Mapping[str, Any]) -> Self:
        """Return the control with stored percentiles."""
        return replace(self, scaling=self.scaling.restored(state))
