"""Recorded frames sent through a model's autoencoder and back: what it could score at best."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.pipeline import WorldModel

#: sends (V, 1 + T, H, W, 3) uint8 RGB frames through the autoencoder; returns the last T
Reconstruct = Callable[[ByteArray], ByteArray]


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
