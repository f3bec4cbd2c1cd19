"""`mtv-world fit success`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.cli.evaluate import load_pipelines, say_failed
from mtv_world_ros.cli.shared_options import (
    add_options,
    device_here,
    open_checkpoints,
    provenance,
    refuse_for,
)
from mtv_world_ros.core.errors import ConfigError, MtvWorldError
from mtv_world_ros.core.files import check_free
from mtv_world_ros.core.writer_lock import only_writer

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.data.splits import Selection
    from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary
    from mtv_world_ros.evaluation.results import EpisodeResult
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.success.calibration import HorizonCurve
    from mtv_world_ros.success.fitted_to import FittedTo

_EPILOG = """\
Every episode is imagined as a whole from its first frame with its own commands; the success
estimate on the imagined frames is then fitted to the recorded outcomes. The checkpoint gets
success_calibration.json and horizon.json. With --no-foresight, a checkpoint that can foresee
object motion gets success_calibration_pictures.json and horizon_pictures.json; they are used
where no motion is foreseen. DIR gets calibration.md, reliability.html and calibration.json. Half
of the episodes should be failures: mtv-world collect --failures-of-ten 5.
Running the same command again continues an interrupted run. Exit status: 1 if an episode could
not be scored; it is not in the fit.
"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'success',
        help="fit a checkpoint's success estimate to recorded outcomes",
        epilog=_EPILOG,
    )
    parser.add_argument('checkpoint', help="folder, 'bundled' or 'bundled-paper'")
    parser.add_argument('dataset', type=Path, help='folder of episodes with outcomes')
    parser.add_argument(
        '--out', type=Path, required=True, metavar='DIR', help='folder of the results'
    )
    parser.add_argument(
        '--split', help="split of dataset.json, or 'all'; default: test where there is one"
    )
    parser.add_argument('--episodes', type=int, help='use only the first N episodes')
    add_options(parser, 'workers')
    parser.add_advanced(
        '--no-store',
        dest='store',
        action='store_false',
        help='write the report only; do not change the checkpoint',
    )
    add_options(parser, 'overwrite dtype seeds model serving segmenter task')
    parser.set_defaults(handler=_calibrate)


def _calibrate(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.data.splits import select

    (checkpoint,) = open_checkpoints(device_here(arguments), arguments.checkpoint)
    _check_places(arguments, checkpoint)
    selection = select(arguments.dataset, arguments.split, arguments.episodes)
    from mtv_world_ros.data.splits import refuse_test_kinds
    from mtv_world_ros.success.own_tasks import named_here

    print(f'{arguments.dataset}: {selection}')
    arguments.task = named_here(arguments.task, selection.paths)
    refuse_test_kinds(selection.paths, 'calibration')
    refuse_for(checkpoint, selection.paths, arguments)
    made = {**provenance(arguments), 'dataset': f'{arguments.dataset}: {selection}'}
    with only_writer(checkpoint.folder, '--checkpoint') if arguments.store else nullcontext():
        return _fit_and_store(arguments, checkpoint, selection, made)


def _fit_and_store(
    arguments: argparse.Namespace,
    checkpoint: Checkpoint,
    selection: Selection,
    made: dict[str, str],
) -> int:
    from mtv_world_ros.evaluation.evaluation_summary import TRAINING
    from mtv_world_ros.evaluation.fit import calibrate, samples_of
    from mtv_world_ros.reports.calibration_report import write_calibration_report
    from mtv_world_ros.success.calibration import save_fit

    runs = _imagine(arguments, checkpoint, selection)
    failed = say_failed([run.failed for run in runs])  # before what is too few is refused
    segmenter = str(runs[0].settings['segmenter'])
    made[TRAINING] = runs[0].provenance[TRAINING]
    print(f'checkpoint: {made[TRAINING]}')
    samples = samples_of(
        [run.results for run in runs],
        result_kinds(selection.paths),
        result_physics(selection.paths),
    )
    found = calibrate(samples, segmenter=segmenter, made=made)
    horizon = _horizon([run.results for run in runs], runs[0], made)
    text = write_calibration_report(arguments.out, found, horizon)
    if arguments.store:
        fitted_to, folder = _fitted_to(arguments, checkpoint, selection), checkpoint.folder
        stored = found.calibration.replace(fitted_to=fitted_to)
        of_pictures = _is_of_pictures(arguments, checkpoint)
        if horizon is not None:  # first: with the calibration the checkpoint counts as calibrated
            print(f'stored: {save_fit(folder, horizon, of_pictures=of_pictures)}')
        print(f'stored: {save_fit(folder, stored, of_pictures=of_pictures)}')
    print(text)
    return int(failed)


def _fitted_to(
    arguments: argparse.Namespace, checkpoint: Checkpoint, selection: Selection
) -> FittedTo:
    """Return the robot, foresight and cameras of the episodes; of those only that can be read."""
    from mtv_world_ros.data.episode_reader import read_episode
    from mtv_world_ros.success.fitted_to import FittedTo, Setting

    views, cameras = checkpoint.card.views, []
    for path in selection.paths:
        with suppress(MtvWorldError):  # was named when it was imagined
            cameras.append(tuple(read_episode(path, views=views).cameras.values()))
    robot = checkpoint.load_robot(arguments.robot)
    setting = Setting.of(robot, checkpoint.object_motion_digest)
    if not arguments.foresight:
        setting = setting.replace(foresight='')
    return FittedTo.episodes(setting, cameras)


def result_kinds(paths: Sequence[Path]) -> dict[str, tuple[str, ...]]:
    """Return the fault kinds of episodes of scripted policies, by name of the result.

    Raises:
        EpisodeError: the metadata of an episode cannot be used.
        PolicyError: a policy has an unknown fault.
    """
    from mtv_world_ros.data.splits import recorded_kinds
    from mtv_world_ros.evaluation.evaluate_episodes import result_names

    names = result_names(paths)
    return {names[path]: kinds for path, kinds in recorded_kinds(paths).items()}


def result_physics(paths: Sequence[Path]) -> dict[str, str]:
    """Return the physics of simulated episodes, by the names of their results."""
    from mtv_world_ros.data.episode_reader import read_info
    from mtv_world_ros.evaluation.evaluate_episodes import result_names

    names = result_names(paths)
    return {names[path]: read_info(path).physics for path in paths}


def _check_places(arguments: argparse.Namespace, checkpoint: Checkpoint) -> None:
    """Refuse to write into the installed package, and to replace an earlier calibration."""
    from mtv_world_ros.success.calibration import Calibration, fit_path

    check_free(arguments.out / 'calibration.json', arguments.overwrite)
    if not arguments.store:
        return
    folder = checkpoint.folder
    if checkpoint.is_bundled:
        raise ConfigError(
            f"'{checkpoint}' is part of the installed package, into which nothing is "
            f"written; copy it with 'cp -r {folder} DIR' and calibrate DIR, or give --no-store"
        )
    file = fit_path(folder, Calibration, of_pictures=_is_of_pictures(arguments, checkpoint))
    check_free(file, arguments.overwrite, 'checkpoint')


def _is_of_pictures(arguments: argparse.Namespace, checkpoint: Checkpoint) -> bool:
    """Return whether the fit is to rollouts without foreseen object motion."""
    robot = checkpoint.load_robot(arguments.robot)
    return not arguments.foresight and checkpoint.can_foresee(robot)


def _imagine(
    arguments: argparse.Namespace, checkpoint: Checkpoint, selection: Selection
) -> list[EvaluationSummary]:
    """Imagine and score the episodes once a seed."""
    from mtv_world_ros.evaluation.evaluate_episodes import evaluate
    from mtv_world_ros.evaluation.result_settings import fingerprint
    from mtv_world_ros.evaluation.settings import EvaluationConfig
    from mtv_world_ros.rollout.rollout import SEED_STEP

    pipeline, parallel = load_pipelines(arguments, checkpoint, calibrated=False)
    return [
        evaluate(
            pipeline,
            selection.paths,
            arguments.out / f'seed_{index}',
            EvaluationConfig(
                mode='imagine',
                seed=arguments.seed + SEED_STEP * index,
                num_inference_steps=arguments.steps,
                actions=('true',),
                ceiling=False,
                observed=True,
            ),
            name=fingerprint(
                checkpoint,
                calibrated=False,
                adapter=arguments.adapter,
                task=arguments.task,
            ),
            zero_shot=selection.zero_shot,
            provenance=provenance(arguments),
            trained_on=checkpoint.with_adapter(arguments.adapter).trained_episodes,
            parallel=parallel,
            overwrite=arguments.overwrite,
        )
        for index in range(arguments.seeds)
    ]


def _horizon(
    runs: Sequence[Sequence[EpisodeResult]], summary: EvaluationSummary, made: dict[str, str]
) -> HorizonCurve | None:
    """Return J of the objects that move against the horizon; None = nothing moves."""
    from mtv_world_ros.evaluation.metrics.horizon import horizon_curve
    from mtv_world_ros.success.calibration import HorizonCurve

    rows: dict[str, list] = {}
    for result in (result for run in runs for result in run):
        rows.setdefault(result.episode, []).extend(result.rows)
    found = horizon_curve(list(rows.values()), None, 'j_frames')
    if not found.values:
        return None
    return HorizonCurve(
        period_s=1 / summary.spec.fps,
        values=found.values,
        lower=tuple(low if isfinite(low) else 0.0 for low, _ in found.band),
        segmenter=str(summary.settings['segmenter']),
        num_episodes=len(rows),
        made=made,
    )
