"""Several seeds as one estimate."""

from dataclasses import replace
from math import nan

import numpy as np
import pytest

from mtv_world_ros.core.data_types import SuccessEstimate
from mtv_world_ros.rollout.prediction import mean_estimate


def estimate(probability, *reasons):
    return SuccessEstimate(
        probability=probability,
        interval=(nan, nan),
        jaccard=np.array([[0.5]]),
        reasons=reasons or ('fine',),
        features={'margin': 1.0},
    )


def test_one_seed_stays_as_it_is():
    alone = estimate(0.3)
    assert mean_estimate([alone]) is alone


def test_interval_is_students_of_the_mean():
    # mean .5, s = .1, n = 3: t(.975, 2) = 4.303 (tables), half width .2484
    found = mean_estimate([estimate(0.4), estimate(0.5), estimate(0.6)])
    assert found.probability == pytest.approx(0.5)
    assert found.spread == pytest.approx(0.1)
    assert found.interval == pytest.approx((0.2516, 0.7484), abs=1e-4)
    assert found.num_seeds == 3
    assert 'given the world model' in found.reasons[0]
    assert found.features == {'margin': 1.0}


def test_interval_stays_within_what_a_probability_can_be():
    assert mean_estimate([estimate(0.9), estimate(1.0)]).interval == (
        pytest.approx(0.3147, abs=1e-3),
        1,
    )


def test_seeds_that_agree_are_no_surer_than_one_of_them():
    """Noise of the world model says nothing of what the futures do not know."""
    one = replace(estimate(0.67), interval=(0.36, 0.9))
    assert mean_estimate([one, one, one]).interval == (pytest.approx(0.36), pytest.approx(0.9))


def test_one_of_two_that_know_is_not_most_of_them():
    found = mean_estimate([estimate(0.9), estimate(nan, 'abstains: lost')])
    assert np.isnan(found.probability) and np.isnan(found.interval).all()
    assert found.trust == 'cannot tell, because 1 of 2 seeds cannot: lost'


def test_two_of_three_that_know_are():
    found = mean_estimate([estimate(0.9), estimate(nan, 'abstains: lost'), estimate(0.7)])
    assert found.probability == pytest.approx(0.8)
    assert found.reasons[0].startswith('mean of 2 of 3 seeds')
