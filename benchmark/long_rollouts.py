"""How far do chained chunks drift, and what do an anchor and a history do about it?

    python benchmark/long_rollouts.py data/test --checkpoint bundled \
        --checkpoint runs/history/checkpoint --work runs/long_rollouts --out benchmark/results

Imagines whole episodes from their first frame, chunk on chunk, and prints J of the objects that
move by number of the chunk. A checkpoint that was trained with an anchor or a history is served in
every way that its training knew: as if each chunk were a rollout's first one (plain chaining),
with the rollout's first frame as the reference, and with the history on top. So one checkpoint
shows what each of them gives, with the same weights. Finished episodes are kept in --work.

A checkpoint with both, on from another one:

    mtv-world train data/train --preset small --init bundled --set history.num_frames=4 \
        --set history.reference=first_frame --out runs/history
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
import shlex
import sys
from typing import Any

from page import parse_arguments, publish, table
import torch

from mtv_world_ros.assembly import fingerprint, load_pipeline
from mtv_world_ros.data.splits import select
from mtv_world_ros.data_types import ByteArray, History
from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.files import write_json
from mtv_world_ros.lab.evaluation.evaluate_episodes import evaluate, Parallel
from mtv_world_ros.lab.evaluation.report.evaluation_summary import Summary
from mtv_world_ros.lab.evaluation.settings import EvaluationConfig
from mtv_world_ros.lab.training.training_run import spread
from mtv_world_ros.model.card import HistorySettings
from mtv_world_ros.model.world_model import DiffusionWorldModel
from mtv_world_ros.pipeline import Pipeline

PLAIN, ANCHOR, HISTORY = 'plain chaining', 'anchor', 'anchor + history'
WITHOUT_ANCHOR = 'history'


class Forgetful:
    """A world model that is told less of a rollout's past than it could take.

    Args:
        model: what predicts.
        way: what it is told: `PLAIN` nothing, `ANCHOR` the rollout's first frame alone, else all.
    """

    def __init__(self, model: DiffusionWorldModel, way: str) -> None:
        self.model, self.way, self.spec = model, way, model.spec

    def predict(
        self, start_frame: ByteArray, trajectory_frames: ByteArray, **options: Any
    ) -> ByteArray:
        """See `pipeline.WorldModel.predict`."""
        history: History | None = options.pop('history', None)
        if self.way == PLAIN:
            history = None
        elif self.way == ANCHOR and history is not None:
            history = replace(history, frames=history.frames[:, :0])
        return self.model.predict(start_frame, trajectory_frames, history=history, **options)


def ways(settings: HistorySettings) -> list[str]:
    """In which ways a model can be served."""
    if not settings.num_frames:
        return [PLAIN, ANCHOR] if settings.anchored else [PLAIN]
    return [PLAIN, ANCHOR, HISTORY] if settings.anchored else [PLAIN, WITHOUT_ANCHOR]


def load(checkpoint: str, way: str, **options: Any) -> Pipeline:
    """A pipeline around a checkpoint that is served in one way."""
    pipeline = load_pipeline(checkpoint, segmenter='colour', **options)
    assert isinstance(pipeline.world_model, DiffusionWorldModel)
    return replace(pipeline, world_model=Forgetful(pipeline.world_model, way))


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument('held_out', type=Path, help='folder of episodes')
    parser.add_argument('--checkpoint', action='append', required=True, help='may be repeated')
    parser.add_argument('--work', type=Path, required=True, help='keeps the scored episodes')
    parser.add_argument('--split', default='all')
    parser.add_argument('--episodes', type=int, help='so many, spread over all')
    parser.add_argument('--denoising-steps', type=int, default=0, help='0: those of the model')
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--dtype', default='auto')
    parser.add_argument('--threads', type=int, default=0)
    parser.add_argument('--workers', type=int, default=1, help='processes that score')


def score(checkpoint: str, options: argparse.Namespace) -> dict[str, Summary]:
    """Scores a checkpoint in every way that it can be served."""
    episodes = spread(select(options.held_out, options.split).paths, options.episodes)
    given = {'device': options.device, 'dtype': options.dtype, 'num_threads': options.threads}
    settings = load(checkpoint, PLAIN, **given).world_model.model.history  # type: ignore[attr-defined]
    found = {}
    for way in ways(settings):
        print(f'== {checkpoint}: {way}', flush=True)
        make: Callable[[], Pipeline] = partial(load, checkpoint, way, **given)
        name = f'{fingerprint(checkpoint)}, {way}'
        found[way] = evaluate(
            make(),
            episodes,
            options.work / ''.join(c if c.isalnum() else '_' for c in name),
            EvaluationConfig(
                mode='imagine',
                seed=options.seed,
                num_inference_steps=options.denoising_steps,
                actions=('true',),
                ceiling=False,
            ),
            name=name,
            label=way,
            parallel=Parallel(
                workers=options.workers, make_pipeline=make, threads=options.threads
            ),
        )
    return found


def rows(checkpoint: str, found: dict[str, Summary], num_chunks: int) -> list[list[str]]:
    """A row of the table for each way and view."""
    lines = []
    for way, summary in found.items():
        for view in [*summary.spec.views, None]:
            drawn = summary.chunk_curve(view)
            pairs = list(zip(drawn.values, drawn.band, strict=True))
            cells = [f'{value:.3f} [{low:.3f}, {high:.3f}]' for value, (low, high) in pairs]
            missing = ['–'] * (num_chunks - len(cells))
            lines.append([checkpoint, way, view or 'all', *cells, *missing])
    return lines


def body(scored: dict[str, dict[str, Summary]]) -> str:
    """What was measured, and the table."""
    summaries: Sequence[Summary] = [s for found in scored.values() for s in found.values()]
    first, num_chunks = summaries[0], max(s.num_chunks for s in summaries)
    lines = [line for name, found in scored.items() for line in rows(name, found, num_chunks)]
    steps = sorted({s.settings['num_inference_steps'] for s in summaries})
    return (
        f'J of the objects that move by chunk of {first.spec.num_frames} frames, chained from the '
        f"episode's first frame; {len(first.results)} episodes, denoising steps {steps}, masks by "
        'the colour segmenter; brackets: 95 % t intervals over episodes. Later chunks have fewer '
        'episodes.\n\n'
        + table(
            ['checkpoint', 'way', 'view', *(f'chunk {k + 1}' for k in range(num_chunks))], lines
        )
    )


def run(options: argparse.Namespace) -> None:
    """Scores and prints."""
    scored = {checkpoint: score(checkpoint, options) for checkpoint in options.checkpoint}
    numbers = {
        checkpoint: {way: summary.metrics() for way, summary in found.items()}
        for checkpoint, found in scored.items()
    }
    write_json(options.work / 'results.json', numbers)
    options.repeats = max(len(s.results) for found in scored.values() for s in found.values())
    publish(
        'long_rollouts',
        'Long rollouts: J by chunk',
        f'python {shlex.join(sys.argv)}',
        body(scored),
        options,
        f'torch {torch.__version__}',
    )


if __name__ == '__main__':
    try:
        run(parse_arguments(__doc__, 1, add_options))
    except MtvWorldError as error:
        sys.exit(f'long_rollouts: {error}')
