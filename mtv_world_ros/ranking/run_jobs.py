"""Jobs of a ranking, run in process, in worker processes or on a Ray cluster, and resumed."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.executor import score_all
from mtv_world_ros.core.files import plain, write_json, write_whole
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.core.workers import IN_PROCESS, Workers
from mtv_world_ros.evaluation.result_settings import check_same_settings
from mtv_world_ros.ranking.episode_runner import make_runner, RunnerConfig, WantedJob
from mtv_world_ros.ranking.jobs import Job, Result
from mtv_world_ros.rollout.pipeline import Pipeline

FOLDER = 'rollouts'


@dataclass(frozen=True, slots=True, kw_only=True)
class RankedCheckpoint:
    """A checkpoint that imagines the rollouts.

    Attributes:
        make_pipeline: function that returns the pipeline; called once in every process; has to be
            picklable for more than one.
        out: results go into its folder `rollouts`.
        settings: settings that the results depend on, e.g. the checkpoint.
    """

    make_pipeline: Callable[[], Pipeline]
    out: Path
    settings: Mapping[str, Any]


def run_jobs(
    jobs: Sequence[Job],
    checkpoints: Sequence[RankedCheckpoint],
    *,
    config: RunnerConfig,
    workers: Workers = IN_PROCESS,
    overwrite: bool = False,
    show_progress: bool = True,
    watch: Callable[[Sequence[Result]], object] = lambda _: None,
) -> tuple[list[list[Result]], dict[Job, str]]:
    """Return the results of each checkpoint in the order of the jobs, and failures by job.

    The files of a result are a JSON file, a PNG of its last frames with real frames over imagined
    ones, a video, a contact sheet and the frames of both worlds. Each file is written under a
    temporary name and renamed. Jobs with a result of the same settings are not run again.

    Args:
        jobs: the jobs; each is simulated once for all checkpoints.
        checkpoints: one or more checkpoints.
        config: denoising steps, limits and physics of the episodes.
        workers: where the rollouts run.
        overwrite: replace results of other settings.
        show_progress: show the progress.
        watch: called with the first checkpoint's results: at first with those of an earlier run,
            then with each as it comes.

    Raises:
        ConfigError: see `started` of `core/executor.py`; the checkpoints' frame rates differ, or a
            folder holds results of other settings.
        MtvWorldError: a worker died, or no job has a result.
    """
    stores = [_Store(checkpoint, config, jobs, overwrite) for checkpoint in checkpoints]
    wanted = {job: tuple(k for k, s in enumerate(stores) if job not in s.found) for job in jobs}
    left = [WantedJob(job, numbers) for job, numbers in wanted.items() if numbers]
    failed: dict[Job, str] = {}
    if stores and stores[0].found:
        watch(list(stores[0].found.values()))
    make = partial(make_runner, [c.make_pipeline for c in checkpoints], config)
    outcomes = score_all(left, make, workers)
    bar = Progress(outcomes, total=len(left), unit='rollout', is_shown=show_progress)
    for done, outcome in bar:
        if isinstance(outcome, str):
            failed[done.job] = outcome
            continue
        for number, result in outcome.items():
            stores[int(number)].add(done.job, result)
            if int(number) == 0:
                watch([stores[0].found[done.job]])
    if jobs and not all(store.found for store in stores):
        job, reason = next(iter(failed.items()))
        raise MtvWorldError(f'no rollout has a result; the first, {job.name}: {reason}')
    return [[store.found[job] for job in jobs if job in store.found] for store in stores], failed


class _Store:
    """The results of a checkpoint on disk.

    Attributes:
        found: results by job.
    """

    def __init__(
        self,
        checkpoint: RankedCheckpoint,
        config: RunnerConfig,
        jobs: Sequence[Job],
        overwrite: bool,
    ) -> None:
        self._out = checkpoint.out
        self._settings = {
            **checkpoint.settings,
            'steps': config.num_inference_steps,
            'max_chunks': config.max_chunks,
            # absent by default, so that rankings without this setting can be resumed
            **({'hold': config.hold} if config.hold else {}),
        }
        check_same_settings(self._out / FOLDER, self._settings, overwrite)
        stored = {job: self._stored(job, overwrite) for job in jobs}
        self.found = {job: result for job, result in stored.items() if result is not None}

    def _stored(self, job: Job, overwrite: bool) -> Result | None:
        """Return a result of an earlier run, if it is of the same job and settings."""
        path = _path(self._out, job)
        try:
            values = read_json(path)
            definition = values.get('definition', '')
            task_definition = values.get('task_definition', '')
        except (OSError, ValueError, AttributeError):
            return None  # not readable, thus nothing is lost
        if definition != job.definition and not overwrite:
            raise ConfigError(
                f"'{path}' is of another policy with the name '{job.policy}'; give this one "
                'another name, or --overwrite to replace its results'
            )
        is_same_task = task_definition == job.task_definition
        if not is_same_task and not overwrite:
            raise ConfigError(
                f"'{path}' is of another definition of the task '{job.task}'; give this one "
                'another name, or --overwrite to replace its results'
            )
        try:
            result = Result.from_json(values['result'])
            same = values['settings'] == plain(self._settings) and result.seed == job.seed
        except (ValueError, KeyError, TypeError):
            return None
        return result if same and is_same_task and definition == job.definition else None

    def add(self, job: Job, values: dict[str, Any]) -> None:
        """Write a result."""
        path = _path(self._out, job)
        for suffix, data in values.pop('files', {}).items():
            write_whole(path.with_name(f'{job.name}{suffix}'), base64.b64decode(data))
        stored = {'settings': self._settings, 'definition': job.definition, 'result': values}
        if job.task_definition:
            stored['task_definition'] = job.task_definition
        write_json(path, stored)
        self.found[job] = Result.from_json(values)


def _path(out: Path, job: Job) -> Path:
    return Path(out) / FOLDER / f'{job.name}.json'


def read_results(out: Path) -> list[Result]:
    """Read the results of a ranking's folder, whatever their settings.

    Raises:
        ConfigError: one is of another version.
    """
    found = []
    for path in sorted((out / FOLDER).glob('*.json')):
        try:
            found.append(Result.from_json(read_json(path)['result']))
        except (OSError, ValueError, KeyError, TypeError) as error:
            reason = f'{type(error).__name__}: {" ".join(str(error).split())}'
            raise ConfigError(
                f"'{path}' cannot be read ({reason}); run `mtv-world rank` again: it goes on "
                'where it stopped'
            ) from error
    return found
