"""The short part of `make rate`: bursts, and a node that is stopped while they come."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')

from robustness.rate import answer_times, BUFFERS_FULL, BURST, Ended, growth, overlap_s, Rate


def test_each_plan_of_bursts_gets_one_end(tmp_path, monkeypatch):
    monkeypatch.setattr('robustness.rate.STOP_EVERY', 100)
    rate = Rate(tmp_path, bundled=False)
    try:
        rate.run(2 * BURST + 80, 20.0)
        row = rate.row()
    finally:
        rate.close()
    assert row['plans'] > 2 * BURST
    wrong = ('without_end', 'several_ends', 'unknown_ends', 'tracebacks', 'died')
    assert {key: row[key] for key in wrong} == dict.fromkeys(wrong, 0)


def test_the_time_of_a_stop_is_no_answer_time_of_the_node():
    """Sent .5 s before a stop of 1.5 s and answered .25 s after it: it took .75 s."""
    stopped_s = overlap_s((10.0, 12.25), (10.5, 12.0))
    assert stopped_s == 1.5
    ended = [
        Ended(10.0, 2.25, stopped_s, 0.5, 2.2, 'done'),
        Ended(13.0, 2.5, 0.0, 0.0, 0.1, 'done'),
    ]
    assert [one.quiet_s for one in ended] == pytest.approx([0.25, 2.5])
    assert answer_times(ended[:1], 'stopped_')['stopped_worst_s'] == pytest.approx(0.75)
    assert answer_times(ended[1:], '')['worst_s'] == pytest.approx(2.5)
    assert answer_times([], '') == {
        'answers': 0, 'median_s': None, 'p95_s': None, 'p99_s': None, 'worst_s': None
    }  # fmt: skip
    assert overlap_s((10.0, 10.2), (10.5, 12.0)) == overlap_s((12.5, 13.0), (10.5, 12.0)) == 0.0


def test_growth_is_of_plans_after_the_buffers_are_full_or_said_to_be_unknown():
    filling = [(number, 100.0 + number / 100) for number in range(0, BUFFERS_FULL, 10)]
    flat = [(number, 130.0 + number / 2000) for number in range(BUFFERS_FULL, 5000, 10)]
    assert growth(filling + flat) == pytest.approx(0.5)
    assert growth(filling) == 'not measured: 2990 plans'
    assert growth([]) == 'not measured: 0 plans'
