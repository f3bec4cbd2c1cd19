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
    count: int,
    words: Sequence[str],
    environment: Mapping[str, str] | None = None,
    *,
    through: Sequence[str] = (),
) -> subprocess.Popen[str]:
    """Start `mtv-world` words in `count` processes, each through a program that runs its words."""
    launcher = ['-m', 'torch.distributed.run', '--standalone', '--nproc-per-node', str(count)]
    program = ['--no-python', *through, sys.executable] if through else []
    return subprocess.Popen(
        [sys.executable, *launcher, *program, '-m', 'mtv_world_ros.cli', *words],
        env={**os.environ, **ENVIRONMENT, **(environment or {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def rank_pid(launcher: int, rank: int) -> int:
    """Return the number of the launcher's process that has a rank."""
    children = Path(f'/proc/{launcher}/task/{launcher}/children').read_text().split()
    for pid in children:
        variables = Path(f'/proc/{pid}/environ').read_bytes().split(b'\0')
        if f'RANK={rank}'.encode() in variables:
            return int(pid)
    raise AssertionError(f'no rank {rank} among {children}')


def torchrun(
    count: int,
    words: Sequence[str],
    environment: Mapping[str, str] | None = None,
    *,
    through: Sequence[str] = (),
) -> tuple[int, str, str]:
    """Run `mtv-world` words in `count` processes; return status, stdout and stderr."""
    with start_torchrun(count, words, environment, through=through) as process:
        out, err = process.communicate(timeout=600)
    return process.returncode, out, err
