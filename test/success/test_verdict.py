from math import isnan, nan

import pytest

from mtv_world_ros.success.estimator import verdict


@pytest.mark.parametrize(('probability', 'said'), [(0, 0), (0.499, 0), (0.75, 1), (1, 1)])
def test_sure_estimates_have_a_verdict(probability, said):
    assert verdict(probability) == said


@pytest.mark.parametrize('probability', [0.5, 0.74, nan])
def test_a_success_by_half_is_open(probability):
    assert isnan(verdict(probability))
