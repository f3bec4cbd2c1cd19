"""Runs world model, policy and episode runner as processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
import os
from pathlib import Path
import re
import shutil
import subprocess
import time
from typing import Any

import numpy as np
from tqdm import tqdm

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.files import check_free, check_room
from mtv_world_ros.core.processes import (
    how_it_ended,
    module_command,
    private_domain,
    ros_arguments,
    start_process,
    stop_process,
    StoppedProcesses,
)
from mtv_world_ros.data.episode import CALIBRATION_FILE
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.policies.policy import RecordedPolicySettings, ScriptedPolicySettings
from mtv_world_ros.rollout.assembly import policy_settings

#: of logs and bags, before anything is started
ROOM_BYTES = 8 * 2**20
#: the start images stay valid while the policy computes [s]
_NO_AGE = 3600.0
#: the address of its page, or its file
_VIEWER_IS_ON = re.compile(r'^((?:open|written:) .+)\n', re.M)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagineOptions:
    """What is started; see the parameters of the nodes and the options of the runner.

    Attributes:
        policy: YAML file, name of a bundled one, or a scripted policy such as `expert-miss-0.5`.
        episodes: recorded episodes to start from, in turn; none = from the live cameras.
        count: number of episodes; 0 = one for each recorded one.
        start_s: time of the recorded frame to start from [s].
        max_chunks: chunks an episode has at most; 0 = until the policy says it is over.
        max_seconds: an episode takes at most, on the wall [s].
        instruction: empty = the recorded episode's.
        seed: episode k uses seed + 1000 k.
        watch: arguments of a viewer that runs beside it; None = there is none.
        checkpoint, robot, device, num_threads, num_inference_steps, segmenter, describer: of the
            world model.
    """

    policy: str
    episodes: tuple[Path, ...]
    count: int = 0
    start_s: float = 0.0
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
    """Runs the episodes; `out` gets a bag for each, `episodes.json` and `logs/`.

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
    views = Checkpoint.open(options.checkpoint).card.spec.views
    # a wrong name is an error here, before anything is removed
    _check_policy(options)
    check_same_cameras(options.episodes, views)
    watch = options.watch
    viewer = {} if watch is None else {'viewer': module_command('live_viewer', *watch)}
    commands = {
        **viewer,
        'world_model': _world_model_command(options, views),
        'policy': _policy_command(options, views),
        'runner': _runner_command(options, views, out),
    }
    check_room(out, ROOM_BYTES)
    for bag in sorted(out.glob('episode_*')):
        check_free(bag, overwrite)
        shutil.rmtree(bag)
    logs = out / 'logs'
    logs.mkdir(parents=True, exist_ok=True)
    (out / 'episodes.json').unlink(missing_ok=True)
    environment = private_domain() if options.episodes else dict(os.environ)
    started: dict[str, subprocess.Popen[bytes]] = {}
    count = options.count or len(options.episodes) or 1  # from live cameras one by default
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


def check_same_cameras(episodes: Sequence[Path], views: Sequence[str]) -> None:
    """Refuses episodes of different camera poses: one node has one calibration for all.

    Raises:
        ConfigError: two differ.
    """
    first: dict[str, CameraModel] = {}
    for episode in episodes:
        file = episode / CALIBRATION_FILE
        known = load_calibration(file) if file.is_file() else {}
        for view in (view for view in views if view in known):
            before = first.setdefault(view, known[view])
            if not _same(before, known[view]):
                raise ConfigError(
                    f"'{episode}' and '{episodes[0]}' have different cameras of view '{view}', "
                    'and one world model draws all of --episodes with one calibration: imagine '
                    'them one by one (replay --offline and evaluate take each with its own)'
                )


def _same(a: CameraModel, b: CameraModel) -> bool:
    return (
        a.mount_link == b.mount_link
        and np.allclose(a.T_mount_camera, b.T_mount_camera, atol=1e-6)
        and np.allclose(a.K / a.width, b.K / b.width, atol=1e-6)
    )


def _check_policy(options: ImagineOptions) -> None:
    robot = Checkpoint.open(options.checkpoint).load_robot(options.robot or None)
    policy = policy_settings(options.policy, robot)
    if isinstance(policy, RecordedPolicySettings) and not options.episodes:
        raise ConfigError(
            f"policy '{options.policy}' repeats what was commanded in a recorded episode: give "
            '--episodes'
        )
    if isinstance(policy, ScriptedPolicySettings) and options.start_s > 0:
        raise ConfigError(
            f"policy '{options.policy}' plans for the scene as it is in the recording's first "
            f'frame, --start is {options.start_s:g} s: leave --start out, or take --policy '
            'recorded or one that looks at the pictures'
        )


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
    """Waits for the runner; before its first episode it does not notice dead nodes itself."""
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
    """Returns how many episodes have ended, by the runner's `episodes.json`."""
    try:
        return len(read_json(out / 'episodes.json'))
    except (OSError, ValueError, TypeError):  # before the first has ended
        return 0


def _common(options: ImagineOptions, views: Sequence[str]) -> dict[str, object]:
    """Parameters of both nodes."""
    first = options.episodes[0] / CALIBRATION_FILE if options.episodes else None
    return {
        'checkpoint': options.checkpoint,
        'robot_file': options.robot,
        'calibration_file': first.absolute() if first is not None and first.is_file() else '',
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
    arguments += ['--max-seconds', str(options.max_seconds), '--start', str(options.start_s)]
    arguments += ['--instruction', options.instruction] if options.instruction else []
    if options.episodes:
        arguments += ['--episodes', *(str(path) for path in options.episodes)]
    else:
        arguments += ['--live']
    arguments += ['--viewers', str(int(options.watch is not None))]
    return module_command('episodes.episode_runner', *arguments)
