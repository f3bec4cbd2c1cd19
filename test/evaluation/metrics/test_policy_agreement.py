import numpy as np
import pytest

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.evaluation.metrics.policy_agreement import (
    mean_maximum_rank_violation,
    pearson,
    powered_mean,
    rate_agreement,
    rates,
)

# SIMPLER (arXiv 2405.05941), task move_near: rt-2-x, rt-1-converged, rt-1-15pct, rt-1-x,
# rt-1-begin, octo-base, on the real robot and in simulation; as in its repository
REAL = [0.733, 0.633, 0.583, 0.450, 0.017, 0.350]
SIMULATED = [0.779, 0.442, 0.354, 0.317, 0.050, 0.042]


def test_simplers_table_gives_its_published_scores():
    assert pearson(SIMULATED, REAL) == pytest.approx(0.856, abs=1e-3)
    assert mean_maximum_rank_violation(SIMULATED, REAL) == pytest.approx(0.1110, abs=1e-4)


def test_rank_violations_weigh_by_the_true_rates_so_the_order_of_arguments_matters():
    assert mean_maximum_rank_violation(REAL, SIMULATED) == pytest.approx(0.0027, abs=1e-4)


def test_ties_are_violations_for_the_better_policy():
    # by hand: both are judged alike, the first is better by .4; only its own worst pair counts
    assert mean_maximum_rank_violation([0.5, 0.5], [0.9, 0.5]) == pytest.approx(0.2)
    assert mean_maximum_rank_violation([0.1, 0.5], [0.5, 0.5]) == 0.0


def test_what_is_not_known_does_not_count():
    assert pearson([*SIMULATED, np.nan], [*REAL, 1.0]) == pearson(SIMULATED, REAL)
    assert mean_maximum_rank_violation([0.1, np.nan, 0.3], [0.1, 0.0, 0.2]) == 0.0
    assert np.isnan(pearson([0.5], [0.5])) and np.isnan(pearson([0.5, 0.5], [0.1, 0.9]))
    assert np.isnan(mean_maximum_rank_violation([np.nan, 0.1], [0.1, 0.2]))
    with pytest.raises(ConfigError, match='same policies'):
        pearson([0.1], [0.1, 0.2])


def test_point_lies_within_its_interval_which_narrows_with_episodes():
    generator = np.random.default_rng(0)
    truth = np.linspace(0.1, 0.9, 6)[:, None, None]

    def outcomes(num):
        uniform = generator.uniform(size=(2, 6, 2, num))
        return (uniform[0] < truth).astype(float), (uniform[1] < truth * 0.8).astype(float)

    widths = []
    for num in (8, 60):
        real, imagined = outcomes(num)
        found = rate_agreement(imagined, real)
        assert found['pearson'].observed == pearson(rates(imagined), rates(real))
        assert found['mmrv'].observed == mean_maximum_rank_violation(rates(imagined), rates(real))
        for name, least in (('pearson', -1.0), ('mmrv', 0.0)):
            low, high = found[name].interval
            assert least <= low <= found[name].noise_free <= high <= 1.0 and low < high
        low, high = found['pearson'].interval
        widths.append(high - low)
    assert widths[1] < widths[0]


def test_without_noise_r_is_larger_than_observed_and_mmrv_is_smaller():
    """Two worlds of the same rates, whose luck is independent: r is 1 on endless scenes."""
    rng = np.random.default_rng(2)
    truth = np.linspace(0.2, 0.8, 12)[:, None, None]
    real, imagined = (rng.uniform(size=(2, 12, 1, 20)) < truth).astype(float)
    found = rate_agreement(imagined, real)
    assert found['pearson'].observed < found['pearson'].noise_free
    assert found['pearson'].interval[1] > 0.99
    assert found['mmrv'].observed > found['mmrv'].noise_free


def test_estimates_scatter_less_than_outcomes_so_that_less_is_taken_out_of_their_r():
    rng = np.random.default_rng(4)
    chance = np.linspace(0.1, 0.9, 10)[:, None, None]
    true, outcomes = (rng.random((2, 10, 1, 20)) < chance).astype(float)
    estimates = np.broadcast_to(chance, true.shape) + rng.uniform(-0.05, 0.05, true.shape)
    loose, near = (rate_agreement(judged, true)['pearson'] for judged in (outcomes, estimates))
    assert near.observed > loose.observed
    assert near.noise_free - near.observed < loose.noise_free - loose.observed


def test_imagination_that_is_the_truth_has_no_interval_of_width_zero():
    """Without any scene the score is the same, so nothing is known of its spread."""
    real = np.random.default_rng(1).integers(0, 2, (5, 2, 10)).astype(float)
    for judged in (real, np.full((5, 2, 10), np.nan)):
        for found in rate_agreement(judged, real).values():
            assert np.isnan(found.interval).all() and np.isnan(found.noise_free)
    assert rate_agreement(real, real)['pearson'].observed == pytest.approx(1.0)


def test_a_single_episode_of_each_task_is_too_few_for_an_interval():
    rng = np.random.default_rng(0)
    for shape in ((6, 3, 1), (6, 1, 2), (2, 3, 10)):
        real, imagined = rng.integers(0, 2, (2, *shape)).astype(float)
        assert np.isnan(rate_agreement(imagined, real)['pearson'].interval).all()


def test_outcomes_that_are_missing_or_all_alike_do_no_harm():
    rng = np.random.default_rng(4)
    real, imagined = rng.integers(0, 2, (2, 6, 3, 4)).astype(float)
    imagined[0], imagined[1, 0], imagined[2, :, 1] = np.nan, np.nan, np.nan
    real[3], imagined[4] = 1.0, 0.0
    low, high = rate_agreement(imagined, real)['pearson'].interval
    assert -1.0 <= low < high <= 1.0


def test_powered_mean_is_the_one_computed_by_hand():
    # mean of more = 5/8; errors 0, 0, 1, 0: mean 1/4, variance 1/4; variance of more 15/56;
    # 0.625 + 0.25 and 3.18 sqrt(1/16 + 15/448), cut to a rate's range
    found = powered_mean([1, 0, 1, 1], [1, 0, 0, 1], [1, 1, 0, 0, 1, 0, 1, 1], weight=1.0)
    assert found.value == pytest.approx(0.875)
    half = 3.182446 * (1 / 16 + 15 / 448) ** 0.5  # t of three degrees, from a table
    assert found.interval == pytest.approx((max(0.875 - half, 0.0), 1.0))
    assert (found.num_true, found.num_more) == (4, 8)


def test_without_use_the_predictions_weigh_nothing():
    true = [1.0, 0.0, 1.0, 1.0, 0.0]
    for predicted, more in (([0.5] * 5, [0.5] * 9), ([0, 1, 0, 0, 1], [0, 1, 1]), (true, [])):
        found = powered_mean(true, predicted, more)
        assert found.weight == 0.0 and found.value == pytest.approx(0.6)
    assert np.isnan(powered_mean([], [], [0.5]).value)
    assert np.isnan(powered_mean([1.0, 1.0], [0.9, 0.9], [0.5, 0.1]).interval).all()
    with pytest.raises(ConfigError, match='in pairs'):
        powered_mean([1.0], [], [0.5])


@pytest.mark.parametrize('bias', [0.0, 0.3])
def test_powered_intervals_cover_and_are_shorter_than_the_classical_ones(bias):
    """400 studies of 40 real and 400 imagined episodes, also where imagination is optimistic."""
    generator = np.random.default_rng(3)
    num_real, num_more, covered, shorter, values = 40, 400, 0, 0, []
    for _ in range(400):
        chance = generator.uniform(size=num_real + num_more)
        true = (generator.uniform(size=len(chance)) < chance).astype(float)
        said = np.clip(chance + 0.1 * generator.normal(size=len(chance)) + bias, 0, 1)
        found = powered_mean(true[:num_real], said[:num_real], said[num_real:])
        plain = powered_mean(true[:num_real], said[:num_real], [])
        values.append(found.value)
        assert 0.0 <= found.interval[0] <= found.value <= found.interval[1] <= 1.0
        covered += found.interval[0] <= 0.5 <= found.interval[1]
        shorter += np.diff(found.interval)[0] < np.diff(plain.interval)[0]
    assert 0.91 < covered / 400 < 0.98 and shorter > 380
    assert np.mean(values) == pytest.approx(0.5, abs=0.015)
