"""What does each choice for CPUs give in a training step and in a chunk?

    python experiments/cpu_speed.py data/train --work runs/speed --out experiments/results
    git worktree add ../older COMMIT && python experiments/cpu_speed.py ... --checkout ../older

Each measurement is a process of its own, since one cannot take back how it holds memory, and all
take turns. A training step is of the preset `small` from new weights, by `make` of
`training_speed.py`; a chunk is of `bundled-paper` and begins with a frame of its own. CPU time of
one thread. Chunks come after the steps: what held memory gives them is not seen here.
`--checkout` names another checkout of this repository, of which steps are measured.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
import os
from pathlib import Path
import subprocess
import sys
import time
from typing import Any

import numpy as np
from page import parse_arguments, publish, table
import torch

#: turns that do not count, and those that do, of a process
WARM_UP, TURNS = 2, 10
BATCH_SIZE = 2
AS_IT_IS, CHECKOUT = 'as it is', 'other checkout'
#: prefix of the line by which a process reports
REPORT = 'measured: '


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what other benchmarks do not have."""
    parser.add_argument('train', type=Path, help='folder of episodes')
    parser.add_argument('--work', type=Path, required=True, help='folder of what was read of them')
    parser.add_argument('--episodes', type=int, default=4)
    parser.add_argument('--checkout', type=Path, help='folder of another checkout')
    parser.add_argument('--only', help=argparse.SUPPRESS)


def _use_fused_kernel() -> None:
    from mtv_world_ros.model.transformer import attention

    attention.cpu_multiplies_bfloat16 = lambda: False  # type: ignore[assignment]


def _return_memory() -> None:
    from mtv_world_ros.model import loading
    from mtv_world_ros.training import trainer

    loading.keep_freed_memory = trainer.keep_freed_memory = lambda: False  # type: ignore[assignment]


def _norm_in_bfloat16() -> None:
    from mtv_world_ros.model.transformer import stem

    stem._normed = lambda norm, x: norm(x)  # type: ignore[assignment]


#: choices taken back, by name
WITHOUT: dict[str, Callable[[], None]] = {
    AS_IT_IS: lambda: None,
    "torch's fused attention": _use_fused_kernel,
    'freed memory returned to the system': _return_memory,
    'gradient of norms in bfloat16': _norm_in_bfloat16,
}


def step_times(options: argparse.Namespace, checkout: Path) -> dict[str, Any]:
    """Return CPU times [s] and losses of the training steps of a checkout.

    Args:
        options: of the command line.
        checkout: its folder; `training_speed.py` was in `benchmark/` once.
    """
    folder = next(f for f in ('experiments', 'benchmark') if (checkout / f).is_dir())
    if options.only == CHECKOUT:  # its modules, not those that this script has imported
        for name in [n for n in sys.modules if n.partition('.')[0] in ('mtv_world_ros', 'page')]:
            del sys.modules[name]
    sys.path[:0] = [str(checkout / folder), str(checkout)]
    import training_speed

    work = options.work / folder
    work.mkdir(parents=True, exist_ok=True)
    trainer, source = training_speed.make(
        argparse.Namespace(
            train=options.train,
            work=work,
            preset='small',
            set=[f'optimizer.batch_size={BATCH_SIZE}'],
            episodes=options.episodes,
            device='cpu',
            dtype='auto',
            threads=1,
            data_workers=0,
            seed=options.seed,
        )
    )
    batches = [source.batch(step) for step in range(WARM_UP + TURNS)]
    keep = getattr(sys.modules[type(trainer).__module__], 'keep_freed_memory', lambda: False)
    keep()
    times, losses = [], []
    for batch in batches:
        begun = time.process_time()
        losses.append(trainer.train_step(batch).loss)
        times.append(time.process_time() - begun)
        trainer.step += 1
    return {'step': times[WARM_UP:], 'losses': losses}


def chunk_times(options: argparse.Namespace) -> dict[str, Any]:
    """Return CPU times [s] of chunks of `bundled-paper`; the frames of the first are written."""
    from mtv_world_ros.control.control import ControlInputs
    from mtv_world_ros.core.files import share_path
    from mtv_world_ros.data.recording import load_recording
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.model.loading import load_world_model
    from mtv_world_ros.training.clips.batches import BatchSource
    from mtv_world_ros.training.training_config import load_training_config
    from mtv_world_ros.vision.segmenters.choose import choose_segmenter

    checkpoint = Checkpoint.open('bundled-paper')
    config, robot = load_training_config('small', {}), checkpoint.load_robot()
    demo = load_recording(share_path('resource', 'demo_episode'), config.spec, robot)
    segmenter = choose_segmenter('colour')
    source = BatchSource([demo], config, robot=robot, segmenter=segmenter, seed=options.seed)
    batch = source.batch(0)
    source.close()
    assert batch.inputs.video is not None
    control = ControlInputs.drawn(batch.inputs.video[0].numpy())
    model = load_world_model(checkpoint, num_threads=1)
    frames, times = batch.start_frame[0].numpy()[:, None], []
    for _ in range(WARM_UP + TURNS):
        start = np.ascontiguousarray(frames[:, -1])
        begun = time.process_time()
        frames = model.predict(
            start,
            control,
            positions=np.zeros((1 + control.num_frames, 0)),
            seed=options.seed,
            num_inference_steps=model.spec.num_inference_steps,
            should_stop=lambda: False,
        )
        times.append(time.process_time() - begun)
        if len(times) == 1:  # differences of later ones add up: they begin with these frames
            np.save(options.work / f'{_file_name(options.only)}.npy', frames)
    return {'chunk': times[WARM_UP:]}


def _file_name(name: str) -> str:
    return ''.join(c if c.isalnum() else '_' for c in name)


def measured_apart(options: argparse.Namespace, name: str) -> dict[str, Any]:
    """Return what a process of its own measures.

    Args:
        options: of the command line.
        name: in `WITHOUT`, or `CHECKOUT`.

    Raises:
        RuntimeError: the process failed; the message has its last lines.
    """
    words = [sys.executable, __file__, str(options.train), '--work', str(options.work)]
    words += ['--episodes', str(options.episodes), '--seed', str(options.seed), '--only', name]
    if options.checkout:
        words += ['--checkout', str(options.checkout)]
    environment = {**os.environ, 'OMP_NUM_THREADS': '1'}
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    for line in done.stdout.splitlines():
        if line.startswith(REPORT):
            return json.loads(line.removeprefix(REPORT))
    raise RuntimeError(f'{name}: status {done.returncode}: {done.stderr[-2000:]}')


def compared(options: argparse.Namespace) -> str:
    """Return the table of all choices, and what they change."""
    names = [*WITHOUT, *([CHECKOUT] if options.checkout else [])]
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for turn in range(options.repeats):
        for name in names[:: 1 if turn % 2 else -1]:
            found[name].append(measured_apart(options, name))
            print(f'turn {turn}, {name}', file=sys.stderr, flush=True)
    medians = {
        (name, work): np.array([np.median(run[work]) for run in runs if work in run])
        for name, runs in found.items()
        for work in ('step', 'chunk')
    }
    rows = []
    for name in names:
        row = [name]
        for work in ('step', 'chunk'):
            mine, base = medians[name, work], medians[AS_IT_IS, work]
            if mine.size:
                row += [f'{np.median(mine):.3f}', f'{np.median(mine / base):.2f}']
            else:
                row += ['–', '–']
        rows.append(row)
    base_losses = np.array(found[AS_IT_IS][0]['losses'])
    base_frames = np.load(options.work / f'{_file_name(AS_IT_IS)}.npy').astype(int)
    notes = []
    for name in names[1:]:
        apart = np.abs(np.array(found[name][0]['losses']) / base_losses - 1).max()
        note = f'{name}: losses of {len(base_losses)} steps differ by at most {apart:.1e}'
        file = options.work / f'{_file_name(name)}.npy'
        if name != CHECKOUT:
            grey = np.abs(np.load(file).astype(int) - base_frames)
            note += f', frames of a chunk by at most {grey.max()} grey levels'
        notes.append(f'- {note}.')
    head = ['', 'step, CPU [s]', 'of as it is', 'chunk, CPU [s]', 'of as it is']
    return f'{table(head, rows)}\n\n' + '\n'.join(notes)


def main() -> None:
    """Measure and publish, or measure one choice in this process."""
    options = parse_arguments(__doc__, 5, add_options)
    options.work.mkdir(parents=True, exist_ok=True)
    if options.only is None:
        body = compared(options)
        body = (
            f'Each process makes {WARM_UP} + {TURNS} steps of {BATCH_SIZE} clips, and as many '
            f'chunks; n counts processes, the ratios are medians over turns.\n\n{body}'
        )
        words = ['python', 'experiments/cpu_speed.py', 'data/train', '--work', 'runs/speed']
        words += ['--checkout', '../older'] if options.checkout else []
        title = 'Choices for CPUs: a training step and a chunk'
        versions = f'torch {torch.__version__}, one thread'
        publish('cpu_speed', title, ' '.join(words), body, options, versions)
        return
    torch.set_num_threads(1)
    if options.only == CHECKOUT:
        found = step_times(options, options.checkout)
    else:
        WITHOUT[options.only]()
        found = step_times(options, Path(__file__).resolve().parents[1]) | chunk_times(options)
    print(REPORT + json.dumps(found), flush=True)


if __name__ == '__main__':
    main()
