"""Table of fresh seeds: coverage of intervals, the estimate of before, the table of results."""

from __future__ import annotations

from argparse import Namespace
from math import isnan, nan
from pathlib import Path
import re

import pytest

from mtv_world_ros.success.calibration import Calibration
from mtv_world_ros.success.share_fit import ShareEstimate
from test.support.scripts import imported_scripts


@pytest.fixture(scope='module')
def script():
    """The script, which imports its neighbours `page` and `shifted_worlds`."""
    with imported_scripts('unseen_faults') as (module,):
        yield module


def lines(hits, count):
    return [{'final': number < hits} for number in range(count)]


@pytest.mark.parametrize(
    ('hits', 'interval', 'strict', 'loose'),
    [
        (18, (0.8, 0.99), '1.00', '1.00'),
        (20, (0.8, 0.99), '1.00', '1.00'),  # all of 20 are a rate of .975 or more
        (15, (0.8, 0.99), '0.00', '1.00'),  # 15 of 20 may be chance: Wilson to .89
        (6, (0.8, 0.99), '0.00', '0.00'),
        (10, (0.02, 0.99), '1.00', '1.00'),
    ],
)
def test_a_group_is_covered_if_its_rate_lies_within_the_interval(
    script, hits, interval, strict, loose
):
    estimates = [ShareEstimate(0.93, *interval)] * 20
    assert script.coverage(lines(hits, 20), estimates) == ['20', strict, loose]


def test_groups_are_of_like_estimates_and_those_without_an_interval_do_not_count(script):
    estimates = [ShareEstimate(0.05, 0.0, 0.2)] * 4 + [ShareEstimate(0.95, 0.6, 1.0)] * 6
    estimates += [ShareEstimate(nan, nan, nan), ShareEstimate(0.8, nan, nan)]
    real = [{'final': False}] * 4 + [{'final': True}] * 6 + [{'final': False}] * 2
    found = script.groups(real, estimates)
    assert [(hits, count) for hits, count, _ in found] == [(0, 4), (6, 6)]
    assert script.coverage([], []) == ['0', '–', '–']


OLD = Calibration(
    features=('margin', 'grasp', 'foreseen'),
    means=(0.0, 0.0, 0.0),
    scales=(1.0, 1.0, 1.0),
    weights=(1.0, 8.0, 2.0),
    bias=0.0,
    segmenter='colour',
    tasks=('stack',),
    num_episodes=8,
)


def test_the_estimate_of_before_counts_frames_beside_the_motion_and_is_that_of_like_pictures(
    script,
):
    said = {
        'features': {'margin': 1.5, 'grasp': -1.0, 'foreseen': 0.125, 'released': 1.0},
        'reasons': ["stack: 'at its top' held by 15 mm, known to 5 mm"],
    }
    scene = ['stack', 0, 7, 'expert']
    rows = [
        {'job': ['nominal', *scene], 'final': True, 'said': {'bundled': {script.BOTH: said}}},
        {'job': ['bold', *scene], 'final': False, 'said': {'bundled': {}}},
        {'job': ['camera_off', *scene], 'final': True, 'said': {'bundled': {}}},
    ]
    found = script.before(OLD, rows, 'bundled')
    # `camera_off` shows another picture
    assert set(found) == {('nominal', script.BEFORE), ('bold', script.BEFORE)}
    ((_, (estimate,)), (_, (other,))) = found.values()
    # 1 / (1 + exp(-(1.5 + .25))), margins of 1.0 and 2.0 at the ends; the grasp does not count
    assert estimate == pytest.approx((0.8520, 0.7773, 0.9047), abs=1e-4) and other == estimate
    rows[0]['said']['bundled'][script.BOTH] = {'features': None}
    assert isnan(script.before(OLD, rows, 'bundled')['bold', script.BEFORE][1][0].probability)


def test_the_block_of_the_results_page_has_a_row_for_each_judge(script, monkeypatch):
    rows = [{'final': k % 2 == 0, 'job': ['nominal', 'stack', 0, k // 4]} for k in range(16)]
    sure = [ShareEstimate(0.95 if r['final'] else 0.05, nan, nan) for r in rows]
    made = [
        script.row(physics, judge, rows, sure)
        for physics, judge in (
            ('nominal', script.BOTH),
            ('nominal', script.FORESEEN),
            ('bold', script.FORESEEN),
            ('bold', script.AS_FITTED),
            ('nominal', script.RULE),
            ('bold', script.RULE),
        )
    ]
    text = script.block(made, 4, '1,2', 16)
    body = [line.split(' | ') for line in text.splitlines() if line.startswith('| ')][2:]
    assert [row[0].strip('| *') for row in body] == [
        script.BOTH, script.FORESEEN, script.AS_FITTED, script.RULE,
    ]  # fmt: skip
    assert body[1][1] == '16 of 16' and body[1][3] == '1.00'
    assert re.sub(r' \[.*?\]', '', body[1][2]) == '8 of 8; 8 of 8'
    assert body[1][4:8] == [
        '16 of 16', '8 of 8; 8 of 8', '1.00 (1.00, `bold`)', '1.00 (1.00, `bold`)',
    ]  # fmt: skip
    assert '2 seeds (1,2)' in text and '`bold`' in text
    assert script.of_seed(
        Namespace(logs=Path('logs'), seed=0, faults='', log=None), 5
    ).log == Path('logs/5.jsonl')
