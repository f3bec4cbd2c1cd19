"""Runs node, recorder and player as processes of their own, on a private ROS domain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import subprocess
import time
from typing import Any

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import check_room
from mtv_world_ros.core.processes import (
    how_it_ended,
    module_command,
    private_domain,
    ros_arguments,
    start_process,
    stop_process,
    StoppedProcesses,
)
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode_reader import read_info
from mtv_world_ros.rollout.imagined_episodes import ROOM_BYTES

STREAMS = ('predicted/image_raw', 'predicted/camera_info', 'trajectory/image_raw')
TOPICS = ('predicted/joint_states', 'success', 'jaccard', 'report')
NODE = '/world_model'
_NODE_START_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """Options the node is started with; see its parameters."""

    checkpoint: str
    calibration: Path
    device: str
    num_threads: int
    num_inference_steps: int


def record_through_node(
    episode: Path, views: Sequence[str], out: Path, options: DemoOptions
) -> None:
    """Play an episode into a node and record what it publishes in `out/predictions`.

    The bag also holds the cameras' images. The episode's clock is the ROS clock, so predictions
    carry the times that they show. After each trajectory the player waits until the node has
    answered it, so a slow machine loses nothing. Logs of the processes go to `out/logs`.

    Raises:
        EpisodeError: a process failed; the message has its last line and names its log.
        OSError: the disk is full.
    """
    check_room(out, ROOM_BYTES)
    logs = out / 'logs'
    logs.mkdir(parents=True, exist_ok=True)
    environment = private_domain()
    node = start_process('node', _node_command(episode, options), logs, environment)
    recorder: subprocess.Popen[bytes] | None = None
    try:
        recorded = [f'{NODE}/{view}/{stream}' for view in views for stream in STREAMS]
        recorded += [f'{NODE}/{topic}' for topic in TOPICS]
        command = module_command('bags.recorder', str(out / 'predictions'), *recorded)
        command += ['--overwrite', '--stamp', 'header', '--wait-timeout', str(_NODE_START_S)]
        cameras = [f'/{view}/image_raw/compressed' for view in views]
        command += ['--if-published', *cameras]
        recorder = start_process('recorder', command, logs, environment)
        wanted = [*cameras, '/joint_trajectory']
        command = module_command(
            'bags.player', str(episode), '--clock', '--lock-step', '--wait-for', *wanted, *recorded
        )
        command += ['--wait-timeout', str(_NODE_START_S), '--answer-timeout', '300']
        player = start_process('player', command, logs, environment)
        plans = sum(1 for _ in BagReader(episode).messages(('/joint_trajectory',)))
        with Progress(total=plans, desc='imagining', unit='plan') as bar:
            _wait(player, {'node': node, 'recorder': recorder}, logs, bar)
    finally:
        stop_process(recorder)
        stop_process(node)
    if recorder is not None and recorder.returncode != 0:
        raise EpisodeError(how_it_ended('recorder', recorder, logs))


def _node_command(episode: Path, options: DemoOptions) -> list[str]:
    parameters = {
        'use_sim_time': True,
        'compressed_input': True,
        'pace': 'burst',
        'checkpoint': options.checkpoint,
        'calibration_file': options.calibration,
        'device': options.device,
        'num_threads': options.num_threads,
        'num_inference_steps': options.num_inference_steps,
        'place': read_info(episode).place,
        # the same numbers whatever weights are at hand
        'segmenter': 'colour',
    }
    return module_command('world_model.node', *ros_arguments(parameters))


def _wait(
    player: subprocess.Popen[bytes],
    others: Mapping[str, subprocess.Popen[bytes]],
    logs: Path,
    bar: Any,
) -> None:
    stopped = StoppedProcesses()
    while player.poll() is None:
        bar.n = (logs / 'player.log').read_bytes().count(b'trajectory is answered: ')
        bar.refresh()
        for name, process in others.items():
            if process.poll() is not None:
                stop_process(player)
                raise EpisodeError(how_it_ended(name, process, logs))
        if said := stopped.report({'player': player, **others}):
            stop_process(player)
            raise EpisodeError(f"{said} (logs are in '{logs}')")
        time.sleep(0.2)
    if player.returncode != 0:
        raise EpisodeError(how_it_ended('player', player, logs))
