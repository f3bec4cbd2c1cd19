"""Measurements on real recordings: the words of verdicts, and means of differences."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest

from mtv_world_ros.core.data_types import SuccessEstimate
from test.support.scripts import imported_scripts


@pytest.fixture(scope='module')
def script():
    """The script, which imports its neighbour `page`."""
    with imported_scripts('real_recordings') as (module,):
        yield module


def score(recording, view, arm, moving):
    return {
        'recording': recording,
        'view': view,
        'arm_first': 0.3,
        'arm_first_recorded': 0.35,
        'arm': arm,
        'arm_recorded': 0.4,
        'psnr': 24.0,
        'psnr_held': 20.0,
        'moving': moving,
        'moving_held': 0.4,
    }


def test_mean_differences_count_a_recording_once_and_state_an_interval(script):
    scores = [
        score('0001', 'ext1', 0.2, 0.5),
        score('0001', 'ext2', 0.4, 0.6),  # two views, one recording: -.1 in the mean
        score('0007', 'ext1', 0.3, 0.4),
        score('0008', 'ext1', 0.35, nan),
    ]
    rows = {words: rest for words, *rest in script.mean_rows(scores)}
    # -.1, -.1, -.05: mean -.083, standard error .0167, t of two degrees 4.303
    assert rows['J of the arm, whole: imagined less recorded frames'] == [
        '-0.083',
        '[-0.155, -0.012]',
        '3',
    ]
    # two recordings have objects that move: too few for an interval
    assert rows['J of moving objects, whole: imagined less held'] == ['+0.075', '-', '2']


@pytest.mark.parametrize(
    ('probability', 'interval', 'word'),
    [
        (0.97, (0.8, 1.0), 'success'),
        (0.9, (0.2, 1.0), 'open'),  # the interval reaches a failure
        (0.03, (0.0, 0.2), 'failure'),
        (nan, (nan, nan), 'abstains'),
    ],
)
def test_a_verdict_is_a_word_only_where_its_interval_allows_it(
    script, probability, interval, word
):
    found = SuccessEstimate(
        probability=probability,
        interval=interval,
        jaccard=np.full((1, 1), nan),
        reasons=('over it',),
    )
    row = script.verdict_row('0001', 3.04, found)
    assert row[1] == '3.0' and row[3:] == (word, 'over it')


def test_stops_of_fingers_are_compared_with_objects_that_go_along(script):
    tools, cup, box = (np.tile(np.eye(4), (6, 1, 1)) for _ in range(3))
    tools[:, 0, 3] = [0.0, 0.0, 0.02, 0.04, 0.06, 0.5]
    cup[:, 0, 3] = [0.01, 0.01, 0.03, 0.05, 0.05, 0.05]  # let go after the third step
    box[:, 1, 3] = 1.0
    stopped = np.array([False, True, True, False, False, True])
    counts = script.agreement(tools, np.stack([cup, box], axis=1), stopped)
    assert counts.tolist() == [[2, 1], [1, 1]]
    assert script.runs_of(stopped) == [(1, 2), (5, 5)]
