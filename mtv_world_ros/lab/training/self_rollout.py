"""Training from self-generated start frames, so that long rollouts stay stable.

A model that only ever sees recorded start frames meets its own errors first in a chain of chunks,
and they add up. Here some clips start from the end of the model's own rollout of the preceding
chunks, generated as in serving and without gradient, while the target stays the recording: it
learns to continue from its own pictures. So do Resampling Forcing (arXiv:2512.15702: self-made,
detached history, flow matching towards the recording) and BAgger (arXiv:2512.12080); Self Forcing
(arXiv:2506.08009) and PersistWorld (arXiv:2603.25685) roll out likewise and judge the result
otherwise, by a critic and by rewards.

Shape letters: B batch, V views, T frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from mtv_world_ros.data.recording import chunk_of
from mtv_world_ros.data_types import ByteArray, History
from mtv_world_ros.lab.training.clips.batches import Batch
from mtv_world_ros.lab.training.clips.clip_controls import ControlMaker
from mtv_world_ros.lab.training.clips.past import Lead
from mtv_world_ros.lab.training.encoding import condition_batch, Encoders
from mtv_world_ros.model.actions import collate
from mtv_world_ros.model.conditioning import decode_frames
from mtv_world_ros.model.parts import Scheduler
from mtv_world_ros.model.sampler import sample_latents
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer


class SelfRollout:
    """Replaces the start frames of a batch's clips that have a lead.

    Args:
        controls: makes trajectory videos or actions of what was imagined.
        encoders: on the device that trains.
        scheduler: noise levels and step rule of serving.
        num_inference_steps: denoising steps per chunk.
        seed: of the noise.
        device: where the model is.
    """

    def __init__(
        self,
        controls: ControlMaker,
        encoders: Encoders,
        scheduler: Scheduler,
        *,
        num_inference_steps: int,
        seed: int,
        device: torch.device,
    ) -> None:
        self._controls, self._encoders, self._scheduler = controls, encoders, scheduler
        self._steps, self._seed, self._device = num_inference_steps, seed, device

    def apply(self, batch: Batch, step: int, transformer: MultiViewWanTransformer) -> Batch:
        """Returns the batch with its leads imagined; the same step gives the same batch.

        Args:
            batch: clips.
            step: of the training; the noise depends on it.
            transformer: imagines; best with averaged weights, which are those that are served.
        """
        leads = {i: lead for i, lead in enumerate(batch.leads) if lead is not None}
        if not leads:
            return batch
        starts = {i: np.ascontiguousarray(lead.clip.frames[:, 0]) for i, lead in leads.items()}
        pasts = {i: History.begin(start) for i, start in starts.items()}
        for left in range(max(lead.num_chunks for lead in leads.values()), 0, -1):
            now = {i: lead for i, lead in leads.items() if lead.num_chunks >= left}
            chunks = [lead.num_chunks - left for lead in now.values()]
            chunk_batch = self._batch(
                list(now.values()), chunks, [starts[i] for i in now], [pasts[i] for i in now]
            )
            seeds = [_noise_seed(self._seed, step, batch.numbers[i], left) for i in now]
            imagined = self._imagine(chunk_batch, seeds, transformer)
            for i, frames in zip(now, imagined, strict=True):
                pasts[i] = pasts[i].after(starts[i], frames, self._encoders.history.num_frames)
                starts[i] = frames[:, -1]
        return self._replaced(batch, leads, starts, pasts)

    def _batch(
        self,
        leads: Sequence[Lead],
        chunks: Sequence[int],
        starts: Sequence[ByteArray],
        pasts: Sequence[History],
    ) -> Batch:
        """Chunk number `chunks[i]` of each lead, from a given start frame, as a batch."""
        clips = [
            chunk_of(lead.clip, chunk, lead.num_frames)
            for lead, chunk in zip(leads, chunks, strict=True)
        ]
        made = [
            self._controls.make(clip, lead.names, start)
            for clip, lead, start in zip(clips, leads, starts, strict=True)
        ]
        videos = [video for video, _ in made if video is not None]
        actions = [encoded for _, encoded in made if encoded is not None]
        return Batch(
            frames=torch.from_numpy(np.stack([clip.frames for clip in clips])),
            start_frame=torch.from_numpy(np.stack(starts)),
            trajectory=torch.from_numpy(np.stack(videos)) if videos else None,
            object_ids=None,
            actions=torch.from_numpy(collate(actions)) if actions else None,
            **self._shown(pasts),
        )

    def _shown(self, pasts: Sequence[History]) -> dict[str, Any]:
        """The fields of a batch that show the past, at serving's noise level."""
        settings = self._encoders.history
        if not settings.on:
            return {}
        known = [past.frames.shape[1] > 0 for past in pasts]
        return {
            'anchor': torch.from_numpy(np.stack([past.anchor for past in pasts])),
            'history': torch.from_numpy(
                np.stack([past.filled(settings.num_frames) for past in pasts])
            ),
            'history_sigmas': torch.tensor([settings.noise_level if k else 1.0 for k in known]),
        }

    def _imagine(
        self, batch: Batch, seeds: Sequence[int], transformer: MultiViewWanTransformer
    ) -> list[ByteArray]:
        """The (V, T, H, W, 3) frames of each chunk."""
        with torch.inference_mode():
            conditioning = condition_batch(self._encoders, batch, self._device)
            latents = sample_latents(
                transformer,
                self._scheduler,
                conditioning.in_dtype(transformer.dtype),
                seeds=seeds,
                num_inference_steps=self._steps,
                should_stop=lambda: False,
            )
            frames = decode_frames(self._encoders.autoencoder, latents)
        return list(frames.cpu().numpy())

    def _replaced(
        self,
        batch: Batch,
        leads: dict[int, Lead],
        starts: dict[int, ByteArray],
        pasts: dict[int, History],
    ) -> Batch:
        last = [lead.num_chunks for lead in leads.values()]
        made = self._batch(
            list(leads.values()), last, [starts[i] for i in leads], [pasts[i] for i in leads]
        )
        start_frame = batch.start_frame.clone()
        trajectory = None if batch.trajectory is None else batch.trajectory.clone()
        history = None if batch.history is None else batch.history.clone()
        for row, (index, lead) in enumerate(leads.items()):
            # the rollout was made in true colours, which segmenters expect
            start_frame[index] = made.start_frame[row][..., list(lead.colours)]
            if history is not None and made.history is not None:
                history[index] = made.history[row][..., list(lead.colours)]
            if trajectory is not None and made.trajectory is not None:
                trajectory[index] = made.trajectory[row]
        # encoded actions do not depend on pictures
        # nor do anchors on imagined ones: a rollout begins with a recorded frame
        return replace(batch, start_frame=start_frame, trajectory=trajectory, history=history)


def _noise_seed(seed: int, step: int, index: int, left: int) -> int:
    sequence = np.random.SeedSequence((seed, step, index, left))
    return int(sequence.generate_state(1, np.uint32)[0])
