"""The state of a rollout between two chunks."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.core.data_types import (
    ByteArray,
    CameraModel,
    FloatArray,
    History,
    ObjectMasks,
    Observation,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import ObservationError
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.rollout.judge import JudgeState
from mtv_world_ros.rollout.scene_memory import SceneMemory


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """Objects that were followed to a frame.

    Attributes:
        masks: masks of the objects in the frame (T = 1).
        frames: (V, H, W, 3) uint8 RGB.
    """

    masks: ObjectMasks
    frames: ByteArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutState:
    """The state of one seed's rollout, which its next chunk starts from.

    Attributes:
        observation: last frame of the episode, at the model's size.
        history: the frames before that one.
        evidence: what the judge has seen and foreseen so far.
        num_imagined: frames since the last real one.
        scene: memory of the background; None = nothing is held.
        followed: objects in the last frame, as they were followed there; None = nothing was.
    """

    observation: Observation
    history: History
    evidence: JudgeState
    num_imagined: int = 0
    scene: SceneMemory | None = None
    followed: Followed | None = None

    @classmethod
    def at(
        cls, observation: Observation, spec: WorldModelSpec, evidence: JudgeState
    ) -> RolloutState:
        """Return the state of an episode that begins at a real observation.

        Raises:
            ObservationError: the views are not the model's.
        """
        start = fit_observation(observation, spec)
        return cls(observation=start, history=History.begin(start.frames), evidence=evidence)

    def after(
        self,
        frames: ByteArray,
        positions: FloatArray,
        stamp_ns: int,
        num_history: int,
        evidence: JudgeState,
        scene: SceneMemory | None = None,
        followed: ObjectMasks | None = None,
    ) -> RolloutState:
        """Return the state at the last of the frames (V, T, H, W, 3).

        Args:
            frames: (V, T, H, W, 3) uint8 RGB after `observation`.
            positions: (J,) commanded at the last one [rad or m].
            stamp_ns: stamp of the last one [ns].
            num_history: most frames to keep before it.
            evidence: evidence of the judge after the chunk.
            scene: memory of the background after the chunk.
            followed: masks of the objects in these frames.
        """
        start = self.observation
        return replace(
            self,
            observation=replace(
                start, frames=frames[:, -1], positions=positions, stamp_ns=stamp_ns
            ),
            history=self.history.after(start.frames, frames, num_history),
            evidence=evidence,
            num_imagined=self.num_imagined + frames.shape[1],
            scene=scene,
            followed=followed and Followed(masks=followed.last(), frames=frames[:, -1]),
        )

    def seen_by(self, cameras: tuple[CameraModel, ...] | None) -> RolloutState:
        """Return the state at a real frame, from which objects are looked for anew.

        Args:
            cameras: cameras at that frame, at the model's size; None = as before.
        """
        observation = self.observation
        if cameras is not None:
            corrected = self.evidence.camera_check.corrected(cameras)
            observation = replace(observation, cameras=corrected)
        return replace(
            self,
            observation=observation,
            num_imagined=0,
            evidence=self.evidence.at(observation),
        )


def fit_observation(observation: Observation, spec: WorldModelSpec) -> Observation:
    """Return the observation with frames and cameras at the model's size.

    Raises:
        ObservationError: the views are not the model's.
    """
    if observation.views != spec.views:
        raise ObservationError(
            f'the observation has views {list(observation.views)}, the model was trained on '
            f'{list(spec.views)} in this order; give those alone, or train a model of your views '
            'with mtv-world train --views'
        )
    if observation.frames.shape[1:3] == (spec.height, spec.width):
        return observation
    return replace(
        observation,
        cameras=tuple(scaled(c, spec.width, spec.height) for c in observation.cameras),
        frames=resize_frames(observation.frames, spec.width, spec.height),
    )
