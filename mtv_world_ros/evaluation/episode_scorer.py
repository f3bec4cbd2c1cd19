"""Scores one episode: imagines its stretches, segments, compares, keeps what reports need."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
import time

import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import ByteArray, ObjectMasks
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.evaluation.imagined_stretches import (
    imagine_stretch,
    last_chunk,
    observe_stretch,
    predicted_frames,
    Stretch,
    stretches,
)
from mtv_world_ros.evaluation.metrics.arm_masks import arm_scenes, ArmScene
from mtv_world_ros.evaluation.metrics.feature_store import feature_path, FeatureTaker
from mtv_world_ros.evaluation.metrics.grasp_outcomes import grasp_outcomes, GraspOutcome
from mtv_world_ros.evaluation.metrics.image_quality import ImageQuality
from mtv_world_ros.evaluation.metrics.jaccard_scores import (
    find_masks,
    score_frames,
    score_rows,
    ScoreRow,
    true_masks,
    Truth,
)
from mtv_world_ros.evaluation.metrics.object_scores import object_scores, ObjectScores
from mtv_world_ros.evaluation.metrics.picture_scores import (
    HELD,
    mean_pictures,
    picture_scores,
    RECORDED,
    SHUFFLED,
    weighted,
)
from mtv_world_ros.evaluation.references import Reconstruct, with_actions
from mtv_world_ros.evaluation.results import EpisodeResult, rollout_path, stored_stretch
from mtv_world_ros.evaluation.settings import EvaluationConfig
from mtv_world_ros.robot.shape import load_shape, RobotShape
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.success.estimator import SUCCESS_FROM
from mtv_world_ros.success.task import TaskSpec
from mtv_world_ros.viewing.scored_rollout import StoredRollout
from mtv_world_ros.viewing.stored_rollout import join_stretches, save_rollout

#: stages whose run time is measured
STAGES = ('reading', 'imagining', 'segmenting', 'scoring', 'features', 'storing')


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationJob:
    """Episode to be scored, with its names and options.

    Attributes:
        path: folder of the episode.
        name: name of its results, unique in the evaluation.
        donors: episodes whose actions may replace its own; the first readable one is used.
        zero_shot: property that the model was not trained for: `view`, `task` or `object`; empty =
            none.
        objects: names of its objects; empty = the pipeline's, or recorded, or named by the task.
        task: task that the episode defines; None = the one that its instruction matches.
    """

    path: Path
    name: str
    donors: tuple[Path, ...] = ()
    zero_shot: str = ''
    objects: tuple[str, ...] = ()
    task: TaskSpec | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Instruments:
    """Models and metrics that episodes are evaluated with; None = not measured.

    Attributes:
        pipeline: imagines and segments.
        reconstruct: the autoencoder's round trip, for the ceiling.
        quality: PSNR, SSIM, LPIPS.
        features: features, for FID and FVD.
    """

    pipeline: Pipeline
    reconstruct: Reconstruct | None = None
    quality: ImageQuality | None = None
    features: FeatureTaker | None = None


@dataclass(slots=True)
class _Found:
    """Results gathered over the stretches of an episode, and the task that it defines."""

    task: TaskSpec | None
    rows: list[ScoreRow] = field(default_factory=list)
    grasps: list[GraspOutcome] = field(default_factory=list)
    shares: list[tuple[float, float]] = field(default_factory=list)
    shown: list[StoredRollout] = field(default_factory=list)
    quality: list[tuple[int, dict[str, dict[str, float]]]] = field(default_factory=list)
    pictures: list[tuple[int, dict[str, dict[str, float]]]] = field(default_factory=list)
    scenes: list[ArmScene | None] = field(default_factory=list)
    notes: dict[str, None] = field(default_factory=dict)
    not_imagined: dict[str, list[tuple[float, str]]] = field(default_factory=dict)
    num_shuffled: int = 0
    chunk_seconds: list[float] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - begun


class EpisodeScorer:
    """Scorer of episodes with the same instruments; it caches the last two recordings.

    Rollouts and features go into `out/episodes`.
    """

    def __init__(self, instruments: Instruments, config: EvaluationConfig, out: Path) -> None:
        self.instruments, self.config, self.out = instruments, config, out
        self.pipeline = instruments.pipeline
        self._load = lru_cache(maxsize=2)(self._read)

    def score(self, job: EvaluationJob) -> EpisodeResult:
        """Imagine and score an episode.

        Raises:
            MtvWorldError: the episode cannot be read or imagined.
        """
        found = _Found(job.task)
        with found.timed('reading'):
            recording, donor = self._load(job.path), self._donor(job)
            if self._shape.is_known:
                found.scenes += arm_scenes(recording, self.pipeline.robot, self._shape.parts)
        found.notes.update(dict.fromkeys(recording.warnings))
        features = self.instruments.features and self.instruments.features.start()
        success, observed, resumed, shown = None, {}, {}, np.nan
        names = job.objects or self.pipeline.objects or recording.names
        for stretch in stretches(recording, self.pipeline.spec, self.config.mode):
            chunks = self._stretch(recording, stretch, donor, names, found)
            success = chunks[-1].success
            begin_s = float(recording.times[stretch.start] - recording.times[0])
            found.shares += shares_over_time(chunks, begin_s)
            if self.config.observed:
                with found.timed('segmenting'):
                    pipeline = self._pipeline_for(names, found.task)
                    real = observe_stretch(pipeline, recording, stretch)
                    observed, shown = real.features, real.probability
                last = last_chunk(recording, stretch, self.pipeline.spec)
                if last is not None:
                    chunk = self._imagine(recording, last, recording, names, found)[-1]
                    resumed = chunk.success.features
            if features:
                with found.timed('features'):
                    features.add(predicted_frames(chunks), stretch.frames[:, 1:])
        found.notes.update(dict.fromkeys(_left_out(found)))
        doubt = contradiction(recording.outcome, shown)
        found.notes.update({doubt: None} if doubt else {})
        if SHUFFLED in self.config.actions and donor is None:
            why = 'no other episode can be read' if job.donors else 'there is no other episode'
            found.notes[f'no frames were imagined with other commands: {why}'] = None
        with found.timed('storing'):
            save_rollout(rollout_path(self.out, job.name), join_stretches(found.shown))
            if features:
                features.save(feature_path(self.out, job.name))
        return EpisodeResult(
            episode=job.name,
            task=recording.task,
            zero_shot=job.zero_shot,
            outcome=recording.outcome,
            rows=tuple(found.rows),
            grasps=tuple(found.grasps),
            shares=tuple(found.shares),
            quality=_mean_quality(found.quality),
            pictures=mean_pictures(found.pictures),
            num_chunks=len(found.pictures),
            num_shuffled=found.num_shuffled,
            probability=success.probability if success else np.nan,
            reasons=success.reasons if success else (),
            interval=success.interval if success else (np.nan, np.nan),
            features=dict(success.features) if success else {},
            observed=dict(observed),
            resumed=dict(resumed),
            notes=tuple(found.notes),
            seconds_per_chunk=float(np.mean(found.chunk_seconds)),
            seconds=found.seconds,
            has_ids=recording.object_ids is not None and not recording.masks_by,
            digest=recording.digest,
        )

    def _read(self, path: Path) -> Recording:
        pipeline = self.pipeline
        return load_recording(path, pipeline.spec, pipeline.robot, source=self.config.source)

    def _pipeline_for(self, names: tuple[str, ...], task: TaskSpec | None) -> Pipeline:
        """Return the pipeline for the objects and the own task of an episode."""
        judge = self.pipeline.judge.for_task(task)
        return replace(self.pipeline, objects=names, judge=judge)

    def _donor(self, job: EvaluationJob) -> Recording | None:
        """Return the episode that lends its actions; None if there is none that can be read."""
        if SHUFFLED not in self.config.actions:
            return None
        for path in job.donors:
            try:
                return self._load(path)
            except MtvWorldError:  # listed with its reason when its own turn comes
                continue
        return None

    def _stretch(
        self,
        recording: Recording,
        stretch: Stretch,
        donor: Recording | None,
        names: tuple[str, ...],
        found: _Found,
    ) -> list[Prediction]:
        """Imagine and score one stretch; return its chunks."""
        chunks = self._imagine(
            recording, stretch, recording, names, found, num_seeds=self.config.num_seeds
        )
        found.chunk_seconds += [sum(chunk.seconds.values()) for chunk in chunks]
        frames, real = predicted_frames(chunks), stretch.frames[:, 1:]
        with found.timed('segmenting'):
            truth = true_masks(
                stretch,
                self.pipeline.segmenter,
                names,
                recording.objects,
                use_ids=self.config.use_ids,
            )
            masks = find_masks(frames, truth, self.pipeline.segmenter)
        with found.timed('scoring'):
            predicted = object_scores(masks, truth.masks)
        others, shuffled = self._controls(recording, stretch, donor, truth, found)
        others |= self._ceilings(stretch, truth, found)
        views = self.pipeline.spec.views
        with found.timed('scoring'):
            found.rows += score_rows(stretch, views, truth, predicted, others, masks)
            found.grasps += self._grasps(recording, stretch, truth, masks)
        with found.timed('features'):
            found.quality.append((stretch.num_frames, self._quality(frames, real)))
            pictures = self._pictures(stretch, frames, shuffled, found.scenes)
            found.pictures.append((stretch.num_frames, pictures))
        stored = stored_stretch(
            chunks,
            stretch,
            start_seconds=float(recording.times[stretch.start]),
            fps=self.pipeline.spec.fps,
            true_masks=truth.masks,
            masks=masks,
            j=predicted.frames,
        )
        found.shown.append(stored)
        return chunks

    def _grasps(
        self, recording: Recording, stretch: Stretch, truth: Truth, masks: ObjectMasks
    ) -> tuple[GraspOutcome, ...]:
        """Return the outcomes of the grasps of a stretch, recorded and imagined."""
        motion = Motion.of(
            self.pipeline.robot, recording.cameras_at(stretch.start), stretch.positions
        )
        first = truth.first.masks[:, :, :1]
        real, imagined = (
            np.concatenate([first, found.masks], axis=2) for found in (truth.masks, masks)
        )
        return grasp_outcomes(motion, truth.names, real, imagined, stretch=stretch.index)

    def _imagine(
        self,
        recording: Recording,
        stretch: Stretch,
        actions: Recording,
        names: tuple[str, ...],
        found: _Found,
        num_seeds: int = 1,
    ) -> list[Prediction]:
        with found.timed('imagining'):
            chunks = imagine_stretch(
                self._pipeline_for(names, found.task),
                recording,
                stretch,
                actions=actions,
                seed=self.config.seed + 1000 * stretch.index,
                num_inference_steps=self.config.num_inference_steps,
                num_seeds=num_seeds,
            )
        stages = ('start masks', 'masks')
        masks = sum(chunk.seconds.get(stage, 0.0) for chunk in chunks for stage in stages)
        found.seconds['imagining'] -= masks
        found.seconds['segmenting'] += masks
        return chunks

    def _controls(
        self,
        recording: Recording,
        stretch: Stretch,
        donor: Recording | None,
        truth: Truth,
        found: _Found,
    ) -> tuple[dict[str, ObjectScores], ByteArray | None]:
        """Score rollouts under other actions if an object moves; return their scores and frames.

        Shuffled actions are imagined in any case, and their frames are returned. Actions that the
        robot cannot execute become a note.
        """
        scores: dict[str, ObjectScores] = {}
        shuffled = None
        moves = truth.moving.any()
        for name in self.config.actions if moves else {SHUFFLED} & {*self.config.actions}:
            try:
                actions = with_actions(name, recording, stretch, donor)
                if name == 'true' or actions is None:
                    continue
                chunks = self._imagine(recording, stretch, actions, truth.names, found)
            except MtvWorldError as error:
                begun_s = float(recording.times[stretch.start])
                found.not_imagined.setdefault(name, []).append((begun_s, str(error)))
                continue
            frames = predicted_frames(chunks)
            if name == SHUFFLED:
                shuffled = frames
                found.num_shuffled += 1
            if moves:
                scores[name] = self._scored(frames, truth, found)
        return scores, shuffled

    def _pictures(
        self,
        stretch: Stretch,
        frames: ByteArray,
        shuffled: ByteArray | None,
        scenes: Sequence[ArmScene | None],
    ) -> dict[str, dict[str, float]]:
        """Picture scores by view: imagined, first frame held, shuffled commands, recorded."""
        held = np.repeat(stretch.frames[:, :1], frames.shape[1], axis=1)
        compared = {'': frames, f'_{HELD}': held}
        compared |= {} if shuffled is None else {f'_{SHUFFLED}': shuffled}
        scores = {
            view: {
                f'{name}{suffix}': value
                for suffix, shown in compared.items()
                for name, value in picture_scores(
                    shown[v], stretch.frames[v, 1:], stretch.frames[v, 0]
                ).items()
            }
            for v, view in enumerate(self.pipeline.spec.views)
        }
        compared[f'_{RECORDED}'] = stretch.frames[:, 1:]
        for v, (numbers, scene) in enumerate(zip(scores.values(), scenes, strict=False)):
            if scene is not None:
                masks = scene.masks(stretch.positions[1:])
                for suffix, shown in compared.items():
                    numbers[f'j_arm{suffix}'] = masks.jaccard(shown[v])
        return scores

    @cached_property
    def _shape(self) -> RobotShape:
        return load_shape(self.pipeline.robot)

    def _ceilings(self, stretch: Stretch, truth: Truth, found: _Found) -> dict[str, ObjectScores]:
        """Return the scores of the recorded frames: as they are, and through the autoencoder."""
        if not self.config.ceiling:
            return {}
        scores = {'self': self._scored(stretch.frames[:, 1:], truth, found)}
        if self.instruments.reconstruct is not None:
            with found.timed('imagining'):
                back = self.instruments.reconstruct(stretch.frames)
            scores['ceiling'] = self._scored(back, truth, found)
        return scores

    def _scored(self, frames: ByteArray, truth: Truth, found: _Found) -> ObjectScores:
        with found.timed('segmenting'):
            return score_frames(frames, truth, self.pipeline.segmenter)

    def _quality(self, frames: ByteArray, real: ByteArray) -> dict[str, dict[str, float]]:
        measure = self.instruments.quality
        if measure is None:
            return {}
        each = enumerate(self.pipeline.spec.views)
        return {view: measure(frames[v], real[v]) for v, view in each}


def _mean_quality(
    stretches: Sequence[tuple[int, dict[str, dict[str, float]]]],
) -> dict[str, dict[str, float]]:
    """Return the means over the stretches of an episode by view.

    Frames weigh equally, NaN counts nothing.
    """
    found: dict[str, dict[str, float]] = {}
    for view in stretches[0][1]:
        names = dict.fromkeys(name for _, numbers in stretches for name in numbers[view])
        found[view] = {
            name: weighted([(count, numbers[view]) for count, numbers in stretches], name)
            for name in names
        }
    return found


def shares_over_time(chunks: Sequence[Prediction], begin_s: float) -> list[tuple[float, float]]:
    """Return the end of each chunk of a rollout [s], and the share of the futures that succeed.

    Args:
        chunks: the chunks of the rollout.
        begin_s: time at which it begins [s].
    """
    return [
        (round(begin_s + chunk.imagined_seconds, 3), chunk.success.futures.share)
        for chunk in chunks
        if chunk.success.futures is not None
    ]


#: estimates of recorded frames up to this one contradict a success [probability]
_CLEAR_FAILURE = 0.25


def contradiction(outcome: str, probability: float) -> str:
    """Return how the recorded frames contradict the label of an episode; empty = they do not.

    Args:
        outcome: the label, `success`, `failure` or `unknown`.
        probability: success estimate at the end of the recorded frames; NaN = it abstains.
    """
    is_against = {'success': probability <= _CLEAR_FAILURE, 'failure': probability >= SUCCESS_FROM}
    if not is_against.get(outcome, False):
        return ''
    seen = 'failure' if outcome == 'success' else 'success'
    return (
        f'the episode is labelled a {outcome}, but its recorded frames look like a {seen} '
        f'(estimate {probability:.2f}): look at it, and correct the label or the task'
    )


def _left_out(found: _Found) -> list[str]:
    """Return which chunks were not imagined with other actions, and why, a line for each kind."""
    lines = []
    for name, chunks in found.not_imagined.items():
        times = ', '.join(f'{begun_s:.1f}' for begun_s, _ in chunks)
        reasons = '; '.join(dict.fromkeys(reason for _, reason in chunks))
        margins = ' and have no margins' if name == SHUFFLED else ''
        lines.append(
            f'{name} actions: {len(chunks)} of {len(found.pictures)} chunks (from {times} s on) '
            f'were not imagined{margins}: {reasons}'
        )
    return lines
