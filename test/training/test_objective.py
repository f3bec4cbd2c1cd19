"""The loss: noise levels, what weighs more, and the latent layout of the weights."""

import math

import pytest
import torch

from mtv_world_ros.model.autoencoders import SpaceToDepthAutoencoder
from mtv_world_ros.training.objective import (
    add_noise,
    draw_sigmas,
    latent_weights,
    NoiseDraws,
    pixel_weights,
    sample_loss,
    sigma_weights,
)
from mtv_world_ros.training.training_config import ObjectiveConfig

CONFIG = ObjectiveConfig()


def test_noise_levels_follow_wans_shift():
    """Without the share at full noise, the median of sigma' is s * .5 / (1 + (s - 1) * .5)."""
    config = ObjectiveConfig(full_noise_share=0.0, sigma_shift=5.0)
    sigmas = draw_sigmas(NoiseDraws(0, 0, range(20_000)), config)
    assert sigmas.min() > 0
    assert sigmas.max() <= 1
    assert abs(sigmas.median().item() - 5 * 0.5 / 3) < 0.01


def test_noise_is_mixed_in_by_sigma():
    clean, noise = torch.tensor([[2.0], [2.0]]), torch.tensor([[10.0], [10.0]])
    assert add_noise(clean, noise, torch.tensor([0.0, 0.25])).tolist() == [[2.0], [4.0]]


def test_changed_pixels_and_objects_weigh_more():
    frames = torch.zeros(1, 1, 2, 1, 4, 3, dtype=torch.uint8)
    frames[0, 0, 1, 0, 1] = 200  # changes
    ids = torch.zeros(1, 1, 2, 1, 4, dtype=torch.uint8)
    ids[0, 0, :, 0, 2] = 1  # an object that stays
    ids[0, 0, 1, 0, 3] = 2  # one that came
    weights = pixel_weights(frames, ids, CONFIG)[0, 0, 0, 0].tolist()
    c = CONFIG
    assert weights == [
        1.0,
        1.0 + c.change_weight,
        1.0 + c.object_weight,
        1.0 + c.object_weight + c.moved_weight,
    ]


def test_places_of_attempts_weigh_the_same_however_a_clip_goes_on():
    """A tool goes from left to right; the object goes along, or it stays where it was."""
    frames = torch.zeros(1, 1, 3, 1, 64, 3, dtype=torch.uint8)
    places = torch.zeros(1, 1, 3, 1, 64, dtype=torch.bool)
    grasped, missed = (torch.zeros(1, 1, 3, 1, 64, dtype=torch.uint8) for _ in range(2))
    for frame, column in enumerate((4, 20, 40)):
        places[0, 0, frame, 0, [4, column]] = True
        grasped[0, 0, frame, 0, column] = missed[0, 0, frame, 0, 4] = 1

    def weights(ids, config):
        return pixel_weights(frames, ids, config, places)[0, 0, :, 0]

    by_outcome = CONFIG.replace(attempt_weight=0.0)
    assert weights(grasped, by_outcome)[1, 40] > weights(missed, by_outcome)[1, 40]
    none = dict.fromkeys(('change_weight', 'object_weight', 'moved_weight'), 0.0)
    by_plan = CONFIG.replace(attempt_weight=7.0, **none)
    assert torch.equal(weights(grasped, by_plan), weights(missed, by_plan))
    assert weights(grasped, by_plan)[1].tolist() == [
        8.0 if x in (4, 40) else 1.0 for x in range(64)
    ]


def test_latent_weights_lie_where_the_autoencoder_puts_the_pixels():
    """Encoding an image of weights with three equal colours gives the weights of the latents."""
    weights = torch.rand(1, 2, 3, 8, 6)
    autoencoder = SpaceToDepthAutoencoder(block_size=2)
    video = weights.flatten(0, 1)[:, None].expand(-1, 3, -1, -1, -1)
    expected = autoencoder.encode(video).unflatten(0, (1, 2))
    assert torch.equal(latent_weights(weights, 2), expected)


def test_loss_is_zero_for_the_truth_and_counts_by_weight():
    clean = torch.zeros(1, 1, 1, 1, 1, 2)
    wrong = torch.tensor([1.0, 0.0]).reshape(clean.shape)
    light, heavy = torch.tensor([1.0, 3.0]), torch.tensor([3.0, 1.0])
    assert sample_loss(clean, clean, light.reshape(clean.shape), 0.1).mean == 0
    low = sample_loss(wrong, clean, light.reshape(clean.shape), 0.1).mean
    high = sample_loss(wrong, clean, heavy.reshape(clean.shape), 0.1).mean
    torch.testing.assert_close(high, 3 * low)


def test_middle_noise_levels_count_as_in_diffsynth():
    """exp(-2 ((t - 500) / 1000)^2) of t = 1000, 995.02 .. 4.98, less the least, mean 1."""
    config = ObjectiveConfig(sigma_weighting='middle', sigma_shift=5.0)
    steps = [k / 1000 for k in range(1000, 0, -1)]
    times = [1000 * 5 * s / (1 + 4 * s) for s in steps]
    bell = [math.exp(-2 * ((t - 500) / 1000) ** 2) for t in times]
    scale = 1000 / sum(b - math.exp(-0.5) for b in bell)
    expected = [(math.exp(-2 * (s - 0.5) ** 2) - math.exp(-0.5)) * scale for s in (0.5, 0.9, 1.0)]
    found = sigma_weights(torch.tensor([0.5, 0.9, 1.0]), config)
    assert found.tolist() == pytest.approx(expected, abs=1e-5)
    assert sigma_weights(torch.tensor([0.1, 1.0]), CONFIG).tolist() == [1, 1]


def test_without_delta_the_error_is_squared_and_samples_count_by_noise_level():
    clean = torch.zeros(2, 1, 1, 1, 1, 2)
    wrong = torch.tensor([[1.0, 2.0], [3.0, 0.0]]).reshape(clean.shape)
    loss = sample_loss(wrong, clean, torch.ones_like(clean), None, torch.tensor([1.0, 0.5]))
    assert loss.mean.item() == pytest.approx((1 + 4 + 0.5 * 9) / 4)
