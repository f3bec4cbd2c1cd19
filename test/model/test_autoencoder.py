"""The rearranging autoencoder loses nothing."""

from __future__ import annotations

import torch

from mtv_world_ros.model.autoencoder import SpaceToDepthAutoencoder
from mtv_world_ros.model.conditioning import condition, decode_frames, encode_frames


def test_bytes_come_back_as_they_went_in() -> None:
    frames = torch.randint(0, 256, (2, 3, 5, 16, 24, 3), dtype=torch.uint8)
    autoencoder = SpaceToDepthAutoencoder(block_size=2)
    latents = encode_frames(autoencoder, frames)
    assert latents.shape == (2, 3, 12, 5, 8, 12)
    assert torch.equal(decode_frames(autoencoder, latents), frames)


def test_control_frame_k_stands_at_predicted_frame_k() -> None:
    """Frame 0 of the trajectory video is the start, frames 1 .. T are the predicted ones."""
    trajectory = torch.zeros(1, 1, 5, 4, 4, 3, dtype=torch.uint8)
    trajectory[:, :, 3] = 255
    autoencoder = SpaceToDepthAutoencoder()
    cond = condition(autoencoder, trajectory[:, :, 0], trajectory)
    bright = cond.control.amax(dim=(0, 1, 2, 4, 5)) > 0
    assert bright.tolist() == [False, False, True, False]
    assert cond.control.shape[3] == 4
