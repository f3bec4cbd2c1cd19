"""Control input of a clip: its trajectory video, and what came before it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from threading import Lock
from typing import NamedTuple

import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.control import Control, ControlInputs, ControlScene
from mtv_world_ros.core.data_types import BoolArray, ByteArray, History, WorldModelSpec
from mtv_world_ros.data.recording import frame_indices, Recording
from mtv_world_ros.data.recordings import Clip, cut_clip
from mtv_world_ros.physics.object_motion import cut_outs, moved_pictures, ObjectMotion
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.training.training_config import HistoryConfig, SelfRolloutConfig
from mtv_world_ros.vision.segmenters.segmenter import masks_from_ids, Segmenter


class Past(NamedTuple):
    """Anchor and history of a clip.

    Attributes:
        anchor: (V, H, W, 3) uint8 RGB first frame of the rollout.
        frames: (V, N, H, W, 3) uint8 RGB.
        sigma: noise level of the frames; 1 = there are none.
    """

    anchor: ByteArray
    frames: ByteArray
    sigma: float


def history_before(
    recording: Recording,
    start: int,
    spec: WorldModelSpec,
    config: HistoryConfig,
    rng: np.random.Generator,
) -> History:
    """Return the past of a rollout that began some frames before recorded frame `start`."""
    begins = rng.random() < config.first_share
    longest = int((recording.times[start] - recording.times[0]) * spec.fps + 1e-3)
    if begins or not longest:
        return History.begin(recording.frames[:, start])
    age = int(rng.integers(1, longest + 1))
    first = frame_before(recording, start, age / spec.fps)
    shown = None if first is None else frame_indices(recording, first, spec, age)
    if shown is None:  # a gap: no rollout can cross it
        return History.begin(recording.frames[:, start])
    kept = shown[max(age - config.num_frames, 0) : age]
    return History(anchor=recording.frames[:, shown[0]], frames=recording.frames[:, kept])


def draw_past(history: History, config: HistoryConfig, rng: np.random.Generator) -> Past:
    """Return the history of a clip, with a noise level drawn for it."""
    known = history.frames.shape[1] > 0 and rng.random() >= config.dropout
    sigma = float(rng.uniform(0.0, config.max_noise)) if known else 1.0
    return Past(history.anchor, history.filled(config.num_frames), sigma)


def frame_before(recording: Recording, start: int, seconds: float) -> int | None:
    """Return the recorded frame nearest to a time before another; None = before the first."""
    wanted = recording.times[start] - seconds
    if wanted < recording.times[0] - 1e-6:
        return None
    return int(np.argmin(np.abs(recording.times - wanted)))


@dataclass(frozen=True, slots=True, kw_only=True)
class LeadIn:
    """A clip of several chunks: the model imagines the first ones and is trained on the last.

    Attributes:
        clip: (num_chunks + 1) * T frames after its first one.
        num_chunks: chunks to imagine.
        names: names of the objects.
        colours: order of the colour channels of the clip that is trained on.
        foresees: whether the objects' motion counts as foreseen.
    """

    clip: Clip
    num_chunks: int
    names: tuple[str, ...] = ()
    colours: tuple[int, ...] = (0, 1, 2)
    foresees: bool = True

    @property
    def num_frames(self) -> int:
        """T, frames of a chunk."""
        return (len(self.clip.times) - 1) // (self.num_chunks + 1)

    def chunk(self, index: int) -> Clip:
        """Return one of the chunks with the frame before it.

        Its first position is the command of that frame, as in a rollout of chained chunks.
        """
        clip, first = self.clip, index * self.num_frames
        window = slice(first, first + self.num_frames + 1)
        ids, poses = clip.object_ids, clip.object_poses
        return replace(
            clip,
            times=clip.times[: self.num_frames + 1],
            frames=clip.frames[:, window],
            object_ids=None if ids is None else ids[:, window],
            positions=clip.positions[window],
            object_poses=None if poses is None else poses[window],
        )

    def history(self, num_frames: int) -> History:
        """Return the recorded frames before the chunk that is trained on."""
        shown = self.clip.frames[:, : self.num_chunks * self.num_frames]
        kept = max(shown.shape[1] - num_frames, 0)
        return History(anchor=shown[:, 0], frames=shown[:, kept:])


def draw_lead_in(
    recording: Recording,
    start: int,
    spec: WorldModelSpec,
    config: SelfRolloutConfig,
    step: int,
    rng: np.random.Generator,
) -> LeadIn | None:
    """Return the chunks to imagine before the clip at recorded frame `start`.

    A rollout is shorter where the episode is too short before the clip. The clip that is trained
    on then starts at the recorded frame next to `start` on the rollout's clock.

    Returns:
        None with the configured probability, before the configured step, or without any room.
    """
    # nothing is drawn while it is off: such runs keep their clips
    if step < config.start_step or config.share == 0 or rng.random() >= config.share:
        return None
    for num_chunks in range(int(rng.integers(config.max_chunks)) + 1, 0, -1):
        first = frame_before(recording, start, num_chunks * spec.chunk_seconds)
        num_frames = (num_chunks + 1) * spec.num_frames
        if first is None or frame_indices(recording, first, spec, num_frames) is None:
            continue
        return LeadIn(clip=cut_clip(recording, first, spec, num_frames), num_chunks=num_chunks)
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlMaker:
    """Maker of the control input of a clip, equal to that of serving.

    Attributes:
        robot: robot of the episodes.
        segmenter: finds the objects of the start frame.
        control: control of the model.
    """

    robot: RobotModel
    segmenter: Segmenter
    control: Control
    # batches are prepared in one thread while the model's rollouts are drawn in another
    _lock: Lock = field(default_factory=Lock)

    def make(
        self,
        clip: Clip,
        names: tuple[str, ...],
        start: ByteArray | None = None,
        *,
        foresees: bool = True,
    ) -> ControlInputs:
        """Return the control's inputs of a clip.

        Objects are searched in its first frame, unless this segmenter made the masks that are
        stored with the episode.

        Args:
            clip: the chunk.
            names: names of the objects.
            start: (V, H, W, 3) uint8 RGB imagined frame in place of the clip's first one.
            foresees: whether the objects' motion counts as foreseen in this clip.
        """
        control = self.control
        motion = Motion.of(self.robot, clip.cameras, clip.positions, control.links)
        shows_objects = foresees and control.shows_objects
        scene = ControlScene(
            motion=motion,
            times=clip.times,
            start_frames=clip.frames[:, 0] if start is None else start,
            masks=self._start_masks(clip, names, start) if control.uses_masks else None,
            objects=self._objects(clip, motion, names) if shows_objects else None,
        )
        inputs = control.make(scene)
        control.layout.check(inputs, type(control).__name__)
        return inputs

    def _start_masks(
        self, clip: Clip, names: tuple[str, ...], start: ByteArray | None
    ) -> BoolArray:
        """Return the masks (V, O, H, W) of a clip's start frame, recorded or imagined."""
        if start is not None:
            return self._masks(start, names)
        ids = clip.object_ids
        return self._stored(clip, names, clip.frames[:, 0], None if ids is None else ids[:, 0])

    def _stored(
        self, clip: Clip, names: tuple[str, ...], frames: ByteArray, ids: ByteArray | None
    ) -> BoolArray:
        """(V, O, H, W) of ids (V, H, W) that this segmenter made, or else of their frames."""
        by_other = clip.masks_by != self.segmenter.name
        if ids is None or by_other or not set(names) <= set(clip.objects):
            return self._masks(frames, names)
        return masks_from_ids(ids[:, None], clip.objects, names).masks[:, :, 0]

    def _masks(self, frames: ByteArray, names: tuple[str, ...]) -> BoolArray:
        """Return the masks (V, O, H, W) of frames (V, H, W, 3)."""
        with self._lock:
            return self.segmenter.segment(frames[:, None], names).masks[:, :, 0]

    def _objects(
        self, clip: Clip, clip_motion: Motion, names: tuple[str, ...]
    ) -> ByteArray | None:
        """Return (V, 1 + T, H, W, 4) objects that go where they went.

        None = they are held as masks.

        They are those of the episode's first frame, as in a rollout of chained chunks.
        """
        origin, poses = clip.origin, clip.object_poses
        if origin is None or poses is None:
            return None
        if any(name not in clip.objects for name in names):
            return None
        items = [clip.objects.index(name) for name in names]
        first, poses = origin.object_poses[items], poses[:, items]
        motion = ObjectMotion(
            reference=first[:, :3, 3],
            points=poses[..., :3, 3],
            rotations=poses[..., :3, :3] @ np.swapaxes(first[:, :3, :3], -1, -2),
        )
        at_first = Motion.of(self.robot, clip.cameras, origin.positions[None])
        return moved_pictures(
            cut_outs(origin.frames, self._stored(clip, names, origin.frames, origin.object_ids)),
            motion,
            clip.cameras,
            at_first.camera_poses,
            clip_motion.camera_poses,
        )
