"""Self-rollout: training clips that start from the model's own imagined frames.

A model that only ever sees recorded start frames meets its own errors first in a chain of chunks,
where they add up. Here some clips start from the end of the model's own rollout of the preceding
chunks, imagined as in serving and without gradient, while the target stays the recording: the
model learns to continue from its own pictures. Resampling Forcing (arXiv:2512.15702) and BAgger
(arXiv:2512.12080) do so, too.

Shape letters: B batch, V views, T frames, H W pixels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from mtv_world_ros.core.data_types import ByteArray, History
from mtv_world_ros.model.conditioning import ControlBatch, decode_frames
from mtv_world_ros.model.parts import Scheduler
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.model.world_model import sample_latents
from mtv_world_ros.training.clips.batches import ClipBatch
from mtv_world_ros.training.clips.clip_controls import ControlMaker, LeadIn
from mtv_world_ros.training.clips.encoding import condition_batch, Encoders


class SelfRollout:
    """Replacement of the start frames of clips that have a lead-in.

    Args:
        controls: maker of the control inputs of imagined frames.
        encoders: encoders on the device that trains.
        scheduler: noise levels and step rule of serving.
        num_inference_steps: denoising steps of a chunk.
        seed: seed of the noise.
        device: device of the model.
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

    def apply(self, batch: ClipBatch, transformer: MultiViewWanTransformer) -> ClipBatch:
        """Return the batch with the lead-ins imagined; the same step gives the same batch.

        Args:
            batch: clips of a step.
            transformer: imagines; best with averaged weights, which are those that will serve.
        """
        start_frame, made_inputs = batch.start_frame.clone(), batch.inputs
        history = None if batch.history is None else batch.history.clone()
        for index, lead_in in enumerate(batch.lead_ins):
            if lead_in is None:
                continue
            noise = (self._seed, batch.step, batch.numbers[index])
            made = self._last_chunk(lead_in, noise, transformer)
            # the rollout was made in true colours, which segmenters expect
            colours = list(lead_in.colours)
            start_frame[index] = made.start_frame[0][..., colours]
            made_inputs = made_inputs.with_chunk(index, made.inputs)
            if history is not None and made.history is not None:
                history[index] = made.history[0][..., colours]
        return replace(batch, start_frame=start_frame, inputs=made_inputs, history=history)

    def _last_chunk(
        self, lead_in: LeadIn, noise: tuple[int, int, int], transformer: MultiViewWanTransformer
    ) -> ClipBatch:
        """Return the chunk that is trained on, after the rollout of those before it (B = 1)."""
        start = np.ascontiguousarray(lead_in.clip.frames[:, 0])
        past = History.begin(start)
        for chunk in range(lead_in.num_chunks):
            frames = self._imagine(
                self._chunk(lead_in, chunk, start, past), noise_seed(*noise, chunk), transformer
            )
            past = past.after(start, frames, self._encoders.history.num_frames)
            start = frames[:, -1]
        return self._chunk(lead_in, lead_in.num_chunks, start, past)

    def _chunk(self, lead_in: LeadIn, index: int, start: ByteArray, past: History) -> ClipBatch:
        """Return one chunk from a given start frame, as a batch of one clip."""
        clip = lead_in.chunk(index)
        inputs = self._controls.make(clip, lead_in.names, start, foresees=lead_in.foresees)
        return ClipBatch(
            frames=torch.from_numpy(np.array(clip.frames))[None],
            start_frame=torch.from_numpy(np.array(start))[None],
            inputs=ControlBatch.of([inputs]),
            object_ids=None,
            **self._past(past),
        )

    def _past(self, past: History) -> dict[str, Any]:
        """Return the fields of a batch that show the past, at the noise level of serving."""
        settings = self._encoders.history
        if not settings.on:
            return {}
        sigma = settings.noise_level if past.frames.shape[1] else 1.0
        return {
            'anchor': torch.from_numpy(np.array(past.anchor))[None],
            'history': torch.from_numpy(past.filled(settings.num_frames))[None],
            'history_sigmas': torch.tensor([sigma]),
        }

    def _imagine(
        self, batch: ClipBatch, seed: int, transformer: MultiViewWanTransformer
    ) -> ByteArray:
        """Return (V, T, H, W, 3) frames of the chunk."""
        with torch.inference_mode():
            conditioning = condition_batch(self._encoders, batch, self._device)
            latents = sample_latents(
                transformer,
                self._scheduler,
                conditioning.in_dtype(transformer.dtype),
                seed=seed,
                num_inference_steps=self._steps,
                should_stop=lambda: False,
            )
            frames = decode_frames(self._encoders.autoencoder, latents)
        return frames[0].cpu().numpy()


def noise_seed(seed: int, step: int, number: int, chunk: int) -> int:
    """Return the seed of a chunk's noise: its own for each clip of each step."""
    sequence = np.random.SeedSequence((seed, step, number, chunk))
    return int(sequence.generate_state(1, np.uint32)[0])
