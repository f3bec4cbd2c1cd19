"""What came of plans against what was foreseen."""

from math import isnan, nan

import numpy as np
import pytest

from mtv_world_ros.core.data_types import SuccessEstimate
from mtv_world_ros.success.doubts import PhysicsWatch, SAYS, unforeseen, WATCH, widened


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
    for rollout, away in enumerate((0.01, 0.02, nan, 0.01, 0.2)):
        watch.take(away, rollout)
    assert not watch.doubt and watch.text == 'as it was fitted, by 4 executed chunks'
    watch.take(0.2, 5)
    # evidence 8 x 8 = 64 of 200; each end as foreseen makes it .6 / .95 of that
    assert not watch.doubt
    watch.take(0.3, 6)
    assert watch.doubt.startswith(f'{SAYS}: 3 of 6 executed chunks')
    assert watch.text == watch.doubt
    # it takes as much evidence to the contrary: ln 200 / ln (.95 / .6) = 11.5
    for rollout in range(7, 18):
        watch.take(0.0, rollout)
    assert watch.doubt
    watch.take(0.0, 18)
    assert not watch.doubt
    watch.forget()
    assert watch.text == 'not compared yet'


def test_what_follows_from_a_surprise_in_the_same_rollout_is_no_further_evidence():
    watch = PhysicsWatch()
    for _ in range(20):
        watch.take(0.2, 1)
    assert not watch.doubt and watch.text == 'as it was fitted, by 1 executed chunks'


def run_length(rate, rng):
    """Comparisons until the watch doubts, of which a share ends unforeseen."""
    watch, count = PhysicsWatch(), 0
    while not watch.doubt:
        count += 1
        watch.take(0.2 if rng.random() < rate else 0.0, count)
    return count


def test_false_alarms_are_as_rare_as_stated_and_another_physics_is_noticed():
    rng = np.random.default_rng(0)
    fitted = [run_length(WATCH.max_unforeseen_fraction, rng) for _ in range(60)]
    assert np.mean(fitted) > WATCH.run_length
    other = [run_length(WATCH.other_unforeseen_fraction, rng) for _ in range(200)]
    assert np.median(other) < 15


def test_estimates_widen():
    sure = SuccessEstimate(
        probability=0.96, interval=(0.9, 1.0), jaccard=np.zeros((2, 1)), reasons=('why',)
    )
    found = widened(sure, 'another physics')
    assert found.probability == pytest.approx(0.73)
    assert found.interval == (pytest.approx(0.38), 1.0)
    assert found.reasons == ('why', 'not fitted here: another physics')
    assert not found.is_calibrated
    none = SuccessEstimate(
        probability=nan, interval=(nan, nan), jaccard=np.zeros((2, 1)), reasons=('abstains',)
    )
    assert isnan(widened(none, 'another physics').probability)
