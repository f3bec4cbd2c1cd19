"""Latents of a training's clips, encoded once into a cache, and batches from it.

Shape letters: B batch, V views, C latent channels, F latent frames, h w latent size, N tokens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
import json
from pathlib import Path
import shutil
import time
from typing import Any

import numpy as np
from safetensors import safe_open, SafetensorError
from safetensors.torch import save
import torch
from torch import Tensor

from mtv_world_ros.core.bounded_input import parse_json, read_json, require_regular
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.errors import ConfigError, TrainingError
from mtv_world_ros.core.files import content_digest, write_whole
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.data.recordings import cut_clip
from mtv_world_ros.model.conditioning import Conditioning, ControlBatch, pad_rows, start_slot
from mtv_world_ros.training.base_checkpoint import Base
from mtv_world_ros.training.clips.batches import (
    attempted,
    BatchSource,
    ClipBatch,
    history_fields,
)
from mtv_world_ros.training.clips.clip_controls import ControlMaker, draw_past, history_before
from mtv_world_ros.training.clips.encoding import encode_batch, EncodedBatch, Encoders
from mtv_world_ros.training.clips.episode_index import digest_of, IndexedEpisode, robot_digest
from mtv_world_ros.training.clips.step_loader import StepLoader
from mtv_world_ros.training.distributed import Processes
from mtv_world_ros.training.objective import pixel_weights, pooled_weights
from mtv_world_ros.training.training_config import HistoryConfig, ObjectiveConfig, TrainingConfig

#: bytes of tensors that are gathered before they are written
SHARD_BYTES = 256 * 2**20
#: longest time in which tensors are gathered, which a killed process loses [s]
SHARD_S = 60.0
SETTINGS = 'settings.json'
_STEM = 'latents'
_LABELS = 'labels'


class LatentCache:
    """Tensors of clips in shards of safetensors, a folder for each combination of settings.

    A shard appears under its name only when it is whole, so that a run that was killed is resumed
    at its last shard. Several processes fill one cache, each with shards of its own names.

    Args:
        root: folder of caches of any settings.
        settings: settings that the tensors of all clips depend on, as plain values.
        number: number of this process, in the names of the shards that it writes.
        shard_bytes: size at which a shard is written.

    Attributes:
        folder: folder of these settings.
        notes: caches in `root` that are not used, and why.
    """

    def __init__(
        self,
        root: Path,
        settings: Mapping[str, Any],
        *,
        number: int = 0,
        shard_bytes: int = SHARD_BYTES,
    ) -> None:
        self.root, self.settings = root, json.loads(json.dumps(settings, default=list))
        self.folder = root / digest_of(self.settings)
        self.notes = [] if self.folder.is_dir() else _other_settings(root, self.settings)
        self._shard_bytes, self._number = shard_bytes, number
        self._written_s = time.monotonic()
        self._shards: dict[str, Any] = {}
        self._labels: dict[str, str] = {}
        self._waiting: dict[str, Tensor] = {}
        self._waiting_labels: dict[str, str] = {}
        self._opened: set[Path] = set()
        self.refresh()

    def refresh(self) -> None:
        """Open the shards that other processes have written."""
        for file in sorted(set(self.folder.glob(f'{_STEM}-*.safetensors')) - self._opened):
            self._open(file)

    def __contains__(self, key: str) -> bool:
        return key in self._shards

    def __len__(self) -> int:
        return len(self._shards)

    def read(self, key: str) -> dict[str, Tensor]:
        """Return the tensors of a clip by name.

        Raises:
            TrainingError: the latents are missing.
        """
        if key not in self._shards:
            raise TrainingError(f"latent cache '{self.folder}' has no clip {key}")
        shard = self._shards[key]
        names = shard.keys()
        mine = [name for name in names if name.startswith(f'{key}/')]
        return {name.partition('/')[2]: shard.get_tensor(name) for name in mine}

    def changed(self, labels: Mapping[str, str]) -> list[str]:
        """Return those of the labels (by key) whose clips are here with another content."""
        held = {label: key for key, label in self._labels.items()}
        return sorted(
            label for key, label in labels.items() if key not in self._shards and label in held
        )

    def add(self, key: str, label: str, tensors: Mapping[str, Tensor]) -> None:
        """Add the tensors of a clip; they are on disk once a shard is full, or after `flush`."""
        for name, tensor in tensors.items():
            self._waiting[f'{key}/{name}'] = tensor.detach().cpu().contiguous()
        self._waiting_labels[key] = label
        is_full = sum(t.nbytes for t in self._waiting.values()) >= self._shard_bytes
        if is_full or time.monotonic() - self._written_s > SHARD_S:
            self.flush()

    def flush(self) -> None:
        """Write the clips that wait.

        Raises:
            TrainingError: the disk is full, or the folder cannot be written.
        """
        self._written_s = time.monotonic()
        if not self._waiting:
            return
        data = save(self._waiting, {_LABELS: json.dumps(self._waiting_labels)})
        number, stem = len(self._opened), f'{_STEM}-{self._number:03d}'
        while (file := self.folder / f'{stem}-{number:05d}.safetensors').exists():
            number += 1
        try:
            text = json.dumps(self.settings, indent=2, sort_keys=True) + '\n'
            write_whole(self.folder / SETTINGS, text)
            write_whole(file, data)
        except OSError as error:
            raise TrainingError(
                f"latent cache '{self.folder}' cannot be written: {error.strerror or error}; the "
                f'shard takes {len(data) / 1e6:.1f} MB, the {len(self)} clips before it are kept. '
                'Free some space and run the same command again, or give --latent-cache another '
                'folder'
            ) from error
        self._waiting, self._waiting_labels = {}, {}
        self._open(file)

    def _open(self, file: Path) -> None:
        self._opened.add(file)
        try:
            require_regular(file)
            shard: Any = safe_open(file, framework='pt')
            labels = dict(
                parse_json((shard.metadata() or {})[_LABELS], 'what it says of its clips')
            )
        except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
            self.notes.append(
                f"'{file}' is damaged ({error}): its clips are encoded again; remove it"
            )
            return
        self._shards |= dict.fromkeys(labels, shard)
        self._labels |= labels


def _other_settings(root: Path, mine: Mapping[str, Any]) -> list[str]:
    """Return the settings in which the neighbouring caches differ."""
    notes = []
    for file in sorted(root.glob(f'*/{SETTINGS}')):
        try:
            theirs = dict(read_json(file))
        except (OSError, TypeError, ValueError):
            continue
        names = sorted(set(mine) | set(theirs))
        differing = [name for name in names if mine.get(name) != theirs.get(name)]
        changes = [f'{n} was {theirs.get(n)}, is {mine.get(n)}' for n in differing]
        notes.append(f"'{file.parent}' is not used: {'; '.join(changes)}")
    return notes


#: to be increased when the stored data or their computation change
_VERSION = 3
#: name of the tokens of a control, whose number differs between clips
CONTEXT = 'context'
#: kinds of pixels with extra weight, in the order of a cache's `shares`
WEIGHTS = ('change_weight', 'object_weight', 'moved_weight', 'attempt_weight')
_NO_WEIGHTS = ObjectiveConfig(change_weight=0.0, object_weight=0.0, moved_weight=0.0)
#: stale clips that a note names
_MOST_NAMED = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class CachedClip:
    """A clip that a cache holds or will hold.

    Attributes:
        episode: episode of the clip.
        start: recorded frame that it starts from.
        key: key in the cache.
    """

    episode: IndexedEpisode
    start: int
    key: str

    @property
    def label(self) -> str:
        """Its name, independent of its content."""
        return f'{self.episode.path.name} from frame {self.start}'


def settings_of(
    config: TrainingConfig, base: Path, controls: ControlMaker, dtype: torch.dtype
) -> dict[str, Any]:
    """Return everything that the latents of all clips depend on, as plain values.

    That is the preset, the encoders of the base checkpoint, the control, the robot's kinematics,
    the segmenter, and the number format of the encoders and of what is kept.
    """
    control = controls.control
    video = config.video.model_dump()
    names = ('views', 'fps', 'num_frames', 'width', 'height')
    settings = {
        'version': _VERSION,
        **{f'video.{name}': video[name] for name in names},
        'autoencoder': content_digest(base / 'autoencoder')[:16],
        'dtype': str(dtype),
        **{f'history.{k}': v for k, v in config.history.model_dump().items()},
        'video.control': video['control'],
        **control.cache_key(),
        'robot': robot_digest(controls.robot),
        'segmenter': controls.segmenter.name if control.uses_masks else None,
    }
    if (base / 'image_encoder').is_dir():
        settings['image_encoder'] = content_digest(base / 'image_encoder')[:16]
    return settings


def list_clips(episodes: Sequence[IndexedEpisode]) -> list[CachedClip]:
    """Return the clips of episodes, keyed by the content of their files."""
    clips = []
    for episode in episodes:
        content = episode.content_digest()
        if episode.described:
            content = digest_of(content, *episode.described)
        clips += [
            CachedClip(episode=episode, start=start, key=digest_of(content, start))
            for start in episode.starts
        ]
    return clips


def read_clip(
    clip: CachedClip, spec: WorldModelSpec, controls: ControlMaker, history: HistoryConfig
) -> ClipBatch:
    """Return a clip as it was recorded, as a batch of one.

    Its anchor and history are drawn once, by its start.
    """
    recording = clip.episode.recording()
    cut = cut_clip(recording, clip.start, spec)
    inputs, places = controls.make(cut, recording.names), attempted(cut, controls.robot)
    past = None
    if history.on:
        rng = np.random.default_rng((_VERSION, clip.start))
        before = history_before(recording, clip.start, spec, history, rng)
        past = draw_past(before, history, rng)
    return ClipBatch(
        frames=_alone(cut.frames),
        start_frame=_alone(cut.frames[:, 0]),
        inputs=ControlBatch.of([inputs]),
        object_ids=None if cut.object_ids is None else _alone(cut.object_ids),
        attempted=None if places is None else _alone(places),
        **history_fields([past]),  # type: ignore[arg-type]
    )


def _alone(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(array))[None]


def encode_missing_clips(
    cache: LatentCache,
    clips: Sequence[CachedClip],
    read: Callable[[CachedClip], ClipBatch],
    encoders: Encoders,
    device: torch.device,
    dtype: torch.dtype,
    *,
    shares: int = 1,
) -> Iterator[str]:
    """Encode the missing clips of a cache; yield after each how many are, and how fast.

    What was encoded is written, too, when an error or a signal ends it.

    Raises:
        TrainingError: the disk is full, or will be before all clips are there.
    """
    missing = [clip for clip in clips if clip.key not in cache]
    started = time.perf_counter()
    try:
        for number, clip in enumerate(missing, start=1):
            tensors = _encode(read(clip), encoders, device, dtype)
            size = sum(tensor.nbytes for tensor in tensors.values())
            if number == 1:
                _check_space(cache.root, size, len(missing) * shares)
            cache.add(clip.key, clip.label, tensors)
            seconds = time.perf_counter() - started
            rate = number / max(seconds, 1e-9)
            each = f'{size / 1e6:.2f} MB each'
            yield f'{number} encoded in {seconds:.1f} s ({rate:.2f} clips/s, {each})'
    finally:
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
    batch: ClipBatch, encoders: Encoders, device: torch.device, dtype: torch.dtype
) -> dict[str, Tensor]:
    """Return the tensors of one clip, without the batch axis."""
    encoded = encode_batch(encoders, batch, ObjectiveConfig(), device)
    cond = encoded.conditioning
    tensors = {'clean': encoded.clean, 'reference': cond.reference, 'image': cond.image}
    tensors |= {'anchor': cond.anchor, 'history': cond.history}
    tensors['control'] = cond.control if batch.inputs.video is not None else None
    held = {name: value[0].to(dtype) for name, value in tensors.items() if value is not None}
    tokens = {CONTEXT: cond.context, 'frame': cond.frame}
    held |= {name: value[0] for name, value in tokens.items() if value is not None}
    if cond.history_sigmas is not None:
        held['history_sigma'] = cond.history_sigmas[0].float()
    return held | {'shares': _shares(batch, encoded.clean.shape)[0]}


def _shares(batch: ClipBatch, shape: Sequence[int]) -> Tensor:
    """(B, 4, V, F, h, w) uint8 shares of each latent that a kind of weight counts."""
    parts = []
    for name in WEIGHTS:
        one = _NO_WEIGHTS.replace(**{name: 1.0})
        weights = pixel_weights(batch.frames, batch.object_ids, one, batch.attempted)
        parts.append(pooled_weights(weights, shape)[:, :, 0] - 1)
    return (torch.stack(parts, dim=1) * 255).round().to(torch.uint8)


def cached_batches(
    source: BatchSource,
    root: Path,
    config: TrainingConfig,
    base: Base | None,
    *,
    seed: int,
    dtype: torch.dtype,
    processes: Processes,
    workers: int = 0,
) -> CachedSource:
    """Encode missing clips, report their number, and return batches from the cache.

    Every process encodes its share; all have to call this. The source of the same clips, which
    encodes nothing, is closed.

    Raises:
        ConfigError: the preset disturbs pictures, or has no encoder worth a cache.
        TrainingError: the disk is full.
    """
    _check(config)
    assert base is not None
    source.close()
    controls, spec = source.controls, config.spec
    settings = settings_of(config, base.folder, controls, dtype)
    processes.check_same('settings of the latent cache', digest_of(settings))
    cache = LatentCache(root, settings, number=processes.number)
    clips = list_clips(source.episodes)
    if processes.is_main:
        for note in [*cache.notes, *_changed(cache, clips)]:
            Progress.write(f'latent cache: {note}')
    # another process may already have written some: all share out what the main one missed
    missing = processes.of_main([clip.key for clip in clips if clip.key not in cache])
    mine = set(missing[processes.number :: processes.count])
    steps = encode_missing_clips(
        cache,
        [clip for clip in clips if clip.key in mine],
        lambda clip: read_clip(clip, spec, controls, config.history),
        base.encoders,
        processes.device,
        dtype,
        shares=processes.count,
    )
    bar = Progress(
        steps,
        total=len(mine),
        desc='encoding clips',
        unit='clip',
        is_shown=processes.is_main,
    )
    done = [*bar]
    processes.any(False)  # all have written theirs
    cache.refresh()
    if processes.is_main:
        made = done[-1] if done else 'none to encode'
        if processes.count > 1 and missing:
            made = f'{len(missing)} encoded by {processes.count} processes, of these here {made}'
        held = len(clips) - len(missing)
        Progress.write(
            f"latent cache '{cache.folder}': {held} of {len(clips)} clips were there, {made}"
        )
    return CachedSource(
        cache,
        clips,
        objective=config.objective,
        text=base.encoders.text,
        batch_size=config.optimizer.batch_size,
        seed=seed,
        numbers=processes.share(config.optimizer.batch_size),
        device=processes.device,
        workers=workers,
    )


def _check(config: TrainingConfig) -> None:
    """Raise ConfigError if cached latents would differ from those of uncached training."""
    if config.autoencoder.get('_class_name', 'SpaceToDepthAutoencoder') != 'AutoencoderKLWan':
        raise ConfigError(
            "--latent-cache is for presets with Wan's autoencoder; this one's only rearranges "
            'pixels, which costs less than reading latents: leave --latent-cache out'
        )
    augment = config.augment
    disturbed = {
        'augment.start_noise': augment.start_noise,
        'augment.colour_permutation': augment.colour_permutation,
        'augment.failure_share': augment.failure_share,
        'self_rollout.share': config.self_rollout.share,
        '1 - rendering.foreseen_ratio': 1 - config.rendering.foreseen_ratio,
    }
    for name, value in disturbed.items():
        if value:
            raise ConfigError(
                f'{name} is {value}, but a latent cache holds every clip once, as it was '
                f'recorded: set {name} to 0, or leave --latent-cache out'
            )


def _changed(cache: LatentCache, clips: list[CachedClip]) -> list[str]:
    """Return a note on cached clips whose episodes have changed since."""
    stale = cache.changed({clip.key: clip.label for clip in clips})
    if not stale:
        return []
    named = ', '.join(stale[:_MOST_NAMED]) + (', ...' if len(stale) > _MOST_NAMED else '')
    return [f'{len(stale)} clips are not used, their episodes have changed: {named}']


class CachedSource:
    """Batches from a cache: every clip once an epoch, in an order of its own each epoch.

    Args:
        cache: cache that has all clips.
        clips: all clips of the training.
        objective: weights of pixels in the loss.
        text: (1, 512, text_dim) umT5 tokens of the prompt, in models with text.
        batch_size: number of clips of a step, over all processes.
        seed: seed of the order.
        numbers: positions of this process's clips in a step; None: all.
        device: device of the batches.
        workers: processes that read them; 0 = a thread of this one.
    """

    def __init__(
        self,
        cache: LatentCache,
        clips: Sequence[CachedClip],
        *,
        objective: ObjectiveConfig,
        text: Tensor | None,
        batch_size: int,
        seed: int,
        numbers: Sequence[int] | None = None,
        device: torch.device,
        workers: int = 0,
    ) -> None:
        self._cache, self._clips, self._objective = cache, clips, objective
        self._text, self._device = text, device
        self._batch_size, self._seed = batch_size, seed
        self._numbers = range(batch_size) if numbers is None else numbers
        self._order = lru_cache(2)(self._drawn_order)
        self._loader = StepLoader(
            self._read,
            self._collated,
            numbers=self._numbers,
            workers=workers,
            pin=device.type == 'cuda',
        )

    @property
    def num_clips(self) -> int:
        """Clips of an epoch."""
        return len(self._clips)

    def batch(self, step: int) -> EncodedBatch:
        """Return the batch of a step."""
        read = self._loader.batch(step)
        held = {name: tensor.to(self._device) for name, tensor in read.items()}
        clean, reference = held['clean'], held['reference']
        control = held.get('control', torch.zeros_like(clean))
        cond = Conditioning(
            control=control,
            start_control=control[:, :, :, 0],
            start=start_slot(reference, clean.shape[3], includes_start=True),
            reference=reference,
            text=self._repeated(self._text, len(clean)),
            image=held.get('image'),
            anchor=held.get('anchor'),
            history=held.get('history'),
            history_sigmas=held.get('history_sigma'),
            context=held.get(CONTEXT),
            frame=held.get('frame'),
        )
        return EncodedBatch(
            step=step,
            numbers=self._numbers,
            clean=clean.float(),
            conditioning=cond,
            weights=self._weights(held['shares'], clean.shape),
        )

    def close(self) -> None:
        """Stop reading."""
        self._loader.close()

    def _read(self, step: int, number: int) -> dict[str, Tensor]:
        return self._cache.read(self._clip(step, number).key)

    def _collated(self, _: int, rows: list[dict[str, Tensor]]) -> dict[str, Tensor]:
        return {
            name: (pad_rows if name == CONTEXT else torch.stack)([row[name] for row in rows])
            for name in rows[0]
        }

    def _clip(self, step: int, number: int) -> CachedClip:
        epoch, place = divmod(step * self._batch_size + number, len(self._clips))
        return self._clips[self._order(epoch)[place]]

    def _drawn_order(self, epoch: int) -> np.ndarray:
        return np.random.default_rng((self._seed, epoch)).permutation(len(self._clips))

    def _repeated(self, text: Tensor | None, count: int) -> Tensor | None:
        return None if text is None else text.to(self._device).expand(count, -1, -1)

    def _weights(self, shares: Tensor, shape: Sequence[int]) -> Tensor:
        weights = torch.ones_like(shares[:, 0], dtype=torch.float32)
        for index, name in enumerate(WEIGHTS):
            weights += getattr(self._objective, name) * shares[:, index].float() / 255
        return weights.unsqueeze(2).expand(*shape)
