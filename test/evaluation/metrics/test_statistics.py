from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.evaluation.metrics.jaccard_scores import episode_means, ScoreRow
from mtv_world_ros.evaluation.metrics.statistics import (
    clustered_wilson,
    mean_interval,
    summarise,
    wilson,
)

NAN = float('nan')


def row(j, copy, *, name='red block', view='low', moving=True, frames=4):
    return ScoreRow(
        stretch=0, num_frames=frames, view=view, name=name, status='ok', moving=moving, j=j,
        j_visible=j, j_copy=copy, j_self=1.0,
    )  # fmt: skip


def test_frames_weigh_equally_within_an_episode():
    means = episode_means([row(1.0, 0.5, frames=3), row(0.0, 0.5, frames=1)], 'low')
    assert means['j_object_mean'] == 0.75 and means['margin_moving'] == 0.25


def test_still_objects_count_for_the_mean_but_not_for_the_moving_ones():
    means = episode_means([row(0.4, 0.2), row(1.0, 1.0, moving=False)], None)
    assert means['j_object_mean'] == 0.7
    assert means['j_moving'] == 0.4 and means['j_copy_moving'] == 0.2


def test_what_is_imagined_to_move_joins_what_really_moves():
    grasped = replace(row(0.1, 1.0, moving=False), moving_imagined=True)
    means = episode_means([row(0.5, 0.2), grasped, row(1.0, 1.0, moving=False)], None)
    assert means['j_moving'] == 0.5 and means['j_moving_either'] == pytest.approx(0.3)
    assert ScoreRow.from_json(grasped.as_json()).moving_imagined
    older = grasped.as_json()
    del older['moving_imagined']
    assert not ScoreRow.from_json(older).moving_imagined


def test_unscored_rows_leave_the_baseline_too():
    means = episode_means([row(0.4, 0.2), row(NAN, 0.9)], None)
    assert means['j_copy_moving'] == 0.2


def test_margins_are_over_the_rows_and_episodes_that_have_all_baselines():
    compared = replace(row(0.6, 0.4), j_shuffled=0.1)
    found = episode_means([compared, row(0.9, 0.1)], None)
    assert found['j_moving'] == 0.75 and found['j_copy_moving'] == 0.25  # of all rows
    assert found['margin_moving'] == pytest.approx(0.2)  # of the first alone
    assert found['margin_over_shuffled'] == pytest.approx(0.5)
    assert found['margin_of_shuffled'] == pytest.approx(-0.3)
    alone = episode_means([row(0.9, 0.1)], None)
    assert alone['margin_moving'] == 0.8 and np.isnan(alone['margin_over_shuffled'])
    both = summarise([found, alone])
    assert both['margin_moving'].num_episodes == both['margin_over_shuffled'].num_episodes == 1
    assert both['margin_moving'].value == pytest.approx(0.2)
    assert summarise([alone])['margin_moving'].value == 0.8
    assert both['j_moving'].num_episodes == 2


def test_union_row_is_no_object():
    means = episode_means([row(0.4, 0.2), row(0.9, 0.8, name='')], 'low')
    assert means['j_object_mean'] == 0.4 and means['j_union'] == 0.9


def test_episode_without_a_moving_object_does_not_count_as_zero():
    episodes = [episode_means([row(0.6, 0.2)], None), episode_means([], None)]
    found = summarise(episodes)['j_moving']
    assert found.value == 0.6 and found.num_episodes == 1


def test_interval_is_that_of_the_mean():
    rng = np.random.default_rng(1)
    scores = rng.normal(0.6, 0.1, 200)
    episodes = [episode_means([row(float(s), float(s) - 0.1)], None) for s in scores]
    found = summarise(episodes)
    half = 1.96 * scores.std() / np.sqrt(200)
    low, high = found['j_moving'].interval
    assert low == pytest.approx(scores.mean() - half, abs=0.003)
    assert high == pytest.approx(scores.mean() + half, abs=0.003)


def test_margin_is_paired_so_its_interval_ignores_how_episodes_differ():
    scores = np.linspace(0.2, 0.9, 20)
    noise = np.resize([0.001, -0.001], 20)
    pairs = zip(scores.tolist(), noise.tolist(), strict=True)
    episodes = [episode_means([row(s, s - 0.1 + e)], None) for s, e in pairs]
    found = summarise(episodes)
    assert found['margin_moving'].interval == pytest.approx((0.1, 0.1), abs=1e-3)
    assert found['j_moving'].interval[1] - found['j_moving'].interval[0] > 0.1


def test_skill_is_that_of_the_means():
    found = summarise([episode_means([row(0.8, 0.6)], None)])
    assert found['skill'].value == pytest.approx(0.5)


def test_too_few_episodes_and_equal_ones_have_no_interval():
    for scores in ((0.2,), (0.2, 0.9), (0.5, 0.5, 0.5, 0.5)):
        found = summarise([episode_means([row(s, 0.1)], None) for s in scores])
        assert np.isfinite(found['j_moving'].value)
        assert np.isnan(found['j_moving'].interval).all()


def test_no_interval_leaves_the_range_of_its_number():
    found = summarise([episode_means([row(s, 1 - s)], None) for s in (0.0, 1.0, 1.0)])
    assert found['j_moving'].interval == (0.0, 1.0)
    assert found['margin_moving'].interval == (-1.0, 1.0)
    assert found['skill_moving'].interval[1] <= 1.0


@pytest.mark.parametrize('num', [4, 8, 20, 60])
def test_95_percent_intervals_of_means_cover_where_episodes_differ_in_length(num):
    """4,000 sets of episodes of 8 to 16 values, whose J is spread as a Beta of mean .6."""
    rng = np.random.default_rng(num)
    counts = rng.integers(8, 17, (num, 4000)).astype(float)
    values = rng.beta(6, 4, (num, 4000))
    means, (low, high) = mean_interval(values * counts, counts)
    assert 0.93 <= ((low <= 0.6) & (high >= 0.6)).mean() <= 0.97
    assert means.mean() == pytest.approx(0.6, abs=0.01)


@pytest.mark.parametrize('num', [8, 20, 60])
def test_intervals_of_shares_cover_where_rollouts_share_a_scene(num):
    """Ten rollouts a scene; an interval that takes them for independent covers too little."""
    rng = np.random.default_rng(num)
    covered, naive = [], []
    for _ in range(1000):
        share = rng.uniform(0.2, 0.8)
        hits = rng.binomial(10, rng.beta(4 * share, 4 * (1 - share), num))
        low, high = clustered_wilson(hits, np.full(num, 10))
        covered.append(low <= share <= high)
        low, high = wilson(hits.sum(), 10 * num)
        naive.append(low <= share <= high)
    assert 0.93 <= np.mean(covered) <= 0.975 and np.mean(naive) < 0.8


def test_share_of_scenes_that_are_all_alike_counts_scenes_and_not_rollouts():
    low, high = clustered_wilson(np.zeros(5), np.full(5, 10))
    assert low == 0.0 and high > wilson(0, 50)[1]
    assert np.isnan(clustered_wilson(np.ones(2), np.full(2, 10))).all()


def test_wilson_is_scipys():
    stats = pytest.importorskip('scipy.stats')
    for hits, count in ((0, 1), (1, 1), (3, 7), (59, 60)):
        expected = stats.binomtest(hits, count).proportion_ci(method='wilson')
        assert wilson(hits, count) == pytest.approx((expected.low, expected.high), abs=1e-9)
    assert np.isnan(wilson(0, 0)).all()


def test_nothing_measured_is_nan():
    found = summarise([episode_means([row(NAN, NAN)], None)])
    assert np.isnan(found['j_moving'].value) and np.isnan(found['j_moving'].interval).all()
