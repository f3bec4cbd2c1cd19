"""Latents of a training's clips, encoded once into a cache.

Shape letters: B batch, V views, C latent channels, F latent frames, h w latent size, N tokens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
import shutil
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mtv_world_ros.data.recording import cut_clip, Recording
from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.errors import TrainingError
from mtv_world_ros.files import content_digest
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.model.action_features import TRAJECTORY_VIDEO
from mtv_world_ros.model.actions import collate
from mtv_world_ros.training.clips.batches import Batch, pasts
from mtv_world_ros.training.clips.clip_controls import ControlMaker
from mtv_world_ros.training.clips.past import draw_past, history_before
from mtv_world_ros.training.config import HistoryConfig, ObjectiveConfig, TrainingConfig
from mtv_world_ros.training.encoding import encode_batch, Encoders
from mtv_world_ros.training.latent_cache.store import digest_of, LatentCache
from mtv_world_ros.training.objective import pixel_weights, pooled_weights
from mtv_world_ros.vision.describers.describer import objects_from_instruction

#: raised when what is stored, or how it is computed, changes
_VERSION = 1
#: what pixels weigh more for, in the order of a cache's `shares`
WEIGHTS = ('change_weight', 'object_weight', 'moved_weight')
_NO_WEIGHTS = ObjectiveConfig(change_weight=0.0, object_weight=0.0, moved_weight=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class CachedClip:
    """A clip that a cache holds or shall hold.

    Attributes:
        recording: its episode.
        start: recorded frame that it starts from.
        key: in the cache.
    """

    recording: Recording
    start: int
    key: str

    @property
    def label(self) -> str:
        """What it is called, whatever its content."""
        return f'{self.recording.path.name} from frame {self.start}'


def settings_of(
    config: TrainingConfig, base: Path, robot: RobotModel, segmenter: str, dtype: torch.dtype
) -> dict[str, Any]:
    """Returns everything that the latents of all clips depend on, as plain values.

    Args:
        config: the preset.
        base: checkpoint whose encoders are used.
        robot: its kinematics place what trajectory videos show.
        segmenter: name of what finds the objects.
        dtype: of the encoders and of what is kept.
    """
    video = asdict(config.video)
    names = ('views', 'fps', 'num_frames', 'width', 'height')
    settings = {
        'version': _VERSION,
        **{f'video.{name}': video[name] for name in names},
        'autoencoder': content_digest(base / 'autoencoder')[:16],
        'dtype': str(dtype),
        **{f'history.{k}': v for k, v in asdict(config.history).items()},
        'trajectory_video': config.video.control == TRAJECTORY_VIDEO,
    }
    if (base / 'image_encoder').is_dir():
        settings['image_encoder'] = content_digest(base / 'image_encoder')[:16]
    if settings['trajectory_video']:
        settings |= {f'rendering.{k}': v for k, v in asdict(config.rendering).items()}
        settings |= {'robot': _robot_digest(robot), 'video.object_mask': video['object_mask']}
        settings['segmenter'] = segmenter if video['object_mask'] else None
    return settings


def _robot_digest(robot: RobotModel) -> str:
    """Changes with the robot's kinematics, tools and grippers."""
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    rows = np.random.default_rng(0).uniform(lower, upper, (8, len(lower)))
    poses, openings = robot.tool_poses(rows), robot.gripper_openings(rows)
    numbers = [np.round(part, 6).tolist() for part in (poses, openings)]
    return digest_of(robot.name, robot.joint_names, *numbers)[:16]


def list_clips(recordings: Sequence[tuple[Recording, np.ndarray]]) -> list[CachedClip]:
    """Returns the clips of recordings, keyed by the content of their episode's files.

    Args:
        recordings: each with the frames that its clips start from.
    """
    clips = []
    for recording, starts in recordings:
        content = content_digest(recording.path)
        clips += [
            CachedClip(recording=recording, start=int(s), key=digest_of(content, int(s)))
            for s in starts
        ]
    return clips


def read_clip(
    clip: CachedClip, spec: WorldModelSpec, controls: ControlMaker, history: HistoryConfig
) -> Batch:
    """Returns a clip as it was recorded, as a batch of one.

    What it is shown of what came before it is drawn once, by its start.
    """
    cut = cut_clip(clip.recording, clip.start, spec)
    names = cut.objects or objects_from_instruction(clip.recording.instruction)
    trajectory, actions = controls.make(cut, names, cut.frames[:, 0])
    parts = (cut.frames, cut.frames[:, 0], trajectory, cut.object_ids)
    frames, start, drawn, ids = (
        None if part is None else torch.from_numpy(np.array(part))[None] for part in parts
    )
    assert frames is not None and start is not None
    past = None
    if history.on:
        rng = np.random.default_rng((_VERSION, clip.start))
        before = history_before(clip.recording, clip.start, spec, history, rng)
        past = draw_past(before, history, rng)
    return Batch(
        frames=frames,
        start_frame=start,
        trajectory=drawn,
        object_ids=ids,
        actions=None if actions is None else torch.from_numpy(collate([actions])),
        **pasts([past]),  # type: ignore[arg-type]
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Build:
    """How far filling a cache has come: clips encoded, seconds since the first, bytes of one."""

    num_encoded: int
    seconds: float
    clip_bytes: int

    @property
    def clips_per_s(self) -> float:
        """Encoded clips a second."""
        return self.num_encoded / max(self.seconds, 1e-9)


def fill(
    cache: LatentCache,
    clips: Sequence[CachedClip],
    read: Callable[[CachedClip], Batch],
    encoders: Encoders,
    device: torch.device,
    dtype: torch.dtype,
) -> Iterator[Build]:
    """Encodes the clips that a cache lacks, and yields after each.

    Args:
        cache: of the settings that all of the other arguments follow from.
        clips: all that training takes.
        read: gives a clip, undisturbed, as a batch of one.
        encoders: on the device.
        device: where to encode.
        dtype: that latents are kept in.

    Raises:
        TrainingError: the disk is full, or will be before all clips are there.
    """
    missing = [clip for clip in clips if clip.key not in cache]
    started = time.perf_counter()
    for number, clip in enumerate(missing, start=1):
        tensors = _encode(read(clip), encoders, device, dtype)
        size = sum(tensor.nbytes for tensor in tensors.values())
        if number == 1:
            _check_space(cache.root, size, len(missing))
        cache.add(clip.key, clip.label, tensors)
        yield Build(num_encoded=number, seconds=time.perf_counter() - started, clip_bytes=size)
    cache.flush()


def _check_space(root: Path, clip_bytes: int, count: int) -> None:
    root.mkdir(parents=True, exist_ok=True)
    needed, free = clip_bytes * count, shutil.disk_usage(root).free
    if needed > free:
        raise TrainingError(
            f"latents of {count} clips take {needed / 1e9:.1f} GB in '{root}', {free / 1e9:.1f} "
            'GB are free there; give --latent-cache a folder on a larger disk, raise '
            'video.clip_stride_s, or leave --latent-cache out and encode in every step'
        )


@torch.no_grad()
def _encode(
    batch: Batch, encoders: Encoders, device: torch.device, dtype: torch.dtype
) -> dict[str, Tensor]:
    """The tensors of one clip, without the batch axis."""
    encoded = encode_batch(encoders, batch, ObjectiveConfig(), device)
    cond = encoded.conditioning
    tensors = {'clean': encoded.clean, 'reference': cond.reference, 'image': cond.image}
    tensors |= {'anchor': cond.anchor, 'history': cond.history}
    if batch.trajectory is not None:
        tensors['control'] = cond.control
    held = {name: value[0].to(dtype) for name, value in tensors.items() if value is not None}
    if cond.history_sigmas is not None:
        held['history_sigma'] = cond.history_sigmas[0].float()
    return held | {'shares': _shares(batch, encoded.clean.shape)[0]}


def _shares(batch: Batch, shape: Sequence[int]) -> Tensor:
    """(B, 3, V, F, h, w) uint8: how much of a latent changes, shows an object, or loses one."""
    parts = []
    for name in WEIGHTS:
        one = replace(_NO_WEIGHTS, **{name: 1.0})
        weights = pixel_weights(batch.frames, batch.object_ids, one)
        parts.append(pooled_weights(weights, shape)[:, :, 0] - 1)
    return (torch.stack(parts, dim=1) * 255).round().to(torch.uint8)
