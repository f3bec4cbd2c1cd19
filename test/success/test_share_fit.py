"""Probability and interval of a share of futures."""

import numpy as np
import pytest
from scipy.stats import beta

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.success.share_fit import ShareFit


@pytest.mark.parametrize('share', [0.0, 1 / 16, 9 / 16, 1.0])
def test_the_stated_fit_is_the_posterior_of_the_share(share):
    """Golden: scipy's beta distribution, with a uniform prior."""
    found = ShareFit().estimate(share, 16)
    posterior = beta(16 * share + 1, 16 * (1 - share) + 1)
    assert found.probability == pytest.approx(posterior.mean())
    # the interval is computed on a grid of 199 quantiles
    assert [found.low, found.high] == pytest.approx(posterior.ppf([0.025, 0.975]), abs=0.004)


def test_few_futures_and_uneven_weights_are_less_sure():
    widths = [np.ptp(ShareFit().estimate(0.5, number)[1:]) for number in (4, 8, 16, 64)]
    assert widths == sorted(widths, reverse=True) and widths[0] > 2 * widths[-1]


def test_a_fit_to_few_episodes_widens_the_interval():
    """Golden: draws of share and logistic."""
    fit = ShareFit(bias=-0.5, slope=1.2, covariance=(0.4, -0.1, 0.09), num_episodes=20)
    found = fit.estimate(0.75, 16)
    rng = np.random.default_rng(0)
    rates = rng.beta(13, 5, 200_000)
    drawn = rng.multivariate_normal([-0.5, 1.2], [[0.4, -0.1], [-0.1, 0.09]], len(rates))
    logits = drawn[:, 0] + drawn[:, 1] * np.log(rates / (1 - rates))
    expected = np.quantile(1 / (1 + np.exp(-logits)), [0.025, 0.975])
    assert [found.low, found.high] == pytest.approx(expected, abs=0.015)
    exact = fit.replace(covariance=(0.0, 0.0, 0.0)).estimate(0.75, 16)
    assert exact.probability == found.probability
    assert found.low < exact.low and exact.high < found.high


@pytest.mark.parametrize('share', [1 / 16, 0.5, 15 / 16])
def test_where_nothing_was_fitted_either_side_may_be_what_this_robot_does(share):
    found, fitted = (ShareFit().estimate(share, 16, is_fitted=known) for known in (False, True))
    assert found.probability == fitted.probability
    assert found.low < 0.05 and found.high > 0.95
    for alike in (0.0, 1.0):
        assert ShareFit().estimate(alike, 16, is_fitted=False) == ShareFit().estimate(alike, 16)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'covariance': (1.0, 0.0)}, 'three numbers'),
        ({'covariance': (1.0, 2.0, 1.0)}, 'no covariance'),
        ({'slope': -1.0}, 'slope'),
        ({'max_picture_gap_m': 0.0}, 'max_picture_gap_m'),
    ],
)
def test_a_fit_that_is_none_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        ShareFit(**change)
