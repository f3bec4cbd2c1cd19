import json
from math import isnan, nan
import re
import xml.etree.ElementTree as ElementTree

import pytest

from mtv_world_ros.ranking.jobs import Job, Result, StoredEstimate
from mtv_world_ros.ranking.judges import judged_by, JUDGES
from mtv_world_ros.ranking.ranking_summary import Summary
from mtv_world_ros.reports.ranking_report import console, markdown, remarks, tables, write_ranking

#: (policy, true outcomes, imagined probabilities) of four episodes
POLICIES = (
    ('good', (1, 1, 1, 1), (0.9, 0.8, 0.7, 0.6)),
    ('fair', (1, 1, 0, 0), (0.9, 0.1, 0.2, nan)),
    ('bad', (0, 0, 0, 0), (0.1, 0.8, 0.2, 0.3)),
)


@pytest.fixture
def summary(make_result):
    results = [
        make_result(policy, index, bool(final), probability)
        for policy, finals, probabilities in POLICIES
        for index, (final, probability) in enumerate(zip(finals, probabilities, strict=True))
    ]
    return Summary(
        results=results, failed={Job(policy='<b>', task='x', index=0, seed=1): 'gone'}, num_true=2,
        provenance={'command': 'mtv-world rank'},
    )  # fmt: skip


def test_rates_are_means_of_estimates_and_verdicts_may_be_open(summary):
    fair = summary.judged_rate('fair', None, 'imagined')
    assert (fair.hits, fair.count, fair.num_unknown) == (pytest.approx(1.2), 3, 1)
    assert fair.value == pytest.approx(0.4)
    assert summary.true_rate('fair', None).value == 0.5
    assert summary.policies == ('good', 'fair', 'bad')
    # .6 and .7 are neither; one has no estimate
    assert summary.abstained('imagined').hits == 3 and summary.abstained('seen').hits == 0
    counts = {'success_success': 3, 'success_failure': 1, 'failure_success': 1}
    assert summary.confusion('imagined') == {**counts, 'failure_failure': 4}


def test_agreement_is_that_of_the_rates(summary):
    # rates judged .75, .4, .35 against true 1, .5, 0: by hand .2 / sqrt(.095 * .5)
    found = summary.agreement('imagined', None)
    assert found['pearson'].value == pytest.approx(0.9177, abs=1e-4)
    assert found['mmrv'].value == 0.0 and found['mmrv'].count == 3
    low, high = found['pearson_noise_free'].interval
    assert low <= found['pearson_noise_free'].value <= high
    assert summary.agreement('seen', None)['pearson'].value == pytest.approx(1.0)


def test_powered_estimates_use_the_first_true_outcomes_alone(summary):
    found = summary.powered('fair')
    # true outcomes 1, 1 do not vary: they and imagination cannot give an interval with weight 0
    assert (found.num_true, found.num_more) == (2, 2)
    good = summary.powered('good')
    assert good.value == pytest.approx(1.0) and isnan(good.interval[0])


def test_speed_compares_both_worlds(summary):
    speed = summary.speed()
    assert speed['imagined episodes an hour'] == pytest.approx(1800)
    assert speed['simulated episodes an hour, with pictures'] == pytest.approx(9000)
    assert speed['simulated episodes an hour, physics alone'] == pytest.approx(36000)


def test_the_page_says_what_the_numbers_hide(summary, make_result):
    text = ' '.join(remarks(summary))
    assert '1 of 12 imagined episodes have no estimate (stack_blocks_two: 1)' in text
    assert '1 rollouts have no result' in text and 'x_00000_<b>: gone' in text
    blind = Summary(
        results=[make_result(p, 0, p == 'a', nan) for p in 'ab'],
        failed={}, num_true=1, provenance={},
    )  # fmt: skip
    text = ' '.join(remarks(blind))
    assert 'r is not defined' in text and 'It judged nothing of stack_blocks_two' in text
    assert 'not defined' in markdown(blind)
    alike = [make_result(p, i, i < 2, 0.9 if i < 2 else 0.1) for p in 'ab' for i in range(4)]
    same = Summary(results=alike, failed={}, num_true=1, provenance={})
    assert 'rates are alike' in ' '.join(remarks(same))


def test_the_page_says_that_two_policies_prove_nothing(make_result):
    pair = [make_result(p, i, p == 'a', 0.9 if p == 'a' else 0.1) for p in 'ab' for i in range(4)]
    two = Summary(results=pair, failed={}, num_true=1, provenance={})
    assert two.agreement('imagined', None)['pearson'].value == pytest.approx(1.0)
    assert 'Of two policies r is 1 or -1 whatever they do' in ' '.join(remarks(two))


@pytest.mark.parametrize(
    ('scenes', 'shown'),
    [
        (1, ('few', 'Cannot tell from 1 scene: give at least 3 (imagination is right in 0.50')),
        (2, ('few', 'Cannot tell from 2 scenes: give at least 3 (imagination is right in 0.50')),
        (3, ('doubt', 'Not shown: imagination is right in 0.50')),
    ],
)
def test_the_first_line_of_the_page_tells_few_scenes_from_a_failure(
    scenes, shown, make_result, tmp_path
):
    pair = [make_result(p, i, p == 'a', 0.9, rule=p == 'a') for p in 'ab' for i in range(scenes)]
    path = write_ranking(Summary(results=pair, failed={}, num_true=1, provenance={}), tmp_path)
    page = path.read_text()
    answer = page[page.index('id="answer"') :]
    style, text = re.search(r'<p class="verdict (\w*)">([^<]*)<', answer).groups()
    assert style == shown[0] and text.startswith(shown[1])
    assert 'Cells: value [95 % interval] count' in page


def test_files_hold_the_same_numbers_and_the_page_is_whole(summary, tmp_path):
    path = write_ranking(summary, tmp_path)
    held = json.loads((tmp_path / 'ranking.json').read_text())
    assert held['policies']['fair']['rates']['all tasks']['imagined']['unknown'] == 1
    assert held['agreement']['imagined']['all tasks']['pearson']['value'] == pytest.approx(
        0.9177, abs=1e-4
    )
    assert '0.40 [0.08, 0.83] of 3, 1 without an estimate' in (tmp_path / 'ranking.md').read_text()
    page = path.read_text()
    assert '&lt;b&gt;' in page and '<b>' not in page
    charts = re.findall(r'<svg.*?</svg>', page, re.DOTALL)
    for chart in charts:
        tree = ElementTree.fromstring(chart)
        assert sum(found.get('class') == 'point' for found in tree.iter('g')) == 3
    assert len(charts) == 4 and not list(tmp_path.rglob('*.part'))


def test_tables_fit_a_console_and_no_column_is_empty(summary, make_result):
    long = [
        make_result(f'expert-elsewhere-0.1{"0" * i}', k, k > i, 0.9 if k else nan, end='time out')
        for i in range(4)
        for k in range(4)
    ]
    many = Summary(results=long, failed=summary.failed, num_true=2, provenance={})
    for one in (summary, many):
        assert 'Agreement with' not in console(one) and 'Agreement with' in markdown(one)
        rows = [line for line in console(one).splitlines() if line.startswith('|')]
        assert rows and max(map(len, rows)) <= 100
        for part in re.findall(r'(?:^\|.*\|\n?)+', console(one), re.M):
            cells = [line[2:-2].split(' | ') for line in part.strip().splitlines()]
            columns = list(zip(*(cells[:1] + cells[2:]), strict=True))
            assert all(any(c.strip() not in ('', '–') for c in col[1:]) for col in columns)


def test_a_result_survives_its_file(make_result):
    result = make_result('a', 0, True, nan)
    values = json.loads(json.dumps(result.as_json()).replace('NaN', 'null'))
    back = Result.from_json(values)
    assert isnan(back.imagined.probability) and back.seen == result.seen
    assert back.imagined.reasons == ('why',) and back.seconds == result.seconds


def test_what_a_picture_is_worth_stands_beside_what_is_foreseen(make_result):
    def said(value):
        return StoredEstimate.stated(value, 'said')

    results = [
        make_result(
            policy,
            index,
            final,
            0.9 if final else 0.2,
            rule=True,
            # motions rank half of the pairs rightly, pictures none
            foreseen=said(1.0 if final or policy == 'expert-miss-1' else 0.0),
            pictures=said(nan if index == 3 else 0.3 if final else 0.8),
        )
        for index in range(6)
        for policy, final in (('expert', True), ('expert-miss-1', False), ('expert-stop-1', False))
    ]
    summary = Summary(results=results, failed={}, num_true=1, provenance={'physics': 'bold: x'})
    worth = summary.worth
    assert {judge: scores['auroc'].value for judge, scores in worth.items()} == {
        'foreseen': 0.75,
        'pictures': 0.0,
        'imagined': 1.0,
        'no_picture': 0.5,
        'seen': 1.0,
    }
    assert worth['foreseen']['false_success'].value == 0.5
    for judge, scores in worth.items():  # of what was said, and of all rollouts
        called = {call: [r for r in summary.results if judged_by(r, judge).success == call]
                for call in (0, 1)}  # fmt: skip
        for call, key in ((1, 'right_success'), (0, 'right_failure')):
            assert scores[key].count == len(called[call])
            if called[call]:
                right = sum(r.final == call for r in called[call]) / len(called[call])
                assert scores[key].value == pytest.approx(right)
        assert scores['auroc_all'].count == len(summary.results)
    # by hand: one success and two failures without a verdict tie, of 6 x 12 pairs
    assert worth['pictures']['auroc_all'].value == pytest.approx(1 / 72)
    assert worth['pictures']['abstention'].value == pytest.approx(3 / 18)
    assert worth['pictures']['auroc'].count == 15
    said_in_json = summary.as_json()['worth']['pictures']['false_success']
    assert said_in_json['value'] == 1.0 and said_in_json['count'] == 10
    first = tables(summary)[0]
    assert [row[0] for row in first.rows] == [judge.title for judge in JUDGES.values()]
    assert 'Truth of the simulator: bold: x.' in remarks(summary)
    assert '[' in str(first.rows[0][3]), 'no interval'
