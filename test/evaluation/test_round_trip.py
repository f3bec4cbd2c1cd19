import numpy as np
import pytest
import torch

from mtv_world_ros.evaluation.references import round_trip
from mtv_world_ros.model.autoencoders import SpaceToDepthAutoencoder


class Frozen(SpaceToDepthAutoencoder):
    """Encodes the start frame too, and shows it again in every frame of the chunk."""

    includes_start = True

    def decode(self, latents):
        return super().decode(latents[:, :, :1].expand_as(latents))


@pytest.fixture
def frames():
    return np.random.default_rng(0).integers(0, 256, (2, 10, 6, 8, 3), np.uint8)


def test_an_autoencoder_that_loses_nothing_gives_the_frames_after_the_start(make_pipeline, frames):
    model = make_pipeline().world_model  # chunks of 4: two whole ones and a frame
    assert round_trip(model) is None
    model.autoencoder = SpaceToDepthAutoencoder()
    reconstruct = round_trip(model)
    assert reconstruct is not None and (reconstruct(frames) == frames[:, 1:]).all()


def test_each_chunk_follows_the_real_frame_before_it(make_pipeline, frames):
    model = make_pipeline().world_model
    model.autoencoder = Frozen()
    reconstruct = round_trip(model)
    assert reconstruct is not None
    found = reconstruct(frames)
    starts = [0, 0, 0, 0, 4, 4, 4, 4, 8]
    assert found.dtype == np.uint8 and (found == frames[:, starts]).all()
    assert not torch.is_inference_mode_enabled()
