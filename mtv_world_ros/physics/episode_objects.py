"""The named objects of an imagined episode: detection, foresight and rendering.

Shape letters: V views, O objects, K futures, T frames, H W pixels, J joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import (
    BoolArray,
    ByteArray,
    FloatArray,
    ObjectMasks,
    Observation,
)
from mtv_world_ros.core.errors import RolloutPreempted
from mtv_world_ros.core.images import resize_frames, resize_labels
from mtv_world_ros.physics.foreseen_motions import foreseen_of, ForeseenMotions
from mtv_world_ros.physics.grips import FingerState, watch_fingers
from mtv_world_ros.physics.object_motion import FoundObjects, ObjectMotionModel
from mtv_world_ros.physics.sights import KeptPose, Sights
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import ChunkPlan
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

#: maps the motions until now to the futures (K,) that end as the majority does; None = no majority
Majority = Callable[[ForeseenMotions], BoolArray | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectForesight:
    """Objects of an episode; immutable, so calls that change something return a new one.

    Attributes:
        model: motion model of the objects; None = no foresight, verdicts rest on frames alone.
        segmenter: segmenter of real frames.
        robot: robot that is commanded.
        first: first real observation of the episode, at the cameras' size.
        source: newest real observation, at the cameras' size.
        found: the objects in `source` and their motion since; None = not looked for yet.
        fingers: motion of the fingers until `source`, as measured; None = not known.
        sights: last frames until `source` that showed the objects free; None = none were watched.
    """

    model: ObjectMotionModel | None
    segmenter: Segmenter
    robot: RobotModel
    first: Observation
    source: Observation
    found: FoundObjects | None = None
    fingers: FingerState | None = None
    sights: Sights | None = None
    _whole: dict[tuple[str, ...], FoundObjects] = field(default_factory=dict)

    def branch(self, source: Observation) -> ObjectForesight:
        """Return the objects of the same episode, to be found again in a later real frame.

        The pictures of objects that were seen whole are kept.
        """
        return replace(self, source=source, found=None)

    def as_fitted(self) -> ObjectForesight:
        """Return the objects, simulated with the fitted contact parameters, not the prior.

        Objects whose simulation has begun go on as they are.
        """
        if self.model is None or self.found is not None or self.model.is_fitted:
            return self
        return replace(self, model=self.model.as_fitted())

    def ends_by(
        self,
        model: ObjectMotionModel,
        plans: Sequence[ChunkPlan],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> FloatArray | None:
        """Return centres (K, 1 + T, O, 3) in the futures of another model [m]; None = unknown.

        Args:
            model: motion model, e.g. one with other contact parameters.
            plans: the chunks since the objects were found; the centres are those of the last one.
            should_stop: polled while futures are simulated; true cancels.

        Raises:
            RolloutPreempted: `should_stop` said so.
        """
        if self.found is None:
            return None
        found = self.found.simulated_by(model)
        for plan in plans:
            found = found.after(
                plan.fine_positions(found.tracked.step_s, found.tracked.commands_a_step),
                should_stop,
            )
        motions = replace(self, found=found).motions(plans[-1], is_begun=True)
        return None if motions is None else motions.at_frames(plans[-1])

    def watched(
        self,
        motion: Motion,
        names: Sequence[str],
        masks: BoolArray,
        period_s: float,
        commands: FloatArray | None = None,
    ) -> ObjectForesight:
        """Return the objects after real frames.

        Args:
            motion: measured motion of the robot at 1 + T states; row 0 where it stood before.
            names: names of the O objects.
            masks: (V, O, 1 + T, H, W) their masks.
            period_s: time between two rows [s].
            commands: (1 + T, J) commanded at the same times [rad or m]; None = not known.
        """
        commanded = None if commands is None else self.robot.gripper_openings(commands)
        before = self.fingers
        if before is not None:  # what masks say is judged anew
            before = replace(before, is_refuted=np.zeros(len(before.rest), np.bool_))
        stopped, fingers = watch_fingers(motion.openings, period_s, before, commanded)
        sights = self.sights
        if sights is None or sights.names != tuple(names):
            sights = Sights.begin(names, motion.first(1))
            sights = sights.after(motion.first(1), masks[:, :, :1], stopped[:, :1], period_s)
        sights = sights.after(motion.after_first(), masks[:, :, 1:], stopped[:, 1:], period_s)
        fingers = replace(fingers, is_refuted=sights.refuted)
        return replace(self, fingers=fingers, sights=sights)

    def foresee(
        self,
        plan: ChunkPlan,
        observation: Observation,
        names: tuple[str, ...],
        start_masks: ObjectMasks,
        majority: Majority,
        is_begun: bool,
        should_stop: Callable[[], bool],
    ) -> ObjectForesight:
        """Simulate the objects through a chunk and return their state at its end.

        Pictures keep showing the same future, unless its outcome is that of a minority.

        Args:
            plan: commands of the chunk.
            observation: first observation of the episode, at the model's size.
            names: names of the O objects.
            start_masks: masks of the objects in `observation`.
            majority: selects the futures that end as the majority does.
            is_begun: whether no real frame was seen since the episode began.
            should_stop: polled while futures are simulated; true cancels.

        Raises:
            RolloutPreempted: `should_stop` said so.
        """
        if self.model is None:
            return self
        found = self.found
        if found is None or found.names != names:
            fingers = self.fingers if found is None else found.tracked.fingers
            found = self._find(observation, names, start_masks)
            found = replace(found, tracked=found.tracked.with_fingers(fingers))
            if should_stop():
                raise RolloutPreempted('stopped while objects were looked for')
        shown = found.shown
        positions = plan.fine_positions(found.tracked.step_s, found.tracked.commands_a_step)
        found = found.after(positions, should_stop)
        after = replace(self, found=found)
        motions = after.motions(plan, is_begun)
        among = None if motions is None else majority(motions)
        if plan.chunk == 0 or (among is not None and not among[shown]):
            shown = found.medoid(among)
        return replace(
            after, found=replace(found, shown=shown, shown_before=self._shown_before(shown))
        )

    def pictures(self, plan: ChunkPlan, motion: Motion) -> ByteArray | None:
        """Return the objects on their way through a chunk (V, 1 + T, H, W, 4); None = unknown.

        Args:
            plan: the chunk.
            motion: motion of the robot and the cameras at its 1 + T states.
        """
        if self.found is None:
            return None
        times = plan.times - plan.times[0]
        return self.found.pictures(times, motion.cameras, motion.camera_poses)

    def motions(self, plan: ChunkPlan, is_begun: bool) -> ForeseenMotions | None:
        """Return the futures up to the last kept frame of a chunk; None = not to be used.

        Args:
            plan: the chunk.
            is_begun: whether nothing real was seen since the episode began.
        """
        found = self.found
        # where the rollout began earlier, objects may have been found half hidden, or in a grip
        if found is None or not (is_begun or found.is_whole):
            return None
        left = round(plan.num_left * plan.frame_s / found.tracked.step_s)
        return foreseen_of(
            self.robot, found, len(found.motions[0].points) - left, is_begun=is_begun
        )

    @property
    def reasons(self) -> tuple[str, ...]:
        """Doubts about the simulated motion, in words."""
        return () if self.found is None else self.found.tracked.reasons

    @property
    def starts_later(self) -> bool:
        """True if motions are to be foreseen from a real frame later than the episode's first."""
        return self.model is not None and self.source is not self.first

    @property
    def refusal(self) -> str:
        """Reason to give no verdict; empty = none.

        In the episode's first part, an object whose motion cannot be simulated is a reason, too:
        pictures of objects that cannot be where they were found are no evidence.
        """
        if self.found is None:
            return ''
        tracked = self.found.tracked
        doubts = tracked.doubts if self.found.is_whole else {}
        return tracked.refusal or '; '.join(dict.fromkeys(doubts.values()))

    def _sharp(self, source: Observation, names: tuple[str, ...], masks: BoolArray) -> BoolArray:
        """Return masks at the recorded size; of what is not found there, those of the model's."""
        sharp = self.segmenter.segment(source.frames[:, None], names).masks[:, :, 0].copy()
        height, width = sharp.shape[-2:]
        for view, item in np.argwhere(masks.any((-2, -1)) & ~sharp.any((-2, -1))):
            small = masks[view, item].astype(np.uint8)[None]
            sharp[view, item] = resize_labels(small, width, height)[0] > 0
        return sharp

    def _shown_before(self, shown: int) -> int:
        return shown if self.found is None else self.found.shown

    def _find(
        self, observation: Observation, names: tuple[str, ...], start_masks: ObjectMasks
    ) -> FoundObjects:
        """Return the named objects where the rollout stands."""
        # at its own size the real frame shows better where they are; where the names have
        # changed only an imagined frame shows where they are now
        source = self.source if self.found is None else observation
        if source is self.first:
            return self._find_whole(names, observation, start_masks)
        frames, masks = observation.frames, start_masks.masks[:, :, 0]
        if self.found is not None:
            return self._found_in(source, names, frames, masks)
        return self._found_in(source, names, frames, masks, self._find_whole(names, observation))

    def _find_whole(
        self,
        names: tuple[str, ...],
        observation: Observation,
        start_masks: ObjectMasks | None = None,
    ) -> FoundObjects:
        """Return named objects in the episode's first real frame, in which they count as whole."""
        if names not in self._whole:
            height, width = observation.frames.shape[1:3]
            frames = self.first.frames
            if frames.shape[1:3] != (height, width):
                frames = resize_frames(frames, width, height)
            if start_masks is None:
                start_masks = self.segmenter.segment(frames[:, None], names)
            found = self._found_in(self.first, names, frames, start_masks.masks[:, :, 0])
            self._whole[names] = replace(found, is_whole=True)
        found = self._whole[names]
        assert self.model is not None
        is_same = found.tracked.is_fitted == self.model.is_fitted
        return found if is_same else found.simulated_by(self.model)

    def _found_in(
        self,
        source: Observation,
        names: tuple[str, ...],
        frames: ByteArray,
        masks: BoolArray,
        whole: FoundObjects | None = None,
    ) -> FoundObjects:
        """Return the objects of masks in the frames of an observation, at the model's size.

        Args:
            source: the observation at the recorded size.
            names: names of the O objects.
            frames: (V, H, W, 3) uint8 RGB.
            masks: (V, O, H, W) masks of the objects.
            whole: the objects when nothing hid them; None = nothing hides them now.
        """
        assert self.model is not None
        sharp = self._sharp(source, names, masks)
        motion = Motion.of(self.robot, source.cameras, source.positions[None])
        poses = motion.camera_poses[:, 0]
        given = names, sharp, source.cameras, list(poses)
        if whole is None:
            return FoundObjects.at(names, frames, masks, poses, self.model.find(*given))
        kept: tuple[KeptPose | None, ...] = ()
        held: tuple[bool, ...] = ()
        if self.sights is not None and self.sights.names == names:
            kept, held = self.sights.kept(motion.tools[:, 0]), self.sights.held
        tracked, same, hidden = self.model.find_again(whole.tracked, *given, kept, held)
        found = FoundObjects.at(names, frames, masks, poses, tracked).shown_as(whole, hidden)
        return replace(found, is_whole=bool(same.all()))
