"""Context parallelism: processes share a transformer's token sequence, each on its own device.

diffusers splits the sequence before the blocks and gathers it behind them; in self-attention each
process has all tokens of some of the heads (Ulysses).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import timedelta
import logging
from typing import Any

from diffusers import ContextParallelConfig, ParallelConfig
from diffusers.hooks import apply_context_parallel
from diffusers.models._modeling_parallel import ContextParallelInput, ContextParallelOutput
import torch
from torch import distributed, Tensor
from torch.distributed.device_mesh import init_device_mesh

from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.transformer.context import ContextAttnProcessor
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

#: how long a process that does not answer is waited for; the first pass may compile
_TIMEOUT = timedelta(minutes=5)
_HOST = '127.0.0.1'
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
    """Returns where the processes meet: made by the first one on a free port, then found."""
    return distributed.TCPStore(
        _HOST, port, is_master=port == 0, timeout=_TIMEOUT, wait_for_workers=False
    )


def join(store: distributed.TCPStore, rank: int, size: int, device: torch.device) -> None:
    """Waits until all processes are there; rank 0 is the one that predicts."""
    if device.type == 'cuda':
        torch.cuda.set_device(device)
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
