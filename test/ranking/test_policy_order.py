"""Policies are ordered by rollouts of one scene under common futures."""

import json
from math import isnan

import numpy as np
import pytest

from mtv_world_ros.core.data_types import FutureEvidence, SuccessEstimate
from mtv_world_ros.ranking.jobs import Result, StoredEstimate, StoredFutures
from mtv_world_ros.ranking.policy_order import bradley_terry, PolicyOrder
from mtv_world_ros.ranking.ranking_summary import Summary
from mtv_world_ros.reports.ranking_report import (
    best_policy,
    console,
    markdown,
    order_remark,
    write_ranking,
)

#: share of four futures in which each policy succeeds
SUCCESSES = {'good': 4, 'fair': 2, 'bad': 0, 'as bad': 0}


@pytest.fixture
def rollout(make_result):
    def make(policy, index, num, key='k', **more):
        outcomes = tuple(k < num for k in range(4))
        futures = StoredFutures(key=f'{key}{index}', outcomes=outcomes, is_fitted=False)
        return make_result(policy, index, num > 2, 0.6, futures=futures, **more)

    return make


@pytest.fixture
def results(rollout):
    return [rollout(name, k, num) for k in range(6) for name, num in SUCCESSES.items()]


def test_pairs_are_of_one_scene_and_equal_policies_are_not_told(results):
    order = PolicyOrder.of(results)
    assert order.policies[:2] == ('good', 'fair') and order.num_scenes == 6
    found = {(pair.first, pair.second): pair for pair in order.pairs}
    best = found['good', 'fair']
    assert (best.num_first, best.num_second, best.num_scenes) == (6, 0, 6)
    # a uniform prior: six of six
    assert best.better == 'good' and best.confidence == pytest.approx(1 - 0.5**7)
    equal = found.get(('bad', 'as bad')) or found['as bad', 'bad']
    assert equal.better == '' and equal.leader == '' and order.num_ordered == 5
    assert order.strengths[0] > order.strengths[1] > order.strengths[2]
    low, high = order.intervals[0]
    assert 0 < low < order.strengths[0] < high < 1


def test_few_scenes_order_nothing(rollout):
    results = [rollout(name, k, num) for k in range(3) for name, num in SUCCESSES.items()]
    order = PolicyOrder.of(results)
    # three of three: 1 - 1/16 is below .95
    assert order.num_ordered == 0 and len(order.pairs) == 6
    assert all(isnan(low) for low, _ in order.intervals)


def test_rollouts_without_common_futures_are_no_pair(rollout, make_result):
    results = [rollout('good', 0, 4), rollout('bad', 0, 0, key='other')]
    order = PolicyOrder.of([*results, make_result('bad', 1, True, 0.6)])
    assert order.pairs == () and order.num_scenes == 0 and order.num_without == 1
    assert 'not ordered' in order_remark(order) and '--overwrite' in order_remark(order)
    assert isnan(order.strengths[0])


def test_the_answer_names_what_cannot_be_told(results, rollout, make_result):
    few = [rollout(name, k, num) for k in range(3) for name, num in SUCCESSES.items()]
    assert best_policy(_summary(few))[0].startswith(
        'No policy can be called best after 3 scenes: the first, good, is not told from fair'
    )
    bad = [result for result in results if result.policy in ('bad', 'as bad')]
    assert 'is not told from' in best_policy(_summary(bad))[0]
    better = [rollout('better', k, 4) for k in range(6)]
    text = best_policy(_summary([*results, *better]))[0]
    assert 'comes first: better than fair, ' in text and 'not told from ' in text
    without = [make_result('a', 0, True, 0.9), make_result('b', 0, False, 0.2)]
    text = best_policy(_summary(without))[0]
    assert text.startswith('No policy can be called best') and 'a, 0.90' in text
    assert best_policy(_summary(without[:1]))[0].startswith('One policy, a: imagined')


def _summary(results):
    return Summary(results=results, failed={}, num_true=2, provenance={})


def test_strengths_are_those_of_the_shares_of_wins():
    # of 40 scenes the first is better in 30: log odds log 3, halved about the mean, shrunk a bit
    wins = np.zeros((40, 2, 2))
    wins[:30, 0, 1], wins[30:, 1, 0] = 1, 1
    (first, second), (interval, _) = bradley_terry(wins)
    assert first == pytest.approx(3**0.5 / (1 + 3**0.5), abs=0.02)
    assert first + second == pytest.approx(1.0)
    assert interval[0] > 0.5
    # the same comparisons in four scenes say less
    (_, _), (few, _) = bradley_terry(wins.reshape(4, 10, 2, 2).sum(1))
    assert few[0] < interval[0] and few[1] > interval[1]


def test_the_order_comes_first_and_names_the_prior_and_the_fit(results, tmp_path):
    summary = Summary(results=results, failed={}, num_true=2, provenance={})
    text = console(summary)
    answer = 'Best policy: good, better than '
    assert text.startswith(answer) and ', with probability 0.99 or more (6 scenes).' in text
    assert '\n\nOrder of the policies: 5 of 6 pairs are ordered, 6 scenes' in text
    said = ' '.join(text.split())
    assert 'wide prior' in said and '`mtv-world fit contact`' in said
    assert markdown(summary).split('\n## ')[1].startswith('Order of the policies')
    assert markdown(summary).split('\n\n')[1].startswith(f'**{answer}')
    page = write_ranking(summary, tmp_path).read_text()
    assert page.index('id="best"') < page.index('Best policy: good') < page.index('id="order"')
    assert page.index('id="order"') < page.index('id="answer"')
    stored = json.loads((tmp_path / 'ranking.json').read_text())['order']
    assert [pair['better'] for pair in stored['pairs']].count('good') == 3


def test_outcomes_survive_a_file_and_old_files_have_none(results):
    values = json.loads(json.dumps(results[0].as_json()))
    assert Result.from_json(values).futures == results[0].futures
    del values['futures']
    assert Result.from_json(values).futures is None


def test_foreseen_motions_alone_are_judged_by_the_estimator_of_futures():
    futures = FutureEvidence(
        outcomes=(True, False), probability=0.5, interval=(0.1, 0.9), is_fitted=False
    )
    shown = SuccessEstimate(
        probability=0.4, interval=(0.0, 0.95), jaccard=np.zeros((1, 0)), reasons=('why',),
        futures=futures,
    )  # fmt: skip
    alone = StoredEstimate.of_motions(shown)
    assert (alone.probability, alone.interval) == (0.5, (0.1, 0.9)) and isnan(alone.success)
    assert StoredFutures.of(shown, 'key') == StoredFutures(
        key='key', outcomes=(True, False), is_fitted=False
    )
    refused = SuccessEstimate(
        probability=float('nan'), interval=(float('nan'),) * 2, jaccard=np.zeros((1, 0)),
        reasons=('abstains: cameras',), futures=futures,
    )  # fmt: skip
    assert isnan(StoredEstimate.of_motions(refused).probability)
    assert StoredEstimate.of_motions(refused).reasons == ('abstains: cameras',)
    assert StoredFutures.of(refused, 'key') is None and StoredFutures.of(shown, '') is None
