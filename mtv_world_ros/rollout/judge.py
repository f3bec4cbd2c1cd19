"""The judge of a rollout: what turns evidence into a verdict, chunk after chunk.

V views, T frames, J joints, O objects, K futures, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, Self

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import (
    ByteArray,
    FloatArray,
    ObjectMasks,
    Observation,
    SuccessEstimate,
    WorldModelSpec,
)
from mtv_world_ros.physics.episode_objects import ObjectForesight
from mtv_world_ros.physics.foreseen_motions import ForeseenMotions
from mtv_world_ros.physics.object_motion import ObjectMotionModel
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import ChunkPlan, Plan
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.success.calibration import HorizonCurve
from mtv_world_ros.success.comparison import Comparison
from mtv_world_ros.success.estimator import SuccessEstimator
from mtv_world_ros.success.footage_memory import FootageMemory
from mtv_world_ros.success.task import TaskSpec
from mtv_world_ros.vision.camera_check import CameraCheck
from mtv_world_ros.vision.frame_check import StillPictures
from mtv_world_ros.vision.segmenters.segmenter import Segmenter


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeState:
    """Evidence of one rollout between two chunks.

    Attributes:
        objects: foreseen poses of the named objects.
        camera_check: calibration check on the episode's first frames; its corrections are
            applied.
        memory: memory of masks, grasps and positions; None before the first chunk.
        frame_doubt: reason why the real frames that the plan starts from allow no verdict; empty =
            none.
        observed_doubts: reasons why the real frames before that one are no evidence.
        still: what the cameras have shown since their pictures changed last; None = no real frame
            followed the first one.
    """

    objects: ObjectForesight
    camera_check: CameraCheck = CameraCheck()
    memory: FootageMemory | None = None
    frame_doubt: str = ''
    observed_doubts: tuple[str, ...] = ()
    still: StillPictures | None = None

    def is_begun(self, num_imagined: int) -> bool:
        """Return True if no real frame was observed since the episode began.

        Args:
            num_imagined: number of frames since the last real one.
        """
        return self.memory is None or self.memory.num_frames == 1 + num_imagined

    def at(self, observation: Observation) -> JudgeState:
        """Return the evidence at a later real observation, in which objects are looked for anew.

        Args:
            observation: the observation; its cameras are corrected.
        """
        return replace(self, objects=self.objects.branch(observation), frame_doubt='')


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkStart:
    """Plan of a chunk, and the frame that it starts from.

    Attributes:
        plan: the chunk.
        observation: the frame at the model's size.
        masks: masks of the objects in it (T = 1).
        num_imagined: number of frames since the last real one.
    """

    plan: ChunkPlan
    observation: Observation
    masks: ObjectMasks
    num_imagined: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ImaginedChunk:
    """Imagined frames of a chunk.

    Attributes:
        motion: motion of robot and cameras at the start and the T frames.
        masks: masks of the objects in these frames.
        is_in_view: whether the plan is drawn in a view, where the control is a drawing.
    """

    motion: Motion
    masks: ObjectMasks
    is_in_view: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenChunk:
    """Real frames after an observation.

    Attributes:
        motion: motion of robot and cameras at the start and the T frames, as measured.
        start_masks: masks of the objects in the frame before them (T = 1).
        masks: masks of the objects in these frames.
        frames: (V, T, H, W, 3) uint8 RGB.
        period_s: time between two frames [s].
        commands: (1 + T, J) commanded at the same times [rad or m]; None = not known.
    """

    motion: Motion
    start_masks: ObjectMasks
    masks: ObjectMasks
    frames: ByteArray
    period_s: float
    commands: FloatArray | None = None


class Judgement(NamedTuple):
    """Verdict of a chunk.

    Attributes:
        estimate: the estimate at the chunk's end.
        foreseen: motions that it rests on; None = frames alone.
        state: evidence after the chunk.
    """

    estimate: SuccessEstimate
    foreseen: ForeseenMotions | None
    state: JudgeState


class Judge(Protocol):
    """Judges rollouts chunk by chunk; it has no state of its own, see `SuccessJudge`."""

    @property
    def estimator(self) -> SuccessEstimator:
        """Tasks, and the estimate of one."""
        ...

    @property
    def object_motion(self) -> ObjectMotionModel | None:
        """Simulates object motion; None = imagined frames alone decide."""
        ...

    @property
    def horizon(self) -> HorizonCurve | None:
        """Measured Jaccard index by horizon; None = not measured."""
        ...

    def begin(
        self, observation: Observation, *, segmenter: Segmenter, foresees: bool
    ) -> JudgeState:
        """Return the evidence of an episode at its first real observation.

        Args:
            observation: the observation at any image size.
            segmenter: finds the objects in real frames.
            foresees: whether the world model is shown simulated object motion.
        """
        ...

    def foresee(self, state: JudgeState, start: ChunkStart, options: RolloutOptions) -> JudgeState:
        """Return the evidence with the object motion of a chunk, before a frame is imagined.

        Args:
            state: evidence before the chunk.
            start: the chunk.
            options: instruction, objects and task.

        Raises:
            RolloutPreempted: `should_stop` of the options said so.
        """
        ...

    def ahead(
        self, state: JudgeState, start: ChunkStart, motion: Motion, options: RolloutOptions
    ) -> SuccessEstimate | None:
        """Return the verdict before frames are imagined, which `judge` can only widen.

        Args:
            state: evidence as `foresee` returned it.
            start: the chunk.
            motion: motion of robot and cameras at the start and the frames.
            options: instruction, objects and task.

        Returns:
            The estimate; None = the frames are needed for one.
        """
        ...

    def judge(
        self, state: JudgeState, start: ChunkStart, chunk: ImaginedChunk, options: RolloutOptions
    ) -> Judgement:
        """Return the verdict after imagined frames.

        Args:
            state: evidence as `foresee` returned it.
            start: the chunk.
            chunk: its imagined frames.
            options: instruction, objects and task.
        """
        ...

    def see(self, state: JudgeState, chunk: SeenChunk, options: RolloutOptions) -> Judgement:
        """Return the verdict after real frames.

        Args:
            state: evidence before the frames.
            chunk: the frames.
            options: instruction, objects and task.
        """
        ...

    def compare(
        self,
        state: JudgeState,
        plans: Sequence[Plan],
        observation: Observation,
        masks: ObjectMasks,
        spec: WorldModelSpec,
        options: RolloutOptions,
    ) -> Comparison:
        """Return which of several plans of one scene is better, without imagined frames.

        Args:
            state: evidence at the observation, with simulated object motion.
            plans: checked plans of one length.
            observation: observation that all plans start from, at the model's size.
            masks: masks of the objects in it.
            spec: clock of the model.
            options: instruction, objects and limits.

        Raises:
            RolloutPreempted: `should_stop` of the options said so.
        """
        ...

    def is_fitted_at(self, place: str) -> bool:
        """Return True if futures are drawn as they were fitted, in a robot cell.

        Args:
            place: name of the robot cell; empty = not stated.
        """
        ...

    def for_task(self, task: TaskSpec | None) -> Self:
        """Return the judge of the task that an episode defines; None = it defines none."""
        ...

    def with_robot(self, robot: RobotModel) -> Self:
        """Return the judge for a robot of the same joints and tools, e.g. a calibrated one."""
        ...

    def without_camera_check(self) -> Self:
        """Return the judge of observations whose cameras were checked before."""
        ...

    def without_foresight(self) -> Self:
        """Return the judge without simulated object motion: imagined frames alone decide."""
        ...
