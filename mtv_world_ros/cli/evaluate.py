"""`mtv-world evaluate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from mtv_world_ros.cli.options import add_dtype, add_model_options, add_segmenter, pipeline_of
from mtv_world_ros.cli.provenance import provenance


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command."""
    parser = commands.add_parser('evaluate', help='score a checkpoint on recorded episodes')
    parser.add_argument('checkpoint', help="folder, or 'bundled'")
    parser.add_argument('dataset', type=Path)
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--mode', choices=('observe', 'imagine'), default='observe')
    parser.add_argument('--episodes', type=int, help='use only the first so many')
    add_dtype(parser)
    add_model_options(parser)
    add_segmenter(parser)
    parser.set_defaults(handler=_evaluate)


def _evaluate(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.assembly import fingerprint
    from mtv_world_ros.evaluation.evaluate import evaluate
    from mtv_world_ros.evaluation.html_report import write_report
    from mtv_world_ros.training.run import find_episodes

    table = evaluate(
        pipeline_of(arguments),
        find_episodes(arguments.dataset)[: arguments.episodes],
        arguments.out,
        name=fingerprint(arguments.checkpoint),
        provenance={**provenance(arguments), 'dataset': str(arguments.dataset)},
        mode=arguments.mode,
        seed=arguments.seed,
        num_inference_steps=arguments.steps,
    )
    print(table)
    written = write_report([arguments.out], arguments.out / 'report.html')
    print(f'written: {written}')
    return 0
