"""Cost against size: hours, GPUs, disk and memory, from measured constants.

    python experiments/scale.py                 tables of docs/paper_scale.md
    python experiments/scale.py measure         formula against points of this machine
    python experiments/scale.py ray             what Ray adds to a rollout

The constants are those of the pages in `experiments/results` that each names. `measure` compares
the CPU time of 1, 2 and 4 processes and of 100 to 10,000 episodes with the formula: constants are
fitted to the smallest two sizes, and the others are predicted. CPU time is taken, as it
hardly depends on the load.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.documents import Table
from mtv_world_ros.core.executor import run_all
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.workers import Workers
from mtv_world_ros.data.episode_reader import list_episodes, read_info

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, kw_only=True)
class Constants:
    """Measured constants of `wan-1.3b` on one H200, and of the simulator on one core.

    Attributes:
        step_s: training step of one clip, compiled, blocks computed again [s]
            (wan_gpu_h200_2026-11-27.md).
        encoded_per_s: clips that are encoded into the latent cache in a second (same page).
        training_gib: memory of such a training [GiB] (same page).
        chunk_s: imagined chunk of 5 s by number of denoising steps, compiled [s] (same page; 50
            steps: encode, decode and 50 steps of the transformer).
        collected_per_minute: episodes of the simulator in a minute of a core (docs/simulator.md).
        clip_mib: latents of one clip: clean and control, 2 views of 21 frames of 36 x 48, 16
            channels of 2 bytes [MiB].
        episode_mib: episode of the simulator at 16 fps, 2 views of 384 x 288 [MiB].
        batch: clips of a step, the paper's.
        epochs: passes over the clips, the paper's.
    """

    step_s: float = 1.180
    encoded_per_s: float = 0.767
    training_gib: float = 8.7
    chunk_s: tuple[tuple[int, float], ...] = ((4, 2.248), (16, 5.265), (50, 13.31))
    collected_per_minute: float = 41.0
    clip_mib: float = 2 * 2 * 21 * 36 * 48 * 16 * 2 / 2**20
    episode_mib: float = 1.3
    batch: int = 8
    epochs: int = 8


C = Constants()


def training_hours(clips: int, gpus: int) -> float:
    """Return the hours of a training: each step lasts as long as the GPU with most clips."""
    batch = max(C.batch, gpus)  # fewer clips than processes are refused
    steps = ceil(clips / batch) * C.epochs
    return steps * ceil(batch / gpus) * C.step_s / 3600


def encoding_hours(clips: int, gpus: int) -> float:
    """Return the hours that filling the latent cache takes, each GPU its share."""
    return clips / (C.encoded_per_s * gpus) / 3600


def ranking_hours(policies: int, tasks: int, seeds: int, gpus: int, steps: int) -> float:
    """Return the hours of a ranking's imagined rollouts of three chunks (15 s)."""
    chunk_s = dict(C.chunk_s)[steps]
    return ceil(policies * tasks * seeds / gpus) * 3 * chunk_s / 3600


def training_table() -> Table:
    """Return hours of encoding and training, one clip an episode, by episodes and GPUs."""
    gpus = (1, 8, 64)
    head = ['episodes', 'simulated, 16 cores [h]', 'disk: episodes, latents']
    head += [f'encode + train, {g} GPU{"s" * (g > 1)} [h]' for g in gpus]
    rows = []
    for episodes in (748, 10**3, 10**4, 10**5, 10**6):
        disk = [f'{size * episodes / 1024:,.1f} GiB' for size in (C.episode_mib, C.clip_mib)]
        hours = [
            f'{encoding_hours(episodes, g):,.1f} + {training_hours(episodes, g):,.1f}'
            for g in gpus
        ]
        collected = episodes / (16 * C.collected_per_minute * 60)
        rows.append([f'{episodes:,}', f'{collected:,.1f}', ', '.join(disk), *hours])
    return Table(head=head, rows=rows)


def ranking_table() -> Table:
    """Return hours of rankings by size, denoising steps and GPUs."""
    head = ['policies x tasks x seeds', 'rollouts']
    cases = [(gpus, steps) for steps in (4, 50) for gpus in (1, 8, 64)]
    head += [f'{g} GPU{"s" * (g > 1)}, {s} steps [h]' for g, s in cases]
    rows = [
        [
            f'{p} x {t} x {s}',
            f'{p * t * s:,}',
            *(f'{ranking_hours(p, t, s, g, n):,.2f}' for g, n in cases),
        ]
        for p, t, s in ((5, 3, 10), (10, 15, 10), (10, 15, 50), (100, 15, 50))
    ]
    return Table(head=head, rows=rows)


def _children_cpu_s() -> float:
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def read_cpu_s(count: int, work: Path) -> float:
    """Return the CPU time of listing and reading the descriptions of some episodes [s]."""
    folder = work / f'episodes_{count}'
    source = share_path('resource', 'demo_episode')
    for index in range(count):
        # a link for the recording: 10,000 copies need no room
        one = folder / f'stack_blocks_two_{index:05d}'
        one.mkdir(parents=True)
        for part in source.iterdir():
            if part.suffix == '.mcap':
                (one / part.name).symlink_to(part.resolve())
            else:
                shutil.copy(part, one / part.name)
    begun = time.process_time()
    for path in list_episodes(folder):
        read_info(path)
    return time.process_time() - begun


def train_cpu_s(processes: int, steps: int, work: Path) -> float:
    """Return the CPU time of all processes of a small training [s]."""
    data = work / 'data' / 'stack_blocks_two_00000'
    if not data.is_dir():
        shutil.copytree(share_path('resource', 'demo_episode'), data)
    before = _children_cpu_s()
    subprocess.run(
        [
            sys.executable, '-m', 'torch.distributed.run', '--standalone', '--nproc-per-node',
            str(processes), '-m', 'mtv_world_ros.cli', 'train', str(data.parent), '--preset',
            'small', '--threads', '1', '--peak-tflops', '1', '--set=optimizer.batch_size=4',
            f'--set=optimizer.steps={steps}', '--out', str(work / f'run_{processes}_{steps}'),
        ],
        check=True, cwd=ROOT, capture_output=True,
    )  # fmt: skip
    return _children_cpu_s() - before


def predicted(sizes: Sequence[int], found: Sequence[float]) -> Callable[[int], float]:
    """Return the line through the first two points."""
    slope = (found[1] - found[0]) / (sizes[1] - sizes[0])
    return lambda size: found[0] + slope * (size - sizes[0])


def measure() -> int:
    """Print measured points beside what the formula says of them."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        rows = []
        sizes = (100, 1000, 10_000)
        found = [read_cpu_s(size, work) for size in sizes]
        line = predicted(sizes, found)
        rows += [
            [f'{size:,} episodes listed and described', f'{value:.2f}', f'{line(size):.2f}']
            for size, value in zip(sizes, found, strict=True)
        ]
        # startup and steps of one process; others start as long, and share the steps
        once, more = (train_cpu_s(1, steps, work) for steps in (2, 12))
        step_s = (more - once) / 10
        start_s = once - 2 * step_s
        for processes in (1, 2, 4):
            value = more if processes == 1 else train_cpu_s(processes, 12, work)
            formula = processes * start_s + 12 * step_s
            rows.append([f'12 steps on {processes} process{"es" * (processes > 1)}',
                         f'{value:.1f}', f'{formula:.1f}'])  # fmt: skip
        print(Table(head=['point', 'CPU time [s]', 'formula [s]'], rows=rows).markdown())
    return 0


@dataclass(frozen=True)
class _Echo:
    """Job that does nothing and returns some bytes, as a rollout returns its video and frames."""

    size: int

    def __call__(self) -> Callable[[int], bytes]:
        return lambda number: bytes([number % 256]) * self.size


def measure_ray() -> int:
    """Print what a job costs on Ray beside the median time of a rollout on this machine."""
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / 'ranking'
        words = ['rank', '--policies', 'expert', '--tasks', 'stack_blocks_two', '--episodes', '3',
                 '--threads', '1', '--out', str(out)]  # fmt: skip
        subprocess.run(
            [sys.executable, '-m', 'mtv_world_ros.cli', *words],
            check=True, cwd=ROOT, capture_output=True,
        )  # fmt: skip
        files = list((out / 'rollouts').iterdir())
        results = [read_json(file)['result'] for file in files if file.suffix == '.json']
        rollout_s = statistics.median(sum(result['seconds'].values()) for result in results)
        size = sum(file.stat().st_size for file in files) * 4 // 3 // len(results)
    ends = [time.perf_counter()]
    for _ in run_all(range(41), _Echo(size), Workers(ray='')):
        ends.append(time.perf_counter())
    job_s = (ends[-1] - ends[1]) / 40  # the first one waits for the cluster
    rows = [
        ['rollout, median of 3 [s]', f'{rollout_s:.2f}'],
        ['bytes that it returns', f'{size:,}'],
        ['job of as many bytes on Ray, mean of 40 [s]', f'{job_s:.4f}'],
        ['share of a rollout', f'{100 * job_s / rollout_s:.2f} %'],
        ['start of the cluster and first job [s]', f'{ends[1] - ends[0]:.1f}'],
    ]
    print(Table(head=['what', 'found'], rows=rows).markdown())
    return 0


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('what', nargs='?', choices=('tables', 'measure', 'ray'), default='tables')
    what = parser.parse_args().what
    if what != 'tables':
        return measure() if what == 'measure' else measure_ray()
    print(f'{training_table().markdown()}\n\n{ranking_table().markdown()}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
