"""Runs node, recorder and player as processes of their own, on a private ROS domain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import time

from mtv_world_ros.errors import EpisodeError

STREAMS = ('predicted/image_raw', 'predicted/camera_info', 'trajectory/image_raw')
TOPICS = ('predicted/joint_states', 'success', 'jaccard', 'report')
NODE = '/world_model'
_NODE_START_S = 120.0
_STOP_S = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """What the node is started with; see its parameters."""

    checkpoint: str
    calibration: Path
    robot: str | None
    device: str
    num_threads: int
    num_inference_steps: int
    seed: int


def record_through_node(
    episode: Path, views: Sequence[str], out: Path, options: DemoOptions
) -> None:
    """Plays an episode into a node and records what it publishes in `out/predictions`.

    The episode's clock is the ROS clock, so predictions carry the times they are about. After
    each trajectory the player waits until the node has answered it (a slow machine loses
    nothing). Logs of the processes go to `out/logs`.

    Raises:
        EpisodeError: a process failed; the message names its log.
    """
    logs = out / 'logs'
    logs.mkdir(parents=True, exist_ok=True)
    environment = _private_domain()
    node = _start('node', _node_command(options), logs, environment)
    recorder: subprocess.Popen[bytes] | None = None
    try:
        recorded = [f'{NODE}/{view}/{stream}' for view in views for stream in STREAMS]
        recorded += [f'{NODE}/{topic}' for topic in TOPICS]
        command = _module('recorder', str(out / 'predictions'), *recorded)
        command += ['--overwrite', '--stamp', 'header', '--wait-timeout', str(_NODE_START_S)]
        recorder = _start('recorder', command, logs, environment)
        wanted = [f'/{view}/image_raw/compressed' for view in views] + ['/joint_trajectory']
        command = _module(
            'player', str(episode), '--clock', '--lock-step', '--wait-for', *wanted, *recorded
        )
        command += ['--wait-timeout', str(_NODE_START_S), '--answer-timeout', '300']
        player = _start('player', command, logs, environment)
        _wait(player, (node, recorder), logs)
    finally:
        _stop(recorder)
        _stop(node)
    if recorder is not None and recorder.returncode != 0:
        raise EpisodeError(
            f"the recorder ended with status {recorder.returncode}; see '{logs / 'recorder.log'}'"
        )


def _private_domain() -> dict[str, str]:
    environment = dict(os.environ)
    environment.setdefault('ROS_DOMAIN_ID', str(random.SystemRandom().randint(1, 100)))
    environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    return environment


def _module(name: str, *arguments: str) -> list[str]:
    return [sys.executable, '-m', f'mtv_world_ros.ros.{name}', *arguments]


def _node_command(options: DemoOptions) -> list[str]:
    values = {
        'use_sim_time': 'true',
        'compressed_input': 'true',
        'pace': 'burst',
        'checkpoint': options.checkpoint,
        'robot_file': options.robot or '',
        'calibration_file': str(options.calibration),
        'device': options.device,
        'num_threads': str(options.num_threads),
        'num_inference_steps': str(options.num_inference_steps),
        'seed': str(options.seed),
        # the same numbers whatever weights are at hand
        'segmenter': 'colour',
    }
    assignments = [f'{key}:={value}' for key, value in values.items() if value]
    flags = [part for assignment in assignments for part in ('-p', assignment)]
    return _module('node', '--ros-args', *flags)


def _start(
    name: str, command: list[str], logs: Path, environment: dict[str, str]
) -> subprocess.Popen[bytes]:
    with (logs / f'{name}.log').open('wb') as log:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )


def _wait(
    player: subprocess.Popen[bytes], others: Sequence[subprocess.Popen[bytes]], logs: Path
) -> None:
    while player.poll() is None:
        if any(process.poll() is not None for process in others):
            _stop(player)
            raise EpisodeError(f"node or recorder ended early; see the logs in '{logs}'")
        time.sleep(0.1)
    if player.returncode != 0:
        raise EpisodeError(f"the player ended with status {player.returncode}; see '{logs}'")


def _stop(process: subprocess.Popen[bytes] | None) -> None:
    if process is None or process.poll() is not None:
        return
    process.send_signal(signal.SIGINT)
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
