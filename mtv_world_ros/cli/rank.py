"""`mtv-world rank`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from hashlib import sha256
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from mtv_world_ros.cli.faults import ListFaults
from mtv_world_ros.cli.physics_option import add_physics, physics_text
from mtv_world_ros.cli.shared_options import (
    add_options,
    add_watch,
    device_here,
    open_checkpoints,
    pipeline_choices,
    provenance,
    watch_arguments,
    workers_of,
)
from mtv_world_ros.core.errors import ConfigError, PolicyError

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.ranking.jobs import Job
    from mtv_world_ros.ranking.policy_list import ListedPolicy
    from mtv_world_ros.ranking.run_jobs import RankedCheckpoint
    from mtv_world_ros.reports.shown_rankings import LiveRanking
    from mtv_world_ros.robot.model import RobotModel

_DESCRIPTION = """\
Run policies on the same episodes in the simulator and in imagination, and measure how well the two
agree. DIR gets the report (ranking.html, ranking.md, ranking.json), flips.png (six commands that
change the outcome, real and imagined) and the folder rollouts: result, last frames and video of
each rollout. The same command continues a ranking that was stopped.
"""
_EPILOG = """\
A scripted policy is `expert`, followed by faults with their sizes, e.g.
expert-joint_noise-0.03-gripper_delay-0.3; mtv-world rank --list-faults prints all kinds. By
default one denoising step. Logs of the policy servers that a file starts go to DIR/logs.
"""


def add(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        'rank',
        help='rank policies in imagination, and compare with the simulator',
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    parser.add_advanced(
        '--list-faults',
        action=ListFaults,
        nargs='?',
        metavar='KINDS',
        help='print fault kinds and what their sizes mean, then exit: those of a split (train, '
        'calibrate, test), of drawn:SEED, or comma-separated names; default: all',
    )
    policies = parser.add_mutually_exclusive_group()
    policies.add_argument(
        '--policies',
        metavar='LIST|FILE',
        help='scripted policies, comma-separated, or a YAML file of any policies, like '
        'config/rankings/example.yaml; default: ten scripted ones',
    )
    policies.add_argument(
        '--faults',
        type=_fault_set,
        metavar='{train,calibrate,test,drawn:SEED}',
        help='rank the expert and each fault kind of a split at a small and a large size (the '
        'optimism benchmark); kinds of test are in no training and no calibration; drawn:SEED '
        'composes new kinds',
    )
    parser.add_argument(
        '--tasks',
        metavar='LIST',
        help='names of tasks, or YAML files with a scene, comma-separated; default: three, with '
        '--faults six',
    )
    parser.add_argument('--episodes', type=int, default=10, help='number of scenes of each task')
    parser.add_argument(
        '--out', type=Path, required=True, metavar='DIR', help='folder of the results'
    )
    parser.add_advanced(
        '--compare',
        metavar='CHECKPOINT',
        help='a second checkpoint that is ranked, too; every rollout is simulated once. Its own '
        'ranking goes to DIR/compared',
    )
    add_options(parser, 'workers')
    parser.add_advanced(
        '--true-episodes',
        type=int,
        default=5,
        metavar='M',
        help='number of episodes of each task whose true outcomes the prediction-powered rates '
        'use; default: 5',
    )
    parser.add_advanced(
        '--max-chunks',
        type=int,
        default=8,
        help='largest number of answers of a policy in an episode',
    )
    parser.add_advanced(
        '--hold',
        type=int,
        default=0,
        metavar='N',
        help='end an episode also when the task is done, or the estimate abstains, after N '
        'answers in a row; default: only the policy and --max-chunks end it',
    )
    parser.add_advanced(
        '--no-video',
        '--no-clips',
        dest='clips',
        action='store_false',
        help='keep the last frames of each rollout alone, without a video to play: faster',
    )
    add_watch(parser, 'rates so far and every rollout that has ended')
    add_physics(parser)
    add_options(parser, 'overwrite checkpoint dtype model describer segmenter serving')
    parser.set_defaults(handler=_rank, steps=1)


def _rank(arguments: argparse.Namespace) -> int:
    names, truth = _names(arguments), physics_text(arguments.physics)
    opened = open_checkpoints(device_here(arguments), *names)
    watched = watch_arguments(arguments, _recording_name(arguments))
    if watched and not arguments.clips:
        raise ConfigError('--watch shows what --no-video leaves out; give one of them')
    robot = opened[0].load_robot(arguments.robot)
    listed = _listed(arguments, robot)
    jobs = _jobs(arguments, listed, robot)
    from mtv_world_ros.core.images import write_png
    from mtv_world_ros.ranking.episode_runner import RunnerConfig
    from mtv_world_ros.ranking.flips import flip_sheet
    from mtv_world_ros.ranking.policy_list import ListedPolicies
    from mtv_world_ros.ranking.ranking_summary import Optimism, Summary
    from mtv_world_ros.ranking.run_jobs import FOLDER, run_jobs
    from mtv_world_ros.reports.ranking_report import console, write_ranking

    folders = [arguments.out, arguments.out / 'compared'][: len(names)]
    checkpoints = [_ranked(arguments, one, out) for one, out in zip(opened, folders, strict=True)]
    config = RunnerConfig(
        num_inference_steps=arguments.steps,
        max_chunks=arguments.max_chunks,
        hold=arguments.hold,
        clips=arguments.clips,
        physics=arguments.physics,
    )
    if listed:
        policies = ListedPolicies(listed, (arguments.out / 'logs').absolute())
        config = replace(config, make_policy=policies)
    viewer = _viewer(arguments)
    found, failed = run_jobs(
        jobs,
        checkpoints,
        config=config,
        workers=workers_of(arguments, *(one.folder for one in opened)),
        overwrite=arguments.overwrite,
        watch=viewer.add if viewer else lambda _: None,
    )
    # the benchmark of faults is about policies whose names say their faults
    optimism = {
        name: Optimism.of(results, out / FOLDER)
        for name, out, results in zip(names, folders, found, strict=True)
        if not listed
    }
    summaries = [
        Summary(
            results=results,
            failed=failed,
            num_true=arguments.true_episodes,
            provenance={
                **provenance(arguments),
                'checkpoint': checkpoint.settings['checkpoint'],
                'physics': truth,
            },
            # the first report has all checkpoints side by side
            optimism={k: v for k, v in optimism.items() if number == 0 or k == names[number]},
        )
        for number, (results, checkpoint) in enumerate(zip(found, checkpoints, strict=True))
    ]
    path, *_ = [
        write_ranking(summary, out) for summary, out in zip(summaries, folders, strict=True)
    ]
    for name, out, results in zip(names, folders, found, strict=True):
        if name not in optimism:
            continue
        sheet = flip_sheet(results, optimism[name].flips, out / FOLDER)
        if sheet is not None:
            write_png(out / 'flips.png', sheet)
    print(f'{console(summaries[0])}\n\nreport: {path}')
    for job, reason in failed.items():
        sys.stderr.write(f'mtv-world: {job.name} has no result: {reason}\n')
    return int(bool(failed))


def _viewer(arguments: argparse.Namespace) -> LiveRanking | None:
    """Return the viewer of `--watch`; prints its address."""
    if arguments.watch is None:
        return None
    from mtv_world_ros.reports.shown_rankings import LiveRanking
    from mtv_world_ros.viewing import rerun_log

    stream = rerun_log.recording(_recording_name(arguments))
    watch = arguments.watch
    print(rerun_log.open_viewer(stream, None, watch.address, watch.file, False), flush=True)
    return LiveRanking(stream, arguments.out, watch.file)


def _recording_name(arguments: argparse.Namespace) -> str:
    """Return the name of the viewer's recording: that of the ranking in `--out`."""
    folder = str(arguments.out.resolve())
    return f'ranking {sha256(folder.encode(errors="surrogateescape")).hexdigest()[:16]}'


def _names(arguments: argparse.Namespace) -> list[str]:
    """Return the checkpoints to rank with: one, or two with `--compare`."""
    if arguments.true_episodes < 0:
        raise ConfigError(f'--true-episodes is {arguments.true_episodes}; it must be 0 or more')
    names = [arguments.checkpoint, *([arguments.compare] if arguments.compare else [])]
    if len(set(names)) < len(names):
        raise ConfigError(f"--compare is '{arguments.compare}', as --checkpoint; give another one")
    return names


def _ranked(arguments: argparse.Namespace, checkpoint: Checkpoint, out: Path) -> RankedCheckpoint:
    from mtv_world_ros.ranking.run_jobs import RankedCheckpoint
    from mtv_world_ros.rollout.pipeline import Pipeline

    make_pipeline = partial(
        Pipeline.load,
        checkpoint,
        num_threads=workers_of(arguments).num_threads,
        describer=arguments.describer,
        **pipeline_choices(arguments),
    )
    settings = _settings(arguments, checkpoint)
    return RankedCheckpoint(make_pipeline=make_pipeline, out=out, settings=settings)


def _listed(arguments: argparse.Namespace, robot: RobotModel) -> tuple[ListedPolicy, ...]:
    """Return the policies of a file; none where `--policies` is a comma-separated list."""
    from mtv_world_ros.ranking.policy_list import check_single_clients, load_policy_list

    path = Path(arguments.policies or '')
    if path.suffix not in ('.yaml', '.yml'):
        return ()
    listed = load_policy_list(path, robot)
    check_single_clients(listed, arguments.workers)
    return listed


def _fault_set(text: str) -> str:
    from mtv_world_ros.simulation.faults.catalogue import kinds_of

    try:
        kinds_of(text)
    except PolicyError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def _jobs(
    arguments: argparse.Namespace, listed: Sequence[ListedPolicy], robot: RobotModel
) -> list[Job]:
    from mtv_world_ros.ranking.jobs import (
        BENCHMARK_TASKS,
        DEFAULT_POLICIES,
        DEFAULT_TASKS,
        make_jobs,
        policies_named,
    )
    from mtv_world_ros.ranking.policy_list import check_tasks, tasks_of
    from mtv_world_ros.simulation.expert.expert import Expert
    from mtv_world_ros.simulation.faults.catalogue import policies_of
    from mtv_world_ros.simulation.scenes.tasks import tasks_named

    policies, names = DEFAULT_POLICIES, DEFAULT_TASKS
    if listed:
        policies = tuple(policy.name for policy in listed)
    elif arguments.policies is not None:
        policies = policies_named(arguments.policies)
    elif arguments.faults is not None:
        policies, names = policies_of(arguments.faults), BENCHMARK_TASKS
    tasks = tasks_named(arguments.tasks or ','.join(names))
    if listed and not arguments.tasks:
        tasks = tasks_of(listed, tasks)
    check_tasks(listed, tasks)
    expert = Expert(robot, physics=arguments.physics)
    jobs = make_jobs(policies, tasks, arguments.episodes, arguments.seed, expert)
    if listed:
        of = {policy.name: policy for policy in listed}
        jobs = [
            replace(job, definition=of[job.policy].definition)
            for job in jobs
            if job.task in {task.name for task in of[job.policy].tasks or tasks}
        ]
    print(f'{len(policies)} policies, {len(tasks)} tasks, {len(jobs)} rollouts in each world')
    return jobs


def _settings(arguments: argparse.Namespace, checkpoint: Checkpoint) -> dict[str, str]:
    """Return the settings that rollouts depend on: with other settings they are run again."""
    from mtv_world_ros.core.files import content_digest, share_path
    from mtv_world_ros.data.episode import NOMINAL
    from mtv_world_ros.evaluation.result_settings import fingerprint
    from mtv_world_ros.importing.stored_objects import stage_key

    settings = {
        'checkpoint': fingerprint(checkpoint),
        'task files': f'({content_digest(share_path("config", "tasks"))[:8]})',
        'robot': arguments.robot or '',
        'segmenter': arguments.segmenter,
        **({} if arguments.physics == NOMINAL else {'physics': arguments.physics}),
    }
    if arguments.describer:
        settings['describer'] = sha256(stage_key(arguments.describer, '')).hexdigest()[:8]
    return settings
