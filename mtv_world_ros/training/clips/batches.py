"""Training batches by step and clip number, the same in any process.

Shape letters: B batch, V views, T frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.control import Control, ControlInputs
from mtv_world_ros.control.registry import create_control
from mtv_world_ros.core.data_types import BoolArray, ByteArray
from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.data.recording import Recording
from mtv_world_ros.data.recordings import Clip, cut_clip
from mtv_world_ros.model.conditioning import ControlBatch
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.training.clips.clip_controls import (
    ControlMaker,
    draw_lead_in,
    draw_past,
    history_before,
    LeadIn,
    Past,
)
from mtv_world_ros.training.clips.episode_index import IndexedEpisode
from mtv_world_ros.training.clips.step_loader import StepLoader
from mtv_world_ros.training.training_config import TrainingConfig
from mtv_world_ros.vision.held_objects import attempted_places, tools_in_views
from mtv_world_ros.vision.segmenters.segmenter import masks_from_ids, Segmenter

#: largest standard deviation of the noise of a disturbed start frame, as a share of full range
START_NOISE_STD = 0.04


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipBatch:
    """Clips with the inputs of their control.

    Attributes:
        frames: (B, V, 1 + T, H, W, 3) uint8 RGB.
        start_frame: (B, V, H, W, 3) uint8 RGB, frame 0 as the model sees it (maybe disturbed).
        inputs: inputs of the control.
        object_ids: (B, V, 1 + T, H, W) uint8, zero in clips without; None where no clip has them.
        attempted: (B, V, 1 + T, H, W) bool, likewise; see `attempted`.
        anchor: (B, V, H, W, 3) uint8 RGB, the first frame of the clip's rollout, in models with a
            history; see `draw_past`.
        history: (B, V, N, H, W, 3) uint8 RGB frames before the clip, in such models.
        history_sigmas: (B,) float32 noise levels of those, 1 = there are none.
        lead_ins: B entries: the chunks to imagine before a clip, None = the clip starts from its
            recorded frame; empty = all do.
        step: step of the training, from 0.
        numbers: numbers of its clips within the step's whole batch, which processes and
            accumulation split; each clip's noise depends on its own.
    """

    frames: Tensor
    start_frame: Tensor
    inputs: ControlBatch
    object_ids: Tensor | None
    attempted: Tensor | None = None
    anchor: Tensor | None = None
    history: Tensor | None = None
    history_sigmas: Tensor | None = None
    lead_ins: tuple[LeadIn | None, ...] = ()
    step: int = 0
    numbers: Sequence[int] = ()

    def pin_memory(self) -> ClipBatch:
        """Return a copy in pinned memory, from which a GPU copies faster."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        pinned = {n: v.pin_memory() for n, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **pinned)

    def parts(self, count: int) -> Iterator[ClipBatch]:
        """Yield its clips in `count` batches of nearly equal size."""
        size = len(self.numbers)
        for index in range(count):
            chosen = slice(size * index // count, size * (index + 1) // count)
            values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != 'step'}
            held = {name: v if v is None else v[chosen] for name, v in values.items()}
            yield replace(self, **held)


class _Sample(NamedTuple):
    """One clip of a batch."""

    frames: ByteArray
    start_frame: ByteArray
    inputs: ControlInputs
    object_ids: ByteArray | None
    attempted: BoolArray | None
    past: Past | None
    lead_in: LeadIn | None


class BatchSource:
    """Cuts, renders and disturbs clips; the next batches are prepared during a training step.

    Args:
        episodes: episodes that clips are cut from; recordings stay in memory.
        config: views and times of clips, how they are drawn and disturbed, clips per step.
        robot: kinematics of the recorded robot.
        segmenter: finds the objects of the first frames.
        control: fitted to the recordings; None = that of the configuration, which needs no fit.
        seed: seed of choice and disturbances.
        numbers: the clips of a step that this process makes; None: all.
        workers: processes that make them; 0 = a thread of this one.
        pin: put batches into pinned memory.
    """

    def __init__(
        self,
        episodes: Sequence[Recording | IndexedEpisode],
        config: TrainingConfig,
        *,
        robot: RobotModel,
        segmenter: Segmenter,
        control: Control | None = None,
        seed: int,
        numbers: Sequence[int] | None = None,
        workers: int = 0,
        pin: bool = False,
    ) -> None:
        self._numbers = range(config.optimizer.batch_size) if numbers is None else numbers
        spec, stride_s = config.spec, config.video.clip_stride_s
        indexed = [
            IndexedEpisode.of(one, spec, stride_s) if isinstance(one, Recording) else one
            for one in episodes
        ]
        self.episodes = [one for one in indexed if one.starts]
        if not self.episodes:
            raise TrainingError(
                f'none of {len(episodes)} episodes is long enough for a clip of '
                f'{spec.num_frames} frames at {spec.fps} Hz ({spec.chunk_seconds:.1f} s); '
                'record longer ones or lower video.num_frames'
            )
        self.controls = ControlMaker(
            robot=robot,
            segmenter=segmenter,
            control=control or create_control(config.video.control, config.control_options(robot)),
        )
        self._weighs_attempts = config.objective.attempt_weight > 0
        self._foreseen_ratio = config.rendering.foreseen_ratio
        self._spec, self._augment, self._seed = spec, config.augment, seed
        self._history, self._self_rollout = config.history, config.self_rollout
        self._failed = [one for one in self.episodes if one.outcome == 'failure']
        self._loader = StepLoader(
            self._clip, self._collated, numbers=self._numbers, workers=workers, pin=pin
        )

    @property
    def num_clips(self) -> int:
        """Clips that can be cut."""
        return sum(len(one.starts) for one in self.episodes)

    def batch(self, step: int) -> ClipBatch:
        """Return the batch of a step, and start preparing the next ones."""
        return self._loader.batch(step)

    def close(self) -> None:
        """Stop preparing."""
        self._loader.close()

    def _collated(self, step: int, samples: list[_Sample]) -> ClipBatch:
        return ClipBatch(
            step=step,
            numbers=self._numbers,
            frames=torch.from_numpy(np.stack([s.frames for s in samples])),
            start_frame=torch.from_numpy(np.stack([s.start_frame for s in samples])),
            inputs=ControlBatch.of([s.inputs for s in samples]),
            object_ids=_stacked([s.object_ids for s in samples]),
            attempted=_stacked([s.attempted for s in samples]),
            lead_ins=tuple(s.lead_in for s in samples),
            **history_fields([s.past for s in samples]),
        )

    def _clip(self, step: int, number: int) -> _Sample:
        rng = np.random.default_rng((self._seed, step, number))
        episode = self._choose(rng)
        start = episode.starts[rng.integers(len(episode.starts))]
        recording = episode.recording()
        lead_in = draw_lead_in(recording, start, self._spec, self._self_rollout, step, rng)
        if lead_in is None:
            clip = cut_clip(recording, start, self._spec)
        else:
            clip = lead_in.chunk(lead_in.num_chunks)
        past = self._past(recording, start, lead_in, rng)
        names = recording.names
        if rng.random() < self._augment.name_dropout:
            names = tuple(name for name in names if rng.random() < 0.5)
        foresees, ratio = True, self._foreseen_ratio
        if 0 < ratio < 1:  # nothing is drawn otherwise: such runs keep their clips
            foresees = bool(rng.random() < ratio)
        inputs = self.controls.make(clip, names, foresees=foresees)
        frames = clip.frames
        if rng.random() < self._augment.colour_permutation:
            colours = rng.permutation(3)
            frames = frames[..., colours]
            past = past and Past(past.anchor[..., colours], past.frames[..., colours], past.sigma)
            lead_in = lead_in and replace(lead_in, colours=tuple(colours.tolist()))
        start = frames[:, 0]
        if rng.random() < self._augment.start_noise:
            start = _disturb(start, rng)
        whole = np.ascontiguousarray(frames)
        lead_in = lead_in and replace(lead_in, names=names, foresees=foresees)
        places = attempted(clip, self.controls.robot) if self._weighs_attempts else None
        return _Sample(whole, start.copy(), inputs, clip.object_ids, places, past, lead_in)

    def _past(
        self, recording: Recording, start: int, lead_in: LeadIn | None, rng: np.random.Generator
    ) -> Past | None:
        """Return the anchor and history of the clip, in models that take them."""
        if not self._history.on:  # nothing is drawn: runs without history keep their clips
            return None
        if lead_in is None:
            history = history_before(recording, start, self._spec, self._history, rng)
        else:
            history = lead_in.history(self._history.num_frames)
        return draw_past(history, self._history, rng)

    def _choose(self, rng: np.random.Generator) -> IndexedEpisode:
        """Draw an episode; failed ones with the configured share."""
        share = self._augment.failure_share
        pool = self.episodes
        if share is not None and self._failed and rng.random() < share:
            pool = self._failed
        return pool[rng.integers(len(pool))]


def history_fields(given: Sequence[Past | None]) -> dict[str, Tensor]:
    """Return fields of a batch: anchors and histories of its clips."""
    known = [past for past in given if past is not None]
    if not known:
        return {}
    return {
        'anchor': torch.from_numpy(np.stack([past.anchor for past in known])),
        'history': torch.from_numpy(np.stack([past.frames for past in known])),
        'history_sigmas': torch.tensor([past.sigma for past in known]),
    }


def attempted(clip: Clip, robot: RobotModel) -> BoolArray | None:
    """Return (V, 1 + T, H, W) where objects are that grippers close at, or would be if they held.

    Whether they do hold does not change it. None where the objects of the clip are not known.
    """
    if clip.object_ids is None or not clip.objects:
        return None
    masks = masks_from_ids(clip.object_ids, clip.objects, clip.objects).masks
    motion = Motion.of(robot, clip.cameras, clip.positions)
    places = np.zeros(clip.object_ids.shape, np.bool_)
    for arm, openings in enumerate(motion.openings):
        places |= attempted_places(masks, openings, tools_in_views(motion, arm))
    return places


def _stacked(ids: Sequence[np.ndarray | None]) -> Tensor | None:
    """Return the arrays of a batch, zero in clips that have none; None if no clip has any."""
    known = next((part for part in ids if part is not None), None)
    if known is None:
        return None
    return torch.from_numpy(
        np.stack([np.zeros_like(known) if part is None else part for part in ids])
    )


def _disturb(frames: ByteArray, rng: np.random.Generator) -> ByteArray:
    """Blur and noise of random strength, like a frame the model predicted itself."""
    blurred = np.stack([cv2.blur(frame, (3, 3)) for frame in frames]).astype(np.float32)
    share = rng.random() * 0.7
    mixed = (1 - share) * frames + share * blurred
    mixed = mixed + rng.normal(0, 255 * START_NOISE_STD * rng.random(), mixed.shape)
    return mixed.round().clip(0, 255).astype(np.uint8)
