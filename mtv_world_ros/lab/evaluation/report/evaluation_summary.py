"""All episodes of one checkpoint, summed up into metrics.json, CSV and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.files import write_json, write_whole
from mtv_world_ros.lab.documents import DASH, Table
from mtv_world_ros.lab.evaluation.metrics.horizon import by_chunk, Curve, curve
from mtv_world_ros.lab.evaluation.metrics.picture_scores import (
    Following,
    following,
    KINDS,
    MEASURES,
    picture_estimates,
)
from mtv_world_ros.lab.evaluation.metrics.scores import FRAME_FIELDS, MOVING_RULE, ScoreRow
from mtv_world_ros.lab.evaluation.metrics.statistics import Estimate, METHOD, summarise
from mtv_world_ros.lab.evaluation.metrics.success_agreement import agreement, Judgement
from mtv_world_ros.lab.evaluation.report import tables
from mtv_world_ros.lab.evaluation.results import EpisodeResult

BRACKETS = (
    f'Brackets: {METHOD}. J moving, persistence and shuffled actions: of the '
    'objects that really move.'
)
_NO_OBJECTS = (
    'No object is named in any episode, so that none is scored: pictures are compared instead. '
    'Name objects with `--describer`, or in the episodes.'
)
#: why a column is empty although objects that move were scored
_NOT_MADE = {
    'j_shuffled_moving': "no rollout was imagined with another episode's actions (`--actions`, "
    'or there is no other episode)',
    'j_ceiling_moving': 'no recorded frame went through an autoencoder (`--no-ceiling`, or the '
    'model has none)',
    'j_self_moving': 'recorded frames were not scored themselves (`--no-ceiling`)',
}
#: what a set of episodes that the model was trained for is called beside zero-shot sets
SEEN = 'seen'


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Episodes that are summed up together; empty = any.

    Attributes:
        task: their task.
        zero_shot: `seen`, or what the model was not trained for in them.
    """

    task: str | None = None
    zero_shot: str | None = None

    def holds(self, result: EpisodeResult) -> bool:
        """Whether an episode is one of them."""
        fits = self.zero_shot in (None, result.zero_shot or SEEN)
        return fits and self.task in (None, result.task)


ALL = Group()


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationSummary:
    """All episodes of one checkpoint.

    Attributes:
        name: of the checkpoint.
        label: of its rows in tables that compare checkpoints.
        spec: of the model.
        settings: of the evaluation, by name; written to metrics.json.
        results: scored episodes.
        failed: reason by path of those that could not be.
        provenance: versions, machine and command, by heading.
        distances: FID and FVD by (zero-shot set, view), the set None for all episodes.
    """

    name: str
    label: str = ''
    spec: WorldModelSpec
    settings: Mapping[str, Any]
    results: Sequence[EpisodeResult]
    failed: Mapping[str, str]
    provenance: Mapping[str, str] = field(default_factory=dict)
    distances: Mapping[tuple[str | None, str], Mapping[str, Estimate]] = field(
        default_factory=dict
    )

    def with_distances(
        self, distances: Mapping[tuple[str | None, str], Mapping[str, Estimate]]
    ) -> EvaluationSummary:
        """Returns the same with FID and FVD."""
        return replace(self, distances=distances)

    def write(self, out: Path) -> str:
        """Writes metrics.json, rows.csv and tables.md; returns the tables."""
        write_json(out / 'metrics.json', self.metrics())
        rows = ((r.episode, r.task, row) for r in self.results for row in r.rows)
        write_whole(out / 'rows.csv', tables.rows_csv(rows))
        text = self.markdown()
        write_whole(out / 'tables.md', text)
        return text

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks."""
        return sorted({result.task for result in self.results})

    @property
    def zero_shot_sets(self) -> list[str]:
        """Names of the zero-shot sets, `seen` first; empty if there are none."""
        sets = {result.zero_shot for result in self.results} - {''}
        seen = [SEEN] if any(not result.zero_shot for result in self.results) else []
        return [*seen, *sorted(sets)] if sets else []

    def chosen(self, group: Group = ALL) -> list[EpisodeResult]:
        """Returns the results of a group."""
        return [result for result in self.results if group.holds(result)]

    def estimates(self, view: str | None, group: Group = ALL) -> dict[str, Estimate]:
        """Returns the numbers of a view (None = all) and a group."""
        means = [result.means(view) for result in self.chosen(group)]
        found = summarise(means)
        measured = self.distances.get((group.zero_shot, view or ''), {})
        return {**found, **(measured if group.task is None else {})}

    def metrics(self) -> dict[str, Any]:
        """Returns what metrics.json holds."""
        seconds = float(np.mean([result.seconds_per_chunk for result in self.results]))
        source = "the simulator's" if all(r.has_ids for r in self.results) else "the segmenter's"
        return {
            'name': self.name,
            'label': self.label,
            'provenance': self.provenance,
            'num_episodes': len(self.results),
            'episodes': [result.episode for result in self.results],
            'num_episodes_failed': len(self.failed),
            'failed': self.failed,
            'notes': {r.episode: r.notes for r in self.results if r.notes},
            **self.settings,
            'model': asdict(self.spec),
            'num_episodes_with_true_masks': self.num_true,
            'moving_rule': MOVING_RULE.format(source=source),
            'follows_commands': asdict(self.following),
            'pictures': self._pictures(),
            'interval': f'{METHOD}; of FID and FVD jackknife over groups of episodes',
            **self._numbers(ALL),
            'tasks': {task: self._group(Group(task=task)) for task in self.tasks},
            'zero_shot': {
                name: self._group(Group(zero_shot=name)) for name in self.zero_shot_sets
            },
            'success': agreement(
                [Judgement(probability=r.probability, outcome=r.outcome) for r in self.results]
            ),
            'seconds_per_chunk': seconds,
            'seconds_per_episode': self._seconds(),
            'real_time_factor': self.spec.chunk_seconds / seconds if seconds else None,
        }

    def markdown(self) -> str:
        """Returns the tables: view by number, task and view by number, statuses, failures."""
        views = [*self.spec.views]
        counts = ', '.join(
            f'{len(self.chosen(Group(task=task)))} of {task or "no task"}' for task in self.tasks
        )
        by_view = [(view, self.estimates(view)) for view in views]
        sets = [(f'{name} · {view}', self.estimates(view, Group(zero_shot=name)))
                for name in self.zero_shot_sets for view in views]  # fmt: skip
        by_task = [(f'{task} · {view}', self.estimates(view, Group(task=task)))
                   for task in self.tasks for view in views]  # fmt: skip
        of_objects = [
            self._truth(),
            BRACKETS,
            tables.markdown_table([*by_view, ('all views', self.estimates(None))], 'view'),
            self._why_dashes(),
            tables.markdown_table(sets, 'zero-shot set · view') if sets else '',
            tables.markdown_table(by_task, 'task · view'),
            tables.controls_table(by_view),
            self._chunks_table(),
        ]
        parts = [
            self.following.line,
            f'# {self.name or "Evaluation"}\n\n{len(self.results)} episodes: {counts}.',
            *(of_objects if self._has_objects else [_NO_OBJECTS, BRACKETS]),
            tables.quality_table(by_view),
            self._pictures_table(),
            tables.status_table({view: self._statuses(view) for view in views})
            if self._has_objects
            else '',
            '\n'.join(f'- not scored: {path}: {why}' for path, why in self.failed.items()),
            '\n'.join(f'- {r.episode}: {note}' for r in self.results for note in r.notes),
        ]
        return '\n\n'.join(part for part in parts if part) + '\n'

    @property
    def following(self) -> Following:
        """Whether the model follows the commands, by pictures alone."""
        return following(picture_estimates([result.pictures for result in self.results]))

    def _pictures(self) -> dict[str, Any]:
        """Picture scores by view, with intervals."""
        episodes = [result.pictures for result in self.results]
        views = {view: picture_estimates(episodes, view) for view in self.spec.views}
        return {
            view: {name: asdict(estimate) for name, estimate in found.items()}
            for view, found in {**views, 'overall': picture_estimates(episodes)}.items()
        }

    def _pictures_table(self) -> str:
        """Picture scores beside the held frame and shuffled commands; empty without any."""
        episodes = [result.pictures for result in self.results if result.pictures]
        if not episodes:
            return ''
        rows = [
            [f'{view or "all views"} · {words}',
             *(tables.cell(found.get(f'{name}{suffix}')) for name in MEASURES)]
            for view in (*self.spec.views, None)
            for found in [picture_estimates(episodes, view)]
            for suffix, words in KINDS.items()
            if any(f'{name}{suffix}' in found for name in MEASURES)
        ]  # fmt: skip
        return Table(head=['pictures', *MEASURES.values()], rows=rows).text()

    @property
    def _has_objects(self) -> bool:
        return bool(self._rows(None, ALL))

    def _why_dashes(self) -> str:
        """Why numbers of objects are not there, a line each; empty where all are."""
        missing = [
            key for key in tables.COLUMNS if tables.cell(self.estimates(None).get(key)) == DASH
        ]
        named = [row for row in self._rows(None, ALL) if row.name]
        scored = [row for row in named if np.isfinite(row.j)]
        if not missing:
            return ''
        if not scored:
            counts = ', '.join(f'{n} {word}' for word, n in self._statuses(None).items())
            return f'Dashes: no named object could be scored in any stretch ({counts}).'
        if not any(row.moving for row in scored):
            return 'Dashes: no object that was scored really moves.'
        lines = [
            f'Dashes of {tables.COLUMNS[key]}: {_NOT_MADE[key]}.'
            for key in missing
            if key in _NOT_MADE
        ]
        return '\n'.join(lines)

    @property
    def num_true(self) -> int:
        """Episodes that were scored against the simulator's masks."""
        return sum(r.has_ids for r in self.results) if self.settings.get('use_ids') else 0

    def _truth(self) -> str:
        """What the predictions were scored against."""
        others = len(self.results) - self.num_true
        if not others:
            return (
                "Ground truth: the simulator's masks. 'Segmenter alone' is the segmenter's own J "
                'on the recorded frames; no prediction can be expected to exceed it.'
            )
        where = f' in {others} of {len(self.results)} episodes' if self.num_true else ''
        return (
            f"Ground truth: the segmenter's own masks of the recorded frames{where}. Its errors "
            'there do not show in the numbers, and a ceiling of 1 says nothing.'
        )

    def _chunks_table(self) -> str:
        """J against the number of the chunk; empty where no rollout has two."""
        if self.num_chunks < 2:
            return ''
        curves = {view: self.chunk_curve(view) for view in (*self.spec.views, None)}
        head = ['J of objects that move, chunk', *(view or 'all views' for view in curves)]
        rows = [
            [str(k + 1), *(tables.point(c.values, c.band, k) for c in curves.values())]
            for k in range(self.num_chunks)
        ]
        return Table(head=head, rows=rows).text()

    def _numbers(self, group: Group) -> dict[str, Any]:
        return {
            'views': {view: self._view(view, group) for view in self.spec.views},
            'overall': self._view(None, group),
        }

    def _group(self, group: Group) -> dict[str, Any]:
        return {'num_episodes': len(self.chosen(group)), **self._numbers(group)}

    def _rows(self, view: str | None, group: Group) -> list[ScoreRow]:
        return [
            row
            for result in self.chosen(group)
            for row in result.rows
            if row.name and view in (None, row.view)
        ]

    def _statuses(self, view: str | None, group: Group = ALL) -> dict[str, int]:
        found = [row.status for row in self._rows(view, group)]
        return {word: found.count(word) for word in sorted(set(found))}

    def _view(self, view: str | None, group: Group) -> dict[str, Any]:
        rows = self._rows(view, group)
        return {
            **tables.estimates_json(self.estimates(view, group)),
            'num_rows': len(rows),
            'num_moving': sum(row.moving for row in rows),
            'num_not_scored': sum(not np.isfinite(row.j) for row in rows),
            'status': self._statuses(view, group),
            **self._horizon(view, group),
        }

    def _horizon(self, view: str | None, group: Group) -> dict[str, Any]:
        """J of moving objects by predicted frame, with intervals."""
        episodes = [result.rows for result in self.chosen(group)]
        found: dict[str, Any] = {}
        for name in FRAME_FIELDS:
            drawn = curve(episodes, view, name, min_share=0)
            key = f'{name.removesuffix("_frames")}_moving_by_frame'
            found[key], found[f'{key}_interval'] = drawn.values, drawn.band
        if self.num_chunks > 1:
            drawn = self.chunk_curve(view, group)
            found |= {'j_moving_by_chunk': drawn.values, 'j_moving_by_chunk_interval': drawn.band}
        return found

    @property
    def num_chunks(self) -> int:
        """Chunks of the longest rollout."""
        frames = [row.num_frames for result in self.results for row in result.rows]
        return -(-max(frames, default=0) // self.spec.num_frames)

    def chunk_curve(self, view: str | None, group: Group = ALL) -> Curve:
        """Returns J of moving objects by chunk of a view (None = all), with intervals."""
        episodes = [result.rows for result in self.chosen(group)]
        return by_chunk(episodes, view, 'j_frames', self.spec.num_frames)

    def _seconds(self) -> dict[str, float]:
        """Mean time of an episode by what it went into [s]."""
        stages = self.results[0].seconds
        return {name: float(np.mean([r.seconds[name] for r in self.results])) for name in stages}
