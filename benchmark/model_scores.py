"""Scores of checkpoints on held-out episodes, for benchmarks that train and compare."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
import statistics

from control_tables import cell
from page import in_turns

from mtv_world_ros.assembly import fingerprint, load_pipeline
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.data.splits import select
from mtv_world_ros.files import share_path
from mtv_world_ros.lab.evaluation.evaluate_episodes import evaluate, Parallel
from mtv_world_ros.lab.evaluation.imagined_stretches import imagine_stretch, stretches
from mtv_world_ros.lab.evaluation.report.evaluation_summary import Summary
from mtv_world_ros.lab.evaluation.settings import EvaluationConfig
from mtv_world_ros.lab.training.training_config import load_training_config, TrainingRun
from mtv_world_ros.lab.training.training_run import spread

#: columns of a table, and what `Summary.estimates` calls them
COLUMNS = {'J moving': 'j_moving', 'J objects': 'j_object_mean', 'skill': 'skill'}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Adds what training and scoring need."""
    parser.add_argument('train', type=Path, help='folder of episodes to train on')
    parser.add_argument('held_out', type=Path, help='folder of episodes to score on')
    parser.add_argument('--work', type=Path, required=True, help='checkpoints and scores')
    parser.add_argument('--checkpoint', default='bundled', help='to start from')
    parser.add_argument('--preset', default='small')
    parser.add_argument('--training-steps', type=int, default=1000)
    parser.add_argument('--batch-size', type=int, default=4)
    parser.add_argument('--learning-rate', type=float, default=1e-4)
    parser.add_argument('--episodes', type=int, help='of TRAIN, spread over all')
    parser.add_argument('--held-out-episodes', type=int, help='of HELD_OUT, spread over all')
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--dtype', default='float32')
    parser.add_argument('--threads', type=int, default=1)
    parser.add_argument('--workers', type=int, default=1, help='processes that score')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--machine', default='cpu2', help='its name on the page')
    parser.add_argument('--out', type=Path, help='folder to write the page into')


def overrides(options: argparse.Namespace) -> dict[str, object]:
    """Returns what the options change of the preset."""
    return {
        'optimizer.steps': options.training_steps,
        'optimizer.batch_size': options.batch_size,
        'optimizer.learning_rate': options.learning_rate,
        'optimizer.warmup_steps': min(50, options.training_steps),
        'optimizer.ema_decay': 0.99,
    }


def loader(checkpoint: str | Path, options: argparse.Namespace) -> partial:
    """Returns a function that loads a checkpoint's pipeline."""
    return partial(
        load_pipeline,
        checkpoint,
        device=options.device,
        dtype=options.dtype,
        segmenter='colour',
        num_threads=options.threads,
    )


def score(
    checkpoint: str | Path, out: Path, options: argparse.Namespace, *, mode: str, steps: int
) -> Summary:
    """Returns the scores of a checkpoint; those made before are taken from `out`."""
    load = loader(checkpoint, options)
    return evaluate(
        load(),
        spread(select(options.held_out, 'all').paths, options.held_out_episodes),
        out,
        EvaluationConfig(
            mode=mode,
            seed=options.seed,
            num_inference_steps=steps,
            actions=('true',),
            ceiling=False,
        ),
        name=fingerprint(checkpoint),
        parallel=Parallel(workers=options.workers, make_pipeline=load, threads=options.threads),
    )


def run_of(options: argparse.Namespace, name: str, changes: dict[str, object]) -> TrainingRun:
    """Returns a training of the preset with changes, whose folder is `name`."""
    return TrainingRun(
        config=load_training_config(options.preset, changes),
        dataset=tuple(select(options.train, 'all').paths),
        num_episodes=options.episodes,
        out=options.work / name,
        seed=options.seed,
        device=options.device,
        dtype=options.dtype,
        cache=options.work / 'cache',
    )


def cells(summary: Summary) -> list[str]:
    """Returns the numbers over all views, in the order of `COLUMNS`."""
    found = summary.estimates(None)
    return [cell(found.get(key)) for key in COLUMNS.values()]


def chunk_seconds(
    models: Mapping[str, tuple[str | Path, int]], options: argparse.Namespace, repeats: int = 5
) -> dict[str, float]:
    """Returns the median times [s] that models take for a chunk of the bundled episode, in turns.

    Args:
        models: checkpoint and denoising steps, by name.
        options: as `add_options` has them.
        repeats: turns that count.
    """
    spent: dict[str, list[float]] = {name: [] for name in models}
    works = {
        name: _chunk(checkpoint, options, steps, spent[name])
        for name, (checkpoint, steps) in models.items()
    }
    in_turns(works, repeats)
    return {name: statistics.median(times[1:]) for name, times in spent.items()}


def _chunk(
    checkpoint: str | Path, options: argparse.Namespace, steps: int, spent: list[float]
) -> Callable[[], None]:
    """Returns what imagines a chunk and notes the time of the model [s], another seed each."""
    pipeline = loader(checkpoint, options)()
    recording = load_recording(
        share_path('resource', 'demo_episode'), pipeline.spec, pipeline.robot
    )
    stretch = stretches(recording, pipeline.spec, 'observe')[0]

    def work() -> None:
        prediction = imagine_stretch(
            pipeline,
            recording,
            stretch,
            actions=recording,
            seed=len(spent),
            num_inference_steps=steps,
        )[0]
        spent.append(prediction.seconds['model'])

    return work
