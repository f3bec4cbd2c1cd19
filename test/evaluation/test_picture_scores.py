"""Picture scores against torchmetrics, and when a model is said to follow the commands."""

from math import nan

import numpy as np
import pytest

from mtv_world_ros.evaluation.metrics.picture_scores import (
    following,
    mean_pictures,
    picture_estimates,
    picture_scores,
    ssim_map,
    WORSE,
)
from mtv_world_ros.evaluation.metrics.statistics import Estimate


def frames(seed=0):
    """A first frame, recorded frames in which a square moves over it, and noisy ones."""
    generator = np.random.default_rng(seed)
    first = generator.integers(60, 120, (48, 64, 3)).astype(np.uint8)
    real = np.repeat(first[None], 4, axis=0)
    for t in range(4):
        real[t, 10:26, 8 * t : 8 * t + 16] = 230
    noisy = (real.astype(int) + generator.integers(-9, 10, real.shape)).clip(0, 255)
    return first, real, noisy.astype(np.uint8)


def test_whole_frames_score_as_torchmetrics_says():
    torch = pytest.importorskip('torch')
    image = pytest.importorskip('torchmetrics.functional.image')
    first, real, noisy = frames()
    found = picture_scores(noisy, real, first)
    a, b = (torch.from_numpy(x).permute(0, 3, 1, 2).double() for x in (noisy, real))
    psnr = image.peak_signal_noise_ratio(
        a, b, data_range=255.0, dim=(1, 2, 3), reduction='elementwise_mean'
    )
    assert found['psnr'] == pytest.approx(float(psnr), abs=1e-4)
    whole = image.structural_similarity_index_measure(
        a, b, data_range=255.0, return_full_image=True, reduction='none'
    )[1]
    ours = np.stack([ssim_map(x, y) for x, y in zip(noisy, real, strict=True)])
    inner = (slice(None), slice(8, -8), slice(8, -8))  # rims are padded in other ways
    theirs = whole.mean(dim=1).numpy()
    assert np.abs(ours[inner] - theirs[inner]).max() < 1e-3


def test_where_the_picture_changes_the_held_frame_is_worse_than_in_all():
    first, real, noisy = frames()
    held = picture_scores(np.repeat(first[None], 4, axis=0), real, first)
    imagined = picture_scores(noisy, real, first)
    assert held['psnr_changed'] < held['psnr'] - 5
    assert imagined['psnr_changed'] > held['psnr_changed'] + 10
    assert held['j_changed'] == 0 and imagined['j_changed'] > 0.9
    still = picture_scores(noisy[:1], np.repeat(first[None], 1, axis=0), first)
    assert np.isnan(still['psnr_changed']) and np.isfinite(still['psnr'])


def episodes(over_held, over_shuffled):
    """Picture scores of episodes with these margins [dB]."""
    rows = zip(over_held, over_shuffled, strict=True)
    return [
        {'low': {'psnr_changed': 15.0, 'psnr_changed_held': 15.0 - held,
                 'psnr_changed_shuffled': 15.0 - other}}
        for held, other in rows
    ]  # fmt: skip


@pytest.mark.parametrize(
    ('over_held', 'over_shuffled', 'word'),
    [
        ((2.0, 2.5, 2.2, 1.9), (3.0, 3.5, 2.6, 3.1), 'yes'),
        ((2.0, 2.5, 2.2, 1.9), (0.05, -0.04, 0.02, 0.01), 'no'),
        ((2.0, 2.5, 2.2, 1.9), (3.0, -3.0, 2.0, -1.0), 'cannot tell'),
        ((2.0, 2.5), (3.0, 3.2), 'cannot tell'),
    ],
)
def test_commands_are_followed_where_both_margins_are_shown(over_held, over_shuffled, word):
    found = following(picture_estimates(episodes(over_held, over_shuffled)))
    assert found.word == word
    assert found.line.startswith(f'follows the commands: {word} (')


@pytest.mark.parametrize(
    ('value', 'interval', 'num_episodes', 'word'),
    [
        (0.3, (0.2, 0.4), 4, 'yes'),
        (-0.19, (-0.25, -0.12), 36, 'no'),
        (0.1, (-0.1, 0.3), 4, 'cannot tell'),
        (-0.1, (nan, nan), 4, 'cannot tell'),
        (-0.2, (nan, nan), 2, 'yes'),
        (nan, (nan, nan), 0, 'yes'),
    ],
)
def test_commands_are_not_followed_where_objects_are_worse_than_held(
    value, interval, num_episodes, word
):
    pictures = picture_estimates(episodes((2.0, 2.5, 2.2, 1.9), (3.0, 3.5, 2.6, 3.1)))
    objects = Estimate(value=value, interval=interval, num_episodes=num_episodes)
    found = following(pictures, objects)
    assert found.word == word
    assert ('J of moving objects' in found.why) == (num_episodes >= 3)


def test_margins_are_over_the_chunks_that_all_baselines_have():
    """Other commands were imagined in the first chunk alone, where the model is worse."""
    compared = {'psnr_changed': 14.0, 'psnr_changed_held': 12.0, 'psnr_changed_shuffled': 11.0,
                'psnr': 24.0, 'psnr_held': 23.0, 'psnr_shuffled': 20.0}  # fmt: skip
    alone = {'psnr_changed': 20.0, 'psnr_changed_held': 10.0, 'psnr': 30.0, 'psnr_held': 26.0}
    found = mean_pictures([(8, {'low': compared}), (4, {'low': alone})])['low']
    assert found['psnr_changed'] == pytest.approx((8 * 14 + 4 * 20) / 12)  # of all chunks
    assert found['psnr_changed_over_held'] == 2.0  # not (8 * 2 + 4 * 10) / 12
    assert found['psnr_changed_over_shuffled'] == 3.0
    assert (found['psnr_over_held'], found['psnr_over_shuffled']) == (1.0, 4.0)
    without = mean_pictures([(8, {'low': alone}), (4, {'low': alone})])['low']
    assert without['psnr_changed_over_held'] == 10.0
    assert 'psnr_changed_over_shuffled' not in without
    estimates = picture_estimates([{'low': found}, {'low': without}, {'low': found}])
    assert estimates['margin_over_held'].value == 2.0
    assert estimates['margin_over_held'].num_episodes == 2
    assert estimates['psnr_changed'].num_episodes == 3
    why = following(estimates, chunks=(2, 6)).why
    assert '2 episodes, 2 of 6 chunks' in why


def test_without_other_commands_nothing_is_said():
    found = following(picture_estimates([{'low': {'psnr_changed': 15.0}}] * 4))
    assert found.word == 'cannot tell' and 'no frames were imagined' in found.why


def test_one_episode_is_told_how_many_it_takes():
    found = following(picture_estimates([{'low': {'psnr_changed': 15.0}}]))
    assert found.line == 'follows the commands: cannot tell (episodes: 1, give at least 3)'
    few = following(picture_estimates(episodes((2.0, 2.5), (3.0, 3.2))))
    assert few.line.endswith('2 episodes, give at least 3)')


@pytest.mark.parametrize(
    ('psnr', 'word'),
    [
        ((19.9, 20.1, 19.8, 20.3), WORSE),  # the held frame has 23.9 dB
        ((19.9,), WORSE),
        ((23.5,), 'cannot tell'),  # too near for one episode
        ((19.9, 31.0, 19.8, 30.3), 'cannot tell'),
    ],
)
def test_frames_further_off_than_the_held_frame_are_worse_than_a_still_picture(psnr, word):
    chunks = [[(8, {'low': {'psnr': value, 'psnr_held': 23.9}})] for value in psnr]
    found = following(picture_estimates([mean_pictures(chunk) for chunk in chunks]))
    assert found.word == word
    if word == WORSE:
        line = found.line
        assert line.startswith('the imagined frames are worse than a still picture (PSNR -')
        assert 'against the first frame held' in line
