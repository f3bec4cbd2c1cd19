import numpy as np
import pytest

from mtv_world_ros.evaluation.metrics.scores import ScoreRow
from mtv_world_ros.evaluation.metrics.statistics import episode_means, summarise
from mtv_world_ros.evaluation.metrics.success_agreement import agreement, Judgement

NAN = float('nan')


def row(j, copy, *, name='red block', view='low', moving=True, frames=4, shuffled=NAN, zero=NAN):
    return ScoreRow(
        stretch=0,
        num_frames=frames,
        view=view,
        name=name,
        status='ok',
        moving=moving,
        j=j,
        j_visible=j,
        j_copy=copy,
        j_shuffled=shuffled,
        j_zero=zero,
        j_mirrored=NAN,
        j_ceiling=NAN,
        j_self=1.0,
        j_frames=(j,) * frames,
        j_copy_frames=(copy,) * frames,
        j_shuffled_frames=(shuffled,) * frames,
    )


def test_frames_weigh_equally_within_an_episode():
    means = episode_means([row(1.0, 0.5, frames=3), row(0.0, 0.5, frames=1)], 'low')
    assert means['j_object_mean'] == 0.75 and means['margin_moving'] == 0.25


def test_still_objects_count_for_the_mean_but_not_for_the_moving_ones():
    means = episode_means([row(0.4, 0.2), row(1.0, 1.0, moving=False)], None)
    assert means['j_object_mean'] == 0.7
    assert means['j_moving'] == 0.4 and means['j_copy_moving'] == 0.2


def test_unscored_rows_leave_the_baseline_too():
    means = episode_means([row(0.4, 0.2), row(NAN, 0.9)], None)
    assert means['j_copy_moving'] == 0.2


def test_union_row_is_no_object():
    means = episode_means([row(0.4, 0.2), row(0.9, 0.8, name='')], 'low')
    assert means['j_object_mean'] == 0.4 and means['j_union'] == 0.9


def test_episode_without_a_moving_object_does_not_count_as_zero():
    episodes = [episode_means([row(0.6, 0.2)], None), episode_means([], None)]
    found = summarise(episodes, num_resamples=100)['j_moving']
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
    episodes = [episode_means([row(float(s), float(s) - 0.1)], None) for s in scores]
    found = summarise(episodes, num_resamples=200)
    assert found['margin_moving'].interval == pytest.approx((0.1, 0.1))
    assert found['j_moving'].interval[1] - found['j_moving'].interval[0] > 0.1


def test_skill_is_that_of_the_means():
    found = summarise([episode_means([row(0.8, 0.6)], None)], num_resamples=10)
    assert found['skill'].value == pytest.approx(0.5)


def test_same_seed_gives_the_same_interval():
    episodes = [episode_means([row(s, 0.1)], None) for s in (0.2, 0.5, 0.9)]
    first, second = (summarise(episodes, seed=3)['margin_moving'] for _ in range(2))
    assert first == second


def test_nothing_measured_is_nan():
    found = summarise([episode_means([row(NAN, NAN)], None)], num_resamples=10)
    assert np.isnan(found['j_moving'].value) and np.isnan(found['j_moving'].interval).all()


def test_agreement_counts_abstentions_apart():
    found = agreement(
        [
            Judgement(probability=0.9, outcome='success'),
            Judgement(probability=0.8, outcome='failure'),
            Judgement(probability=0.1, outcome='failure'),
            Judgement(probability=NAN, outcome='success'),
            Judgement(probability=0.9, outcome='unknown'),
        ]
    )
    assert found['num_outcomes_known'] == 4 and found['num_abstained'] == 1
    assert found['accuracy'] == pytest.approx(2 / 3)
    assert found['false_success_rate'] == 0.5
    assert found['brier'] == pytest.approx((0.01 + 0.64 + 0.01) / 3)


def test_agreement_of_nothing_is_unknown():
    assert agreement([])['accuracy'] is None
