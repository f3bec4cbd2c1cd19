"""Compiled blocks and captured CUDA graphs: the same passes with less to launch."""

from __future__ import annotations

import inspect
import os
import shutil
from typing import Any

import torch
from torch import Tensor

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

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


def capture(transformer: MultiViewWanTransformer, device: torch.device) -> None:
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
