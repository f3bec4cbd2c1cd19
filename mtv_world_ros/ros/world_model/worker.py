"""One thread that runs the model: the newest request wins, results go back to the executor."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from threading import Condition, current_thread, Thread
import time
import traceback

from mtv_world_ros.core.data_types import Observation, SuccessEstimate
from mtv_world_ros.core.errors import ModelMemoryError, MtvWorldError, PlanError, RolloutPreempted
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import ChunkPlan, Plan
from mtv_world_ros.rollout.observed_episode import ObservedEpisode
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.rollout.rollout import Rollout
from mtv_world_ros.ros.messages.conversions import NANO
from mtv_world_ros.ros.messages.rejection import Reason
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.sensing.observations import SensedScene
from mtv_world_ros.success.doubts import ContactTrust
from mtv_world_ros.vision.camera_check import CameraCheck

#: a thread that is stuck in the model is not waited for longer than this at the end [s]
_LONGEST_JOIN_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A trajectory to imagine.

    Attributes:
        rollout: number of the rollout, counted from 1.
        plan: the checked trajectory, from the scene on.
        stamp_ns: the trajectory's stamp [ns]; 0 = it starts at the observation.
        scene: the newest scene when it came in; its frames are real, or predicted.
        imagine: whether to start from the last predicted frames if there are newer ones, and
            whether the next request shall.
        instruction: text for the robot.
        stored_objects: names of the objects that came with the recording; empty = none did.
        settings: the parameters when it came in. In imagine mode the seed counts one up with
            every chunk after a reset, over requests too.
        received_s: when it came in [s], of `time.monotonic`.
        received_ns: time of arrival by the node's clock [ns].
    """

    rollout: int
    plan: Plan
    stamp_ns: int
    scene: SensedScene
    imagine: bool
    instruction: str
    settings: Settings
    received_s: float
    received_ns: int = 0
    stored_objects: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """A predicted chunk of a request.

    Attributes:
        request: request that the chunk answers.
        plan: the plan from where the rollout started.
        scene: the scene it started from.
        prediction: frames, masks and estimate.
        ready_s: time at which it was ready [s], of `time.monotonic`.
    """

    request: Request
    plan: Plan
    scene: SensedScene
    prediction: Prediction
    ready_s: float

    @property
    def lead_s(self) -> float:
        """Lead of the chunk over the stamp of its last frame [s].

        The time that computing took is taken off the stamp by the wall, not by the node's clock:
        a player that holds the clock meanwhile makes no lead.
        """
        end_ns = self.prediction.stamp_ns + round(float(self.prediction.video.times[-1]) * NANO)
        ahead_s = (end_ns - self.request.received_ns) / NANO
        return ahead_s - (self.ready_s - self.request.received_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Foreseen:
    """The estimate of a chunk whose frames are not imagined yet.

    Attributes:
        request: request that the chunk answers.
        chunk: index of the chunk in its rollout.
        num_chunks: chunks of the rollout.
        success: the estimate of simulated futures.
        ready_s: time at which it was ready [s], of `time.monotonic`.
    """

    request: Request
    chunk: int
    num_chunks: int
    success: SuccessEstimate
    ready_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Ended:
    """End of a request; each request has exactly one.

    Attributes:
        request: request that has ended.
        state: `done`, `preempted`, `rejected`, `failed` or `reset`.
        num_chunks: number of predicted chunks.
        last: last predicted chunk; None = no chunk was predicted.
        foreseen: last estimate before frames were imagined; None = futures told none.
        reason: code of the reason why the plan was rejected or failed.
        text: the reason in words, also of a pre-emption by anything but a newer plan.
        trace: traceback of an unexpected error.
    """

    request: Request
    state: str
    num_chunks: int
    last: Chunk | None = None
    foreseen: Foreseen | None = None
    reason: Reason | None = None
    text: str = ''
    trace: str = ''

    @property
    def success(self) -> SuccessEstimate | None:
        """Last estimate of the plan; None = none was given."""
        last, foreseen = self.last, self.foreseen
        if foreseen is not None and (last is None or foreseen.chunk > last.prediction.chunk):
            return foreseen.success
        return None if last is None else last.prediction.success


#: what takers of results are given; `Foreseen` is reported alone
Result = Chunk | Ended


class RolloutWorker:
    """Runs one request at a time in its own thread.

    Attributes:
        camera_check: result of the camera check on the newest episode's first frames.
        doubt: returns why the fitted physics does not hold here; empty = it may hold.
        contact: returns the evidence on contact parameters of another robot cell, for the name of
            this cell and an instruction.

    Args:
        pipeline: the main path.
        notify: called from the thread whenever `take` has something new.
    """

    def __init__(self, pipeline: Pipeline, notify: Callable[[], None]) -> None:
        self._pipeline, self._observed = pipeline, ObservedEpisode(pipeline)
        self._notify = notify
        self.camera_check = CameraCheck()
        self.doubt: Callable[[], str] = str
        self.contact: Callable[[str, str], ContactTrust] = lambda *_: ContactTrust()
        self._changed = Condition()
        self._pending: Request | None = None
        self._running: Request | None = None
        self._known: list[Chunk] = []
        #: futures of the running plan's first chunk are computed
        self._is_foreseeing = False
        #: what futures of the running plan told last
        self._foreseen: Foreseen | None = None
        self._is_starved = False
        #: when the last chunk was ready, of `time.monotonic`, and how long its frames last [s]
        self._pictured_s = -inf
        self._chunk_s = pipeline.spec.num_frames / pipeline.spec.fps
        self._between: deque[Callable[[], None]] = deque()
        self._abandoned = False
        self._closing = False
        self._episode: Rollout | None = None
        self._last: SensedScene | None = None
        self._results: deque[Result | Foreseen] = deque()
        #: time of the thread's last step [s]; None = it waits for work
        self._beat_s: float | None = None
        self._thread = self._new_thread()

    def start(self) -> None:
        """Start the thread; requests wait until then."""
        self._thread.start()

    def supervise(self, longest_s: float) -> bool:
        """Give up a thread that is stuck in the model, and go on in a new one.

        Args:
            longest_s: longest time between two denoising steps [s].

        Returns:
            Whether the thread was stuck; its rollout failed then.
        """
        with self._changed:
            if self._beat_s is None or time.monotonic() - self._beat_s < longest_s:
                return False
            if self._running is not None and not self._abandoned:
                text = (
                    f'the model did not go on for {longest_s:g} s and was given up; '
                    "'stuck_after_s' allows more"
                )
                self._put(self._ended(self._running, 'failed', Reason.WORKER_STUCK, text))
            self._running, self._abandoned, self._beat_s = None, False, None
            self._episode, self._last, self._known = None, None, []
            self._is_foreseeing, self._foreseen = False, None
            self._observed = ObservedEpisode(self._pipeline)
            self._thread = self._new_thread()
            self._thread.start()
            return True

    def _new_thread(self) -> Thread:
        """Return a daemon thread: one that is stuck does not keep the process from ending."""
        return Thread(target=self._run, name='rollouts', daemon=True)

    @property
    def _is_given_up(self) -> bool:
        """Return whether the calling thread was replaced."""
        return current_thread() is not self._thread

    @property
    def last_scene(self) -> SensedScene | None:
        """Last predicted frames, from which imagine mode continues; None = there are none."""
        with self._changed:
            return self._last

    @property
    def busy(self) -> bool:
        """True if a rollout runs or waits."""
        with self._changed:
            return self._running is not None or self._pending is not None

    def submit(self, request: Request) -> None:
        """Start a request; it pre-empts a running one and replaces a waiting one.

        A running one first gets the verdict of its first chunk's futures: of plans that come
        faster, as many as there is time for get verdicts. Its frames are skipped for the newer
        one, unless no chunk was imagined for as long as a chunk lasts.

        Where futures tell no verdict, frames do: from when a rollout was pre-empted without one
        until one ends with none waiting, each completes its first chunk.
        """
        with self._changed:
            if self._pending is not None:
                self._put(Ended(request=self._pending, state='preempted', num_chunks=0))
            self._pending = request
            self._changed.notify_all()

    def sees(self, stamp_ns: int) -> bool:
        """Return whether `see` takes an observation of this stamp [ns]."""
        return self._observed.is_due(stamp_ns)

    def see(self, observation: Observation) -> None:
        """Give the judge a real observation between plans."""
        self._observed.see(observation)
        with self._changed:
            self._changed.notify_all()

    def run_between(self, job: Callable[[], None]) -> None:
        """Run a job that must not raise, never during a rollout; jobs run in order."""
        with self._changed:
            self._between.append(job)
            self._changed.notify_all()

    def use_robot(self, robot: RobotModel) -> None:
        """Imagine with another description of the same robot from the next rollout on."""

        def use() -> None:
            with self._changed:
                self._pipeline = self._pipeline.with_robot(robot)
                self._observed = ObservedEpisode(self._pipeline)
                if self._episode is not None:
                    self._episode.pipeline = self._pipeline

        self.run_between(use)

    def reset(self, state: str = 'reset', text: str = '') -> None:
        """Give up what runs and waits, drop chunks not taken, forget the last frames.

        Args:
            state: state of the ended plan, for `Ended`.
            text: reason in words.
        """
        with self._changed:
            self._results = deque(r for r in self._results if isinstance(r, Ended))
            running = None if self._abandoned else self._running
            if running is not None:
                self._put(self._ended(running, state, text=text))
            if self._pending is not None:
                self._put(Ended(request=self._pending, state=state, num_chunks=0, text=text))
            self._abandoned = self._running is not None
            self._pending = None
            self._episode, self._last = None, None
            self._observed.forget()

    def give_up(self, rollout: int | None, text: str) -> None:
        """Pre-empt a plan that runs or waits; imagine mode continues from its chunks.

        Args:
            rollout: number of the plan's rollout; None = every plan.
            text: reason in words.
        """
        with self._changed:
            running, pending = self._running, self._pending
            if running is not None and rollout in (None, running.rollout) and not self._abandoned:
                self._put(self._ended(running, 'preempted', text=text))
                self._abandoned = True
            if pending is not None and rollout in (None, pending.rollout):
                self._put(Ended(request=pending, state='preempted', num_chunks=0, text=text))
                self._pending = None

    def wait_for_verdict(self, longest_s: float) -> None:
        """Wait until no futures are computed, which other work would delay.

        Args:
            longest_s: longest time to wait [s].
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._is_foreseeing or self._closing, longest_s)

    def take(self) -> list[Result | Foreseen]:
        """Return the results since the last call, in order."""
        with self._changed:
            taken = list(self._results)
            self._results.clear()
            return taken

    def close(self) -> None:
        """End the thread; a running rollout is given up at its next denoising step."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(_LONGEST_JOIN_S)
        with self._changed:  # a thread that is stuck notifies nobody when it ends
            self._notify = lambda: None

    def _run(self) -> None:
        while (request := self._next()) is not None:
            ended = self._roll_out(request)
            with self._changed:
                if self._is_given_up:
                    return
                if not self._abandoned:
                    self._put(ended)
                is_preempted = ended.state == 'preempted' and not self._abandoned
                are_fast = self._is_starved and self._pending is not None
                self._is_starved = are_fast or (is_preempted and ended.success is None)
                self._running, self._abandoned = None, False
                self._end_foreseeing()

    def _next(self) -> Request | None:
        while True:
            with self._changed:
                if self._is_given_up:
                    return None
                self._beat_s = None
                self._changed.wait_for(self._has_work)
                if self._closing:
                    return None
                self._beat_s = time.monotonic()
                job = self._between.popleft() if self._between else None
                if job is None and self._pending is None:
                    job = self._catch_up
                if job is None:
                    self._running, self._pending = self._pending, None
                    self._known, self._foreseen = [], None
                    return self._running
            job()

    def _has_work(self) -> bool:
        is_asked = self._closing or self._between or self._pending is not None
        return bool(is_asked) or self._observed.is_behind

    def _catch_up(self) -> None:
        """Segment real frames while no rollout runs; after a failure they are dropped."""
        try:
            self._observed.catch_up()
        except Exception:
            self._observed.forget()
            traceback.print_exc()

    def _should_stop(self) -> bool:
        with self._changed:
            if self._is_given_up:
                return True
            self._beat_s = time.monotonic()
            is_replaced = self._pending is not None and self._gives_way()
            return self._closing or self._abandoned or is_replaced

    def _gives_way(self) -> bool:
        """Return whether the running plan is left for a newer one now."""
        if self._known:
            return True
        if self._is_foreseeing:
            return False
        if self._foreseen is None:
            return not self._is_starved
        # an imagined episode goes on from its frames
        are_wanted = self._running is not None and self._running.imagine
        return not are_wanted and time.monotonic() - self._pictured_s < self._chunk_s

    def _end_foreseeing(self) -> None:
        self._is_foreseeing = False
        self._changed.notify_all()

    def _roll_out(self, request: Request) -> Ended:
        try:
            self._imagine(request)
        except RolloutPreempted:
            return self._ended(request, 'preempted')
        except (ModelMemoryError, MemoryError) as error:
            text = str(error) or 'out of memory'
            return self._ended(request, 'failed', Reason.OUT_OF_MEMORY, text)
        except PlanError as error:
            return self._ended(request, 'rejected', Reason(error.fault), str(error))
        except MtvWorldError as error:
            return self._ended(request, 'rejected', Reason.ROLLOUT_INVALID, str(error))
        except Exception as error:  # the node outlives whatever the model raises
            text = f'{type(error).__name__}: {error}'
            ended = self._ended(request, 'failed', Reason.INTERNAL_ERROR, text)
            return replace(ended, trace=traceback.format_exc())
        return self._ended(request, 'done')

    def _ended(
        self, request: Request, state: str, reason: Reason | None = None, text: str = ''
    ) -> Ended:
        """Return the end of the running request, with what is known of it."""
        known = self._known
        last = known[-1] if known else None
        return Ended(
            request=request,
            state=state,
            num_chunks=len(known),
            last=last,
            foreseen=self._foreseen,
            reason=reason,
            text=text,
        )

    def _imagine(self, request: Request) -> None:
        """Imagine the chunks of a request and hand each on."""
        with self._changed:
            self._is_foreseeing = True
        scene, episode = self._begin(request, self._options(request))
        # rollouts before this one may have moved the robot in imagination
        plan = request.plan.after(episode.observation)
        for prediction in episode.extend(plan):
            chunk = Chunk(
                request=request,
                plan=plan,
                scene=scene,
                prediction=prediction,
                ready_s=time.monotonic(),
            )
            with self._changed:
                if self._abandoned or self._closing or self._is_given_up:
                    raise RolloutPreempted('the rollout was given up')
                if request.imagine:
                    self._episode = episode
                    self._last = replace(scene, observation=episode.observation)
                self._known.append(chunk)
                self._pictured_s = chunk.ready_s
                self._put(chunk)

    def _options(self, request: Request) -> RolloutOptions:
        """Return the options that the request asks for."""
        settings = request.settings
        return RolloutOptions(
            instruction=request.instruction,
            objects=settings.objects,
            stored_objects=request.stored_objects,
            seed=settings.seed,
            num_seeds=settings.num_seeds,
            num_inference_steps=settings.num_inference_steps,
            limits=settings.plan_limits,
            should_stop=self._should_stop,
            doubt='' if request.imagine else self.doubt(),
            contact=self.contact(settings.place, request.instruction),
            on_foreseen=partial(self._put_foreseen, request),
        )

    def _put_foreseen(
        self, request: Request, plan: ChunkPlan, success: SuccessEstimate | None
    ) -> None:
        """Hand on the estimate of a chunk whose frames are not imagined yet, if there is one."""
        if success is None:
            with self._changed:
                if not self._is_given_up:
                    self._end_foreseeing()
            return
        found = Foreseen(
            request=request,
            chunk=plan.chunk,
            num_chunks=plan.num_chunks,
            success=success,
            ready_s=time.monotonic(),
        )
        with self._changed:
            if not (self._abandoned or self._closing or self._is_given_up):
                self._foreseen = found
                self._end_foreseeing()
                self._put(found)

    def _begin(self, request: Request, options: RolloutOptions) -> tuple[SensedScene, Rollout]:
        """Return the start scene and its episode: the present one, or a new one."""
        with self._changed:
            if request.imagine and self._episode is not None and self._last is not None:
                self._episode.options = options
                return self._last, self._episode
        scene = request.scene
        begin = self._pipeline.begin if request.imagine else self._observed.begin
        episode = begin(scene.observation, options)
        self.camera_check = episode.camera_check
        return scene, episode

    def _put(self, result: Result | Foreseen) -> None:
        self._results.append(result)
        self._notify()
