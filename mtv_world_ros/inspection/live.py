"""Records running topics for some seconds, with the ROS recorder in a separate process."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import subprocess
import time

from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.processes import (
    last_line,
    module_command,
    start_process,
    stop_process,
    StoppedProcesses,
)
from mtv_world_ros.data.episode import (
    camera_info_topic,
    image_topic,
    INSTRUCTION,
    JOINT_STATES,
    JOINT_TRAJECTORY,
)


def record_topics(
    views: Sequence[str], out: Path, seconds: float, *, wait_s: float = 20.0
) -> Path:
    """Record the views' images, CameraInfo, joint states and commands; return the bag.

    Images may be raw or compressed; commands and instruction are taken if they are published.

    Raises:
        ConfigError: the time is not positive.
        EpisodeError: the recorder failed, e.g. since nobody publishes joint states, or stands
            still.
    """
    if not seconds > 0:
        raise ConfigError(f'--seconds is {seconds}, must be positive')
    log = out.with_suffix('.log')
    process, stopped = _start(views, out, log, seconds, wait_s), StoppedProcesses()
    try:
        while process.poll() is None:
            if said := stopped.report({'recorder': process}):
                raise EpisodeError(f"{said}; its log is '{log}'")
            time.sleep(0.1)
    finally:
        stop_process(process)
    if process.returncode != 0:
        raise _failure(log)
    return out


def _start(
    views: Sequence[str], out: Path, log: Path, seconds: float, wait_s: float
) -> subprocess.Popen[bytes]:
    images = [image_topic(view) for view in views]
    optional = [name for image in images for name in (image, f'{image}/compressed')]
    optional += [camera_info_topic(view) for view in views] + [JOINT_TRAJECTORY, INSTRUCTION]
    options = ['--wait-timeout', str(wait_s), '--duration', str(seconds)]
    command = module_command(
        'bags.recorder', str(out), JOINT_STATES, *options, '--if-published', *optional
    )
    return start_process(log.stem, command, log.parent)


def _failure(log: Path) -> EpisodeError:
    return EpisodeError(
        f'the topics could not be recorded: {last_line(log, "no message")} (are the robot '
        'and its cameras running, with the same ROS_DOMAIN_ID?)'
    )
