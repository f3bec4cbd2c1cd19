"""Cost against size: hours, GPUs, disk and memory, from measured constants.

    python experiments/scale.py                 tables of docs/paper_scale.md
    python experiments/scale.py measure         formula against points of this machine
    python experiments/scale.py start           time to the first step of 1, 2 and 4 processes
    python experiments/scale.py data            start, memory and clips of 100 to 10,000 episodes
    python experiments/scale.py speed           gain of two processes over one, on a quiet machine
    python experiments/scale.py ray             what Ray adds to a rollout

The constants are those of the pages in `experiments/results` that each names. `measure` compares
the CPU time of 1, 2 and 4 processes and of 100 to 10,000 episodes with the formula: constants are
fitted to the smallest sizes, and the others are predicted. CPU time is taken, as it
hardly depends on the load; of several processes, `start` takes that of the slowest. `speed` takes
wall time, one process and two in turns.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import json
from math import ceil
import os
from pathlib import Path
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.documents import Table
from mtv_world_ros.core.executor import run_all
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.workers import Workers
from mtv_world_ros.data.episode_reader import list_episodes

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


def copy_episodes(count: int, folder: Path) -> list[Path]:
    """Return copies of the demo episode with other names and contents; recordings are links."""
    source = share_path('resource', 'demo_episode')
    for index in range(count):
        one = folder / f'stack_blocks_two_{index:05d}'
        if one.is_dir():
            continue
        one.mkdir(parents=True)
        (one / 'copy.txt').write_text(str(index))
        for part in source.iterdir():
            if part.suffix == '.mcap':
                (one / part.name).symlink_to(part.resolve())
            else:
                shutil.copy(part, one / part.name)
    return list_episodes(folder)[:count]


def own_process(what: str, work: Path, *, count: int = 1, number: int = 0) -> list[dict[str, Any]]:
    """Return what `measured_process` prints, of each process.

    Args:
        what: what is measured, `data` or `start`.
        work: folder of the caches.
        count: number of processes.
        number: number of episodes.
    """
    launcher = ['-m', 'torch.distributed.run', '--standalone', '--nproc-per-node', str(count)]
    done = subprocess.run(
        [sys.executable, *launcher, str(Path(__file__)), what, '--work', str(work),
         '--episodes', str(number)],
        check=True, cwd=ROOT, stdout=subprocess.PIPE, text=True,
        env={**os.environ, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': str(ROOT)},
    )  # fmt: skip
    # lines of two processes may stand on one
    parts = done.stdout.split(_MARK)[1:]
    return [json.JSONDecoder().raw_decode(part)[0] for part in parts]


def measured_process(what: str, work: Path, number: int) -> None:
    """Measure in this process, one of those that a launcher started, and print JSON.

    Args:
        what: `data`: start and clips of the preset small; `start`: reading, and latents of an
            autoencoder with Wan's layers and random weights.
        work: folder of the caches.
        number: number of episodes.
    """
    from diffusers import AutoencoderKLWan
    import torch

    from mtv_world_ros.model.autoencoders import WanAutoencoder
    from mtv_world_ros.robot.file import load_robot, robot_path
    from mtv_world_ros.training.base_checkpoint import Base
    from mtv_world_ros.training.clips.batches import BatchSource
    from mtv_world_ros.training.clips.encoding import Encoders
    from mtv_world_ros.training.clips.latent_cache import cached_batches
    from mtv_world_ros.training.distributed import Processes
    from mtv_world_ros.training.training_config import load_training_config
    from mtv_world_ros.training.training_run import load_episodes
    from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

    torch.set_num_threads(1)
    torch.manual_seed(0)
    changes: dict[str, Any] = {'video.clip_stride_s': 86400.0}
    if what == 'start':
        changes |= {'autoencoder._class_name': 'AutoencoderKLWan', 'augment.start_noise': 0.0}
        changes |= {'augment.colour_permutation': 0.0, 'augment.failure_share': None}
    config, processes = load_training_config('small', changes), Processes('cpu')
    robot = load_robot(robot_path(config.video.robot))
    processes.any(False)
    begun_s = time.perf_counter()
    last = time.process_time(), begun_s
    found: dict[str, Any] = {}

    def lap(name: str) -> None:
        nonlocal last
        now = time.process_time(), time.perf_counter()
        found[name], found[f'{name}_wall'] = now[0] - last[0], now[1] - last[1]
        last = now

    paths = list_episodes(work / 'episodes')[:number]
    cache = work / f'cache_{what}_{processes.count if what == "start" else number}'
    episodes, _ = load_episodes(paths, config, robot, cache, processes=processes)
    lap('read')
    source = BatchSource(episodes, config, robot=robot, segmenter=ColourSegmenter(), seed=0)
    if what == 'start':
        small = AutoencoderKLWan(base_dim=16, z_dim=16).eval().requires_grad_(False)
        encoders = Encoders(autoencoder=WanAutoencoder(small))
        parts: Any = None  # the cache takes the encoders alone
        base = Base(folder=work / 'base', checkpoint=parts, encoders=encoders, digest='')
        latents = work / f'latents_{processes.count}'
        lap('prepare')
        cached_batches(
            source, latents, config, base, seed=0, dtype=torch.float32, processes=processes
        ).close()
        lap('encode')
    else:
        memory: list[float] = []
        for step in range(2 * _STEPS + 1):
            source.batch(step)
            if step % _STEPS == 0:
                memory.append(_memory_mib())
                lap(f'steps_{step}')
        found['memory_mib'] = memory
        found['clips'] = source.num_clips
        source.close()
    found['wall_s'] = time.perf_counter() - begun_s
    print(f'{_MARK}{json.dumps(found)}', flush=True)
    processes.any(False)
    processes.close()


def _memory_mib() -> float:
    """Return the memory of this process that no file backs [MiB]."""
    text = Path('/proc/self/status').read_text()
    return int(text.partition('RssAnon:')[2].split()[0]) / 1024


def measure_start() -> int:
    """Print the time to the first step of 1, 2 and 4 processes."""
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        copy_episodes(_START_EPISODES, work / 'episodes')
        first = 0.0
        for count in (1, 2, 4):
            found = own_process('start', work, count=count, number=_START_EPISODES)
            read, encode = (max(row[key] for row in found) for key in ('read', 'encode'))
            first = first or read + encode
            again = own_process('start', work, count=count, number=_START_EPISODES)
            rest = max(row['read'] + row['encode'] for row in again)
            gain = first / (read + encode)
            rows.append([str(count), f'{read:.1f}', f'{encode:.1f}', f'{gain:.2f}', f'{rest:.1f}'])
    head = ['processes', 'read and check [s]', 'encode [s]', 'gain', 'second start [s]']
    print(f'{_START_EPISODES} episodes, one clip each; CPU time of the slowest process\n')
    print(Table(head=head, rows=rows).markdown())
    return 0


def measure_data(sizes: Sequence[int] = (100, 1000, 10_000)) -> int:
    """Print start, memory and clips of data sets of several sizes."""
    from mtv_world_ros.data.recordings import recording_key
    from mtv_world_ros.robot.file import load_robot, robot_path
    from mtv_world_ros.training.training_config import load_training_config

    config = load_training_config('small')
    robot, spec = load_robot(robot_path(config.video.robot)), config.spec
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        paths = copy_episodes(max(sizes), work / 'episodes')
        own_process('data', work, number=1)  # decodes one; the others have equal frames
        (decoded,) = (work / 'cache_data_1').glob('*.npz')
        starts: list[float] = []
        for size in sizes:
            cache = work / f'cache_data_{size}'
            cache.mkdir()
            keys = [recording_key(path, spec, robot) for path in paths[:size]]
            for key in keys:
                (cache / f'{key}.npz').hardlink_to(decoded)
            (first,) = own_process('data', work, number=size)
            starts.append(first['read'])
            (again,) = own_process('data', work, number=size)
            per_clip = again[f'steps_{2 * _STEPS}'] / _STEPS / config.optimizer.batch_size
            rows.append([
                f'{size:,}', f'{starts[-1]:.1f}', f'{again["read"]:.2f}',
                *(f'{value:.0f}' for value in again['memory_mib']),
                f'{per_clip * again["clips"]:.0f}',
            ])  # fmt: skip
            print(' | '.join(rows[-1]), file=sys.stderr, flush=True)
        line = predicted(sizes, starts)
        for row, size in zip(rows, sizes, strict=True):
            row.insert(2, f'{line(size):.1f}')
    head = ['episodes', 'first start [s]', 'formula [s]', 'later start [s]']
    head += ['memory after 1 step [MiB]', f'after {_STEPS}', f'after {2 * _STEPS}']
    head += ['clips of an epoch [s]']
    print('CPU time of one process; memory is what no file backs\n')
    print(Table(head=head, rows=rows).markdown())
    return 0


#: begins the line of a measured process
_MARK = 'measured: '
#: episodes of the table of starts
_START_EPISODES = 16
#: steps between two looks at the memory
_STEPS = 50


def train(processes: int, steps: int, work: Path) -> Path:
    """Return the folder of a small training of some processes, one thread each."""
    data = work / 'data' / 'stack_blocks_two_00000'
    if not data.is_dir():
        shutil.copytree(share_path('resource', 'demo_episode'), data)
    out = Path(tempfile.mkdtemp(dir=work))
    subprocess.run(
        [
            sys.executable, '-m', 'torch.distributed.run', '--standalone', '--nproc-per-node',
            str(processes), '-m', 'mtv_world_ros.cli', 'train', str(data.parent), '--preset',
            'small', '--threads', '1', '--peak-tflops', '1', '--set=optimizer.batch_size=4',
            f'--set=optimizer.steps={steps}', '--out', str(out),
        ],
        check=True, cwd=ROOT, capture_output=True,
    )  # fmt: skip
    return out


def train_cpu_s(processes: int, steps: int, work: Path) -> float:
    """Return the CPU time of all processes of a small training [s]."""
    before = _children_cpu_s()
    train(processes, steps, work)
    return _children_cpu_s() - before


def measure_speed(rounds: int = 3, steps: int = 30) -> int:
    """Print wall times of training and encoding by one process and by two, in turns.

    Args:
        rounds: number of turns; the medians of the ratios count.
        steps: steps of a training; the first ten do not count.
    """
    found: dict[str, list[tuple[float, float]]] = {'step of four clips': [], 'encoding': []}
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        copy_episodes(_START_EPISODES, work / 'episodes')
        own_process('start', work, number=_START_EPISODES)  # decodes the episodes
        for _ in range(rounds):
            trained, encoded = [], []
            for count in (1, 2):
                log = (train(count, steps, work) / 'log.jsonl').read_text().splitlines()
                rows = [json.loads(row) for row in log][1:]
                trained.append(statistics.mean(1 / row['steps_per_second'] for row in rows))
                shutil.rmtree(work / f'latents_{count}', ignore_errors=True)
                parts = own_process('start', work, count=count, number=_START_EPISODES)
                encoded.append(max(part['encode_wall'] for part in parts))
            for key, pair in zip(found, (trained, encoded), strict=True):
                found[key].append((pair[0], pair[1]))
                print(f'{key}: {pair[0]:.2f} s, {pair[1]:.2f} s', file=sys.stderr, flush=True)
    rows = [
        [
            key,
            *(f'{statistics.median(pair[k] for pair in pairs):.2f}' for k in range(2)),
            f'{statistics.median(one / two for one, two in pairs):.2f}',
        ]
        for key, pairs in found.items()
    ]
    print(f'wall time; medians of {rounds} turns; one thread a process\n')
    print(Table(head=['what', '1 process [s]', '2 processes [s]', 'gain'], rows=rows).markdown())
    return 0


def predicted(sizes: Sequence[int], found: Sequence[float]) -> Callable[[int], float]:
    """Return the line through the first two points."""
    slope = (found[1] - found[0]) / (sizes[1] - sizes[0])
    return lambda size: found[0] + slope * (size - sizes[0])


def measure() -> int:
    """Print measured points of training beside what the formula says of them."""
    with tempfile.TemporaryDirectory() as name:
        work, rows = Path(name), []
        # constants: start of one process and of each further one, and a step of four clips
        once, more, two = (train_cpu_s(n, steps, work) for n, steps in ((1, 2), (1, 12), (2, 2)))
        step_s = (more - once) / 10
        start_s, further_s = once - 2 * step_s, two - once
        for processes in (1, 2, 4):
            value = more if processes == 1 else train_cpu_s(processes, 12, work)
            formula = start_s + (processes - 1) * further_s + 12 * step_s
            ratio = f'{100 * (formula / value - 1):+.0f} %'
            rows.append([f'12 steps on {processes} process{"es" * (processes > 1)}',
                         f'{value:.1f}', f'{formula:.1f}', ratio])  # fmt: skip
        print(Table(head=['point', 'CPU time [s]', 'formula [s]', 'off'], rows=rows).markdown())
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
    runs = {
        'measure': measure,
        'ray': measure_ray,
        'start': measure_start,
        'data': measure_data,
        'speed': measure_speed,
    }
    parser.add_argument('what', nargs='?', choices=('tables', *runs), default='tables')
    parser.add_argument(
        '--work', type=Path, help='folder of a process that `start` or `data` starts'
    )
    parser.add_argument('--episodes', type=int, default=0, help='its number of episodes')
    options = parser.parse_args()
    if options.work is not None:
        measured_process(options.what, options.work, options.episodes)
        return 0
    if options.what != 'tables':
        return runs[options.what]()
    print(f'{training_table().markdown()}\n\n{ranking_table().markdown()}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
