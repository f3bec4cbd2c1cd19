"""Records running topics for a while, with the ROS recorder as a process of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import signal
import subprocess
import sys
import time

from mtv_world_ros.data.episode import (
    camera_info_topic,
    image_topic,
    INSTRUCTION,
    JOINT_STATES,
    JOINT_TRAJECTORY,
)
from mtv_world_ros.errors import ConfigError, EpisodeError

#: what the recorder logs once it is connected
_READY = 'recording'
_STOP_S = 30.0


def record_topics(
    views: Sequence[str], out: Path, seconds: float, *, wait_s: float = 20.0
) -> Path:
    """Records the views' images, CameraInfo, joint states and commands; returns the bag.

    Images may be raw or compressed; commands and instruction are taken if they are published.

    Raises:
        ConfigError: nobody publishes joint states, or the images of a view.
        EpisodeError: the recorder failed.
    """
    if not seconds > 0:
        raise ConfigError(f'--seconds is {seconds}, must be positive')
    log = out.with_suffix('.log')
    process = _start(views, out, log, wait_s)
    try:
        _wait_until_ready(process, log)
        _sleep(process, seconds)
    finally:
        _stop(process)
    if process.returncode != 0:
        raise _failure(log)
    return out


def _start(views: Sequence[str], out: Path, log: Path, wait_s: float) -> subprocess.Popen[bytes]:
    images = [image_topic(view) for view in views]
    optional = [name for image in images for name in (image, f'{image}/compressed')]
    optional += [camera_info_topic(view) for view in views] + [JOINT_TRAJECTORY, INSTRUCTION]
    command = [sys.executable, '-m', 'mtv_world_ros.ros.recorder', str(out), JOINT_STATES]
    command += ['--wait-timeout', str(wait_s), '--if-published', *optional]
    with log.open('wb') as stream:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def _wait_until_ready(process: subprocess.Popen[bytes], log: Path) -> None:
    while not any(line.rstrip().endswith(_READY) for line in _lines(log)):
        if process.poll() is not None:
            raise _failure(log)
        time.sleep(0.05)


def _sleep(process: subprocess.Popen[bytes], seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end and process.poll() is None:
        time.sleep(0.05)


def _stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is not None:
        return
    process.send_signal(signal.SIGINT)
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _lines(log: Path) -> list[str]:
    return log.read_text(encoding='utf-8', errors='replace').splitlines() if log.exists() else []


def _failure(log: Path) -> EpisodeError:
    said = [line for line in _lines(log) if line.strip()]
    return EpisodeError(
        f'the topics could not be recorded: {said[-1] if said else "no message"} (are the robot '
        'and its cameras running, with the same ROS_DOMAIN_ID?)'
    )
