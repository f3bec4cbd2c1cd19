"""Data-parallel training: one process, or those that a launcher started, on torch's own engine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
import os
import time
from typing import TypeVar

import torch
from torch import Tensor
import torch.distributed as dist

from mtv_world_ros.core.errors import TrainingError

Value = TypeVar('Value')
#: timeout of processes that wait for those whose share of reading, encoding or scoring takes
#: longer; NCCL's default of 10 minutes would end the training
_PATIENCE = timedelta(days=1)
#: time in which the processes that are left tell each other so [s]
_ROLL_CALL_S = 3.0
#: words in errors of torch that another process has caused
_OF_OTHERS = ('gloo', 'nccl', 'peer', 'connection')


@contextmanager
def memory_errors_named(device: torch.device) -> Iterator[None]:
    """Turn an out-of-memory error into one that names the settings to change.

    Raises:
        TrainingError: in place of torch's error.
    """
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise TrainingError(
            f'out of memory on {device}: set optimizer.gradient_checkpointing to true, raise '
            'optimizer.accumulation or lower optimizer.batch_size, then run the same command '
            f'again: it goes on from the last state ({str(error).splitlines()[0]})'
        ) from error


class Processes:
    """Processes that train together, and this one's share of the work.

    Started with `torchrun` or `accelerate launch` there are several, on one machine or many;
    otherwise there is one. A process's device is that of its number on its machine.

    Args:
        device: `cpu`, or `cuda` for a device a process.

    Attributes:
        number: number of this process, from 0.
        count: number of processes.
        device: device of this process.
    """

    def __init__(self, device: str) -> None:
        self.device = torch.device(device)
        self.number, self.count = 0, int(os.environ.get('WORLD_SIZE', '1'))
        if self.count == 1:
            return
        self.number = int(os.environ['RANK'])
        backend = 'gloo'
        if self.device.type == 'cuda':
            backend = 'cpu:gloo,cuda:nccl'
            self.device = torch.device('cuda', int(os.environ.get('LOCAL_RANK', '0')))
            torch.cuda.set_device(self.device)
        if not dist.is_initialized():
            dist.init_process_group(backend, timeout=_PATIENCE)

    @property
    def is_main(self) -> bool:
        """True for the main process, which writes logs and results."""
        return self.number == 0

    def share(self, count: int) -> range:
        """Return this process's part of `count` clips; parts have nearly equal sizes."""
        return range(count * self.number // self.count, count * (self.number + 1) // self.count)

    @contextmanager
    def losses_named(self) -> Iterator[None]:
        """Turn an error that comes of the loss of another process into one that names it.

        Raises:
            TrainingError: in place of torch's error.
        """
        try:
            yield
        except RuntimeError as error:
            text = str(error)
            if self.count == 1 or not any(word in text.lower() for word in _OF_OTHERS):
                raise
            raise TrainingError(
                f'process {self.number} of {self.count} lost {self._lost()}: '
                f'{text.strip().splitlines()[0]}; look for its own message, then run the same '
                'command again: it goes on from the last state'
            ) from error

    def _lost(self) -> str:
        """Return the numbers of the processes that do not answer, in words."""
        others: list[int] = []
        with suppress(RuntimeError, AttributeError):  # the store ended with the process
            store = dist.distributed_c10d._get_default_store()  # pyright: ignore[reportPrivateUsage]
            store.set(f'mtv_world/left/{self.number}', '')
            time.sleep(_ROLL_CALL_S)
            others = [n for n in range(self.count) if not store.check([f'mtv_world/left/{n}'])]
        return f'process {", ".join(map(str, others))}' if others else 'another one'

    def summed(self, tensor: Tensor) -> Tensor:
        """Return the sum of a tensor over the processes.

        Raises:
            TrainingError: another process is gone.
        """
        if self.count == 1:
            return tensor
        total = tensor.clone()
        with self.losses_named():
            dist.all_reduce(total)
        return total

    def any(self, *flags: bool) -> list[bool]:
        """Return for each flag if it is set in any process; all processes have to call this.

        Raises:
            TrainingError: another process is gone.
        """
        if self.count == 1:
            return list(flags)
        found = self.summed(torch.tensor(flags, dtype=torch.float32, device=self.device))
        return [value > 0 for value in found.tolist()]

    def of_main(self, value: Value) -> Value:
        """Return the main process's value (pickled on its way); all processes have to call this.

        Raises:
            TrainingError: another process is gone.
        """
        if self.count == 1:
            return value
        held = [value]
        with self.losses_named():
            dist.broadcast_object_list(held, src=0)
        return held[0]

    def of_all(self, value: Value) -> list[Value]:
        """Return the values of all processes (pickled on their way), which have to call this.

        Raises:
            TrainingError: another process is gone.
        """
        found = [value] * self.count
        if self.count > 1:
            with self.losses_named():
                dist.all_gather_object(found, value)
        return found

    def check_same(self, what: str, value: str) -> None:
        """Check that a value is the same in all processes, which have to call this.

        Raises:
            TrainingError: values differ; names the first process with another one.
        """
        found = self.of_all(value)
        for number, theirs in enumerate(found):
            if theirs != found[0]:
                raise TrainingError(
                    f'{what} of process {number} differ from those of process 0; every machine '
                    'has to see the same files under the same paths'
                )

    @contextmanager
    def main_first(self) -> Iterator[None]:
        """Run the block in the main process first; the others then use its results.

        Raises:
            TrainingError: another process is gone.
        """
        if not self.is_main:
            self.any(False)
        yield
        if self.is_main:
            self.any(False)

    def close(self) -> None:
        """Leave the other processes."""
        if self.count > 1 and dist.is_initialized():
            dist.destroy_process_group()
