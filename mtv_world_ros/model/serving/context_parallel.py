"""Context parallelism: processes share a transformer's token sequence, each on its own device.

diffusers splits the sequence before the blocks and gathers it behind them; in self-attention each
process has all tokens of some of the heads (Ulysses). `Followers` are the other processes as the
one that predicts sees them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import timedelta
import inspect
import json
import logging
import os
import socket
import subprocess
import sys
from typing import Any

from diffusers import ContextParallelConfig, ParallelConfig
from diffusers.hooks import apply_context_parallel
from diffusers.models._modeling_parallel import ContextParallelInput, ContextParallelOutput
import torch
from torch import distributed, Tensor
from torch.distributed.device_mesh import init_device_mesh

from mtv_world_ros.errors import CheckpointError, ConfigError, ModelError
from mtv_world_ros.model.serving.serving_options import ServingOptions
from mtv_world_ros.model.transformer.cross_attention import ContextAttnProcessor
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

#: how long a process that does not answer is waited for; the first pass may compile
_TIMEOUT = timedelta(minutes=5)
_HOST = '127.0.0.1'
_LOOPBACK = 'lo'
#: where the sequence is split and gathered: by the names that the stock class has, too
_PLAN: Mapping[str, Any] = {
    'rope': {
        index: ContextParallelInput(split_dim=1, expected_dims=4, split_output=True)
        for index in (0, 1)
    },
    'blocks.0': {'hidden_states': ContextParallelInput(split_dim=1, expected_dims=3)},
    # four axes = a noise level for each token, three = one for all
    'blocks.*': {'temb': ContextParallelInput(split_dim=1, expected_dims=4)},
    # whole again before views, reference and video are told apart
    'norm_out': ContextParallelOutput(gather_dim=1, expected_dims=3),
}


def open_store(port: int = 0) -> distributed.TCPStore:
    """Returns where the processes meet: made by the first one on a free port, then found.

    It listens on the loopback alone: by itself it would listen on every interface.
    """
    if port:
        return distributed.TCPStore(_HOST, port, timeout=_TIMEOUT, wait_for_workers=False)
    listening = socket.create_server((_HOST, 0))
    port, descriptor = listening.getsockname()[1], listening.detach()
    return distributed.TCPStore(
        _HOST,
        port,
        is_master=True,
        timeout=_TIMEOUT,
        wait_for_workers=False,
        master_listen_fd=descriptor,
    )


def join(store: distributed.TCPStore, rank: int, size: int, device: torch.device) -> None:
    """Waits until all processes are there; rank 0 is the one that predicts."""
    if device.type == 'cuda':
        torch.cuda.set_device(device)
    for variable in ('GLOO_SOCKET_IFNAME', 'NCCL_SOCKET_IFNAME'):
        os.environ.setdefault(variable, _LOOPBACK)
    # diffusers exchanges sizes on the CPU where it can
    backend = 'gloo' if device.type == 'cpu' else f'cpu:gloo,{device.type}:nccl'
    distributed.init_process_group(
        backend, store=store, rank=rank, world_size=size, timeout=_TIMEOUT
    )


def split(transformer: MultiViewWanTransformer) -> None:
    """Splits the transformer's sequence over the processes that joined.

    Raises:
        CheckpointError: blocks look at the actions of their own time, which a part of the sequence
            does not show.
    """
    if any(
        isinstance(b.attn2.processor, ContextAttnProcessor) for b in _with_context(transformer)
    ):
        raise CheckpointError(
            f"control '{transformer.config['control']}' cannot be shared by several processes; "
            'set context_parallel=1'
        )
    size, rank = distributed.get_world_size(), distributed.get_rank()
    device = transformer.device
    # any number of tokens and heads: few of our sizes divide
    config = ContextParallelConfig(ulysses_degree=size, ulysses_anything=True)
    mesh = init_device_mesh(device.type, config.mesh_shape, mesh_dim_names=config.mesh_dim_names)
    parallel = ParallelConfig(context_parallel_config=config)
    # what `enable_parallelism` does, but for asking for an accelerator where there is none
    parallel.setup(rank, size, device, mesh=mesh)
    transformer._parallel_config = parallel
    for block in transformer.blocks:
        block.attn1.processor._parallel_config = parallel  # type: ignore[union-attr]
    # it says of every pass that there is one noise level for all tokens
    logging.getLogger('diffusers.hooks.context_parallel').setLevel(logging.ERROR)
    apply_context_parallel(transformer, config, dict(_PLAN))


def _with_context(transformer: MultiViewWanTransformer) -> list[Any]:
    return [b for b in transformer.blocks if hasattr(b.attn2, 'processor')]


Described = dict[str, tuple[Sequence[int], str]]


def describe(tensors: Mapping[str, Tensor]) -> Described:
    """Returns shapes and number formats, as JSON takes them."""
    return {n: (list(t.shape), str(t.dtype).removeprefix('torch.')) for n, t in tensors.items()}


def send(tensors: Mapping[str, Tensor]) -> None:
    """Sends tensors from the first process to the others, which `receive` them."""
    for tensor in tensors.values():
        # laid out anew: an expanded tensor of one number calls itself contiguous and is not
        plain = torch.empty(tensor.shape, dtype=tensor.dtype, device=tensor.device)
        distributed.broadcast(_bytes(plain.copy_(tensor)), src=0)


def receive(described: Described, device: torch.device) -> dict[str, Tensor]:
    """Returns what the first process sends."""
    tensors = {
        name: torch.empty(tuple(shape), dtype=getattr(torch, dtype), device=device)
        for name, (shape, dtype) in described.items()
    }
    for tensor in tensors.values():
        distributed.broadcast(_bytes(tensor), src=0)
    return tensors


def _bytes(tensor: Tensor) -> Tensor:
    """A view of it: not every number format can be sent everywhere."""
    return tensor.reshape(-1).view(torch.uint8)


class Followers:
    """Starts the other processes and lets them take part in every forward pass.

    They get the weights, and before each pass its arguments, so that sampling, seeds and adapters
    stay with the process that predicts.

    Args:
        transformer: on its device; the followers take the next ones.
        serving: how many processes, this one included, and what each of them makes of the weights.

    Raises:
        ConfigError: fewer devices than processes, or a group of processes is there already.
        CheckpointError: see `split`.
    """

    def __init__(self, transformer: MultiViewWanTransformer, serving: ServingOptions) -> None:
        size = serving.context_parallel
        devices = _devices(transformer.device, size)
        if distributed.is_initialized():
            raise ConfigError(
                'context_parallel starts its own processes and is 1 in a process that has a '
                'group already (torchrun)'
            )
        self._transformer = transformer
        store = open_store()
        self._processes = [
            _start(transformer, serving, devices[rank], rank, store.port)
            for rank in range(1, size)
        ]
        join(store, 0, size, devices[0])
        self.send_weights()
        split(transformer)
        self._names = list(inspect.signature(type(transformer).forward).parameters)[1:]
        self._hook = transformer.register_forward_pre_hook(self._before, with_kwargs=True)

    def send_weights(self) -> None:
        """Gives the followers the weights as they are now."""
        self._send('weights', dict(self._transformer.state_dict()))

    def close(self) -> None:
        """Ends the followers; the transformer is not to be used any more."""
        self._hook.remove()
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.close()
        for process in self._processes:
            process.wait()
        distributed.destroy_process_group()

    def _before(self, _: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        given = {**dict(zip(self._names, args, strict=False)), **kwargs}
        self._send('run', {name: value for name, value in given.items() if value is not None})

    def _send(self, command: str, tensors: dict[str, Tensor]) -> None:
        line = json.dumps({'command': command, 'tensors': describe(tensors)}) + '\n'
        for process in self._processes:
            if process.poll() is not None:
                raise ModelError(
                    f'a process of context_parallel ended with status {process.returncode}, see '
                    'what it printed; restart this program, with context_parallel=1 to do without'
                )
            assert process.stdin is not None
            process.stdin.write(line)
            process.stdin.flush()
        send(tensors)


def _devices(first: torch.device, size: int) -> list[torch.device]:
    if first.type == 'cpu':
        return [first] * size
    count = torch.accelerator.device_count()
    if size > count:
        raise ConfigError(f'context_parallel is {size}, this machine has {count} devices')
    return [torch.device(first.type, ((first.index or 0) + rank) % count) for rank in range(size)]


def _start(
    transformer: MultiViewWanTransformer,
    serving: ServingOptions,
    device: torch.device,
    rank: int,
    port: int,
) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, '-m', 'mtv_world_ros.model.serving.context_parallel_worker'],
        stdin=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    start = {
        'rank': rank,
        'size': serving.context_parallel,
        'serving': dict(serving),
        'port': port,
        'device': str(device),
        'dtype': str(transformer.dtype).removeprefix('torch.'),
        'config': dict(transformer.config),
        'num_threads': torch.get_num_threads(),
    }
    process.stdin.write(json.dumps(start) + '\n')
    process.stdin.flush()
    return process
