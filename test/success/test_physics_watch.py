"""What came of plans against what was foreseen."""

from math import isnan, nan

import numpy as np
import pytest

from mtv_world_ros.core.data_types import SuccessEstimate
from mtv_world_ros.success.doubts import PhysicsWatch, SAYS, unforeseen, widened


def futures(*ways):
    """(K, 2, 1, 3): one object that begins anywhere and goes each of these ways."""
    starts = np.array([[0.1, 0.2, 0.02], [0.3, 0.0, 0.02], [0.0, 0.0, 0.0]])[: len(ways)]
    return np.stack([starts, starts + np.array(ways)], axis=1)[:, :, None]


def test_the_nearest_future_counts():
    foreseen = futures((0.1, 0, 0), (0.0, 0, 0), (0.2, 0, 0))
    real = np.array([[[1.0, 1.0, 1.0]], [[1.13, 1.0, 1.0]]])
    assert unforeseen(foreseen, real) == pytest.approx(0.03)


def test_what_rests_as_foreseen_or_is_not_seen_tells_nothing():
    still = futures((0, 0, 0), (0.01, 0, 0))
    assert isnan(unforeseen(still, np.zeros((2, 1, 3))))
    assert isnan(unforeseen(futures((0.1, 0, 0)), np.full((2, 1, 3), nan)))
    # an object that nobody foresaw to move
    real = np.array([[[0.0, 0.0, 0.0]], [[0.2, 0.0, 0.0]]])
    assert unforeseen(still, real) == pytest.approx(0.19)


def test_a_few_surprises_are_chance_and_many_are_another_physics():
    watch = PhysicsWatch()
    assert watch.text == 'not compared yet' and not watch.doubt
    for away in (0.01, 0.02, nan, 0.01, 0.2):
        watch.take(away)
    assert not watch.doubt and watch.text == 'as it was fitted, by 4 executed chunks'
    watch.take(0.2)
    watch.take(0.3)
    # three of six: binomial tail at .15 is .047; four of seven: .012; five of eight: .0029
    assert not watch.doubt
    watch.take(0.1)
    assert not watch.doubt
    watch.take(0.1)
    assert watch.doubt.startswith(f'{SAYS}: 5 of the last 8 executed chunks')
    assert watch.text == watch.doubt
    watch.forget()
    assert watch.text == 'not compared yet'


def test_estimates_widen():
    sure = SuccessEstimate(
        probability=0.96, interval=(0.9, 1.0), jaccard=np.zeros((2, 1)), reasons=('why',)
    )
    found = widened(sure, 'another physics')
    assert found.probability == pytest.approx(0.73)
    assert found.interval == (pytest.approx(0.38), 1.0)
    assert found.reasons == ('another physics', 'why')
    none = SuccessEstimate(
        probability=nan, interval=(nan, nan), jaccard=np.zeros((2, 1)), reasons=('abstains',)
    )
    assert isnan(widened(none, 'another physics').probability)
