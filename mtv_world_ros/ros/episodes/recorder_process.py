"""The records of imagined episodes: the recorder as a process of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import subprocess

from std_srvs.srv import Trigger

from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.processes import (
    last_line,
    module_command,
    StandStill,
    start_process,
    stop_process,
)
from mtv_world_ros.ros.peers import Peers

_VIEW_TOPICS = ('predicted/image_raw', 'predicted/camera_info')
_TOPICS = ('predicted/joint_states', 'success', 'jaccard')
_TIMEOUT_S = 60.0


def predicted_topics(world_model: str, views: Sequence[str]) -> list[str]:
    """Topics of what the world model predicts."""
    topics = [f'{world_model}/{view}/{stream}' for view in views for stream in _VIEW_TOPICS]
    return topics + [f'{world_model}/{topic}' for topic in _TOPICS]


class RecorderProcess:
    """Starts and stops the recorder of episodes; however it is stopped, it closes its bag whole.

    Args:
        out: folder of the bags; logs go to `logs/` in it.
        peers: talks to the recorder.
    """

    def __init__(self, out: Path, peers: Peers) -> None:
        self._out, self._peers = out, peers
        self._process: subprocess.Popen[bytes] | None = None
        self._bag: Path | None = None
        self._still = StandStill()

    def start(self, topics: Sequence[str]) -> None:
        """Starts the recorder and waits until it is connected to every topic.

        Raises:
            EpisodeError: the recorder ended.
        """
        logs = self._out / 'logs'
        logs.mkdir(parents=True, exist_ok=True)
        self._log = logs / 'recorder.log'
        arguments = (str(self._out), *topics, '--stamp', 'header')
        command = module_command('episodes.episode_recorder', *arguments)
        self._process = start_process('recorder', command, logs)
        self._peers.wait(self._is_on, f"the recorder; see '{self._log}'", 2 * _TIMEOUT_S)

    def begin(self) -> str:
        """Begins a bag; returns its path, empty = nothing is recorded."""
        if self._process is None:
            return ''
        answer = self._peers.call(Trigger, 'episode_recorder/begin', Trigger.Request())
        if not answer.success:
            raise EpisodeError(f'nothing can be recorded: {answer.message}')
        self._bag = Path(answer.message)
        return answer.message

    def check(self) -> None:
        """Refuses to go on without the recorder.

        Raises:
            EpisodeError: the recorder ended, e.g. because the disk is full, or was stopped.
        """
        if self._process is None:
            return
        if self._process.poll() is not None:
            status, text = self._process.returncode, last_line(self._log, 'its log is empty')
            raise EpisodeError(f'the recorder ended with status {status}: {text}')
        if said := self._still.said({'recorder': self._process}):
            raise EpisodeError(f"{said}; its log is '{self._log}'")

    def end(self) -> None:
        """Lets the recorder take what is still on its way, and waits for the closed bag.

        Raises:
            EpisodeError: the recorder ended; the bag holds what had been received.
        """
        bag, self._bag = self._bag, None
        if bag is None:
            return
        self.check()
        self._peers.call(Trigger, 'episode_recorder/end', Trigger.Request())
        self._peers.wait(lambda: self._is_on() and bag.is_dir(), f"'{bag}'", _TIMEOUT_S)

    def stop(self) -> None:
        """Ends the recorder."""
        stop_process(self._process)
        self._process = None

    def _is_on(self) -> bool:
        self.check()
        return ': recording' in self._log.read_text(errors='replace')
