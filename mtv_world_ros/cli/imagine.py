"""`mtv-world replay` and `imagine`: whole episodes, from commands or by a policy."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from mtv_world_ros.cli.bundled_help import policies
from mtv_world_ros.cli.imagine_table import (
    add_options_of_tables,
    imagine_table,
    is_asked_for,
)
from mtv_world_ros.cli.shared_options import (
    add_options,
    add_watch,
    device_here,
    open_checkpoints,
    pipeline_choices,
    pipeline_of,
    refuse_for,
    watch_arguments,
    workers_of,
)
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import check_free

if TYPE_CHECKING:
    from mtv_world_ros.cli.parser import Commands
    from mtv_world_ros.core.workers import Workers
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.rollout.episode_viewer import EpisodeViewer
    from mtv_world_ros.rollout.imagined_episodes import EpisodeStart
    from mtv_world_ros.rollout.pipeline import Pipeline

#: ends of an episode that are no fault
GOOD_ENDS = ('done', 'max_chunks', 'max_seconds')


def add_replay(commands: Commands) -> None:
    """Add the command `replay`."""
    parser = commands.add_parser(
        'replay',
        help='play an episode into ROS topics, or imagine it offline (MCAP to MCAP)',
        epilog='Without --offline it takes the options of the ROS player (--rate, --loop, '
        '--clock, --lock-step, ...): see python -m mtv_world_ros.ros.bags.player --help. '
        'Exit status: 1 if a plan was rejected, failed or got no answer.',
        allow_abbrev=False,
    )
    parser.add_argument('episode', type=Path, help='folder of the episode')
    parser.add_argument(
        '--offline', action='store_true', help='imagine it without ROS, as fast as possible'
    )
    parser.add_argument('--out', type=Path, help='folder for the predictions (with --offline)')
    add_options(parser, 'overwrite source checkpoint dtype model describer segmenter serving task')
    parser.set_defaults(
        handler=_replay,
        takes_more=lambda chosen, _: not chosen.offline,
        default_out=_default_out,
    )


def _default_out(arguments: argparse.Namespace) -> Path | None:
    name = arguments.episode.resolve().name
    return Path('out') / f'{name}_predictions' if arguments.offline else None


def _replay(arguments: argparse.Namespace) -> int:
    if not arguments.offline:
        return _play(arguments)
    if not arguments.episode.exists():
        raise EpisodeError(f"there is no episode '{arguments.episode}'")
    from mtv_world_ros.data.bag_mapping import load_source
    from mtv_world_ros.rollout.assembly import asked_describer
    from mtv_world_ros.rollout.offline import replay_offline
    from mtv_world_ros.success.own_tasks import named_here

    (arguments.checkpoint,) = open_checkpoints(arguments.device, arguments.checkpoint)
    arguments.task = named_here(arguments.task, [arguments.episode])
    refuse_for(arguments.checkpoint, [arguments.episode], arguments)
    out = arguments.out or _default_out(arguments)
    assert out is not None
    check_free(out, arguments.overwrite)
    summary = replay_offline(
        replace(pipeline_of(arguments), describer=asked_describer(arguments.describer)),
        arguments.episode,
        out,
        source=load_source(arguments.topics, arguments.calibration),
        seed=arguments.seed,
        num_inference_steps=arguments.steps,
        overwrite=arguments.overwrite,
    )
    from mtv_world_ros.viewing.sheets import write_pictures

    pictures = write_pictures([out], out)
    print(summary)
    print(f'written: {" ".join(map(str, pictures))}')
    if summary.rejected:
        num_plans = len(summary.rejected) + summary.num_trajectories
        sys.stderr.write(
            f'mtv-world: {len(summary.rejected)} of {num_plans} plans were not imagined, the '
            f'first: {summary.rejected[0][1]}\n'
        )
    return int(bool(summary.rejected))


def _play(arguments: argparse.Namespace) -> int:
    import runpy

    from mtv_world_ros.core.progress import Progress

    Progress.num_shown += 1  # the player logs what it does: it is not loading any more
    sys.argv = ['mtv-world replay', str(arguments.episode), *arguments.ros]
    runpy.run_module('mtv_world_ros.ros.bags.player', run_name='__main__')
    return 0


def add_imagine(commands: Commands) -> None:
    """Add the command `imagine`."""
    parser = commands.add_parser(
        'imagine',
        help='run a policy for whole episodes in the world model',
        epilog='With --live, --ros-args and what follows rename topics (-r FROM:=TO) and set '
        'parameters (-p NAME:=VALUE): see docs/policies.md.',
    )
    parser.add_argument(
        '--policy',
        default='scripted',
        help=f'YAML file, name of a bundled one ({policies()}; recorded: the commands of '
        '--episodes), or a scripted policy such as expert-miss-0.5',
    )
    parser.add_argument(
        '--episodes',
        type=Path,
        nargs='+',
        default=[],
        help='recorded episodes that imagination starts from, or a folder of them',
    )
    parser.add_argument('--live', action='store_true', help='start from what the cameras show now')
    parser.add_argument(
        '--count', type=int, default=0, help='number of episodes; default: each once'
    )
    parser.add_advanced(
        '--max-chunks',
        type=int,
        default=0,
        help='largest number of chunks an episode; 0 = no limit',
    )
    parser.add_argument(
        '--candidates',
        type=int,
        default=1,
        metavar='N',
        help='ask the policy for N plans (seeds) when an episode begins, and imagine the one that '
        'is best in simulated futures; default: 1',
    )
    parser.add_argument(
        '--instruction', default='', help="text for the robot; default: the recorded episode's"
    )
    parser.add_argument(
        '--place',
        help='name of the robot cell, as in `mtv-world fit contact --place`; default: what the '
        'recording states; with --live the parameter `place`',
    )
    parser.add_argument(
        '--out',
        type=Path,
        default=Path('out/imagine'),
        help='folder of the results; default: out/imagine',
    )
    parser.add_advanced(
        '--no-video', dest='video', action='store_false', help='write no comparison.mp4'
    )
    add_options_of_tables(parser)
    add_watch(parser, 'every episode')
    add_options(parser, 'overwrite checkpoint workers model describer segmenter task')
    parser.set_defaults(
        handler=_imagine,
        takes_more=lambda chosen, more: chosen.live and more[0] == '--ros-args',
    )


def _imagine(arguments: argparse.Namespace) -> int:
    from mtv_world_ros.core.errors import ConfigError
    from mtv_world_ros.data.splits import find_episodes

    is_table = is_asked_for(arguments)
    workers = workers_of(arguments, arguments.checkpoint, *arguments.episodes)
    if not workers.are_here and (is_table or arguments.live or arguments.watch is not None):
        raise ConfigError(
            '--live, --watch and a table of joints are of one process; leave them out, or '
            '--workers and --ray'
        )
    if is_table:
        return imagine_table(arguments)
    (arguments.checkpoint,) = open_checkpoints(device_here(arguments), arguments.checkpoint)
    watch_arguments(arguments)
    for folder in arguments.episodes:
        if not folder.exists():
            raise EpisodeError(f"there is no episode '{folder}'")
    episodes = [path for folder in arguments.episodes for path in find_episodes(folder)]
    if bool(episodes) == arguments.live:
        raise ConfigError(
            'give --episodes with recorded episodes to start from, --live to start from the '
            'cameras, or --image and --joints to imagine a table of joints; --episodes has '
            f'{len(episodes)}'
        )
    results = _in_world_model(arguments, episodes, workers)
    from mtv_world_ros.viewing.sheets import write_pictures

    for result in results:
        if int(str(result['num_chunks'])) and Path(str(result['bag'])).is_dir():
            bag = Path(str(result['bag']))
            write_pictures([bag], bag, has_video=arguments.video)
    print('\n'.join(episode_table(results)))
    print(f'look at them: mtv-world view {arguments.out}')
    failed = [result for result in results if result['how'] not in GOOD_ENDS]
    for result in failed:
        why = str(result['text']).strip().splitlines() or ['no reason was given']
        sys.stderr.write(
            f'mtv-world: episode {result["episode"]} failed: {result["how"]}: {why[-1]}\n'
        )
    return int(bool(failed))


def _in_world_model(
    arguments: argparse.Namespace, episodes: Sequence[Path], workers: Workers
) -> Sequence[Mapping[str, object]]:
    """Run the policy from recorded frames, or from what the cameras show."""
    from mtv_world_ros.core.errors import MtvWorldError
    from mtv_world_ros.rollout.assembly import asked_describer
    from mtv_world_ros.rollout.imagined_episodes import (
        check_recording,
        EpisodeOptions,
        imagine_episodes,
        imagine_recorded,
        RecordedSource,
    )
    from mtv_world_ros.success.own_tasks import named_here

    # a wrong name is an error here, before anything is loaded or removed
    robot = arguments.checkpoint.load_robot(arguments.robot)
    check_recording(arguments.policy, robot, is_recorded=not arguments.live)
    for bag in sorted(arguments.out.glob('episode_*')):
        check_free(bag, arguments.overwrite)
    arguments.task = named_here(arguments.task, episodes)
    if episodes:
        refuse_for(arguments.checkpoint, episodes, arguments)
    options = EpisodeOptions(
        policy=arguments.policy,
        count=arguments.count or len(episodes) or 1,
        max_chunks=arguments.max_chunks,
        instruction=arguments.instruction,
        seed=arguments.seed,
        num_inference_steps=arguments.steps,
        num_candidates=arguments.candidates,
    )
    source = RecordedSource(paths=episodes, place=arguments.place)
    if not workers.are_here:
        make = partial(_described_pipeline, arguments.checkpoint, workers.num_threads,
                       arguments.describer, pipeline_choices(arguments))  # fmt: skip
        return imagine_recorded(
            make, options, source, arguments.out, workers, overwrite=arguments.overwrite
        )
    describer = asked_describer(arguments.describer)
    pipeline = replace(pipeline_of(arguments), describer=describer)
    starts = _live_starts(arguments, pipeline) if arguments.live else source.starts(pipeline)
    viewer = _viewer(arguments)
    watched = {'on_start': viewer.begin, 'on_chunk': viewer.add} if viewer else {}
    results = imagine_episodes(
        pipeline, options, starts, arguments.out, overwrite=arguments.overwrite, **watched
    )
    if viewer:
        try:
            viewer.close()
        except MtvWorldError as error:  # the episodes are there
            sys.stderr.write(f'mtv-world: {error}\n')
    return results


def _described_pipeline(
    checkpoint: Checkpoint, threads: int, describer: Path | None, choices: Mapping[str, Any]
) -> Pipeline:
    """Return the pipeline of a worker, with what names the objects."""
    from mtv_world_ros.rollout.assembly import asked_describer
    from mtv_world_ros.rollout.pipeline import Pipeline

    pipeline = Pipeline.load(checkpoint, num_threads=threads, **choices)
    return replace(pipeline, describer=asked_describer(describer))


def _live_starts(arguments: argparse.Namespace, pipeline: Pipeline) -> Iterator[EpisodeStart]:
    """Return what the cameras show at the start of each episode."""
    from mtv_world_ros.ros.sensing.live_start import live_starts

    starts = live_starts(
        pipeline.spec,
        pipeline.robot,
        arguments.checkpoint.cameras_file,
        arguments.ros,
        tell=partial(print, flush=True),
    )
    place = arguments.place
    return starts if place is None else (start.at_place(place) for start in starts)


def _viewer(arguments: argparse.Namespace) -> EpisodeViewer | None:
    """Return the viewer of `--watch`; prints its address."""
    if arguments.watch is None:
        return None
    from mtv_world_ros.rollout.episode_viewer import EpisodeViewer
    from mtv_world_ros.viewing import rerun_log

    watch, stream = arguments.watch, rerun_log.recording('imagine')
    print(rerun_log.open_viewer(stream, None, watch.address, watch.file, False), flush=True)
    return EpisodeViewer(stream, watch.file)


def episode_table(results: Sequence[Mapping[str, object]]) -> list[str]:
    """Return a table of the episodes: estimate, reasons, success rate."""
    lines = ['episode  end            chunks  estimate         verdict   seconds  bag']
    for result in results:
        low, value, high = (result[f'success{end}'] for end in ('_low', '', '_high'))
        estimate = '-' if value is None else f'{value:.2f} [{low:.2f} {high:.2f}]'
        lines.append(
            f'{result["episode"]:>7}  {result["how"]:<13}  {result["num_chunks"]:>6}  '
            f'{estimate:<15}  {result["verdict"]:<8}  {result["episode_s"]:>7}  {result["bag"]}'
        )
        if 'choice' in result:
            lines.append(f'         {result["choice"]}')
        lines += [f'         {reason}' for reason in str(result['reasons']).split('; ') if reason]
    return [*lines, _success_rate([str(result['verdict']) for result in results])]


def _success_rate(verdicts: Sequence[str]) -> str:
    """Return the share of successes among the verdicts, with Wilson's 95 % interval."""
    hits, count = verdicts.count('success'), sum(v in ('success', 'failure') for v in verdicts)
    without = len(verdicts) - count
    rest = f'; {without} without a verdict (open, or the estimate abstains)' if without else ''
    if not count:
        return f'success rate: no verdict in {len(verdicts)} episodes'
    from scipy.stats import binomtest

    low, high = binomtest(hits, count).proportion_ci(method='wilson')
    return f'success rate: {hits} of {count} = {hits / count:.2f} [{low:.2f} {high:.2f}]{rest}'
