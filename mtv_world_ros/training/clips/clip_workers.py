"""Processes that prepare clips beside the training: forked, so that they share the recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import multiprocessing
import os
from threading import Thread
import time
from typing import Any

import cv2
import torch

from mtv_world_ros.errors import TrainingError

#: makes the clip of a step and a number
MakeClip = Callable[[int, int], Any]

_make_clip: MakeClip | None = None


class ClipWorkers:
    """Makes clips in processes of its own.

    Args:
        make_clip: its results are sent between processes; it must not use a GPU.
        count: processes.
    """

    def __init__(self, make_clip: MakeClip, count: int) -> None:
        self._pool = ProcessPoolExecutor(
            count,
            mp_context=multiprocessing.get_context('fork'),  # nothing is copied or pickled
            initializer=_begin,
            initargs=(make_clip, os.getpid()),
        )

    def clips(self, step: int, numbers: Sequence[int]) -> list[Any]:
        """Returns the clips of a step.

        Raises:
            TrainingError: a process was killed.
        """
        try:
            return list(self._pool.map(_run, [step] * len(numbers), numbers))
        except BrokenProcessPool as error:
            raise TrainingError(
                f'a process that prepares clips was killed at step {step}, perhaps for memory '
                '(see dmesg); the last saved state is whole: run the same command again, with '
                'fewer --data-workers if there is too little memory'
            ) from error

    def close(self) -> None:
        """Ends the processes."""
        self._pool.shutdown(cancel_futures=True)


def _begin(make_clip: MakeClip, parent: int) -> None:
    global _make_clip
    _make_clip = make_clip
    # thread pools do not survive a fork, and the processes are the parallelism
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """Ends this process when the training was killed, which cannot end it any more."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _run(step: int, number: int) -> Any:
    assert _make_clip is not None
    return _make_clip(step, number)
