"""What of a rollout comes before the frame that its next chunk starts from.

V views, N frames, H W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import ByteArray, Observation
from mtv_world_ros.errors import ObservationError


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """What of a rollout comes before the frame that its next chunk starts from.

    Attributes:
        anchor: (V, H, W, 3) uint8 RGB, the first frame of the rollout: the observed one.
        frames: (V, N, H, W, 3) uint8 RGB, the last frames before the chunk's start frame, oldest
            first, on the model's clock; none of them at the first chunk.
    """

    anchor: ByteArray
    frames: ByteArray

    def __post_init__(self) -> None:
        views, *image = self.anchor.shape
        if self.frames.ndim != 5 or (views, *image) != (len(self.frames), *self.frames.shape[2:]):
            raise ObservationError(
                f'a history has an anchor of shape {self.anchor.shape} and frames of shape '
                f'{self.frames.shape}; expected (V, H, W, 3) and (V, N, H, W, 3)'
            )

    @staticmethod
    def begin(start_frame: ByteArray) -> History:
        """Returns that of a rollout which begins at a frame (V, H, W, 3)."""
        return History(anchor=start_frame, frames=start_frame[:, None][:, :0])

    def after(self, start_frame: ByteArray, predicted: ByteArray, num_kept: int) -> History:
        """Returns that of the next chunk, which starts from the last predicted frame.

        Args:
            start_frame: (V, H, W, 3) where the chunk started.
            predicted: (V, T, H, W, 3) its frames.
            num_kept: most frames to keep.
        """
        frames = np.concatenate([self.frames, start_frame[:, None], predicted[:, :-1]], axis=1)
        return History(anchor=self.anchor, frames=frames[:, max(frames.shape[1] - num_kept, 0) :])

    def filled(self, num_frames: int) -> ByteArray:
        """Returns (V, num_frames, H, W, 3) frames; where there are fewer, the oldest is repeated.

        Between its first chunk and the N-th predicted frame a rollout has less than N of them, and
        a causal autoencoder takes no less. Zeros where there is none at all.
        """
        count = self.frames.shape[1]
        if not count:
            return np.zeros_like(self.anchor[:, None]).repeat(num_frames, axis=1)
        return self.frames[:, [max(count - num_frames + k, 0) for k in range(num_frames)]]


def fit_history(history: History | None, start: Observation) -> History:
    """Returns the history of a rollout that goes on from an observation, or begins there.

    Args:
        history: as given; None = the rollout begins.
        start: at the model's size.

    Raises:
        ObservationError: its frames are of another shape than the observation's.
    """
    if history is None:
        return History.begin(start.frames)
    if history.anchor.shape != start.frames.shape:
        raise ObservationError(
            f'the history has frames of shape {history.anchor.shape}, the model takes '
            f"{start.frames.shape}; give `end_history` of this model's own prediction"
        )
    return history
