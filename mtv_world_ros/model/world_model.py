"""A trained checkpoint as a world model: frames in, frames out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from diffusers import FlowMatchEulerDiscreteScheduler
import numpy as np
import torch
from torch import Tensor

from mtv_world_ros.control.control import ControlInputs
from mtv_world_ros.control.registry import control_class
from mtv_world_ros.core.data_types import ByteArray, FloatArray, History
from mtv_world_ros.core.errors import CheckpointError, ModelMemoryError, RolloutPreempted
from mtv_world_ros.model.card import check_same_model
from mtv_world_ros.model.conditioning import (
    check_history,
    condition,
    Conditioning,
    ControlBatch,
    decode_frames,
    with_anchor,
    with_history,
    without_history,
)
from mtv_world_ros.model.lora import Adapter, Adapters
from mtv_world_ros.model.parts import check_video, Scheduler
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.serving import (
    check_memory,
    compile_norms,
    decoder_of,
    prepare,
    ServingOptions,
)
from mtv_world_ros.model.trained_model import TrainedModel
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer


def flow_of(transformer: MultiViewWanTransformer, out: Tensor, noisy: Tensor, sigma: Tensor):
    """Return the flow (noise - clean) whatever the transformer predicts.

    Args:
        transformer: transformer; its `config.prediction` says what `out` is.
        out: (B, V, C, F, h, w) output of the transformer.
        noisy: (B, V, C, F, h, w) input of the transformer.
        sigma: noise level of `noisy`, broadcastable to it, > 0.
    """
    if transformer.prediction == 'flow':
        return out
    return (noisy - out) / sigma


@torch.inference_mode()
def sample_latents(
    transformer: MultiViewWanTransformer,
    scheduler: Scheduler,
    conditioning: Conditioning,
    *,
    seed: int,
    num_inference_steps: int,
    should_stop: Callable[[], bool],
    guidance_scale: float = 1.0,
) -> Tensor:
    """Return (1, V, C, F, h, w) float32 denoised latents.

    The noise is drawn on the CPU, so a seed gives the same rollout on every device.

    Args:
        transformer: the model.
        scheduler: noise levels, shift and step rule.
        conditioning: conditioning of one chunk (batch 1).
        seed: seed of the noise.
        num_inference_steps: denoising steps a chunk.
        should_stop: asked between steps, and between the transformer's blocks.
        guidance_scale: factor of the difference between the predictions for the conditioning and
            for `conditioning.unguided`; 1 = no guidance, and half the work.

    Raises:
        RolloutPreempted: `should_stop` said so.
    """
    device = conditioning.control.device
    if transformer.start_image == 'either':
        conditioning = conditioning.with_one_start()
    generator = torch.Generator().manual_seed(seed)
    latents = torch.randn(conditioning.control.shape, generator=generator).to(device)
    if conditioning.history is not None:
        noise = torch.randn(conditioning.history.shape, generator=generator)
        conditioning = conditioning.with_noisy_history(noise.to(device))
    set_timesteps(scheduler, num_inference_steps, device)
    timesteps: Any = scheduler.timesteps  # the stubs are looser than the schedulers
    sigmas: Any = scheduler.sigmas
    for step, timestep in enumerate(timesteps):

        def check(step: int = step) -> None:
            if should_stop():
                raise RolloutPreempted(
                    f'given up after {step} of {num_inference_steps} denoising steps'
                )

        check()
        out = denoise(transformer, latents, timestep, conditioning, conditioning.text, check)
        if guidance_scale != 1.0 and (unguided := conditioning.unguided) is not None:
            away = denoise(transformer, latents, timestep, unguided, unguided.text, check)
            out = away + guidance_scale * (out - away)
        flow = flow_of(transformer, out, latents, sigmas[step].to(device))
        latents = scheduler.step(flow, timestep, latents, return_dict=False)[0]  # type: ignore[arg-type]
    return latents


def set_timesteps(scheduler: Scheduler, num_inference_steps: int, device: torch.device) -> None:
    """Spread the steps over the noise levels, from 1 down; the scheduler shifts them."""
    if isinstance(scheduler, FlowMatchEulerDiscreteScheduler):
        sigmas = torch.linspace(1.0, 1.0 / num_inference_steps, num_inference_steps).tolist()
        scheduler.set_timesteps(sigmas=sigmas, device=device)
    else:
        # Wan's and VideoX-Fun's: evenly from .999 to 0, the last one left out. diffusers by itself
        # ends a step of training higher, shifted by 3 at .060 in place of .058 for 50 steps.
        levels = np.linspace(0.999, 0.0, num_inference_steps + 1)[:-1]
        scheduler.set_timesteps(sigmas=levels, device=device)  # type: ignore[arg-type]


def denoise(
    transformer: MultiViewWanTransformer,
    latents: Tensor,
    timestep: Tensor,
    conditioning: Conditioning,
    text: Tensor | None,
    before_block: Callable[[], None] | None = None,
) -> Tensor:
    """Return the transformer's prediction for latents, in float32.

    Args:
        transformer: the model.
        latents: (B, V, C, F, h, w) noisy latents.
        timestep: timestep of all latents, in [0, 1000].
        conditioning: conditioning in the transformer's number format.
        text: text tokens that replace those of the conditioning; None = keep them.
        before_block: see the transformer's `forward`.
    """
    return transformer(
        latents.to(transformer.dtype),
        timestep.expand(len(latents)),
        control=conditioning.control,
        start=conditioning.start,
        reference=conditioning.reference,
        start_control=conditioning.start_control,
        encoder_hidden_states=text,
        encoder_hidden_states_image=conditioning.image,
        anchor=conditioning.anchor,
        history=conditioning.history,
        history_timestep=conditioning.history_timestep,
        control_context=conditioning.context,
        control_frame=conditioning.frame,
        control_kept=conditioning.control_kept,
        before_block=before_block,
    ).float()


_PLAIN = ServingOptions()
#: in errors that have no class of their own: of torch on a CPU, of CUDA, cuBLAS and cuDNN
_NO_MEMORY = ("can't allocate memory", 'out of memory', 'ALLOC_FAILED', 'ALLOCATION_FAILED')


class DiffusionWorldModel:
    """Pipeline that denoises one chunk of multi-view video under the inputs of a control.

    Args:
        checkpoint: the trained parts.
        device: PyTorch device, e.g. `cpu` or `cuda`.
        dtype: dtype of the transformer's computations.
        serving: options that make the model faster or smaller.

    Raises:
        CheckpointError: the checkpoint's parts do not belong together.
        ConfigError: the serving options are not for this machine.
        ModelMemoryError: the model does not fit the device.
    """

    def __init__(
        self,
        checkpoint: TrainedModel,
        *,
        device: str = 'cpu',
        dtype: torch.dtype = torch.float32,
        serving: ServingOptions = _PLAIN,
    ) -> None:
        self.device = torch.device(device)
        self.card = checkpoint.card
        check_memory(checkpoint, serving, self.device, dtype)
        home = torch.device('cpu') if serving.offload else self.device
        self.transformer = place(checkpoint.transformer, home, dtype).eval()
        self._adapters = Adapters(self.transformer)
        #: adapter of the checkpoint; None = no adapter
        self.own_adapter = checkpoint.adapter
        if checkpoint.adapter is not None:
            check_same_model(self.card, checkpoint.adapter)
        self._adapters.use(checkpoint.adapter)
        prepare(self.transformer, serving, self.device)
        self.autoencoder = place(checkpoint.autoencoder, self.device, dtype).eval()
        if serving.compile:
            compile_norms(self.autoencoder)
        self._decoder = decoder_of(self.autoencoder, serving, dtype)
        self.scheduler = checkpoint.scheduler
        self.spec = checkpoint.card.spec
        check_video(self.autoencoder, self.transformer.config, self.spec)
        if serving.tiny_encoder:
            self.autoencoder = self._decoder
        self.history = checkpoint.card.history
        check_history(self.history, self.autoencoder, self.transformer.config)
        self.text_encoder = checkpoint.text_encoder
        self.image_encoder = checkpoint.image_encoder
        if self.image_encoder is not None:
            self.image_encoder.to(self.device, dtype, stays=not serving.offload)
        if serving.compile:
            self._warm_up()

    def _warm_up(self) -> None:
        """Run one prediction and discard it, so that the first real one does not wait."""
        spec = self.spec
        shape = (len(spec.views), 1 + spec.num_frames, spec.height, spec.width, 3)
        config: Any = self.transformer.config
        context, frame = config['context_input'], config['frame_input']
        vectors = None
        if context is not None:
            size = context['vector_size']
            vectors = np.zeros((1, size), np.float32) if size else np.zeros(1, np.int64)
        self.predict(
            np.zeros((shape[0], *shape[2:]), np.uint8),
            ControlInputs(
                num_frames=spec.num_frames,
                video=np.zeros(shape, np.uint8),
                context=vectors,
                frame=frame and np.zeros((shape[1], frame['vector_size']), np.float32),
            ),
            seed=0,
            num_inference_steps=1,
            should_stop=lambda: False,
        )

    def read_adapter(self, path: Path | None) -> Adapter:
        """Read and check an adapter, for `use_adapter`; safe while a prediction runs.

        Args:
            path: see `Adapters.read`; None = none.

        Raises:
            CheckpointError: the adapter cannot be read or is for another model.
        """
        if path is not None:
            check_same_model(self.card, path)
        return self._adapters.read(path)

    def use_adapter(self, adapter: Adapter | Path | None) -> None:
        """Exchange the LoRA adapter; not to be called while a prediction runs. None = none.

        Raises:
            CheckpointError: it cannot be read or is for another model; the one before stays.
        """
        if not isinstance(adapter, Adapter):
            if adapter == self._adapters.current:
                return
            adapter = self.read_adapter(adapter)
        self._adapters.use(adapter)

    def predict(
        self,
        start_frame: ByteArray,
        control: ControlInputs,
        *,
        positions: FloatArray | None = None,
        seed: int,
        num_inference_steps: int,
        should_stop: Callable[[], bool],
        history: History | None = None,
    ) -> ByteArray:
        """Return (V, T, H, W, 3) uint8 RGB frames; see `pipeline.WorldModel.predict`."""
        del positions  # this model knows the plan by its control alone
        self._check_size(len(start_frame), control.num_frames)
        try:
            with torch.inference_mode():
                conditioning = self._condition(start_frame, control)
                conditioning = self._with_history(
                    conditioning, history or History.begin(start_frame)
                )
                latents = sample_latents(
                    self.transformer,
                    self.scheduler,
                    conditioning,
                    seed=seed,
                    num_inference_steps=num_inference_steps,
                    should_stop=should_stop,
                    guidance_scale=self.card.guidance_scale,
                )
                frames = decode_frames(self._decoder, latents.to(self._decoder.dtype))
                return frames[0].cpu().numpy()
        except (torch.OutOfMemoryError, MemoryError) as error:
            raise self._out_of_memory(start_frame, control.num_frames, error) from error
        except RuntimeError as error:
            if not any(text in str(error) for text in _NO_MEMORY):
                raise
            raise self._out_of_memory(start_frame, control.num_frames, error) from error

    def _check_size(self, views: int, count: int) -> None:
        spec = self.spec
        if views > len(spec.views) or count > spec.num_frames:
            raise CheckpointError(
                f'{views} views of {count} frames given, the model was trained on '
                f'{len(spec.views)} views of {spec.num_frames}; give no more, or train with '
                'video.views and video.num_frames set to what you need'
            )

    def _condition(self, start_frame: ByteArray, control: ControlInputs) -> Conditioning:
        start = self._tensor(start_frame)
        latents = condition(self.autoencoder, start, ControlBatch.of([control]).to(self.device))
        if self.card.guidance_scale != 1.0 and control_class(self.card.control).dropout:
            latents = replace(latents, guides_control=True)
        return self._with_context(latents, start)

    def _with_history(self, latents: Conditioning, history: History) -> Conditioning:
        """Add the history frames, in models that are conditioned on them."""
        count, level = self.history.num_frames, self.history.noise_level
        if self.history.anchored:
            latents = with_anchor(self.autoencoder, latents, self._tensor(history.anchor))
        if not count:
            return latents
        if not history.frames.shape[1]:
            return without_history(self.autoencoder, latents, count)
        frames = self._tensor(history.filled(count))
        sigmas = torch.full((1,), level, device=self.device)
        return with_history(self.autoencoder, latents, frames, sigmas)

    def _with_context(self, latents: Conditioning, start: torch.Tensor) -> Conditioning:
        """Add the prompt's and the start images' tokens, in models with text."""
        if self.text_encoder is None or self.image_encoder is None:
            return latents
        dtype = self.transformer.dtype
        negative = None
        if self.card.guidance_scale != 1.0:
            negative = self.text_encoder.encode(self.card.negative_prompt, self.device)
        return replace(
            latents,
            text=self.text_encoder.encode(self.card.prompt, self.device).to(dtype),
            negative_text=None if negative is None else negative.to(dtype),
            image=self.image_encoder.encode(start[0]).flatten(0, 1)[None].to(dtype),
        )

    def _tensor(self, frames: ByteArray) -> torch.Tensor:
        return torch.from_numpy(np.array(frames))[None].to(self.device)

    def _out_of_memory(
        self, start_frame: ByteArray, count: int, error: Exception
    ) -> ModelMemoryError:
        views, height, width, _ = start_frame.shape
        if self.device.type == 'cuda':
            torch.cuda.empty_cache()
        return ModelMemoryError(
            f'out of memory on {self.device} with {views} views of {1 + count} frames of '
            f"{width}x{height}; set offload=true in 'serving', use a smaller "
            'preset or another device, or free memory there '
            f'({str(error).splitlines()[0]})'
        )
