"""Scores of episodes, and the files that sum them up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.evaluation import tables
from mtv_world_ros.evaluation.outcomes import agreement, Judgement
from mtv_world_ros.evaluation.scores import MOVING_RULE, ScoreRow
from mtv_world_ros.evaluation.statistics import episode_means, Estimate, horizon, summarise

BRACKETS = (
    'Brackets: 95 % bootstrap over episodes. J moving, persistence and shuffled actions: of the '
    'objects that really move.'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeResult:
    """Scores of one episode.

    Attributes:
        episode: name of its folder.
        task: its name.
        outcome: `success`, `failure` or `unknown`.
        rows: scores.
        probability: the success estimate at the end of its last stretch; NaN = abstained.
        reasons: of that estimate.
        seconds_per_chunk: mean time to imagine a chunk [s].
        has_ids: which objects move was read from recorded identities.
    """

    episode: str
    task: str
    outcome: str
    rows: tuple[ScoreRow, ...]
    probability: float
    reasons: tuple[str, ...]
    seconds_per_chunk: float
    has_ids: bool

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        return {**asdict(self), 'rows': [row.as_json() for row in self.rows]}

    @staticmethod
    def from_json(values: dict[str, Any]) -> EpisodeResult:
        """The inverse of `as_json`, read back from a file."""
        read: dict[str, Any] = dict(values)
        read['rows'] = tuple(ScoreRow.from_json(row) for row in values['rows'])
        read['reasons'] = tuple(values['reasons'])
        read['probability'] = np.nan if values['probability'] is None else values['probability']
        return EpisodeResult(**read)


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """All episodes of one checkpoint.

    Attributes:
        name: of the checkpoint.
        spec: of the model.
        settings: how it was evaluated, by name; goes into metrics.json.
        results: scored episodes.
        failed: reason by path of those that could not be.
        provenance: what the results were made with, by heading.
        seed: of the bootstrap.
        num_resamples: of the bootstrap.
    """

    name: str
    spec: WorldModelSpec
    settings: Mapping[str, Any]
    results: Sequence[EpisodeResult]
    failed: Mapping[str, str]
    provenance: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    num_resamples: int = 2000

    def write(self, out: Path) -> str:
        """Writes metrics.json, rows.csv and tables.md; returns the tables."""
        tables.write_json(out / 'metrics.json', self.metrics())
        rows = ((r.episode, r.task, row) for r in self.results for row in r.rows)
        tables.write_text(out / 'rows.csv', tables.rows_csv(rows))
        text = self.markdown()
        tables.write_text(out / 'tables.md', text)
        return text

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks."""
        return sorted({result.task for result in self.results})

    def estimates(self, view: str | None, task: str | None = None) -> dict[str, Estimate]:
        """Returns the numbers of a view (None = all) and a task (None = all)."""
        chosen = [result for result in self.results if task in (None, result.task)]
        means = [episode_means(result.rows, view) for result in chosen]
        return summarise(means, seed=self.seed, num_resamples=self.num_resamples)

    def metrics(self) -> dict[str, Any]:
        """Returns what metrics.json holds."""
        seconds = float(np.mean([result.seconds_per_chunk for result in self.results]))
        source = "the simulator's" if all(r.has_ids for r in self.results) else "the segmenter's"
        return {
            'name': self.name,
            'provenance': self.provenance,
            'num_episodes': len(self.results),
            'episodes': [result.episode for result in self.results],
            'num_episodes_failed': len(self.failed),
            'failed': self.failed,
            **self.settings,
            'model': asdict(self.spec),
            'moving_rule': MOVING_RULE.format(source=source),
            'interval': f'95 % bootstrap over episodes, {self.num_resamples} resamples',
            'views': {view: self._view(view) for view in self.spec.views},
            'overall': self._view(None),
            'tasks': {task: self._task(task) for task in self.tasks},
            'success': agreement(
                [Judgement(probability=r.probability, outcome=r.outcome) for r in self.results]
            ),
            'seconds_per_chunk': seconds,
            'real_time_factor': self.spec.chunk_seconds / seconds if seconds else None,
        }

    def markdown(self) -> str:
        """Returns the tables: view by number, and task and view by number."""
        views = [*self.spec.views]
        counts = ', '.join(
            f'{sum(r.task == task for r in self.results)} of {task or "no task"}'
            for task in self.tasks
        )
        by_view = [(view, self.estimates(view)) for view in views]
        by_task = [
            (f'{t} · {view}', self.estimates(view, t)) for t in self.tasks for view in views
        ]
        parts = [
            f'# {self.name or "Evaluation"}\n\n{len(self.results)} episodes: {counts}.',
            BRACKETS,
            tables.markdown_table([*by_view, ('all views', self.estimates(None))], 'view'),
            tables.markdown_table(by_task, 'task · view'),
        ]
        if self.failed:
            parts.append('\n'.join(f'- not scored: {p}: {why}' for p, why in self.failed.items()))
        return '\n\n'.join(parts) + '\n'

    def _task(self, task: str) -> dict[str, Any]:
        views = {view: self._view(view, task) for view in self.spec.views}
        number = sum(result.task == task for result in self.results)
        return {'num_episodes': number, 'views': views, 'overall': self._view(None, task)}

    def _view(self, view: str | None, task: str | None = None) -> dict[str, Any]:
        chosen = [result for result in self.results if task in (None, result.task)]
        rows = [row for r in chosen for row in r.rows if row.name and view in (None, row.view)]
        status = sorted({row.status for row in rows})
        return {
            **tables.estimates_json(self.estimates(view, task)),
            'num_rows': len(rows),
            'num_moving': sum(row.moving for row in rows),
            'num_not_scored': sum(not np.isfinite(row.j) for row in rows),
            'status': {word: sum(row.status == word for row in rows) for word in status},
            'j_moving_by_frame': horizon(rows),
            'j_copy_moving_by_frame': horizon(rows, 'j_copy_frames'),
            'j_shuffled_moving_by_frame': horizon(rows, 'j_shuffled_frames'),
        }
