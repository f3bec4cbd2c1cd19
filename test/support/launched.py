"""`torchrun ... train` as a user types it, on CPU processes of one thread."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import os
from pathlib import Path
import subprocess
import sys

#: environment of the processes: this package, one thread each, no GPU
ENVIRONMENT = {
    'PYTHONPATH': str(Path(__file__).parents[2]),
    'OMP_NUM_THREADS': '1',
    'CUDA_VISIBLE_DEVICES': '',
}


def start_torchrun(
    count: int, words: Sequence[str], environment: Mapping[str, str] | None = None
) -> subprocess.Popen[str]:
    """Start `mtv-world` words in `count` processes."""
    launcher = ['-m', 'torch.distributed.run', '--standalone', '--nproc-per-node', str(count)]
    return subprocess.Popen(
        [sys.executable, *launcher, '-m', 'mtv_world_ros.cli', *words],
        env={**os.environ, **ENVIRONMENT, **(environment or {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def torchrun(
    count: int, words: Sequence[str], environment: Mapping[str, str] | None = None
) -> tuple[int, str, str]:
    """Run `mtv-world` words in `count` processes; return status, stdout and stderr."""
    with start_torchrun(count, words, environment) as process:
        out, err = process.communicate(timeout=600)
    return process.returncode, out, err
