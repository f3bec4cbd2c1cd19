"""The processes that share a transformer's sequence, as the one that predicts sees them."""

from __future__ import annotations

from dataclasses import asdict
import inspect
import json
import subprocess
import sys
from typing import Any

import torch
from torch import distributed, Tensor

from mtv_world_ros.errors import ConfigError, ModelError
from mtv_world_ros.model.serving.context_parallel import describe, join, open_store, send, split
from mtv_world_ros.model.serving.options import ServingOptions
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer


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
        'serving': asdict(serving),
        'port': port,
        'device': str(device),
        'dtype': str(transformer.dtype).removeprefix('torch.'),
        'config': dict(transformer.config),
        'num_threads': torch.get_num_threads(),
    }
    process.stdin.write(json.dumps(start) + '\n')
    process.stdin.flush()
    return process
