"""Memory and arithmetic of a training step, and its time at a machine's peak."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
import time
from typing import Any

import torch
from torch import nn, Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode, sdpa_backward_flop_count, sdpa_flop_count

from mtv_world_ros.control.control import InputLayout, VIDEO_ONLY
from mtv_world_ros.model.parts import build_autoencoder
from mtv_world_ros.model.transformer.block import NUM_TEXT_TOKENS
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.training.adapter import add_adapter
from mtv_world_ros.training.training_config import TrainingConfig

#: bytes of a float32 number: trained weights, their averages, gradients, Adam's two moments
_FLOAT = 4
#: CLIP tokens of an image
_IMAGE_TOKENS = 257
#: indices a frame that a control is counted with; byte-pair encoding leaves fewer
_TOKENS_A_FRAME = 14
_GIB = 2**30
#: rows and columns of the matrices that are multiplied
_SIZE = {'cpu': 1024, 'cuda': 8192}
#: products between two synchronisations, so that waiting for a GPU hardly counts
_TOGETHER = {'cpu': 1, 'cuda': 10}
_REPEATS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class StepCost:
    """Cost of a training step of the transformer, without the encoding of the videos.

    Attributes:
        parameters: number of weights in the transformer.
        trainable: number of weights that are trained.
        forward_flop: floating-point operations of a forward pass of one batch.
        step_flop: floating-point operations of a forward and a backward pass.
        weight_bytes: weights in the number format of the passes, and trained weights in float32.
        training_bytes: averaged weights, gradients and Adam's moments of the trained weights.
        activation_bytes: activations that the forward pass keeps for the backward pass.
    """

    parameters: int
    trainable: int
    forward_flop: int
    step_flop: int
    weight_bytes: int
    training_bytes: int
    activation_bytes: int

    @property
    def memory_bytes(self) -> int:
        """Memory of all parts together [bytes]."""
        return self.weight_bytes + self.training_bytes + self.activation_bytes

    def lines(self) -> list[str]:
        """Return the table as lines."""
        share = 100 * self.trainable / self.parameters
        return [
            f'parameters          {self.parameters / 1e6:12.2f} M',
            f'trainable           {self.trainable / 1e6:12.2f} M ({share:.1f} %)',
            f'forward             {self.forward_flop / 1e12:12.4f} TFLOP',
            f'forward + backward  {self.step_flop / 1e12:12.4f} TFLOP',
            f'memory              {self.memory_bytes / _GIB:12.3f} GiB, of it',
            f'  weights           {self.weight_bytes / _GIB:12.3f} GiB',
            f'  gradients, Adam, averaged weights {self.training_bytes / _GIB:.3f} GiB',
            f'  activations       {self.activation_bytes / _GIB:12.3f} GiB',
        ]


def step_cost(
    config: TrainingConfig,
    layout: InputLayout = VIDEO_ONLY,
    *,
    dtype: torch.dtype,
    fake: bool = True,
) -> StepCost:
    """Count operations and bytes of a step on shapes only; `fake=False` computes it on a CPU."""
    # fake tensors have shapes and no numbers; said to be on the CPU, they take the attention that
    # keeps no attention matrix, as a GPU does (on `meta` they would take the one that does)
    with torch.device('meta' if fake else 'cpu'):
        transformer = MultiViewWanTransformer(
            **config.transformer, **layout.transformer_arguments()
        )
    if config.lora.rank:
        add_adapter(transformer, rank=config.lora.rank, alpha=config.lora.alpha)
    if config.optimizer.gradient_checkpointing:
        transformer.enable_gradient_checkpointing()
    with FakeTensorMode() if fake else nullcontext():
        fill(transformer, dtype)
        inputs = _inputs(config, layout, transformer, dtype)
        parameters = list(transformer.parameters())
        with FlopCounterMode(display=False, custom_mapping=attention_operations()) as counter:
            with _kept(parameters) as sizes:
                out = transformer(**inputs)
            forward = counter.get_total_flops()
            out.float().square().mean().backward()
    trained = sum(p.numel() for p in parameters if p.requires_grad)
    whole = sum(p.numel() for p in parameters)
    return StepCost(
        parameters=whole,
        trainable=trained,
        forward_flop=forward,
        step_flop=counter.get_total_flops(),
        weight_bytes=whole * dtype.itemsize + trained * _FLOAT,
        training_bytes=trained * (4 * _FLOAT + dtype.itemsize),
        activation_bytes=sum(sizes.values()),
    )


def attention_operations() -> dict[Any, Any]:
    """Return counters of the CPU's attention, which torch's own leaves out."""
    forward = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
    backward = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward
    return {
        forward: lambda q, k, v, *_, **__: sdpa_flop_count(q, k, v),
        backward: lambda grad, q, k, v, *_, **__: sdpa_backward_flop_count(grad, q, k, v),
    }


def fill(module: nn.Module, dtype: torch.dtype) -> None:
    """Replace `meta` weights by zeros in a number format, in place."""
    for part in module.modules():
        for name, parameter in list(part.named_parameters(recurse=False)):
            trained = parameter.requires_grad
            value = torch.zeros(parameter.shape, dtype=dtype)
            setattr(part, name, nn.Parameter(value, requires_grad=trained))
        for name, buffer in list(part.named_buffers(recurse=False)):
            setattr(part, name, torch.zeros(buffer.shape, dtype=dtype))


@contextmanager
def _kept(parameters: list[torch.nn.Parameter]) -> Iterator[dict[int, int]]:
    """Collect the bytes by storage that autograd keeps within the block, weights left out."""
    known = {_storage(p) for p in parameters}
    sizes: dict[int, int] = {}
    alive: list[Tensor] = []  # a freed storage's address would be used again

    def pack(tensor: Tensor) -> Tensor:
        if _storage(tensor) not in known:
            sizes[_storage(tensor)] = tensor.untyped_storage().nbytes()
            alive.append(tensor.detach())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        yield sizes


def _storage(tensor: Tensor) -> int:
    return tensor.untyped_storage()._cdata


def _inputs(
    config: TrainingConfig,
    layout: InputLayout,
    transformer: MultiViewWanTransformer,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    """Return the arguments of the transformer for one batch, all zero."""
    video, batch = config.video, config.optimizer.batch_size
    views, dim = len(video.views), transformer.config['latent_channels']
    frames, num_history, height, width = _latent_size(config)

    def zeros(*shape: int, kind: torch.dtype = dtype) -> Tensor:
        return torch.zeros(batch, *shape, dtype=kind)

    latents = zeros(views, dim, frames, height, width)
    image = zeros(views, dim, height, width)
    values = {
        'hidden_states': latents,
        'timestep': zeros(kind=torch.float32),
        'control': latents,
        'start': latents,
        'reference': image,
        'start_control': image,
    }
    if num_history:
        values['history'] = zeros(views, dim, num_history, height, width)
        values['history_timestep'] = values['timestep']
    if config.history.anchored:
        values['anchor'] = image
    if transformer.with_text:
        values['encoder_hidden_states'] = zeros(NUM_TEXT_TOKENS, config.transformer['text_dim'])
    if config.transformer.get('image_dim'):
        width = config.transformer['image_dim']
        values['encoder_hidden_states_image'] = zeros(views * _IMAGE_TOKENS, width)
    return values | _control_inputs(layout, video.num_frames, zeros)


def _control_inputs(
    layout: InputLayout, num_frames: int, zeros: Callable[..., Tensor]
) -> dict[str, Tensor]:
    values, context = {}, layout.context
    if layout.frame is not None:
        values['control_frame'] = zeros(1 + num_frames, layout.frame.vector_size)
    if context is not None and context.vector_size:
        values['control_context'] = zeros(1, context.vector_size)
    elif context is not None:
        values['control_context'] = zeros(_TOKENS_A_FRAME * num_frames, kind=torch.int64)
    return values


def _latent_size(config: TrainingConfig) -> tuple[int, int, int, int]:
    """Return F, latent frames of the history, h, w."""
    with torch.device('meta'):
        autoencoder = build_autoencoder(config.autoencoder)
    video = config.video
    block = getattr(autoencoder, 'block_size', 8)
    frames = autoencoder.num_latent_frames(video.num_frames)
    count = config.history.num_frames
    num_history = count and autoencoder.num_latent_frames(count - int(autoencoder.includes_start))
    return frames, num_history, video.height // block, video.width // block


def measured_peak(device: torch.device, dtype: torch.dtype) -> float:
    """Return the highest rate [operations/s] of several products of large matrices.

    On a CPU with torch's current number of threads; other running processes lower it.
    """
    size = _SIZE.get(device.type, _SIZE['cuda'])
    together = _TOGETHER.get(device.type, _TOGETHER['cuda'])
    left, right = (torch.randn(size, size, device=device, dtype=dtype) for _ in range(2))
    fastest = float('inf')
    for _ in range(_REPEATS):
        started = time.perf_counter()
        for _ in range(together):
            product = left @ right
        product[0, 0].item()  # waits for the device
        fastest = min(fastest, time.perf_counter() - started)
    return together * 2 * size**3 / fastest


def ideal_seconds(
    config: TrainingConfig, dtype: torch.dtype, flops: float, layout: InputLayout = VIDEO_ONLY
) -> float:
    """Return the time of a step whose forward and backward run at a peak of operations a second.

    The transformer's alone: encoding, and what gradient checkpointing computes again, is not the
    model's arithmetic.
    """
    optimizer = config.optimizer.replace(gradient_checkpointing=False)
    config = config.replace(optimizer=optimizer)
    return step_cost(config, layout, dtype=dtype).step_flop / flops
