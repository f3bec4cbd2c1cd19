"""Live fidelity: J of imagined frames with the real frames of the same times."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from threading import Condition, Lock, Thread
from typing import NamedTuple

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Float32MultiArray

from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import ConfigError, RolloutPreempted
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.physics.object_motion import ObjectMotionModel
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.rollout import Rollout
from mtv_world_ros.ros.messages import image_messages
from mtv_world_ros.ros.messages.conversions import NANO, to_multi_array, to_ns
from mtv_world_ros.ros.messages.rejection import Rejection
from mtv_world_ros.ros.node_events import NodeEvents
from mtv_world_ros.ros.sensing.samples import Samples
from mtv_world_ros.ros.status_publisher import create_publisher
from mtv_world_ros.ros.world_model.chunk_outcomes import ScoredChunk
from mtv_world_ros.ros.world_model.worker import Chunk, Request, Result
from mtv_world_ros.success.cell_file import CellFile
from mtv_world_ros.success.confirmation import ContactConfirmation
from mtv_world_ros.success.doubts import chunk_end, ContactTrust, PhysicsWatch
from mtv_world_ros.success.task import match_task
from mtv_world_ros.success.trust import OTHER_CELL
from mtv_world_ros.vision.jaccard import held_masks, mean_of_known, object_jaccard

#: chunks that wait for their real frames; the oldest is given up for a newer one
MAX_CHUNKS = 8
#: images that wait to be looked at; the oldest is dropped
MAX_WAITING = 32
#: real frames of each view that are kept, at the model's size
MAX_FRAMES = 256
#: chunks whose scores are kept
MAX_KEPT = 1000
#: remark on evidence without a file
NOT_KEPT = "the evidence ends with the node: set the parameter 'place' to keep it"
#: a real frame stands for an imagined one if it is at most this share of a period away
MAX_OFFSET = 0.3
#: a comparison waits for the verdict of a new plan up to this [s]
MAX_DELAY_S = 1.0


@dataclass(slots=True, eq=False)  # arrays have no truth value: one is only itself
class Expected:
    """Chunk with the stamps of its executed frames, those before the next plan."""

    chunk: Chunk
    stamps: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        prediction = self.chunk.prediction
        self.stamps = [
            prediction.stamp_ns + round(float(t) * NANO) for t in prediction.video.times
        ]


class _SeenRollout(NamedTuple):
    """A rollout whose real frames were observed up to a chunk."""

    rollout: int
    num_chunks: int
    episode: Rollout


@dataclass(slots=True, eq=False)
class _Cell:
    """Evidence on contact parameters in a robot cell.

    Attributes:
        confirmation: test of each task.
        file: file that keeps the evidence; None = it ends with the node.
        refusal: reason why the file cannot be used, so that nothing is confirmed; empty = it can.
    """

    confirmation: ContactConfirmation
    file: CellFile | None = None
    refusal: str = ''

    def trust(self, task: str) -> ContactTrust:
        """Return whether contact parameters are taken as fitted here, for a task."""
        if self.refusal:
            return ContactTrust(text=f'contact of this cell is not confirmed: {self.refusal}')
        trust = self.confirmation.trust(task)
        return trust if self.file else replace(trust, text=f'{trust.text}; {NOT_KEPT}')

    @property
    def text(self) -> str:
        """Evidence in words."""
        if self.refusal:
            return f'contact of this cell is not confirmed: {self.refusal}'
        return self.confirmation.text if self.file else f'{self.confirmation.text}; {NOT_KEPT}'


class LiveFidelity:
    """Compares executed chunks with real frames in a thread; publishes `~/fidelity`.

    Chunks of imagine mode are not compared: nobody executes them.

    Attributes:
        watch: tests whether executed plans ended as the fitted contact parameters foresee.
        wait_for_verdict: waits until no verdict is computed, up to a time [s].

    Args:
        node: owner of the publisher.
        pipeline: observes the real frames as it does imagined ones.
        events: takes chunks that were compared, and what went wrong.
    """

    def __init__(
        self,
        node: Node,
        pipeline: Pipeline,
        events: NodeEvents,
    ) -> None:
        self.watch = PhysicsWatch()
        self.wait_for_verdict: Callable[[float], None] = lambda _: None
        self._place = ''
        self._cells: dict[str, _Cell] = {}
        self._cells_lock = Lock()
        #: chunks whose end will not be seen
        self._given_up: list[Chunk] = []
        self._fitted: ObjectMotionModel | None = None
        # imagined frames begin chunks, too, and cameras were checked before
        judge = pipeline.judge.without_camera_check()
        self._pipeline, self._spec = replace(pipeline, judge=judge), pipeline.spec
        self._events = events
        self._tolerance_ns = round(MAX_OFFSET / self._spec.fps * NANO)
        self._changed = Condition()
        self._images: deque[tuple[str, Image | CompressedImage]] = deque(maxlen=MAX_WAITING)
        self._expected: deque[Expected] = deque(maxlen=MAX_CHUNKS)
        self._frames: dict[str, Samples[ByteArray]] = {
            view: Samples(MAX_FRAMES) for view in self._spec.views
        }
        self._seen: _SeenRollout | None = None
        self._results: deque[ScoredChunk | Exception] = deque(maxlen=MAX_CHUNKS)
        self._kept: deque[float] = deque(maxlen=MAX_KEPT)
        self._num_missed, self._closing = 0, False
        self._publisher = create_publisher(node, Float32MultiArray, '~/fidelity', 10)
        self._done = node.create_guard_condition(self._publish)
        self._thread = Thread(target=self._run, name='fidelity')

    def replan(self, request: Request) -> Request:
        """Drop imagined frames after a new request's start, which nobody executes; return it."""
        self.stop_at(request.stamp_ns or request.scene.observation.stamp_ns)
        return request

    def stop_at(self, stamp_ns: int) -> None:
        """Drop imagined frames after a time, at which the plan was given up."""
        with self._changed:
            for expected in self._expected:
                expected.stamps = [stamp for stamp in expected.stamps if stamp <= stamp_ns]

    def expect(self, result: Result) -> None:
        """Remember a chunk until its real frames are here."""
        if isinstance(result, Chunk) and not result.request.imagine:
            with self._changed:
                if len(self._expected) == MAX_CHUNKS:
                    self._num_missed += 1
                    self._given_up.append(self._expected.popleft().chunk)
                self._expected.append(Expected(result))
                self._changed.notify_all()
            # not before: a node that fails at its start would wait for the thread
            if self._thread.ident is None:
                self._thread.start()

    def is_fitted_at(self, place: str) -> bool:
        """Return True if contact parameters were fitted in a robot cell."""
        return self._pipeline.judge.is_fitted_at(place)

    def use_robot(self, robot: RobotModel) -> None:
        """Observe with another description of the same robot from the next chunk on."""
        self._pipeline, self._fitted = self._pipeline.with_robot(robot), None

    def see(self, view: str, message: Image | CompressedImage) -> None:
        """Queue a real image for the comparison thread."""
        with self._changed:
            self._images.append((view, message))
            self._changed.notify_all()

    def reset(self) -> None:
        """Forget chunks and frames: reset, or the clock went back."""
        with self._changed:
            self._given_up += [expected.chunk for expected in self._expected]
            self._expected.clear()
            self._images.clear()
            for frames in self._frames.values():
                frames.clear()

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join()
            self._finish()

    def values(self) -> dict[str, object]:
        """Values for `/diagnostics`: chunks compared and not, mean J of those that are kept."""
        kept = [value for value in self._kept if np.isfinite(value)]
        return {
            'fidelity_chunks': len(self._kept),
            'fidelity_missed': self._num_missed,
            'fidelity_jaccard': float(np.mean(kept)) if kept else float('nan'),
        }

    def _publish(self) -> None:
        while self._results:
            result = self._results.popleft()
            if isinstance(result, Exception):
                self._events.on_error(result)
                continue
            self._kept.append(result.mean)
            self._publisher.publish(to_multi_array(result.jaccard, ('view', 'object')))
            self._events.on_scored(result)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._closing or self._images or self._given_up or self._due()
                )
                if self._closing:
                    return
                images, given_up = list(self._images), self._given_up
                self._images.clear()
                self._given_up = []
            try:
                for chunk in given_up:
                    self._miss(chunk)
                for view, message in images:
                    self._keep(view, message)
                while (expected := self._next_due()) is not None:
                    self.wait_for_verdict(MAX_DELAY_S)
                    self._score(expected)
            except Exception as error:  # the node outlives whatever a segmenter raises
                self._results.append(error)
                self._done.trigger()

    def _keep(self, view: str, message: Image | CompressedImage) -> None:
        """Store a real frame at the model's size, unless there is one of nearly the same time."""
        stamp_ns = to_ns(message.header.stamp)
        frames = self._frames[view]
        if frames and abs(frames.nearest(stamp_ns)[0] - stamp_ns) < self._tolerance_ns / 4:
            return
        try:
            frame = image_messages.to_rgb(message)
        except Rejection:
            return  # counted where it came in
        small = resize_frames(frame[None], self._spec.width, self._spec.height)[0]
        with self._changed:
            frames.add(stamp_ns, small)

    def _due(self) -> Expected | None:
        """Return a chunk whose last frame every view has passed."""
        newest = [frames.newest[0] if frames else -1 for frames in self._frames.values()]
        for expected in self._expected:
            if not expected.stamps or min(newest) >= expected.stamps[-1]:
                return expected
        return None

    def _next_due(self) -> Expected | None:
        with self._changed:
            expected = self._due()
            if expected is not None:
                self._expected.remove(expected)
            return expected

    def _score(self, expected: Expected) -> None:
        prediction = expected.chunk.prediction
        indices, frames = self._matched(expected.stamps)
        if not indices or not prediction.masks.names:
            self._num_missed += 1
            self._miss(expected.chunk)
            return
        episode = self._real_episode(expected.chunk)
        start = episode.observation.positions[None]
        found = episode.observe(frames, np.concatenate([start, prediction.positions[indices]]))
        imagined = replace(prediction.masks, masks=prediction.masks.masks[:, :, indices])
        held = held_masks(found.start_masks.masks[:, :, 0], found.masks)
        scored = ScoredChunk(
            chunk=expected.chunk,
            names=imagined.names,
            jaccard=mean_of_known(object_jaccard(imagined, found.masks), axis=2),
            copy=mean_of_known(object_jaccard(held, found.masks), axis=2),
            num_frames=len(indices),
        )
        self._results.append(scored)
        self._done.trigger()
        if len(indices) == len(prediction.video.times):
            self._test_physics(expected.chunk, episode.seen_points(len(indices)))
        else:
            self._miss(expected.chunk)

    def _test_physics(self, chunk: Chunk, seen: FloatArray) -> None:
        """Compare the end of an executed chunk with the futures of the fitted parameters.

        Futures of the prior foresee nearly everything: they are no test.

        Args:
            chunk: the imagined chunk.
            seen: (1 + T, O, 3) where masks showed the objects [m].
        """
        prediction, request = chunk.prediction, chunk.request
        objects, foreseen = prediction.objects, prediction.foreseen
        if objects is None or objects.found is None or foreseen is None:
            return
        if not objects.found.tracked.is_fitted:
            plans = chunk.plan.chunks(self._spec)[: prediction.chunk + 1]
            try:
                foreseen = objects.ends_by(self._fitted_model(), plans, lambda: self._closing)
            except RolloutPreempted:
                return
        if foreseen is None:
            return
        self._use_place(prediction.start.place)
        end = chunk_end(foreseen, seen)
        self.watch.take(end.away_m, request.rollout)
        is_last, task = prediction.chunk + 1 == prediction.num_chunks, self._task(request)
        self._change(lambda test: test.take(end, request.rollout, task, is_last=is_last))

    def _miss(self, chunk: Chunk) -> None:
        """Note a chunk whose end was not seen, e.g. of a plan that was given up."""
        if chunk.prediction.foreseen is not None:
            self._use_place(chunk.prediction.start.place)
            number, task = chunk.request.rollout, self._task(chunk.request)
            self._change(lambda test: test.miss(number, task))

    def _finish(self) -> None:
        """Count the present rollout, whose end is not seen any more."""
        with self._changed:
            left = [*self._given_up, *(expected.chunk for expected in self._expected)]
        for chunk in left:
            self._miss(chunk)
        self._change(lambda test: test.finish())

    def _change(self, change: Callable[[ContactConfirmation], object]) -> None:
        """Change the evidence of the robot cell, and keep it in its file."""
        if self.is_fitted_at(self._place):
            return
        cell = self._cell(self._place)
        with self._cells_lock:
            if cell.file is None or cell.refusal:
                change(cell.confirmation)
                return
            try:
                remark = cell.file.update(cell.confirmation, change)
            except ConfigError as error:
                cell.refusal = str(error)
                self._report(error)
            except OSError as error:
                cell.file = None  # from here on it is kept in memory alone, and says so
                self._report(error)
            else:
                if remark:
                    self._report(ConfigError(remark))

    def _cell(self, place: str) -> _Cell:
        """Return the evidence of a robot cell, at first that of its file."""
        with self._cells_lock:
            if place not in self._cells:
                self._cells[place] = self._load_cell(place)
            return self._cells[place]

    def _load_cell(self, place: str) -> _Cell:
        checkpoint, robot = self._pipeline.checkpoint, self._pipeline.robot
        fit = '' if checkpoint is None else checkpoint.object_motion_digest
        file = CellFile.at_home(place=place, robot=robot.name, fit=fit)
        if file is None:
            return _Cell(ContactConfirmation())
        try:
            confirmation, remark = file.load()
        except ConfigError as error:
            self._report(error)
            return _Cell(ContactConfirmation(), file, str(error))
        if remark:
            self._report(ConfigError(remark))
        return _Cell(confirmation, file)

    def _report(self, error: Exception) -> None:
        """Report an error from any thread."""
        self._results.append(error)
        self._done.trigger()

    def _task(self, request: Request) -> str:
        """Return the name of a request's task; without a known one, its instruction."""
        return self._task_named(request.instruction)

    def _task_named(self, instruction: str) -> str:
        matched = match_task(self._pipeline.judge.estimator.tasks, instruction)
        return instruction if matched is None else matched[0].name

    def _fitted_model(self) -> ObjectMotionModel:
        """Return foresight with the fitted parameters; its simulator is this thread's own."""
        if self._fitted is None:
            model = self._pipeline.judge.object_motion
            assert model is not None  # something was foreseen
            self._fitted = model.with_robot(self._pipeline.robot)
        return self._fitted

    def _use_place(self, place: str) -> None:
        """Begin the tests anew in another robot cell."""
        if place != self._place:
            self._place = place
            self.watch.forget()

    def trust(self, place: str, instruction: str) -> ContactTrust:
        """Return the evidence on contact parameters that were fitted in another robot cell.

        Args:
            place: name of this robot cell; empty = not stated.
            instruction: text for the robot.
        """
        if self.is_fitted_at(place):
            return ContactTrust()
        # while the watch doubts, its reason is given
        if place == self._place and self.watch.doubt:
            return ContactTrust()
        return self._cell(place).trust(self._task_named(instruction))

    def physics_text(self, place: str) -> str:
        """Text about the contact parameters in a robot cell, for `/diagnostics`."""
        if self.is_fitted_at(place):
            return self.watch.text
        if place == self._place and self.watch.doubt:
            return self.watch.doubt
        cell = self._cell(place)
        is_confirmed = cell.confirmation.is_complete and not cell.refusal
        return cell.text if is_confirmed else f'{cell.text}; {OTHER_CELL}'

    def _real_episode(self, chunk: Chunk) -> Rollout:
        """Return the real frames of the chunk's rollout; a new episode if some are missing."""
        prediction, rollout = chunk.prediction, chunk.request.rollout
        seen = self._seen
        if seen is None or (seen.rollout, seen.num_chunks) != (rollout, prediction.chunk):
            options = RolloutOptions(
                instruction=chunk.request.instruction, objects=prediction.masks.names
            )
            episode = self._pipeline.begin(prediction.start, options)
            seen = _SeenRollout(rollout, prediction.chunk, episode)
        self._seen = seen._replace(num_chunks=prediction.chunk + 1)
        return seen.episode

    def _matched(self, stamps: Sequence[int]) -> tuple[list[int], ByteArray]:
        """Return imagined frames that every view has a real one for, and those (V, N, H, W, 3)."""
        indices, rows = [], []
        for index, stamp in enumerate(stamps):
            row = []
            for frames in self._frames.values():
                near = frames.nearest(stamp) if frames else None
                if near is not None and abs(near[0] - stamp) <= self._tolerance_ns:
                    row.append(near[1])
            if len(row) == len(self._frames):
                indices.append(index)
                rows.append(np.stack(row))
        return indices, np.stack(rows, axis=1) if rows else np.zeros((0, 0), np.uint8)
