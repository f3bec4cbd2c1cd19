"""What do two matrix products in place of torch's fused kernel give in attention on a CPU?

    python experiments/attention_speed.py --machine epyc2 --repeats 20 --out experiments/results

Takes turns between both kernels, step by step and chunk by chunk in one process: training steps
of the preset `small` from the weights of `bundled-paper` on equal clips of the demo episode (CPU
time and losses), and chunks of that checkpoint, one from a recorded frame and one that begins with
its last frame (CPU time, and by how many grey levels the frames differ).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
import tempfile
import time

import numpy as np
from page import in_turns, parse_arguments, publish, ratio, table
import torch

from mtv_world_ros.control.control import ControlInputs
from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.trained_model import load_trained_model
from mtv_world_ros.model.transformer import attention
from mtv_world_ros.model.world_model import DiffusionWorldModel
from mtv_world_ros.training.clips.batches import BatchSource
from mtv_world_ros.training.trainer import Trainer
from mtv_world_ros.training.training_config import load_training_config
from mtv_world_ros.vision.segmenters.choose import choose_segmenter

#: turns that do not count
WARM_UP = 2
#: kernels by name: whether products are preferred where they are fast
KERNELS = {'fused kernel': False, 'two products': True}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what other benchmarks do not have."""
    parser.add_argument('--threads', type=int, default=1)
    parser.add_argument('--batch-size', type=int, default=2)


@contextmanager
def kernel(name: str) -> Iterator[None]:
    """Attend by one of `KERNELS` for the time being."""
    before = attention.cpu_multiplies_bfloat16
    attention.cpu_multiplies_bfloat16 = lambda: KERNELS[name]  # type: ignore[assignment]
    try:
        yield
    finally:
        attention.cpu_multiplies_bfloat16 = before


class Clips:
    """Clips of the demo episode, and weights that know it.

    Args:
        options: of the command line.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.checkpoint = Checkpoint.open('bundled-paper')
        self.config = load_training_config('small', {'optimizer.batch_size': options.batch_size})
        robot = self.checkpoint.load_robot()
        demo = share_path('resource', 'demo_episode')
        self._source = BatchSource(
            [load_recording(demo, self.config.spec, robot)],
            self.config,
            robot=robot,
            segmenter=choose_segmenter('colour'),
            seed=options.seed,
        )
        count = options.repeats + WARM_UP
        self.batches = [self._source.batch(step) for step in range(count)]
        self._source.close()

    def trainer(self) -> Trainer:
        """Return a trainer that starts from the checkpoint's weights."""
        made = Trainer(
            self.config,
            self.options.work,
            seed=self.options.seed,
            device='cpu',
            dtype=torch.bfloat16,
            trained_on={},
        )
        made.start_from(self.checkpoint)
        return made


class Steps:
    """Training steps by one kernel.

    Args:
        name: of the kernel.
        clips: that it is trained on.
    """

    def __init__(self, name: str, clips: Clips) -> None:
        self._name, self._trainer, self._batches = name, clips.trainer(), clips.batches
        self.losses: list[float] = []

    def __call__(self) -> None:
        """Make a step; both kernels see the same clips."""
        step = len(self.losses)
        with kernel(self._name):
            self.losses.append(self._trainer.train_step(self._batches[step]).loss)
        self._trainer.step += 1


class Chunks:
    """Chunks of a checkpoint by one kernel.

    Args:
        name: of the kernel.
        model: that imagines.
        start: (V, H, W, 3) uint8 RGB start frame.
        control: trajectory video of the chunk.
    """

    def __init__(
        self, name: str, model: DiffusionWorldModel, start: ByteArray, control: ControlInputs
    ) -> None:
        self._name, self._model, self._start, self._control = name, model, start, control
        self.frames: ByteArray | None = None

    def __call__(self) -> None:
        """Imagine a chunk."""
        with kernel(self._name):
            self.frames = self._model.predict(
                self._start,
                self._control,
                positions=np.zeros((1 + self._control.num_frames, 0)),
                seed=0,
                num_inference_steps=self._model.spec.num_inference_steps,
                should_stop=lambda: False,
            )


def compare(works: dict[str, Callable[[], None]], repeats: int) -> list[str]:
    """Return the cells of a row: CPU time of both kernels [s], and their ratio."""
    times = in_turns(works, repeats, clock=time.process_time, warm_up=WARM_UP)
    old, new = (times[name] for name in KERNELS)
    return [f'{np.median(t):.3f}' for t in (old, new)] + [f'{ratio(old, new):.2f}']


def measured(options: argparse.Namespace) -> str:
    """Return the tables of the page."""
    clips = Clips(options)
    steps = {name: Steps(name, clips) for name in KERNELS}
    rows = [[f'training step, {options.batch_size} clips', *compare(steps, options.repeats)]]
    losses = [np.array(one.losses) for one in steps.values()]
    model = DiffusionWorldModel(
        load_trained_model(clips.checkpoint, dtype=torch.bfloat16), dtype=torch.bfloat16
    )
    batch = clips.batches[0]
    assert batch.inputs.video is not None
    start = batch.start_frame[0].numpy()
    control = ControlInputs.drawn(batch.inputs.video[0].numpy())
    apart = []
    for label in ('chunk from a recorded frame', 'chunk from its last frame'):
        chunks = {name: Chunks(name, model, start, control) for name in KERNELS}
        rows.append([label, *compare(chunks, options.repeats)])
        old, new = (chunk.frames for chunk in chunks.values())
        assert old is not None and new is not None
        apart.append(np.abs(old.astype(int) - new.astype(int)))
        start = new[:, -1]
    head = ['', *(f'{name}, CPU [s]' for name in KERNELS), 'ratio']
    worst = max(float(one.max()) for one in apart)
    mean = max(float(one.mean()) for one in apart)
    return (
        f'{table(head, rows)}\n\nLosses of {len(losses[0])} steps differ by at most '
        f'{np.abs(losses[0] / losses[1] - 1).max():.1e} of their value (first {losses[0][0]:.4f}, '
        f'last {losses[0][-1]:.4f} and {losses[1][-1]:.4f}). Frames differ by at most '
        f'{worst:.0f} grey levels, {mean:.3f} in the mean.'
    )


def main() -> None:
    """Measure and publish."""
    options = parse_arguments(__doc__, 20, add_options)
    torch.set_num_threads(options.threads)
    with tempfile.TemporaryDirectory() as work:
        options.work = Path(work)
        body = measured(options)
    publish(
        'attention_speed',
        'Attention by two products, and by the fused kernel',
        'python experiments/attention_speed.py',
        body,
        options,
        f'torch {torch.__version__}, {options.threads} threads',
    )


if __name__ == '__main__':
    main()
