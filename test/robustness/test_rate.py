"""The short part of `make rate`: bursts, and a node that is stopped while they come."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')

from rate import BURST, Rate


def test_each_plan_of_bursts_gets_one_end(tmp_path, monkeypatch):
    monkeypatch.setattr('rate.STOP_EVERY', 100)
    rate = Rate(tmp_path, bundled=False)
    try:
        rate.run(2 * BURST + 80, 20.0)
        row = rate.row()
    finally:
        rate.close()
    assert row['plans'] > 2 * BURST
    wrong = ('without_end', 'several_ends', 'unknown_ends', 'tracebacks', 'died')
    assert {key: row[key] for key in wrong} == dict.fromkeys(wrong, 0)
