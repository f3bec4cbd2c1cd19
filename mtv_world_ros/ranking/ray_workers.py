"""Jobs scored by Ray actors, on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import importlib
from typing import Any, TypeVar

from mtv_world_ros.errors import ConfigError, MtvWorldError
from mtv_world_ros.parallel import Outcome, outcome_of, Scorer

Job = TypeVar('Job')


class _Worker:
    """Lives in an actor; what goes wrong while it starts is told by every job."""

    def __init__(self, make_scorer: Callable[[], Scorer]) -> None:
        self._scorer: Scorer | str
        try:
            self._scorer = make_scorer()
        except MtvWorldError as error:
            self._scorer = str(error)

    def score(self, number: int, job: Any) -> tuple[int, Outcome]:
        if isinstance(self._scorer, str):
            return number, self._scorer
        return number, outcome_of(self._scorer, job)


def score_with_ray(
    jobs: Sequence[Job], make_scorer: Callable[[], Scorer], workers: int, address: str = ''
) -> Iterator[tuple[Job, Outcome]]:
    """Yields jobs with their outcome, as they are done.

    Every machine of the cluster needs this package, and checkpoints under the same path.

    Args:
        jobs: what to score.
        make_scorer: called once in every actor; has to be picklable.
        workers: actors, of one core each.
        address: of the cluster; empty = `RAY_ADDRESS`, else a new one on this machine.

    Raises:
        ConfigError: Ray is not installed or cannot be reached, or less than one worker.
        MtvWorldError: an actor died.
    """
    if workers < 1:
        raise ConfigError(f'workers is {workers}; it must be at least 1')
    ray = _ray()
    try:
        ray.init(address=address or None, log_to_driver=False, include_dashboard=False)
    except (ConnectionError, ValueError) as error:
        raise ConfigError(f"Ray cannot be reached at '{address}': {error}; set --ray") from error
    try:
        actor = ray.remote(num_cpus=1)(_Worker)
        pool = ray.util.ActorPool([actor.remote(make_scorer) for _ in range(workers)])
        numbered = list(enumerate(jobs))
        for number, outcome in pool.map_unordered(lambda a, one: a.score.remote(*one), numbered):
            yield jobs[number], outcome
    except ray.exceptions.RayError as error:
        raise MtvWorldError(
            f'a Ray worker died ({error}); what was scored is kept: run the command again'
        ) from error
    finally:
        ray.shutdown()


def _ray() -> Any:
    """Ray, which is optional and large."""
    try:
        ray = importlib.import_module('ray')
        importlib.import_module('ray.util')
    except ImportError as error:
        raise ConfigError(
            "--ray needs Ray: pip install 'mtv_world_ros[rank]', or leave it out and use --workers"
        ) from error
    return ray
