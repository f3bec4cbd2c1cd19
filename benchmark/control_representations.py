"""Which way of telling the model the actions is best? The paper's four, on the same clips.

    python benchmark/control_representations.py TRAIN HELD_OUT --work runs/controls \
        --steps 20000 --batch-size 16 --device cuda --out benchmark/results

Trains every row from scratch on the same clips in the same order for the same steps with the same
transformer, scores each on held-out episodes, and prints one table: J, and J when the actions are
those of another episode, none, or mirrored. Running it again goes on where it was stopped: each
row resumes its training, scored episodes are kept. `--rows` takes some of them; rows that were
finished before are in the table too.

TRAIN and HELD_OUT are made with different seeds, e.g.

    mtv-world collect --task all --episodes 40 --seed 1000 --out data/train
    mtv-world collect --task all --episodes 4 --seed 9000 --out data/test
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
import json
from pathlib import Path
import shlex
import sys
from typing import Any

from control_tables import body, budget, Row, ROWS
from page import machine_line, publish
import torch

from mtv_world_ros.assembly import (
    assemble_segmenter,
    fingerprint,
    load_pipeline,
    robot_path,
)
from mtv_world_ros.data.splits import select
from mtv_world_ros.errors import ConfigError, MtvWorldError
from mtv_world_ros.files import plain, write_json
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.lab.cli.train import set_overrides
from mtv_world_ros.lab.evaluation.evaluate_episodes import evaluate, Parallel
from mtv_world_ros.lab.evaluation.references import ACTIONS
from mtv_world_ros.lab.evaluation.report.comparison import write_comparison
from mtv_world_ros.lab.evaluation.report.evaluation_summary import EvaluationSummary
from mtv_world_ros.lab.evaluation.report.tables import estimates_json
from mtv_world_ros.lab.evaluation.settings import EvaluationConfig
from mtv_world_ros.lab.training.training_config import (
    load_training_config,
    TrainingConfig,
    TrainingRun,
)
from mtv_world_ros.lab.training.training_run import spread, train
from mtv_world_ros.model.checkpoint import load_checkpoint


def parse() -> argparse.Namespace:
    """Reads the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('train', type=Path, help='folder of episodes to train on')
    parser.add_argument('held_out', type=Path, help='folder of episodes to score on')
    parser.add_argument('--work', type=Path, required=True, help='checkpoints and scores')
    parser.add_argument('--rows', default=','.join(ROWS), help='default: all of %(default)s')
    parser.add_argument('--preset', default='small')
    parser.add_argument('--steps', type=int, default=2000)
    parser.add_argument('--batch-size', type=int, default=4)
    parser.add_argument('--set', action='append', default=[], metavar='SECTION.KEY=VALUE')
    parser.add_argument('--split', default='all', help='of TRAIN')
    parser.add_argument('--held-out-split', default='all')
    parser.add_argument('--episodes', type=int, help='of TRAIN, spread over all')
    parser.add_argument('--held-out-episodes', type=int, help='of HELD_OUT, spread over all')
    parser.add_argument('--denoising-steps', type=int, default=1)
    parser.add_argument('--device', default='cpu')
    parser.add_argument('--dtype', default='auto')
    parser.add_argument('--threads', type=int, default=0)
    parser.add_argument('--workers', type=int, default=1, help='processes that score')
    parser.add_argument('--save-every', type=int, default=250)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--machine', default='', help='name of the machine on the page')
    parser.add_argument('--out', type=Path, help='folder for the page and its numbers')
    return parser.parse_args()


def config_of(row: Row, options: argparse.Namespace) -> TrainingConfig:
    """The preset with a row's changes."""
    overrides: dict[str, Any] = {
        'video.control': row.control,
        'video.object_mask': row.object_mask,
        'optimizer.steps': options.steps,
        'optimizer.batch_size': options.batch_size,
    }
    if row.views:
        overrides |= {'video.views': list(row.views), 'transformer.num_views': len(row.views)}
    return load_training_config(options.preset, overrides | set_overrides(options.set))


def train_row(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Trains a row, or goes on; returns what is known of it."""
    config, folder = config_of(ROWS[name], options), options.work / name
    file = folder / 'row.json'
    settings = plain({'config': config.model_dump(), 'seed': options.seed})
    if file.is_file():
        known = json.loads(file.read_text())
        if known['settings'] != settings:
            raise ConfigError(
                f"'{folder}' was trained with other settings; give the same ones, or another "
                '--work'
            )
        return known
    checkpoint = train(
        TrainingRun(
            config=config,
            dataset=tuple(select(options.train, options.split).paths),
            num_episodes=options.episodes,
            out=folder,
            seed=options.seed,
            device=options.device,
            dtype=options.dtype,
            save_every=options.save_every,
            cache=options.work / 'cache',
        ),
        robot=load_robot(robot_path(config.video.robot)),
        segmenter=assemble_segmenter('colour'),
    )
    log = [json.loads(line) for line in (folder / 'log.jsonl').read_text().splitlines()]
    found = {
        'settings': settings,
        'seconds': seconds_of(log),
        'loss': log[-1]['loss'],
        'parameters': sum(p.numel() for p in load_checkpoint(checkpoint).transformer.parameters()),
        'trained_on': json.loads((checkpoint / 'world_model.json').read_text())['trained_on'],
    }
    write_json(file, found)
    return found


def seconds_of(log: list[dict[str, Any]]) -> float:
    """Time of all sessions; each counts from zero."""
    seconds = [row['seconds'] for row in log]
    return sum(now for now, after in zip(seconds, [*seconds[1:], 0.0], strict=True) if after < now)


def score_row(name: str, options: argparse.Namespace) -> EvaluationSummary:
    """Scores a row's checkpoint with all kinds of actions."""
    checkpoint = options.work / name / 'checkpoint'
    load = partial(
        load_pipeline,
        checkpoint,
        device=options.device,
        dtype=options.dtype,
        segmenter='colour',
        num_threads=options.threads,
    )
    return evaluate(
        load(),
        spread(select(options.held_out, options.held_out_split).paths, options.held_out_episodes),
        options.work / name / 'scores',
        EvaluationConfig(
            seed=options.seed,
            num_inference_steps=options.denoising_steps,
            actions=ACTIONS,
            ceiling=False,
        ),
        name=fingerprint(checkpoint),
        label=ROWS[name].title,
        parallel=Parallel(workers=options.workers, make_pipeline=load, threads=options.threads),
    )


def wanted(text: str) -> list[str]:
    """Names of rows.

    Raises:
        ConfigError: one is unknown.
    """
    names = [name.strip() for name in text.split(',') if name.strip()]
    unknown = [name for name in names if name not in ROWS]
    if unknown or not names:
        raise ConfigError(f"--rows '{text}': known are {', '.join(ROWS)}")
    return names


def finished(options: argparse.Namespace, names: Sequence[str]) -> list[str]:
    """Rows asked for, and those that were finished before, in the table's order."""
    return [n for n in ROWS if n in names or (options.work / n / 'row.json').is_file()]


def run(options: argparse.Namespace) -> None:
    """Trains, scores, prints."""
    names = wanted(options.rows)
    if options.threads:
        torch.set_num_threads(options.threads)
    for name in names:
        print(f'== {ROWS[name].title}', flush=True)
        train_row(name, options)
        score_row(name, options)
    shown = finished(options, names)
    rows = {name: train_row(name, options) for name in shown}
    summaries = {name: score_row(name, options) for name in shown}
    write_comparison(list(summaries.values()), options.work / 'paper_tables')
    given = budget(options, rows, summaries[shown[0]])
    numbers = {
        name: {
            **asdict(ROWS[name]),
            **rows[name],
            'scores': {
                view or 'all': estimates_json(summary.estimates(view))
                for view in [*summary.spec.views, None]
            },
        }
        for name, summary in summaries.items()
    }
    result = {'budget': given, 'machine': machine_line(), 'rows': numbers}
    write_json(options.work / 'results.json', result)
    options.repeats = len(summaries[shown[0]].results)
    options.machine = options.machine or options.device
    if options.out is not None:
        write_json(options.out / f'control_representations_{options.machine}.json', result)
    publish(
        'control_representations',
        'Four ways of telling the model the actions',
        f'python {shlex.join(sys.argv)}',
        f'{given}\n\n{body(summaries, rows, options.seed)}',
        options,
        f'torch {torch.__version__}',
    )


if __name__ == '__main__':
    try:
        run(parse())
    except MtvWorldError as error:
        sys.exit(f'control_representations: {error}')
