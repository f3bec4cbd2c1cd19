"""Data-parallel training: one process, or as many as the launcher started."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
import os

from accelerate import PartialState
from accelerate.utils import reduce
import torch
from torch import Tensor

from mtv_world_ros.core.errors import TrainingError

#: timeout of processes that wait for the main one, which alone reads, encodes and scores; NCCL's
#: default of 10 minutes would end the training
_PATIENCE = timedelta(days=1)
#: numbers that are summed over the processes in one call
_BUCKET = 2**24


@contextmanager
def memory_errors_named(device: torch.device) -> Iterator[None]:
    """Turn an out-of-memory error into one that says what to set.

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
    """This process's share of the work, and sums over all processes.

    Started with `torchrun` or `accelerate launch` there are several, on one machine or many;
    otherwise there is one. Each holds the whole model and trains a share of every step's clips.

    Args:
        device: `cpu`, or `cuda` for a device a process.
    """

    def __init__(self, device: str) -> None:
        chosen = torch.device(device)
        # accelerate would change the number of threads
        os.environ.setdefault('OMP_NUM_THREADS', str(torch.get_num_threads()))
        self._state = PartialState(cpu=chosen.type == 'cpu', timeout=_PATIENCE)
        self.number: int = self._state.process_index
        self.count: int = self._state.num_processes
        # several processes have a device each; accelerate knows which
        self.device = chosen if self.count == 1 else torch.device(self._state.device or chosen)

    @property
    def is_main(self) -> bool:
        """True for the main process, the only one that writes files."""
        return self.number == 0

    def share(self, count: int) -> range:
        """Return this process's part of `count` clips; parts have nearly equal sizes."""
        return range(count * self.number // self.count, count * (self.number + 1) // self.count)

    def summed(self, tensor: Tensor) -> Tensor:
        """Return the sum of a tensor over the processes.

        Raises:
            TrainingError: another process is gone.
        """
        if self.count == 1:
            return tensor
        try:
            return reduce(tensor, 'sum')  # type: ignore[return-value]
        except RuntimeError as error:
            raise TrainingError(
                f'process {self.number} of {self.count} lost another one: {error}; look for its '
                'own message, then run the same command again: it goes on from the last state'
            ) from error

    def any(self, flag: bool) -> bool:
        """Return True if a flag is set in any process; all processes have to call this.

        Raises:
            TrainingError: another process is gone.
        """
        if self.count == 1:
            return flag
        return self.summed(torch.tensor([float(flag)], device=self.device)).item() > 0

    def sum_into(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors, all of one number format, by their sums over the processes."""
        if self.count == 1:
            return
        for bucket in _buckets(tensors):
            flat = self.summed(torch.cat([tensor.flatten() for tensor in bucket]))
            parts = flat.split([tensor.numel() for tensor in bucket])
            for tensor, part in zip(bucket, parts, strict=True):
                tensor.copy_(part.view_as(tensor))

    @contextmanager
    def main_first(self) -> Iterator[None]:
        """Run the block in the main process first; the others then use its results."""
        with self._state.main_process_first():
            yield


def _buckets(tensors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    bucket: list[Tensor] = []
    size = 0
    for tensor in tensors:
        if bucket and size + tensor.numel() > _BUCKET:
            yield bucket
            bucket, size = [], 0
        bucket.append(tensor)
        size += tensor.numel()
    if bucket:
        yield bucket
