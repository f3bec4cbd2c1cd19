"""Log of a training: progress, `log.jsonl` and TensorBoard."""

from __future__ import annotations

import json
from pathlib import Path
import time
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from mtv_world_ros.core.bounded_input import parse_json
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.training.trainer import StepReport

#: steps per row of the log
_EVERY = 10


class TrainingLog:
    """Writer of the log; a resumed training continues it after the saved state.

    Args:
        folder: folder of `log.jsonl` and `tensorboard/`.
        step: number of the step at which the training starts; later rows are dropped.
        total: number of steps of the training.
        active: False writes nothing, for all processes except the main one.
        ideal_seconds: ideal seconds of a step at the machine's peak arithmetic rate; None =
            unknown.
    """

    def __init__(
        self,
        folder: Path,
        *,
        step: int,
        total: int,
        active: bool = True,
        ideal_seconds: float | None = None,
    ) -> None:
        self._total, self._active, self._ideal = total, active, ideal_seconds
        self._bar = Progress(
            total=total, initial=step, desc='training', unit='step', is_shown=active
        )
        self._started = time.monotonic()
        self._steps, self._seconds, self._waited = 0, 0.0, 0.0
        if active:
            self._file = _cut(folder / 'log.jsonl', step).open('a')
            self._board = SummaryWriter(str(folder / 'tensorboard'), purge_step=step + 1)

    def __enter__(self) -> TrainingLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
        if self._active:
            self._file.close()
            self._board.close()

    def add(self, report: StepReport) -> None:
        """Count a step; write every tenth and the last one."""
        self._bar.update()
        self._steps += 1
        self._seconds += report.seconds
        self._waited += report.waited
        if not self._active or (report.step % _EVERY and report.step != self._total):
            return
        self._bar.set_postfix(loss=f'{report.average:.4f}')
        row = {
            'loss': round(report.average, 6),
            'learning_rate': report.learning_rate,
            'grad_norm': round(report.grad_norm, 4),
            **self._speed(),
            'seconds': round(time.monotonic() - self._started, 1),
        }
        self.write(report.step, row)

    def _speed(self) -> dict[str, float]:
        """Return the speed since the last row: steps per second and fraction of waiting."""
        seconds = max(self._seconds, 1e-9)
        found = {
            'steps_per_second': round(self._steps / seconds, 4),
            'wait_share': round(self._waited / seconds, 4),
        }
        if self._ideal is not None:
            found['mfu'] = round(self._steps * self._ideal / seconds, 4)
        self._steps, self._seconds, self._waited = 0, 0.0, 0.0
        return found

    def write(self, step: int, row: dict[str, Any]) -> None:
        """Write numbers of a step."""
        if not self._active:
            return
        self._file.write(json.dumps({'step': step, **row}) + '\n')
        self._file.flush()
        for name, value in row.items():
            if name != 'seconds':
                self._board.add_scalar(name, value, step)


def _cut(file: Path, step: int) -> Path:
    """Drop the rows after a step, and one that was cut off in the middle."""
    if file.is_file():
        kept = []
        for line in file.read_text(errors='replace').splitlines(keepends=True):
            try:
                if parse_json(line, 'the row')['step'] > step:
                    break
            except (ValueError, LookupError, TypeError):
                break
            kept.append(line)
        write_whole(file, ''.join(kept))
    return file
