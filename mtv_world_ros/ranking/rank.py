"""Runs the jobs of a ranking, here, in processes or on a Ray cluster; goes on where it stopped."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
import json
import os
from pathlib import Path
from typing import Any

from tqdm import tqdm

from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.files import plain, write_json, write_whole
from mtv_world_ros.parallel import Outcome, score_all
from mtv_world_ros.pipeline import Pipeline
from mtv_world_ros.ranking.jobs import Job, Result
from mtv_world_ros.ranking.runner import make_runner, RolloutConfig

FOLDER = 'rollouts'


def run_jobs(
    jobs: Sequence[Job],
    make_pipeline: Callable[[], Pipeline],
    out: Path,
    *,
    config: RolloutConfig,
    settings: Mapping[str, Any],
    workers: int = 1,
    ray_address: str | None = None,
    show_progress: bool = True,
) -> tuple[list[Result], dict[str, str]]:
    """Returns the results in the order of the jobs, and why others have none, by job.

    Each result is written beside its name and renamed, and its last frames as a PNG, real ones
    over imagined ones; jobs that are there already with the same settings are not run again.

    Args:
        jobs: what to run.
        make_pipeline: called once in every process; has to be picklable for more than one.
        out: results go into its folder `rollouts`.
        config: how episodes are run.
        settings: what the results depend on besides, e.g. which checkpoint.
        workers: processes; with Ray, at most so many at once.
        ray_address: of a Ray cluster, empty = the one at hand or a new one here; None = no Ray.
        show_progress: draw a progress bar.

    Raises:
        ConfigError: less than one worker, or Ray is not installed.
        MtvWorldError: a worker died, or no job has a result.
    """
    kept = {**settings, 'steps': config.num_inference_steps, 'max_chunks': config.max_chunks}
    found = {job: stored for job in jobs if (stored := _stored(out, job, kept)) is not None}
    left = [job for job in jobs if job not in found]
    failed: dict[str, str] = {}
    outcomes = _scored(left, partial(make_runner, make_pipeline, config), workers, ray_address)
    bar = tqdm(outcomes, total=len(left), unit='rollout', disable=not show_progress)
    for job, outcome in bar:
        if isinstance(outcome, str):
            failed[job.name] = outcome
            continue
        picture = base64.b64decode(outcome.pop('last_frames', ''))
        if picture:
            write_whole(_path(out, job).with_suffix('.png'), picture)
        write_json(_path(out, job), {'settings': kept, 'result': outcome})
        found[job] = Result.from_json(outcome)
    if jobs and not found:
        raise MtvWorldError(f'no rollout has a result; the first: {next(iter(failed.items()))}')
    return [found[job] for job in jobs if job in found], failed


def _scored(
    jobs: Sequence[Job], make: Callable[[], Any], workers: int, ray_address: str | None
) -> Iterator[tuple[Job, Outcome]]:
    if ray_address is not None:
        from mtv_world_ros.parallel import score_with_ray

        return score_with_ray(jobs, make, workers, ray_address)
    threads = max(len(os.sched_getaffinity(0)) // max(workers, 1), 1)
    return score_all(jobs, make, workers, threads)


def _path(out: Path, job: Job) -> Path:
    return Path(out) / FOLDER / f'{job.name}.json'


def _stored(out: Path, job: Job, settings: Mapping[str, Any]) -> Result | None:
    """A result of an earlier run, if it is of the same job and settings."""
    try:
        values = json.loads(_path(out, job).read_text(encoding='utf-8'))
        result = Result.from_json(values['result'])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    same = values['settings'] == plain(settings) and result.seed == job.seed
    return result if same else None
