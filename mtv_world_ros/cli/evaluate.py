"""`mtv-world evaluate`, and `report`, which writes the HTML report again."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from math import isfinite
from pathlib import Path
import re
import sys
from typing import Any, NamedTuple, TYPE_CHECKING

from mtv_world_ros.cli.shared_options import (
    add_options,
    device_here,
    names,
    open_checkpoints,
    pipeline_choices,
    provenance,
    refuse_for,
    workers_of,
)
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import check_free

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.data.splits import Selection
    from mtv_world_ros.evaluation.evaluate_episodes import Parallel
    from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.rollout.pipeline import Pipeline


_EPILOG = """\
DIR gets metrics.json, rows.csv, tables.md, numbers.csv, paper_tables.md and report.html. Several
checkpoints share the last three; the others of each are in DIR/NAME. Running the same command
again continues an interrupted run. Exit status: 1 if an episode could not be scored.
"""


def add(commands: Commands) -> None:
    """Add the command `evaluate`."""
    parser = commands.add_parser(
        'evaluate', help='score checkpoints on recorded episodes', epilog=_EPILOG
    )
    parser.add_argument(
        'checkpoints',
        nargs='+',
        metavar='CHECKPOINT',
        help="folder, 'bundled' or 'bundled-paper'; NAME=FOLDER names its row in the tables",
    )
    parser.add_argument('dataset', type=Path, help='folder of episodes')
    parser.add_argument(
        '--out', type=Path, required=True, metavar='DIR', help='folder of the results'
    )
    parser.add_advanced(
        '--mode',
        choices=('observe', 'imagine'),
        default='observe',
        help='begin each chunk at a real frame (observe, default), or at the frame imagined last',
    )
    parser.add_argument(
        '--split', help="split of dataset.json, or 'all'; default: test where there is one"
    )
    parser.add_argument('--episodes', type=int, help='use only the first N episodes')
    parser.add_advanced(
        '--physics',
        metavar='NAME',
        help='only the episodes that were collected with this physics; default: all, counted',
    )
    add_options(parser, 'workers')
    parser.add_advanced(
        '--actions',
        type=names,
        default=('true', 'shuffled'),
        metavar='LIST',
        help='what is imagined, of true,shuffled,zero; default: true,shuffled',
    )
    parser.add_advanced(
        '--no-ceiling',
        dest='ceiling',
        action='store_false',
        help='do not score the recorded frames themselves and through the autoencoder',
    )
    parser.add_advanced(
        '--truth',
        choices=('simulator', 'segmenter'),
        default='simulator',
        help="ground truth: the simulator's masks, where an episode has them, or the segmenter's "
        'masks of the recorded frames',
    )
    parser.add_advanced(
        '--quality',
        type=names,
        default=(),
        metavar='LIST',
        help='picture quality, any of psnr,ssim,lpips',
    )
    parser.add_advanced(
        '--fid-weights', type=Path, help='for FID: state dict of Inception-v3 of 2015-12-05'
    )
    parser.add_advanced('--fvd-weights', type=Path, help='for FVD: state dict of I3D')
    parser.add_advanced(
        '--no-report', dest='report', action='store_false', help='write no report.html'
    )
    add_options(parser, 'overwrite dtype model serving seeds describer segmenter source task')
    parser.set_defaults(handler=_evaluate)


class Entry(NamedTuple):
    """A checkpoint and its row in the tables.

    Attributes:
        path: folder, or `bundled`.
        label: name of the row.
        is_named: the user named it; else what it is trained on and with is added.
    """

    path: str
    label: str
    is_named: bool = False


def parse_entries(texts: list[str]) -> list[Entry]:
    """Return checkpoints by name; `NAME=FOLDER` gives the name, else the folder does.

    Raises:
        ConfigError: two are called alike, or one has no folder.
    """
    entries = []
    for text in texts:
        label, mark, path = text.partition('=')
        is_named = bool(mark) and not Path(text).is_dir()
        if is_named and not path:
            raise ConfigError(f"checkpoint '{text}' names no folder; give NAME=FOLDER")
        entries.append(Entry(path, label, True) if is_named else Entry(text, _label(text)))
    labels = [entry.label for entry in entries]
    doubled = [label for label in labels if labels.count(label) > 1]
    if doubled or '' in labels:
        raise ConfigError(
            f'checkpoints {", ".join(texts)}: {"two are" if doubled else "one is"} called '
            f"'{(doubled or [''])[0]}'; name them: NAME=FOLDER"
        )
    return entries


def _label(path: str) -> str:
    folder = Path(path)
    return folder.resolve().parent.name if folder.name == 'checkpoint' else folder.name


def _row(entry: Entry, pipeline: Pipeline) -> str:
    """Name of the row; an ablation of the paper says so."""
    kinds: list[str] = []
    if len(pipeline.spec.views) == 1:
        kinds.append('Single-View')
    kinds += pipeline.control.ablations
    if entry.is_named or not kinds:
        return entry.label
    return f'{entry.label} ({", ".join(kinds)})'


def _evaluate(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.data.splits import of_physics, select

    entries = parse_entries(arguments.checkpoints)
    checkpoints = open_checkpoints(device_here(arguments), *(entry.path for entry in entries))
    selection = select(arguments.dataset, arguments.split, arguments.episodes)
    selection, truth = of_physics(selection, arguments.physics)
    from mtv_world_ros.reports.comparison import write_comparison
    from mtv_world_ros.success.own_tasks import named_here

    arguments.task = named_here(arguments.task, selection.paths)
    for checkpoint in checkpoints:
        refuse_for(checkpoint, selection.paths, arguments)
    print(f'{arguments.dataset}: {selection}; physics: {truth}')
    alone = len(entries) == 1
    folders = [arguments.out if alone else arguments.out / _slug(e.label) for e in entries]
    summaries = [
        _score(arguments, entry, checkpoint, selection, truth, folder)
        for entry, checkpoint, folder in zip(entries, checkpoints, folders, strict=True)
    ]
    write_comparison(summaries, arguments.out)
    for entry, summary in zip(entries, summaries, strict=True):
        print(f'{entry.label}: {summary.following.line}; {in_short(summary)}')
        if summary.dreams.line:
            print(f'{entry.label}: {summary.dreams.line}')
    print(f'tables: {" ".join(str(folder / "tables.md") for folder in folders)}')
    if arguments.report:
        from mtv_world_ros.reports.evaluation_page import write_report

        print(f'report: {write_report(folders, arguments.out / "report.html")}')
    return int(say_failed([summary.failed for summary in summaries]))


def say_failed(failed: Sequence[Mapping[str, str]]) -> bool:
    """Write which episodes have no result and why, once each, to standard error."""
    lines = dict.fromkeys(
        f'mtv-world: {episode} was not scored: {reason}\n'
        for run in failed
        for episode, reason in run.items()
    )
    sys.stderr.write(''.join(lines))
    return bool(lines)


#: (number, words, the same of what knows nothing): the first that was measured is shown
_J = (
    ('j_moving', 'J of moving objects', 'j_copy_moving'),
    ('j_object_mean', 'J of objects', 'j_copy_mean'),
)
#: J that what moves in imagination alone lowers, too
_EITHER = 'j_moving_either'


def in_short(summary: EvaluationSummary) -> str:
    """Return the one line of an evaluation that is printed; all else is in its report."""
    from mtv_world_ros.core.documents import number
    from mtv_world_ros.evaluation.evaluation_summary import TRAINING
    from mtv_world_ros.evaluation.metrics.statistics import MIN_EPISODES
    from mtv_world_ros.evaluation.tables import cell

    numbers, count = summary.estimates(None), len(summary.results)
    said = [
        f'{words} {cell(numbers[key])} (first frame held: {cell(numbers[held])})'
        for key, words, held in _J
        if isfinite(numbers[key].value)
    ][:1]
    if isfinite(numbers[_EITHER].value):
        said.append(f'of those that move in truth or imagination {cell(numbers[_EITHER])}')
    pictures = summary.pictures[None]
    if 'psnr' in pictures:
        psnr, held = (number(pictures[key].value, 1) for key in ('psnr', 'psnr_held'))
        said.append(f'PSNR {psnr} dB (first frame held: {held} dB)')
    said = said or ['no object was found and no picture compared']
    few = f'; no intervals below {MIN_EPISODES} episodes' if count < MIN_EPISODES else ''
    failed = len(summary.failed)
    lost = f'; {failed} episodes failed, see the report' if failed else ''
    training = summary.provenance.get(TRAINING, '')
    seen = f', {training}' if training else ''
    return f'{", ".join(said)}, {count} episode{"s" * (count > 1)}{seen}{few}{lost}'


def _slug(label: str) -> str:
    return re.sub(r'[^\w.-]+', '_', label).strip('.') or '_'


def load_pipelines(
    arguments: argparse.Namespace, checkpoint: Checkpoint, **options: Any
) -> tuple[Pipeline, Parallel]:
    """Return the pipeline of this process, the workers, and the factory of their pipelines."""
    from mtv_world_ros.evaluation.evaluate_episodes import Parallel
    from mtv_world_ros.rollout.pipeline import Pipeline

    workers = workers_of(arguments, checkpoint.folder, arguments.dataset)
    load = partial(Pipeline.load, checkpoint, **pipeline_choices(arguments) | options)
    pipeline = load(num_threads=arguments.threads, device=device_here(arguments))
    make = partial(load, num_threads=workers.num_threads)
    return pipeline, Parallel(workers=workers, make_pipeline=make)


def _score(
    arguments: argparse.Namespace,
    entry: Entry,
    checkpoint: Checkpoint,
    selection: Selection,
    truth: str,
    out: Path,
) -> EvaluationSummary:
    from mtv_world_ros.data.bag_mapping import load_source
    from mtv_world_ros.evaluation.evaluate_episodes import evaluate
    from mtv_world_ros.evaluation.result_settings import fingerprint
    from mtv_world_ros.evaluation.settings import EvaluationConfig
    from mtv_world_ros.rollout.assembly import asked_describer

    pipeline, parallel = load_pipelines(arguments, checkpoint)
    return evaluate(
        pipeline,
        selection.paths,
        out,
        EvaluationConfig(
            mode=arguments.mode,
            seed=arguments.seed,
            num_seeds=arguments.seeds,
            num_inference_steps=arguments.steps,
            actions=arguments.actions,
            ceiling=arguments.ceiling,
            use_ids=arguments.truth == 'simulator',
            quality=arguments.quality,
            fid_weights=arguments.fid_weights,
            fvd_weights=arguments.fvd_weights,
            source=load_source(arguments.topics, arguments.calibration),
        ),
        name=fingerprint(checkpoint, adapter=arguments.adapter, task=arguments.task),
        label=_row(entry, pipeline),
        zero_shot=selection.zero_shot,
        provenance={
            **provenance(arguments),
            'dataset': f'{arguments.dataset}: {selection}',
            'physics': truth,
        },
        trained_on=checkpoint.with_adapter(arguments.adapter).trained_episodes,
        parallel=parallel,
        describer=asked_describer(arguments.describer),
        overwrite=arguments.overwrite,
    )


def add_report(commands: Commands) -> None:
    """Add the command `export report`."""
    parser = commands.add_parser(
        'report', help='write the HTML report of one or several evaluations again'
    )
    parser.add_argument(
        'evaluations', type=Path, nargs='+', help="folders that 'mtv-world evaluate --out' wrote"
    )
    parser.add_argument(
        '--out', type=Path, help="HTML file; default: the evaluation's report.html, written anew"
    )
    add_options(parser, 'overwrite')
    parser.set_defaults(handler=_report)


def _report(arguments: argparse.Namespace) -> int:
    first, *others = arguments.evaluations
    if others and arguments.out is None:
        raise ConfigError(
            f'{1 + len(others)} evaluations go into one page; give --out FILE: the page of '
            f"'{first}' stays as it is"
        )
    if arguments.out is not None:
        check_free(arguments.out, arguments.overwrite)
    from mtv_world_ros.reports.read_back import check_evaluation

    for folder in arguments.evaluations:
        check_evaluation(folder)
    from mtv_world_ros.reports.evaluation_page import write_report

    path = arguments.out or first / 'report.html'
    print(f'written: {write_report(arguments.evaluations, path)}')
    return 0
