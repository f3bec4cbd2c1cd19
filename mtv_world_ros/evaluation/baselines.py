"""World models that know nothing, to measure the others against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mtv_world_ros.data_types import ByteArray, FloatArray, History, WorldModelSpec


class PersistenceWorldModel:
    """Predicts that nothing ever changes: repeats the start frame."""

    def __init__(self, spec: WorldModelSpec) -> None:
        self.spec = spec

    def predict(
        self,
        start_frame: ByteArray,
        trajectory_frames: ByteArray,
        *,
        positions: FloatArray,
        seed: int,
        num_inference_steps: int,
        should_stop: Callable[[], bool],
        history: History | None = None,
    ) -> ByteArray:
        """Returns the start frame T times; see `pipeline.WorldModel.predict`."""
        del positions, seed, num_inference_steps, should_stop, history
        num_frames = trajectory_frames.shape[1] - 1
        return np.repeat(start_frame[:, None], num_frames, axis=1)
