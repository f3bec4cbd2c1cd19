"""Runs world model, policy and episode runner as processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
import os
from pathlib import Path
import re
import subprocess
import time
from typing import Any

from tqdm import tqdm

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.processes import (
    how_it_ended,
    module_command,
    ros_arguments,
    start_process,
    stop_process,
    StoppedProcesses,
)
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.rollout.imagined_episodes import check_start, clear_episodes

#: the start images stay valid while the policy computes [s]
_NO_AGE = 3600.0
#: the address of its page, or its file
_VIEWER_IS_ON = re.compile(r'^((?:open|written:) .+)\n', re.M)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagineOptions:
    """Launch options of the node, the policy and the episode runner.

    Attributes:
        policy: YAML file, name of a bundled one, or a scripted policy such as `expert-miss-0.5`.
        count: number of episodes; 0 = one.
        max_chunks: chunks an episode has at most; 0 = until the policy says it is over.
        max_seconds: an episode takes at most, on the wall [s].
        instruction: text for the robot.
        seed: episode k uses seed + 1000 k.
        watch: arguments of a viewer that is started, too; None = there is none.
        checkpoint, robot, device, num_threads, num_inference_steps, segmenter, describer: of the
            world model.
    """

    policy: str
    count: int = 0
    max_chunks: int = 0
    max_seconds: float = 3600.0
    instruction: str = ''
    seed: int = 0
    watch: tuple[str, ...] | None = None
    checkpoint: str = 'bundled'
    robot: str = ''
    device: str = 'cpu'
    num_threads: int = 0
    num_inference_steps: int = 0
    segmenter: str = 'colour'
    describer: str = ''


def imagine_episodes(
    options: ImagineOptions,
    out: Path,
    *,
    overwrite: bool = False,
    tell: Callable[[str], object] = lambda _: None,
) -> list[dict[str, object]]:
    """Run the episodes; `out` gets a bag for each, `episodes.json` and `logs/`.

    Args:
        options: policy, episodes and settings of the nodes.
        out: folder of the results.
        overwrite: remove the episodes of an earlier run from it.
        tell: called with the viewer's address or file.

    Returns:
        What `episodes.json` says, one entry for each episode that was begun.

    Raises:
        ConfigError: `out` holds episodes, and `overwrite` is not set; no such policy.
        EpisodeError: a process failed; the message says what it said last and names its log.
        OSError: the disk is full.
    """
    checkpoint = Checkpoint.open(options.checkpoint)
    views, robot = checkpoint.spec.views, checkpoint.load_robot(options.robot or None)
    # a wrong name is an error here, before anything is removed
    check_start(options.policy, robot, 0.0, is_recorded=False)
    watch = options.watch
    viewer = {} if watch is None else {'viewer': module_command('live_viewer', *watch)}
    commands = {
        **viewer,
        'world_model': _world_model_command(options, views),
        'policy': _policy_command(options, views),
        'runner': _runner_command(options, views, out),
    }
    clear_episodes(out, overwrite=overwrite)
    logs = out / 'logs'
    logs.mkdir(parents=True, exist_ok=True)
    environment = dict(os.environ)
    started: dict[str, subprocess.Popen[bytes]] = {}
    count = options.count or 1
    try:
        for name, command in commands.items():
            started[name] = start_process(name, command, logs, environment)
            if name == 'viewer':
                tell(_viewer_said(started[name], logs))
        with tqdm(total=count, unit='ep', disable=None) as bar:
            _wait(started, logs, bar)
    finally:
        # the runner first: it closes its record
        for name in reversed(commands):
            stop_process(started.get(name))
    if started['runner'].returncode != 0:
        raise EpisodeError(how_it_ended('runner', started['runner'], logs))
    try:
        return list(read_json(out / 'episodes.json'))
    except (OSError, ValueError, TypeError) as error:
        raise EpisodeError(
            f"what the episode runner wrote cannot be read: {error} (logs are in '{logs}')"
        ) from error


def _viewer_said(viewer: subprocess.Popen[bytes], logs: Path) -> str:
    """The viewer's line once it is ready; EpisodeError where it ends before."""
    log, stopped = logs / 'viewer.log', StoppedProcesses()
    while not (found := _VIEWER_IS_ON.search(log.read_text(errors='replace'))):
        if viewer.poll() is not None:
            raise EpisodeError(how_it_ended('viewer', viewer, logs))
        if said := stopped.report({'viewer': viewer}):
            raise EpisodeError(f"{said} (logs are in '{logs}')")
        time.sleep(0.1)
    return found[1]


def _wait(processes: dict[str, subprocess.Popen[bytes]], logs: Path, bar: Any) -> None:
    """Wait for the runner; before its first episode it does not notice dead nodes itself."""
    runner, stopped = processes['runner'], StoppedProcesses()
    while runner.poll() is None:
        time.sleep(0.2)
        bar.n = episodes_done(logs.parent)
        bar.refresh()
        if said := stopped.report(processes):
            raise EpisodeError(f"{said} (logs are in '{logs}')")
        dead = [n for n, p in processes.items() if p is not runner and p.poll() is not None]
        if dead and not (logs.parent / 'episodes.json').is_file():
            said = how_it_ended(dead[0], processes[dead[0]], logs)
            if any(logs.parent.glob('.episode_*')):  # the runner notices, and closes the record
                with suppress(subprocess.TimeoutExpired):
                    runner.wait(60.0)
            raise EpisodeError(said)


def episodes_done(out: Path) -> int:
    """Return how many episodes have ended, by the runner's `episodes.json`."""
    try:
        return len(read_json(out / 'episodes.json'))
    except (OSError, ValueError, TypeError):  # before the first has ended
        return 0


def _common(options: ImagineOptions, views: Sequence[str]) -> dict[str, object]:
    """Parameters of both nodes."""
    return {
        'checkpoint': options.checkpoint,
        'robot_file': options.robot,
        'max_image_age_s': _NO_AGE,
        'max_joint_state_age_s': _NO_AGE,
        'diagnostics_period_s': 0.2,
        **{f'camera_topics.{view}': f'start/{view}' for view in views},
    }


_REMAPS = {'joint_states': 'start/joint_states'}


def _world_model_command(options: ImagineOptions, views: Sequence[str]) -> list[str]:
    parameters = {
        **_common(options, views),
        'mode': 'imagine',
        'pace': 'burst',
        # imagined time stops while the policy computes: each answer must be to the newest frames
        'max_trajectory_age_s': 0.001,
        'device': options.device,
        'num_threads': options.num_threads,
        'num_inference_steps': options.num_inference_steps,
        'segmenter': options.segmenter,
        'describer': options.describer,
    }
    return module_command('world_model.node', *ros_arguments(parameters, _REMAPS))


def _policy_command(options: ImagineOptions, views: Sequence[str]) -> list[str]:
    parameters = {**_common(options, views), 'policy': options.policy, 'mode': 'imagine'}
    return module_command('policy.node', *ros_arguments(parameters, _REMAPS))


def _runner_command(options: ImagineOptions, views: Sequence[str], out: Path) -> list[str]:
    arguments = [str(out), '--views', *views, '--count', str(options.count)]
    arguments += ['--seed', str(options.seed), '--max-chunks', str(options.max_chunks)]
    arguments += ['--max-seconds', str(options.max_seconds)]
    arguments += ['--instruction', options.instruction] if options.instruction else []
    arguments += ['--live', '--viewers', str(int(options.watch is not None))]
    return module_command('episodes.episode_runner', *arguments)
