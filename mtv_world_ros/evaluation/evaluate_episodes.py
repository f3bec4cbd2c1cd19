"""Scores a pipeline on recorded episodes: J per view and object, baselines, intervals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

import numpy as np

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.core.executor import score_all
from mtv_world_ros.core.files import plain, write_json
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.core.workers import IN_PROCESS, Workers
from mtv_world_ros.data.recordings import described_objects
from mtv_world_ros.evaluation.episode_scorer import EpisodeScorer, EvaluationJob, Instruments
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary, Group, TRAINING
from mtv_world_ros.evaluation.metrics.feature_store import (
    feature_path,
    FeatureTaker,
    frechet_distances,
    load_features,
)
from mtv_world_ros.evaluation.metrics.frechet_features import clip_features, frame_features
from mtv_world_ros.evaluation.metrics.image_quality import image_quality
from mtv_world_ros.evaluation.metrics.statistics import Estimate
from mtv_world_ros.evaluation.references import round_trip
from mtv_world_ros.evaluation.result_settings import check_same_settings
from mtv_world_ros.evaluation.results import EpisodeResult
from mtv_world_ros.evaluation.settings import EvaluationConfig
from mtv_world_ros.evaluation.tables import write_summary
from mtv_world_ros.model.trained_episodes import TrainedEpisodes
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.success.own_tasks import own_tasks
from mtv_world_ros.success.task import dump_task, TaskSpec
from mtv_world_ros.vision.describers.describer import Describer
from mtv_world_ros.vision.jaccard import mean_of_known

DEFAULTS = EvaluationConfig()
#: maximum number of episodes that are asked to lend their actions
_MAX_DONORS = 3
#: makes the pipeline anew, in another process
MakePipeline = Callable[[], Pipeline]
Value = TypeVar('Value')


@dataclass(frozen=True, slots=True, kw_only=True)
class Parallel:
    """Settings of the parallel evaluation of episodes.

    Attributes:
        workers: workers that score, which write to `out`.
        make_pipeline: picklable function that makes the pipeline in each worker.
    """

    workers: Workers
    make_pipeline: MakePipeline


class Peers(Protocol):
    """Processes that evaluate together, each with a pipeline of its own.

    Attributes:
        number: number of this process, from 0; process 0 writes the summary.
        count: number of processes.
    """

    number: int
    count: int

    def of_all(self, value: Value) -> list[Value]:
        """Return the values of all processes, which have to call this."""
        ...


def evaluate(
    pipeline: Pipeline,
    episode_paths: Sequence[Path],
    out: Path,
    config: EvaluationConfig = DEFAULTS,
    *,
    name: str = '',
    label: str = '',
    zero_shot: Mapping[Path, str] = MappingProxyType({}),
    provenance: Mapping[str, str] = MappingProxyType({}),
    trained_on: TrainedEpisodes | None = None,
    parallel: Parallel | None = None,
    peers: Peers | None = None,
    describer: Describer | None = None,
    overwrite: bool = False,
    show_progress: bool = True,
) -> EvaluationSummary:
    """Score a pipeline and write `metrics.json`, `rows.csv` and `tables.md`.

    Episodes that were scored before with the same settings are taken from `out/episodes`.
    Episodes that cannot be used are listed with their reason.

    Args:
        pipeline: imagines and segments.
        episode_paths: folders of recorded episodes.
        out: folder of the results.
        config: stretches to imagine and scores to compute.
        name: fingerprint of the checkpoint; only results of the same name are taken over, and none
            without a name.
        label: name of its rows in tables that compare checkpoints.
        zero_shot: property that the model was not trained for (`view`, `task` or `object`), by
            path of the episode.
        provenance: command, date and versions, by heading; goes into metrics.json.
        trained_on: episodes that the checkpoint was trained on; how many of them are scored goes
            into the provenance. None = nothing is said.
        parallel: workers to score with; None = this process.
        peers: processes that call this with the same arguments and score a share each; all return
            the same summary. None = this process scores every episode.
        describer: names the objects from each episode's first frame; None = see `EvaluationJob`.
        overwrite: replace results of other settings; only asked where there is a name.
        show_progress: show the progress.

    Raises:
        ConfigError: weights are missing, `out` holds results of other settings, or two episodes
            define a task of one name differently.
        EpisodeError: no episode can be used.
    """
    if not config.num_inference_steps:  # results say the number
        config = config.replace(num_inference_steps=pipeline.spec.num_inference_steps)
    run = _Run(pipeline, out, name, config, parallel, describer)
    check_same_settings(out / 'episodes', run.settings, overwrite or not name)
    tasks = {} if pipeline.judge.estimator.is_given else own_tasks(episode_paths)
    jobs = make_jobs(episode_paths, zero_shot, config.seed, tasks)
    mine = jobs if peers is None else jobs[peers.number :: peers.count]
    bar = Progress(run.results(mine), total=len(mine), unit='episode', is_shown=show_progress)
    results, failed = [], dict[str, str]()
    for job, result in bar:
        if isinstance(result, EpisodeResult):
            results.append(result)
            bar.set_postfix_str(_progress(results))
        else:
            failed[str(job.path)] = result
    if peers is not None:
        parts = peers.of_all((results, failed))
        results = [result for found, _ in parts for result in found]
        failed = {path: reason for _, left_out in parts for path, reason in left_out.items()}
    if not results:
        reason = next(iter(failed.items()), ('', 'none was given'))
        raise EpisodeError(f'no episode could be scored; {reason[0]}: {reason[1]}')
    results.sort(key=lambda result: result.episode)
    if trained_on is not None:
        sentence = trained_on.sentence([result.digest for result in results])
        provenance = {**provenance, TRAINING: sentence}
    summary = EvaluationSummary(
        folder=out,
        name=name,
        label=label,
        spec=pipeline.spec,
        settings={**config.as_json(), 'segmenter': pipeline.segmenter.name},
        provenance=provenance,
        results=results,
        failed=dict(sorted(failed.items())),
    )
    summary = replace(summary, distances=_distances(summary, config))
    if peers is None or peers.number == 0:
        write_summary(summary)
    return summary


def result_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Return the names of results: the folder's, or its whole path where two are equal."""
    count = Counter(Path(path).name for path in paths)
    return {
        path: path.name if count[path.name] == 1 else '__'.join(path.parts).strip('/')
        for path in map(Path, paths)
    }


def make_jobs(
    paths: Sequence[Path],
    zero_shot: Mapping[Path, str],
    seed: int,
    tasks: Mapping[Path, TaskSpec] = MappingProxyType({}),
) -> list[EvaluationJob]:
    """Return jobs in shuffled order; each episode is the donor of actions for the next.

    Where it cannot be read, the ones before it are donors.

    Args:
        paths: folders of the episodes.
        zero_shot: property that the model was not trained for, by path of the episode.
        seed: seed of the order.
        tasks: tasks that episodes define, by path of the episode.
    """
    order = np.random.default_rng(seed).permutation(len(paths))
    shuffled = [Path(paths[index]) for index in order]
    names = result_names(paths)
    return [
        EvaluationJob(
            path=path,
            name=names[path],
            donors=tuple(
                shuffled[index - k] for k in range(1, min(len(shuffled), 1 + _MAX_DONORS))
            ),
            zero_shot=zero_shot.get(path, ''),
            task=tasks.get(path),
        )
        for index, path in enumerate(shuffled)
    ]


def make_scorer(make_pipeline: MakePipeline, config: EvaluationConfig, out: Path) -> EpisodeScorer:
    """Return the scorer of episodes, with every measure that the configuration asks for.

    Raises:
        ConfigError, CheckpointError: weights or packages for that are missing.
    """
    pipeline = make_pipeline()
    device = str(getattr(pipeline.world_model, 'device', 'cpu'))
    features = None
    if config.fid_weights is not None or config.fvd_weights is not None:
        features = FeatureTaker(
            views=pipeline.spec.views,
            num_frames=pipeline.spec.num_frames,
            frames=config.fid_weights and frame_features(config.fid_weights, device),
            clips=config.fvd_weights and clip_features(config.fvd_weights, device),
        )
    instruments = Instruments(
        pipeline=pipeline,
        reconstruct=round_trip(pipeline.world_model) if config.ceiling else None,
        quality=image_quality(config.quality, device),
        features=features,
    )
    return EpisodeScorer(instruments, config, out)


def _progress(results: Sequence[EpisodeResult]) -> str:
    means = [result.means(None) for result in results]
    moving, copy = (
        float(mean_of_known(np.array([found[key] for found in means])))
        for key in ('j_moving', 'j_copy_moving')
    )
    return f'J of moving objects {moving:.3f}, still picture {copy:.3f}'


def _distances(
    summary: EvaluationSummary, config: EvaluationConfig
) -> dict[tuple[str | None, str], dict[str, Estimate]]:
    """Return the FID and FVD by (zero-shot set, view), the set None for all episodes."""
    if config.fid_weights is None and config.fvd_weights is None:
        return {}
    return {
        (group, view): frechet_distances(
            [
                load_features(feature_path(summary.folder, result.episode))
                for result in summary.chosen(Group(zero_shot=group))
            ],
            view,
        )
        for group in (None, *summary.zero_shot_sets)
        for view in summary.spec.views
    }


class _Run:
    """Scorer that reuses the results of earlier runs with the same settings."""

    def __init__(
        self,
        pipeline: Pipeline,
        out: Path,
        name: str,
        config: EvaluationConfig,
        parallel: Parallel | None,
        describer: Describer | None,
    ) -> None:
        self.pipeline, self.out, self.name, self.config = pipeline, out, name, config
        self.parallel, self.describer = parallel, describer
        spec = pipeline.spec
        self.settings = {
            **config.as_json(),
            'name': name,
            'spec': [list(spec.views), spec.fps, spec.num_frames, spec.width, spec.height],
            'segmenter': pipeline.segmenter.name,
        }

    def results(
        self, jobs: Sequence[EvaluationJob]
    ) -> Iterator[tuple[EvaluationJob, EpisodeResult | str]]:
        """Yield jobs with their result, or why there is none."""
        left = []
        for job in map(self._described, jobs):
            if isinstance(job, tuple):
                yield job
                continue
            stored = self._stored(job)
            if stored is None:
                left.append(job)
            else:
                yield job, stored
        for job, outcome in self._scored(left):
            if isinstance(outcome, str):
                yield job, outcome
                continue
            values = {'settings': self._settings_of(job), 'result': outcome}
            write_json(self._file(job), values)
            yield job, EpisodeResult.from_json(outcome)

    def _described(self, job: EvaluationJob) -> EvaluationJob | tuple[EvaluationJob, str]:
        """Return the episode with its objects named, or why they could not be."""
        if self.describer is None:
            return job
        try:
            view, source = self.pipeline.spec.views[0], self.config.source
            found = described_objects(job.path, self.describer, view, source)
        except MtvWorldError as error:
            return job, str(error)
        return replace(job, objects=found)

    def _scored(
        self, jobs: Sequence[EvaluationJob]
    ) -> Iterator[tuple[EvaluationJob, dict[str, Any] | str]]:
        if self.parallel is None or self.parallel.workers.are_here:
            here = partial(make_scorer, lambda: self.pipeline, self.config, self.out)
            return score_all(jobs, here, IN_PROCESS)
        there = partial(make_scorer, self.parallel.make_pipeline, self.config, self.out)
        return score_all(jobs, there, replace(self.parallel.workers, writes=self.out))

    def _file(self, job: EvaluationJob) -> Path:
        return self.out / 'episodes' / f'{job.name}.json'

    def _settings_of(self, job: EvaluationJob) -> dict[str, Any]:
        return {
            **self.settings,
            'path': str(job.path),
            'donor': str(job.donors[0] if job.donors else None),
            'zero_shot': job.zero_shot,
            'objects': list(job.objects),
            # absent for bundled tasks, so that evaluations of earlier versions can be resumed
            **({} if job.task is None else {'task': dump_task(job.task)}),
        }

    def _stored(self, job: EvaluationJob) -> EpisodeResult | None:
        """Return the result of an earlier run.

        None if it is of other settings or another version.
        """
        features = self.config.fid_weights or self.config.fvd_weights
        if not self.name or (features and not feature_path(self.out, job.name).is_file()):
            return None
        try:
            stored = read_json(self._file(job))
            if stored['settings'] == plain(self._settings_of(job)):
                return EpisodeResult.from_json(stored['result'])
        except (OSError, ValueError, KeyError, TypeError):
            pass  # not there, half written, or of another version: score it again
        return None
