"""Held-out episodes during a training: scores are logged, and the best checkpoint is kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import json
import math
from pathlib import Path

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.training.log import TrainingLog
from mtv_world_ros.training.trainer import Trainer

_BEST = 'best.json'


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """What held-out episodes say of a checkpoint.

    Attributes:
        score: the higher the better; NaN = it says nothing.
        numbers: by name, for the log.
    """

    score: float
    numbers: Mapping[str, float]


#: judges the checkpoint in a folder, after so many steps; evaluation is none of training's matter
Judge = Callable[[Path, int], Judged]


class HeldOut:
    """Has a training's checkpoint judged now and then.

    Args:
        judge: scores it.
        every: steps between two times; the last step is one, too.

    Raises:
        ConfigError: `every` is not positive.
    """

    def __init__(self, judge: Judge, every: int) -> None:
        if every < 1:
            raise ConfigError(f'--sample-every is {every}; give at least 1 step')
        self._judge, self._every = judge, every

    def after(self, step: int, trainer: Trainer, log: TrainingLog) -> None:
        """Judges the averaged weights if it is time; the best go to `checkpoint-best/`.

        Or to `adapter-best/`, where an adapter is trained.
        """
        if step % self._every and step != trainer.config.optimizer.steps:
            return
        folder = trainer.folder
        trainer.export(trainer.result)
        judged = self._judge(trainer.result, step)
        log.write(step, dict(judged.numbers))
        best = folder / _BEST
        known = json.loads(best.read_text())['score'] if best.is_file() else -math.inf
        if judged.score > known:
            trainer.export(folder / f'{trainer.result.name}-best')
            partial = best.with_name(f'{_BEST}.partial')
            partial.write_text(json.dumps({'step': step, 'score': judged.score}))
            partial.rename(best)
