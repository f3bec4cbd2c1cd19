"""Batches of training steps through torch's DataLoader, prepared ahead, from any step on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
import signal
import threading
from typing import Any, Generic, TypeVar

import cv2
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from mtv_world_ros.core.errors import MtvWorldError, TrainingError

Sample = TypeVar('Sample')
Batch = TypeVar('Batch')
#: step of the training, and number of a clip within the step
Key = tuple[int, int]
#: batches that each worker prepares ahead
_AHEAD = 2


class _Clips(Dataset[Any]):
    """Clips by step and number; an error of a user takes the place of a clip."""

    def __init__(self, make: Callable[[int, int], Any]) -> None:
        self._make = make

    def __getitem__(self, key: Key) -> tuple[int, Any]:
        try:
            return key[0], self._make(*key)
        except MtvWorldError as error:  # torch would put a traceback into its text
            return key[0], error


class _Steps(Sampler[list[Key]]):
    """Keys of the clips of each step, from a step on without end."""

    def __init__(self, first: int, numbers: Sequence[int]) -> None:
        self._first, self._numbers = first, numbers

    def __iter__(self) -> Iterator[list[Key]]:
        for step in count(self._first):
            yield [(step, number) for number in self._numbers]


class StepLoader(Generic[Sample, Batch]):
    """Loader of the batches of consecutive steps; a step gives the same batch wherever it begins.

    Args:
        make: maker of the clip of a step and a number, which depends on these alone.
        collate: maker of a step's batch from its step and its clips.
        numbers: numbers of the clips of a step that this process makes.
        workers: processes that prepare batches, forked from this one; 0 = a thread of this one.
        pin: put batches into pinned memory; needs a GPU, and `pin_memory` of the batch.
    """

    def __init__(
        self,
        make: Callable[[int, int], Sample],
        collate: Callable[[int, list[Sample]], Batch],
        *,
        numbers: Sequence[int],
        workers: int = 0,
        pin: bool = False,
    ) -> None:
        self._clips, self._collate, self._numbers = _Clips(make), collate, numbers
        self._workers, self._pin = workers, pin
        self._thread = None if workers else ThreadPoolExecutor(max_workers=1)
        self._batches: Iterator[Any] | None = None
        self._ahead: Future[Any] | None = None
        self._next = 0

    def batch(self, step: int) -> Batch:
        """Return the batch of a step, and prepare those that follow.

        Raises:
            TrainingError: a process that prepares clips was killed.
            MtvWorldError: a clip cannot be made.
        """
        if self._batches is None or step != self._next:
            self._begin(step)
        self._next = step + 1
        try:
            found = self._take()
        except RuntimeError as error:
            if 'DataLoader worker' not in str(error):
                raise
            raise TrainingError(
                f'a process that prepares clips was killed at step {step}, perhaps for memory '
                '(see dmesg); the last saved state is whole: run the same command again, with '
                'fewer --data-workers if there is too little memory'
            ) from error
        if isinstance(found, MtvWorldError):
            raise found
        return found

    def close(self) -> None:
        """Stop preparing."""
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)
        self._batches = self._ahead = None  # torch ends the workers of an iterator that is gone

    def _begin(self, step: int) -> None:
        if self._ahead is not None:
            self._ahead.exception()  # the thread is done with the steps before
        self._batches = self._ahead = None
        loader = DataLoader(
            self._clips,
            batch_sampler=_Steps(step, self._numbers),
            collate_fn=self._collated,
            num_workers=self._workers,
            prefetch_factor=_AHEAD if self._workers else None,
            pin_memory=self._pin,
            multiprocessing_context='fork' if self._workers else None,  # shares what is loaded
            worker_init_fn=_start_worker,
        )
        before = signal.getsignal(signal.SIGCHLD)
        self._batches = iter(loader)
        if self._workers and threading.current_thread() is threading.main_thread():
            # torch's handler raises in the middle of anything; `batch` says it, too
            signal.signal(signal.SIGCHLD, before)

    def _take(self) -> Any:
        batches = self._batches
        assert batches is not None
        if self._thread is None:
            return next(batches)
        found = next(batches) if self._ahead is None else self._ahead.result()
        self._ahead = self._thread.submit(next, batches)
        return found

    def _collated(self, samples: list[tuple[int, Any]]) -> Any:
        errors = [sample for _, sample in samples if isinstance(sample, MtvWorldError)]
        return errors[0] if errors else self._collate(samples[0][0], [s for _, s in samples])


def _start_worker(_: int) -> None:
    """Prepare a forked worker: the signals and threads of its parent are not its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops the workers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    cv2.setNumThreads(0)  # 1 would wait for threads that the fork left behind
    torch.set_num_threads(1)
