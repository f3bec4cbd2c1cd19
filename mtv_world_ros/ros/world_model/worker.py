"""One thread that runs the model: the newest request wins, results go back to the executor."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from threading import Condition, Thread
import time
import traceback

from mtv_world_ros.data_types import JointTrajectory
from mtv_world_ros.ensemble import imagine_seeds
from mtv_world_ros.errors import ModelMemoryError, MtvWorldError, RolloutPreempted
from mtv_world_ros.pipeline import Pipeline
from mtv_world_ros.prediction import Prediction
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.sensing.observations import Scene
from mtv_world_ros.ros.world_model.timing import from_observation, TimeLimits
from mtv_world_ros.success.rollout_memory import RolloutMemory


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A trajectory to imagine.

    Attributes:
        rollout: number of the rollout, counted from 1.
        trajectory: in the robot's joint order; times count from `stamp_ns`.
        stamp_ns: the trajectory's stamp [ns]; 0 = it starts at the observation.
        scene: the newest scene when it came in; its frames are real, or predicted.
        imagine: whether to start from the last predicted frames if there are newer ones, and
            whether the next request shall.
        instruction: what the robot was told.
        objects: names of the objects; empty = those the instruction names.
        seed: of the noise of the first chunk after a reset; in imagine mode every further chunk
            counts one up, over requests too.
        num_seeds: rollouts that the estimate is the mean of; the first one's frames are shown.
        num_inference_steps: denoising steps a chunk.
        limits: what is too old or too long.
        received_s: when it came in [s], of `time.monotonic`.
        limit_tolerance: joints may exceed their limits by this [rad or m].
    """

    rollout: int
    trajectory: JointTrajectory
    stamp_ns: int
    scene: Scene
    imagine: bool
    instruction: str
    objects: tuple[str, ...]
    seed: int
    num_inference_steps: int
    limits: TimeLimits
    received_s: float
    limit_tolerance: float = 1e-3
    num_seeds: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """A predicted chunk of a request, the scene it started from, and when it was ready [s]."""

    request: Request
    scene: Scene
    prediction: Prediction
    ready_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Ended:
    """A request came to its end: `done`, `preempted`, `rejected` or `failed`."""

    request: Request
    state: str
    num_chunks: int
    reason: Reason | None = None
    text: str = ''
    trace: str = ''


Result = Chunk | Ended


class RolloutWorker:
    """Runs one request at a time in its own thread.

    Args:
        pipeline: the main path.
        notify: called from the thread whenever `take` has something new.
    """

    def __init__(self, pipeline: Pipeline, notify: Callable[[], None]) -> None:
        self._pipeline = pipeline
        self._notify = notify
        self._changed = Condition()
        self._pending: Request | None = None
        self._running: Request | None = None
        self._between: Callable[[], None] | None = None
        self._abandoned = False
        self._closing = False
        self._last: Scene | None = None
        self._num_imagined = 0
        self._memory: RolloutMemory | None = None
        self._results: deque[Result] = deque()
        self._thread = Thread(target=self._run, name='rollouts')

    def start(self) -> None:
        """Starts the thread; requests wait until then."""
        self._thread.start()

    @property
    def last_scene(self) -> Scene | None:
        """The last predicted frames, from which imagine mode goes on; None = there are none."""
        with self._changed:
            return self._last

    @property
    def busy(self) -> bool:
        """Whether a rollout runs or waits."""
        with self._changed:
            return self._running is not None or self._pending is not None

    def submit(self, request: Request) -> None:
        """Starts a request; it pre-empts a running one and replaces a waiting one."""
        with self._changed:
            if self._pending is not None:
                self._put(Ended(request=self._pending, state='preempted', num_chunks=0))
            self._pending = request
            self._changed.notify_all()

    def run_between(self, job: Callable[[], None]) -> None:
        """Runs a job that must not raise, never during a rollout; it replaces a waiting one."""
        with self._changed:
            self._between = job
            self._changed.notify_all()

    def reset(self) -> None:
        """Gives up what runs and waits, drops chunks not taken, forgets the last frames."""
        with self._changed:
            self._results = deque(r for r in self._results if isinstance(r, Ended))
            running = None if self._abandoned else self._running
            for request in (running, self._pending):
                if request is not None:
                    self._put(Ended(request=request, state='reset', num_chunks=0))
            self._abandoned = self._running is not None
            self._pending = None
            self._last, self._memory, self._num_imagined = None, None, 0

    def take(self) -> list[Result]:
        """Returns the results since the last call, in order."""
        with self._changed:
            taken = list(self._results)
            self._results.clear()
            return taken

    def close(self) -> None:
        """Ends the thread; a running rollout is given up at its next denoising step."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while (request := self._next()) is not None:
            ended = self._roll_out(request)
            with self._changed:
                if not self._abandoned:
                    self._put(ended)
                self._running, self._abandoned = None, False

    def _next(self) -> Request | None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._between or self._pending)
                if self._closing:
                    return None
                job, self._between = self._between, None
                if job is None:
                    self._running, self._pending = self._pending, None
                    return self._running
            job()

    def _should_stop(self) -> bool:
        with self._changed:
            return self._closing or self._abandoned or self._pending is not None

    def _roll_out(self, request: Request) -> Ended:
        num_chunks = 0

        def ended(state: str, reason: Reason | None = None, text: str = '') -> Ended:
            return Ended(
                request=request, state=state, num_chunks=num_chunks, reason=reason, text=text
            )

        try:
            for _ in self._chunks(request):
                num_chunks += 1
        except RolloutPreempted:
            return ended('preempted')
        except (ModelMemoryError, MemoryError) as error:
            return ended('failed', Reason.OUT_OF_MEMORY, str(error) or 'out of memory')
        except Rejection as error:
            return ended('rejected', error.reason, str(error))
        except MtvWorldError as error:
            return ended('rejected', Reason.ROLLOUT_INVALID, str(error))
        except Exception as error:  # the node outlives whatever the model raises
            text = f'{type(error).__name__}: {error}'
            return replace(
                ended('failed', Reason.INTERNAL_ERROR, text), trace=traceback.format_exc()
            )
        return ended('done')

    def _chunks(self, request: Request) -> Iterator[None]:
        scene, memory, num_before = self._start(request)
        trajectory = from_observation(
            request.trajectory, request.stamp_ns, scene.observation.stamp_ns, request.limits
        )
        pipeline = replace(
            self._pipeline,
            objects=request.objects or self._pipeline.objects,
            limit_tolerance=request.limit_tolerance,
        )
        predictions = imagine_seeds(
            pipeline,
            scene.observation,
            trajectory,
            instruction=request.instruction,
            num_seeds=request.num_seeds,
            seed=request.seed + num_before,
            num_inference_steps=request.num_inference_steps,
            should_stop=self._should_stop,
            memory=memory,
            history=scene.history,
        )
        for prediction in predictions:
            self._finish_chunk(request, scene, prediction)
            yield
            if self._should_stop() and prediction.chunk + 1 < prediction.num_chunks:
                raise RolloutPreempted('a newer trajectory arrived')

    def _start(self, request: Request) -> tuple[Scene, RolloutMemory | None, int]:
        """The scene to start from, how it came about, and the chunks imagined before it."""
        with self._changed:
            if request.imagine and self._last is not None:
                return self._last, self._memory, self._num_imagined
            return request.scene, None, 0

    def _finish_chunk(self, request: Request, scene: Scene, prediction: Prediction) -> None:
        chunk = Chunk(
            request=request, scene=scene, prediction=prediction, ready_s=time.monotonic()
        )
        with self._changed:
            if self._abandoned or self._closing:
                raise RolloutPreempted('the rollout was given up')
            if request.imagine:
                self._last = replace(
                    scene,
                    observation=prediction.end_observation,
                    history=prediction.end_history,
                )
                self._memory = prediction.memory
                self._num_imagined += 1
            self._put(chunk)

    def _put(self, result: Result) -> None:
        self._results.append(result)
        self._notify()
