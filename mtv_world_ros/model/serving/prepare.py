"""Prepares a loaded model for serving: 8-bit weights, compiled blocks, captured CUDA graphs.

8-bit weights have format e4m3 with a scale for each output row. Where the device multiplies it
(compute capability 8.9 and newer), inputs are converted too, with a scale for each token;
elsewhere weights are converted back for each product.
"""

from __future__ import annotations

import inspect
import os
from pathlib import Path
import shutil
from typing import Any

from diffusers.models.attention_dispatch import _AttentionBackendRegistry
import torch
from torch import nn, Tensor
import torch.nn.functional as F

from mtv_world_ros.errors import CheckpointError, ConfigError
from mtv_world_ros.model.autoencoders import TinyAutoencoder, WanAutoencoder
from mtv_world_ros.model.parts import Autoencoder
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.serving.serving_options import ServingOptions
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer


def prepare(
    transformer: MultiViewWanTransformer, serving: ServingOptions, device: torch.device
) -> None:
    """Changes the transformer in place, with its adapter in it, on every process alike.

    Raises:
        ConfigError: an option is not for this machine.
    """
    if serving.attention:
        _set_attention(transformer, serving.attention)
    if serving.weights == 'float8':
        to_float8(transformer)
    if serving.offload:
        # each block comes while the one before computes; a CPU has no streams for that
        transformer.enable_group_offload(
            onload_device=device,
            offload_device=torch.device('cpu'),
            offload_type='block_level',
            num_blocks_per_group=1,
            use_stream=device.type == 'cuda',
        )
    if serving.compile:
        compile_blocks(transformer, device)
    if serving.cuda_graphs:
        capture_graphs(transformer, device)


def _set_attention(transformer: MultiViewWanTransformer, name: str) -> None:
    before, _ = _AttentionBackendRegistry.get_active_backend()
    try:
        transformer.set_attention_backend(name)
    except (ValueError, RuntimeError, ImportError) as error:
        raise ConfigError(f"serving: attention '{name}' cannot be used: {error}") from error
    finally:
        # diffusers sets it for all other models of the process, too
        _AttentionBackendRegistry.set_active_backend(before)


def decoder_of(
    autoencoder: Autoencoder, serving: ServingOptions, dtype: torch.dtype
) -> Autoencoder:
    """Returns what decodes: the autoencoder, on its device, or the tiny one in its place.

    Raises:
        CheckpointError: the tiny one's weights cannot be read, or are for other latents.
    """
    if not serving.tiny_decoder:
        return autoencoder
    if not isinstance(autoencoder, WanAutoencoder):
        raise CheckpointError(
            "tiny_decoder decodes Wan's latents, this checkpoint has an autoencoder of its own; "
            "leave it out of 'serving'"
        )
    return place(TinyAutoencoder.load(Path(serving.tiny_decoder)), autoencoder.device, dtype)


#: passes before a capture: kernels are chosen and compiled in them
_WARM_UP = 3
#: shapes that may be compiled: numbers of seeds, of views; torch gives up after 8
_MOST_SHAPES = 64
_COMPILERS = {'cpu': ('CXX', ('g++', 'clang++')), 'cuda': ('CC', ('gcc', 'clang', 'cc'))}


def compile_blocks(transformer: MultiViewWanTransformer, device: torch.device) -> None:
    """Compiles the repeated block once for all; shapes are static, another one compiles again.

    Raises:
        ConfigError: there is no compiler to do it.
    """
    variable, names = _COMPILERS.get(device.type, _COMPILERS['cuda'])
    named = os.environ.get(variable)
    if not any(shutil.which(name) for name in ([named] if named else names)):
        raise ConfigError(
            f'serving: compile=true needs a compiler ({" or ".join(names)}) on the path or named '
            f'by {variable}; install one (apt install g++), or leave it out'
        )
    limits = torch._dynamo.config
    limits.recompile_limit = max(limits.recompile_limit, _MOST_SHAPES)
    transformer.compile_repeated_blocks(fullgraph=True, dynamic=False)


def capture_graphs(transformer: MultiViewWanTransformer, device: torch.device) -> None:
    """Lets passes replay a CUDA graph, captured at the first pass of each shape.

    Raises:
        ConfigError: the device has no such graphs.
    """
    if device.type != 'cuda':
        raise ConfigError(f'serving: cuda_graphs=true needs a CUDA device, device is {device}')
    transformer.forward = _Captured(transformer, device)


class _Graph:
    """A captured pass with the tensors that it reads and writes.

    Args:
        forward: what to capture.
        arguments: of the pass; shapes count.
        side: stream of the device, for the capture.
        pool: of memory that all graphs of a transformer share: they run one after the other, and
            nobody keeps what is in it.
    """

    def __init__(self, forward: Any, arguments: dict[str, Any], side: Any, pool: Any) -> None:
        self._inputs = {name: t.clone() for name, t in arguments.items()}
        self._graph = torch.cuda.CUDAGraph()
        # streams are those of the device that is current, which is the first one otherwise
        with torch.cuda.device(side.device):
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                for _ in range(_WARM_UP):
                    forward(**self._inputs)
            torch.cuda.current_stream().wait_stream(side)
            with torch.cuda.graph(self._graph, pool=pool, stream=side):
                self._out = forward(**self._inputs)

    def replay(self, arguments: dict[str, Any]) -> Tensor:
        for name, tensor in arguments.items():
            self._inputs[name].copy_(tensor)
        self._graph.replay()
        return self._out.clone()  # the next replay writes there again


class _Captured:
    def __init__(self, transformer: MultiViewWanTransformer, device: torch.device) -> None:
        self._forward: Any = transformer.forward
        self._side, self._pool = torch.cuda.Stream(device), torch.cuda.graph_pool_handle()
        self._names = list(inspect.signature(self._forward).parameters)
        self._graphs: dict[tuple[Any, ...], _Graph] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Tensor:
        given = {**dict(zip(self._names, args, strict=False)), **kwargs}
        arguments = {name: value for name, value in given.items() if value is not None}
        key = tuple((name, tuple(t.shape), t.dtype) for name, t in sorted(arguments.items()))
        if key not in self._graphs:
            self._graphs[key] = _Graph(self._forward, arguments, self._side, self._pool)
        return self._graphs[key].replay(arguments)


_FORMAT = torch.float8_e4m3fn
_LARGEST = torch.finfo(_FORMAT).max
#: what the device's product counts in
_ALIGNED = 16


class Float8Linear(nn.Module):
    """A linear layer whose weight is kept in 8 bits.

    Args:
        linear: with the weight to keep; its bias stays as it is.
    """

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        weight, scale = quantise(linear.weight.detach())
        self.register_buffer('weight', weight)
        self.register_buffer('scale', scale)
        self.bias = linear.bias

    def forward(self, x: Tensor) -> Tensor:
        """Returns (..., outputs) for (..., inputs), in the number format of the input."""
        weight, scale = self.get_buffer('weight'), self.get_buffer('scale')
        if not _multiplies(weight, x):
            return F.linear(x, (weight.float() * scale).to(x.dtype), self.bias)
        rows, row_scale = quantise(x.flatten(0, -2))
        out = torch._scaled_mm(
            rows,
            weight.t(),
            scale_a=row_scale,
            scale_b=scale.t(),
            bias=self.bias,
            out_dtype=x.dtype,
            use_fast_accum=True,
        )
        return out.unflatten(0, x.shape[:-1])


def quantise(values: Tensor) -> tuple[Tensor, Tensor]:
    """Returns (N, K) values in 8 bits and the (N, 1) float32 scale of each row."""
    scale = values.abs().amax(dim=1, keepdim=True).float().clamp(min=1e-12) / _LARGEST
    return (values.float() / scale).clamp(-_LARGEST, _LARGEST).to(_FORMAT), scale


def to_float8(transformer: MultiViewWanTransformer) -> None:
    """Puts the blocks' linear layers into 8 bits, in place; adapters are fused before."""
    for block in transformer.blocks:
        for name, module in list(block.named_modules()):
            if isinstance(module, nn.Linear):
                parent, _, own = name.rpartition('.')
                _replace(block.get_submodule(parent), own, Float8Linear(module))


def _replace(parent: Any, name: str, module: nn.Module) -> None:
    if name.isdigit():  # `to_out.0` and the like
        parent[int(name)] = module
    else:
        setattr(parent, name, module)


def _multiplies(weight: Tensor, x: Tensor) -> bool:
    fits = weight.shape[0] % _ALIGNED == 0 and weight.shape[1] % _ALIGNED == 0
    native = x.is_cuda and torch.cuda.get_device_capability(x.device) >= (8, 9)
    return fits and native and x.dtype == torch.bfloat16
