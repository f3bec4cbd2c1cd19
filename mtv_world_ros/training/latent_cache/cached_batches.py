"""Batches from a latent cache: every clip once an epoch.

Shape letters: B batch, V views, C latent channels, F latent frames, h w latent size.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from mtv_world_ros.data.recording import commanded
from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.model.actions import collate
from mtv_world_ros.model.conditioning import Conditioning, start_slot
from mtv_world_ros.training.clips.clip_controls import ControlMaker
from mtv_world_ros.training.config import ObjectiveConfig
from mtv_world_ros.training.encoding import EncodedBatch
from mtv_world_ros.training.latent_cache.clips import CachedClip, WEIGHTS
from mtv_world_ros.training.latent_cache.store import LatentCache


class CachedSource:
    """Batches from a cache: every clip once an epoch, in an order of its own each epoch.

    Args:
        cache: has all clips.
        clips: of the training.
        objective: how much pixels weigh.
        text: (1, 512, text_dim) umT5 tokens of the prompt, in models with text.
        batch_size: clips of a step, over all processes.
        seed: of the order.
        numbers: the clips of a step that this process takes; None: all.
        device: where batches go.
        controls: encodes actions that are not drawn.
        spec: what the model takes and gives.
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
        controls: ControlMaker,
        spec: WorldModelSpec,
    ) -> None:
        self.controls = controls
        self._cache, self._clips, self._objective = cache, clips, objective
        self._text, self._device, self._spec = text, device, spec
        self._batch_size, self._seed = batch_size, seed
        self._numbers = range(batch_size) if numbers is None else numbers

    @property
    def num_clips(self) -> int:
        """Clips of an epoch."""
        return len(self._clips)

    def batch(self, step: int) -> EncodedBatch:
        """Returns the batch of a step."""
        clips = [self._clip(step, number) for number in self._numbers]
        rows = [self._cache.read(clip.key) for clip in clips]
        held = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
        held = {name: tensor.to(self._device) for name, tensor in held.items()}
        clean, reference = held['clean'], held['reference']
        control = held.get('control', torch.zeros_like(clean))
        cond = Conditioning(
            control=control,
            start_control=control[:, :, :, 0],
            start=start_slot(reference, clean.shape[3], includes_start=True),
            reference=reference,
            actions=self._encoded(clips),
            text=self._repeated(self._text, len(rows)),
            image=held.get('image'),
            anchor=held.get('anchor'),
            history=held.get('history'),
            history_sigmas=held.get('history_sigma'),
        )
        return EncodedBatch(
            step=step,
            numbers=self._numbers,
            clean=clean.float(),
            conditioning=cond,
            weights=self._weights(held['shares'], clean.shape),
        )

    def close(self) -> None:
        """Nothing to end; sources have it."""

    def _clip(self, step: int, number: int) -> CachedClip:
        epoch, place = divmod(step * self._batch_size + number, len(self._clips))
        order = np.random.default_rng((self._seed, epoch)).permutation(len(self._clips))
        return self._clips[order[place]]

    def _encoded(self, clips: Sequence[CachedClip]) -> Tensor | None:
        encoding = self.controls.actions
        if encoding is None:
            return None
        times = np.arange(self._spec.num_frames + 1) / self._spec.fps
        chunks = [commanded(clip.recording, clip.start, times) for clip in clips]
        encoded = [encoding.encode(self.controls.robot, chunk) for chunk in chunks]
        return torch.from_numpy(collate(encoded)).to(self._device)

    def _repeated(self, text: Tensor | None, count: int) -> Tensor | None:
        return None if text is None else text.to(self._device).expand(count, -1, -1)

    def _weights(self, shares: Tensor, shape: Sequence[int]) -> Tensor:
        weights = torch.ones_like(shares[:, 0], dtype=torch.float32)
        for index, name in enumerate(WEIGHTS):
            weights += getattr(self._objective, name) * shares[:, index].float() / 255
        return weights.unsqueeze(2).expand(*shape)
