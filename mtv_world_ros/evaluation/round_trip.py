"""Recorded frames sent through a model's autoencoder and back: what it could score at best."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.pipeline import WorldModel

#: sends (V, T, H, W, 3) uint8 RGB frames through the autoencoder and back
Reconstruct = Callable[[ByteArray], ByteArray]


def round_trip(world_model: WorldModel) -> Reconstruct | None:
    """Returns the round trip through a world model's autoencoder; None if it has none.

    The frames go through in pieces as long as a chunk, the last one filled up with its last
    frame: a video autoencoder sees what it sees in the model.
    """
    autoencoder = getattr(world_model, 'autoencoder', None)
    if autoencoder is None:
        return None
    length = world_model.spec.num_frames

    def reconstruct(frames: ByteArray) -> ByteArray:
        pieces = [frames[:, k : k + length] for k in range(0, frames.shape[1], length)]
        return np.concatenate([_through(autoencoder, piece, length) for piece in pieces], axis=1)

    return reconstruct


def _through(autoencoder, piece: ByteArray, length: int) -> ByteArray:
    import torch

    from mtv_world_ros.model.conditioning import decode_frames, encode_frames

    filled = np.concatenate([piece, np.repeat(piece[:, -1:], length - piece.shape[1], 1)], 1)
    frames = torch.from_numpy(np.array(filled))[None].to(autoencoder.device)
    with torch.inference_mode():
        back = decode_frames(autoencoder, encode_frames(autoencoder, frames))
    return back[0, :, : piece.shape[1]].cpu().numpy()
