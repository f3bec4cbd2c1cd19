from math import isnan, nan

import pytest

from mtv_world_ros.success.estimator import verdict


@pytest.mark.parametrize(('probability', 'said'), [(0, 0), (0.499, 0), (0.75, 1), (1, 1)])
def test_sure_estimates_have_a_verdict(probability, said):
    assert verdict(probability) == said


@pytest.mark.parametrize('probability', [0.5, 0.74, nan])
def test_a_success_by_half_is_open(probability):
    assert isnan(verdict(probability))


@pytest.mark.parametrize(
    ('probability', 'interval', 'said'),
    [
        (0.9, (0.5, 1.0), 1.0),
        (0.9, (0.49, 1.0), nan),  # it may be a failure
        (0.1, (0.0, 0.74), 0.0),
        (0.1, (0.0, 0.75), nan),  # it may be a success
        (0.9, (nan, nan), 1.0),  # an older result without an interval
        (0.6, (0.59, 0.61), nan),
    ],
)
def test_an_interval_that_reaches_the_opposite_verdict_leaves_it_open(probability, interval, said):
    found = verdict(probability, interval)
    assert found == said or (isnan(found) and isnan(said))
