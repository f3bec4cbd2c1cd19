"""Actors of a Ray cluster that run the jobs of a command."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
import importlib
import os
from pathlib import Path
import platform
import tempfile
import time
from typing import Any, TYPE_CHECKING, TypeVar
import uuid

from mtv_world_ros.core.errors import ConfigError, MissingPackageError, MtvWorldError
from mtv_world_ros.core.processes import prepare_process
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.core.worker_pool import made_run, Run

if TYPE_CHECKING:
    from mtv_world_ros.core.workers import RunJobs, Workers

#: a job that was running when this many actors of a Ray cluster died is not tried again
MAX_LOST_ACTORS = 3
#: time for which a worker looks for a file of the folder of the results: a network file system
#: shows new files late [s]
SHARED_FILE_TIMEOUT_S = 15.0
#: variable that keeps a cluster which Ray starts by itself on the loopback address, if it is 0; by
#: itself Ray does so on Windows and macOS alone
_RAY_NETWORK = 'RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER'

Job = TypeVar('Job')


@contextmanager
def started(make_run: Callable[[], Run], workers: Workers, num_jobs: int) -> Iterator[RunJobs]:
    """Yield a function that runs jobs on actors of a Ray cluster.

    Every machine of the cluster needs this package.

    Args:
        make_run: returns the function that runs a job; called once in every actor.
        workers: number of actors, their resources, and the address of the cluster.
        num_jobs: largest number of jobs of one call.

    Raises:
        ConfigError: Ray is not installed, cannot be reached, is of another version, or no machine
            has the resources of one worker, or a machine lacks a file or folder.
        MtvWorldError: all actors died, or several of the same job.
    """
    ray = _connected(workers.ray or '')
    marker = _marker(workers.writes)
    try:
        _check_resources(ray, workers)
        needed = tuple(path.absolute() for path in workers.reads)
        actor = ray.remote(num_cpus=workers.cpus, num_gpus=workers.gpus)(_Actor)
        options = (make_run, workers.num_threads, Path.cwd(), needed, marker)
        actors = _Actors(
            ray, [actor.remote(*options) for _ in range(min(workers.count, num_jobs))]
        )
        yield actors.run
    except ray.exceptions.RayError as error:
        raise MtvWorldError(
            f'Ray failed ({error}); what is done is kept: run the command again'
        ) from error
    finally:
        ray.shutdown()
        if marker is not None:
            marker.unlink(missing_ok=True)


def _connected(address: str) -> Any:
    """Return the module `ray`, connected to the cluster."""
    if not address and not _is_ray_at_hand():
        os.environ.setdefault(_RAY_NETWORK, '0')
    ray = _ray()
    try:
        ray.init(address=address or None, log_to_driver=False, include_dashboard=False)
    except (ConnectionError, ValueError) as error:
        raise ConfigError(f"Ray cannot be reached at '{address}': {error}; set --ray") from error
    except ray.exceptions.AuthenticationError as error:
        raise ConfigError(
            f"the Ray cluster at '{address or 'this machine'}' asks for its token, and there is "
            'none, or another one, here: copy ~/.ray/auth_token of the head node to this user, '
            'or set RAY_AUTH_TOKEN (docs/ray.md)'
        ) from error
    except RuntimeError as error:
        if 'version' not in str(error).lower():
            raise
        reason = ' '.join(str(error).split())
        raise ConfigError(
            f"the Ray cluster at '{address or 'this machine'}' runs another version than the "
            f'{ray.__version__} of this machine ({reason}); install the same ray and Python on '
            'all machines'
        ) from error
    return ray


def _check_resources(ray: Any, workers: Workers) -> None:
    """Raise if no machine of the cluster has the cores and GPUs of one worker.

    Raises:
        ConfigError: names what a worker asks for and what the largest machine has.
    """
    nodes = [node['Resources'] for node in ray.nodes() if node['Alive']]
    if any(n.get('CPU', 0) >= workers.cpus and n.get('GPU', 0) >= workers.gpus for n in nodes):
        return
    has = '; '.join(f'{n.get("CPU", 0):g} CPU cores, {n.get("GPU", 0):g} GPUs' for n in nodes)
    raise ConfigError(
        f'a worker asks for {workers.cpus} CPU cores and {workers.gpus:g} GPUs, which no machine '
        f'of the Ray cluster has ({has}): set --cpus-per-worker and --gpus-per-worker, use '
        '--device cpu, or add a machine'
    )


def _marker(folder: Path | None) -> Path | None:
    """Return a new file in the folder of the results, by which actors know the folder."""
    if folder is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    marker = folder.absolute() / f'.workers_{uuid.uuid4().hex}'
    marker.touch()
    return marker


class _Actor:
    """Worker on a machine of the cluster; an error of a job is its result.

    Args:
        make_run: returns the function that runs a job.
        threads: number of OpenCV's threads.
        folder: folder that relative paths start from, where this machine has it.
        needed: files and folders that jobs read.
        marker: file that is there if this machine sees the folder of the results; None = no such
            folder.
    """

    def __init__(
        self,
        make_run: Callable[[], Run],
        threads: int,
        folder: Path,
        needed: Sequence[Path],
        marker: Path | None,
    ) -> None:
        prepare_process()
        with suppress(OSError):
            os.chdir(folder)
        self._problem = _unseen(needed, marker)
        if self._problem is None:
            self._run = made_run(make_run, threads)

    def start(self) -> ConfigError | None:
        """Return why this machine cannot run jobs; None = it can."""
        return self._problem

    def run(self, job: Any) -> Any:
        """Return the result of a job, or its error."""
        try:
            return self._run(job)
        except MtvWorldError as error:
            return _Raised(error)


class _Raised:
    """Error of a job on its way to the process that asked for it."""

    def __init__(self, error: MtvWorldError) -> None:
        self.error = error


def _unseen(needed: Sequence[Path], marker: Path | None) -> ConfigError | None:
    """Return an error that names a path which this machine does not have."""
    machine = platform.node()
    for path in needed:
        if not path.exists():
            return ConfigError(
                f"machine '{machine}' of the Ray cluster has no '{path}'; put it under the same "
                'path on all machines, or on a file system that they share'
            )
    end_s = time.monotonic() + SHARED_FILE_TIMEOUT_S
    while marker is not None and not marker.exists():
        if time.monotonic() > end_s:
            return ConfigError(
                f"machine '{machine}' of the Ray cluster does not see '{marker.parent}', which "
                'results are written to; give --out a folder on a file system that all machines '
                'share'
            )
        time.sleep(0.2)
    return None


class _Actors:
    """Actors of a Ray cluster that run jobs; the job of one that dies goes to another.

    An actor gets its first job when it has started: a cluster with fewer cores than actors starts
    the others later, or never.
    """

    def __init__(self, ray: Any, actors: Sequence[Any]) -> None:
        self._ray, self._num_left = ray, len(actors)
        #: what an actor is at: its job's number and the job; None = it starts
        self._calls: dict[Any, tuple[Any, tuple[int, Any] | None]] = {
            actor.start.remote(): (actor, None) for actor in actors
        }
        self._idle: list[Any] = []

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, Any]]:
        """Yield jobs with their result.

        Raises:
            MtvWorldError: what a job raised; no actor is left, or MAX_LOST_ACTORS actors died of
                one job.
        """
        waiting, num_running, lost = deque(enumerate(jobs)), 0, Counter[int]()
        while waiting or num_running:
            while waiting and self._idle:
                actor, one = self._idle.pop(), waiting.popleft()
                self._calls[actor.run.remote(one[1])] = actor, one
                num_running += 1
            (done,), _ = self._ray.wait(list(self._calls))
            actor, one = self._calls.pop(done)
            num_running -= one is not None
            try:
                found = self._ray.get(done)
            except self._ray.exceptions.RayActorError as error:
                self._lose(one, lost, error)
                waiting.extendleft([] if one is None else [one])
                continue
            self._idle.append(actor)
            if one is None and found is not None:
                raise found
            if isinstance(found, _Raised):
                raise found.error
            if one is not None:
                yield one[1], found

    def _lose(self, one: tuple[int, Any] | None, lost: Counter[int], error: Exception) -> None:
        """Count an actor that died, and say so."""
        self._num_left -= 1
        if one is not None:
            lost[one[0]] += 1
        if one is not None and lost[one[0]] == MAX_LOST_ACTORS:
            raise MtvWorldError(
                f'{MAX_LOST_ACTORS} Ray workers died of the same job ({error}), most likely of '
                'lack of memory; what is done is kept: run the command again'
            ) from error
        if not self._num_left:
            raise MtvWorldError(
                f'all Ray workers died ({error}); what is done is kept: run the command again'
            ) from error
        Progress.write(f'a Ray worker died; {self._num_left} go on')


def _is_ray_at_hand() -> bool:
    """True if Ray would use a running cluster: that of `RAY_ADDRESS`, or the last one here."""
    folder = Path(os.environ.get('RAY_TMPDIR') or tempfile.gettempdir())
    return 'RAY_ADDRESS' in os.environ or (folder / 'ray' / 'ray_current_cluster').is_file()


def _ray() -> Any:
    """Import Ray, which is optional and large."""
    try:
        ray = importlib.import_module('ray')
        importlib.import_module('ray.util')
    except ImportError as error:
        raise MissingPackageError(
            '--ray', 'ray', instead='leave it out and use --workers'
        ) from error
    return ray
