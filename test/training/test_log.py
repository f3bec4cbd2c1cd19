"""The log: rates and shares of the steps since the last row; a resumed run goes on whole."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mtv_world_ros.training.log import TrainingLog
from mtv_world_ros.training.trainer import StepReport


def report(step: int) -> StepReport:
    """Half a second a step, a fifth of it waited."""
    return StepReport(
        step=step,
        loss=float(step),
        average=float(step),
        learning_rate=1e-3,
        grad_norm=1.0,
        seconds=0.5,
        waited=0.1,
    )


def rows(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / 'log.jsonl').open()]


def test_a_row_has_rate_wait_share_and_utilisation(tmp_path):
    with TrainingLog(tmp_path, step=0, total=25, ideal_seconds=0.2) as log:
        for step in range(1, 26):
            log.add(report(step))
    found = rows(tmp_path)
    assert [row['step'] for row in found] == [10, 20, 25]
    for row in found:
        assert row['steps_per_second'] == pytest.approx(2.0)
        assert row['wait_share'] == pytest.approx(0.2)
        assert row['mfu'] == pytest.approx(0.4)  # 0.2 s of arithmetic in 0.5 s
    assert list((tmp_path / 'tensorboard').iterdir())


def test_rows_after_the_saved_state_and_torn_ones_are_made_again(tmp_path):
    with TrainingLog(tmp_path, step=0, total=100) as log:
        for step in range(1, 41):
            log.add(report(step))
    with (tmp_path / 'log.jsonl').open('a') as file:
        file.write('{"step": 50, "lo')
    with TrainingLog(tmp_path, step=25, total=100) as log:
        for step in range(26, 31):
            log.add(report(step))
    assert [row['step'] for row in rows(tmp_path)] == [10, 20, 30]
    assert 'mfu' not in rows(tmp_path)[0]


def test_processes_but_the_main_one_write_nothing(tmp_path):
    with TrainingLog(tmp_path, step=0, total=10, active=False) as log:
        for step in range(1, 11):
            log.add(report(step))
    assert not list(tmp_path.iterdir())
