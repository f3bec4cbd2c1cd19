"""All episodes of one checkpoint, summed up: what metrics.json holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.evaluation.metrics.grasp_outcomes import Dreams, GRASP_RULE
from mtv_world_ros.evaluation.metrics.horizon import by_chunk, Curve, horizon_curve
from mtv_world_ros.evaluation.metrics.jaccard_scores import (
    DISTANCES,
    FRAME_FIELDS,
    MOVING_RULE,
    ScoreRow,
)
from mtv_world_ros.evaluation.metrics.object_scores import COPY_RULE
from mtv_world_ros.evaluation.metrics.picture_scores import Following, following, picture_estimates
from mtv_world_ros.evaluation.metrics.statistics import Estimate, METHOD, summarise
from mtv_world_ros.evaluation.metrics.success_agreement import agreement, Judgement
from mtv_world_ros.evaluation.results import EpisodeResult, rollout_path
from mtv_world_ros.viewing.scored_rollout import StoredRollout
from mtv_world_ros.viewing.stored_rollout import load_rollout

#: name of the group of episodes that are not zero-shot: the model was trained for them
SEEN = 'seen'
#: heading in the provenance of how many of the episodes the checkpoint was trained on
TRAINING = 'training episodes'
NOT_MEASURED = Estimate(value=nan, interval=(nan, nan), num_episodes=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Episodes that are summed up together; None = any.

    Attributes:
        task: task of the episodes.
        zero_shot: `seen`, or what the model was not trained for in them.
    """

    task: str | None = None
    zero_shot: str | None = None

    def holds(self, result: EpisodeResult) -> bool:
        """Return True if an episode belongs to the group."""
        fits = self.zero_shot in (None, result.zero_shot or SEEN)
        return fits and self.task in (None, result.task)


ALL = Group()


@dataclass(frozen=True, kw_only=True)
class EvaluationSummary:
    """All episodes of one checkpoint.

    Attributes:
        folder: folder of the evaluation.
        name: fingerprint of the checkpoint.
        label: name of its rows in tables that compare checkpoints.
        spec: views, rate and size of the model's frames.
        settings: settings of the evaluation, by name; written to metrics.json.
        results: results of the scored episodes.
        failed: reason by path of those that could not be scored.
        provenance: versions, machine and command, by heading.
        distances: FID and FVD by (zero-shot set, view), the set None for all episodes.
    """

    folder: Path
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

    @property
    def title(self) -> str:
        """Label of the checkpoint, and its fingerprint."""
        name, label = self.name, self.label
        return ' · '.join(part for part in (label, name) if part) if label not in name else name

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
        """Return the results of a group."""
        return [result for result in self.results if group.holds(result)]

    def estimates(self, view: str | None, group: Group = ALL) -> dict[str, Estimate]:
        """Return the mean scores of a view (None = all) and a group, with intervals."""
        means = [result.means(view) for result in self.chosen(group)]
        found = summarise(means)
        measured = self.distances.get((group.zero_shot, view or ''), {})
        return {**found, **(measured if group.task is None else {})}

    def rollout(self, episode: str) -> StoredRollout | None:
        """Return the frames of a scored episode; None where they were not kept.

        Raises:
            EpisodeError: the frames cannot be read.
        """
        path = rollout_path(self.folder, episode)
        return load_rollout(path) if path.is_file() else None

    @property
    def moving_rule(self) -> str:
        """Definition of an object that moves, and whose masks tell it."""
        source = "the simulator's" if all(r.has_ids for r in self.results) else "the segmenter's"
        return f'{MOVING_RULE.format(source=source)}; {COPY_RULE}'

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """Content of metrics.json."""
        seconds = float(np.mean([result.seconds_per_chunk for result in self.results]))
        return {
            'name': self.name,
            'label': self.label,
            'provenance': self.provenance,
            'num_episodes': len(self.results),
            'episodes': [result.episode for result in self.results],
            'num_episodes_failed': len(self.failed),
            'num_chunks': sum(r.num_chunks for r in self.results),
            'num_chunks_with_other_commands': sum(r.num_shuffled for r in self.results),
            'failed': self.failed,
            'notes': {r.episode: r.notes for r in self.results if r.notes},
            **self.settings,
            'model': asdict(self.spec),
            'num_episodes_with_true_masks': self.num_true,
            'moving_rule': self.moving_rule,
            'follows_commands': asdict(self.following),
            'dreams': {**asdict(self.dreams), 'grasp_rule': GRASP_RULE},
            'pictures': {
                view or 'overall': {name: asdict(found) for name, found in estimates.items()}
                for view, estimates in self.pictures.items()
            },
            'interval': f'{METHOD}; of FID and FVD jackknife over groups of episodes',
            **self._numbers(ALL),
            'tasks': {task: self._group(Group(task=task)) for task in self.tasks},
            'zero_shot': {
                name: self._group(Group(zero_shot=name)) for name in self.zero_shot_sets
            },
            'success': agreement(self.judgements),
            'seconds_per_chunk': seconds,
            'seconds_per_episode': self._seconds(),
            'real_time_factor': self.spec.chunk_seconds / seconds if seconds else None,
        }

    @property
    def judgements(self) -> list[Judgement]:
        """Success estimates and true outcomes of the episodes."""
        return [
            Judgement(probability=r.probability, outcome=r.outcome, interval=r.interval)
            for r in self.results
        ]

    @cached_property
    def pictures(self) -> dict[str | None, dict[str, Estimate]]:
        """Picture scores by view; None is the mean over views."""
        episodes = [result.pictures for result in self.results]
        return {view: picture_estimates(episodes, view) for view in (*self.spec.views, None)}

    @property
    def following(self) -> Following:
        """Verdict whether the model follows the commands, from its pictures and moving objects."""
        objects = self.estimates(None).get('margin_moving')
        return following(self.pictures[None], objects, self.num_compared)

    @property
    def dreams(self) -> Dreams:
        """Disagreement of imagined and real grasps, and of moving objects."""
        motions: dict[tuple[str, int, str], list[bool]] = {}
        for result in self.results:
            for row in result.rows:
                if row.name and np.isfinite(row.j):
                    seen = motions.setdefault(
                        (result.episode, row.stretch, row.name), [False, False]
                    )
                    seen[0] |= row.moving
                    seen[1] |= row.moving_imagined
        grasps = [grasp for result in self.results for grasp in result.grasps]
        return Dreams.of(grasps, [(real, imagined) for real, imagined in motions.values()])

    @property
    def num_compared(self) -> tuple[int, int] | None:
        """Number of chunks imagined with shuffled commands, and of all; None = not known."""
        if not all(result.num_chunks for result in self.results):
            return None  # of an earlier version
        num_chunks = sum(result.num_chunks for result in self.results)
        return sum(result.num_shuffled for result in self.results), num_chunks

    @property
    def has_objects(self) -> bool:
        """True if any episode names an object; otherwise only pictures are compared."""
        return bool(self._rows(None, ALL))

    @property
    def num_true(self) -> int:
        """Number of episodes scored against the simulator's masks."""
        return sum(r.has_ids for r in self.results) if self.settings.get('use_ids') else 0

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

    def statuses(self, view: str | None, group: Group = ALL) -> dict[str, int]:
        """Return the counts of each status of an object in a stretch."""
        found = [row.status for row in self._rows(view, group)]
        return {word: found.count(word) for word in sorted(set(found))}

    def _view(self, view: str | None, group: Group) -> dict[str, Any]:
        rows = self._rows(view, group)
        # null where no weights of feature networks were named
        estimates = {**dict.fromkeys(DISTANCES, NOT_MEASURED), **self.estimates(view, group)}
        return {
            **{name: found.value for name, found in estimates.items()},
            'intervals': {name: found.interval for name, found in estimates.items()},
            'num_episodes_with': {name: found.num_episodes for name, found in estimates.items()},
            'num_rows': len(rows),
            'num_moving': sum(row.moving for row in rows),
            'num_not_scored': sum(not np.isfinite(row.j) for row in rows),
            'status': self.statuses(view, group),
            **self._horizon(view, group),
        }

    def _horizon(self, view: str | None, group: Group) -> dict[str, Any]:
        """Return J of moving objects by predicted frame, with intervals."""
        episodes = [result.rows for result in self.chosen(group)]
        found: dict[str, Any] = {}
        for name in FRAME_FIELDS:
            drawn = horizon_curve(episodes, view, name, min_share=0)
            key = f'{name.removesuffix("_frames")}_moving_by_frame'
            found[key], found[f'{key}_interval'] = drawn.values, drawn.band
        if self.num_chunks > 1:
            drawn = self.chunk_curve(view, group)
            found |= {'j_moving_by_chunk': drawn.values, 'j_moving_by_chunk_interval': drawn.band}
        return found

    @property
    def num_chunks(self) -> int:
        """Number of chunks of the longest rollout."""
        frames = [row.num_frames for result in self.results for row in result.rows]
        return -(-max(frames, default=0) // self.spec.num_frames)

    def chunk_curve(self, view: str | None, group: Group = ALL) -> Curve:
        """Return J of moving objects by chunk of a view (None = all), with intervals."""
        episodes = [result.rows for result in self.chosen(group)]
        return by_chunk(episodes, view, 'j_frames', self.spec.num_frames)

    def _seconds(self) -> dict[str, float]:
        """Return the mean time of an episode by what it went into [s]."""
        stages = self.results[0].seconds
        return {name: float(np.mean([r.seconds[name] for r in self.results])) for name in stages}
