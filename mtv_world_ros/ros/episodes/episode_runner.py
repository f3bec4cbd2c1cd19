"""Runs imagined episodes one after the other: reset, start, wait, record, whatever happens."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
import json
from math import isfinite
from pathlib import Path
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_srvs.srv import SetBool, Trigger

from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.core.processes import (
    last_line,
    module_command,
    start_process,
    stop_process,
    StoppedProcesses,
)
from mtv_world_ros.ros.episodes.start import EpisodeStart, LiveCameras, recorded_start
from mtv_world_ros.ros.messages.conversions import values_of
from mtv_world_ros.ros.peers import Peers
from mtv_world_ros.ros.policy.loop import ESTIMATE, GOOD_ENDS
from mtv_world_ros.ros.qos_profiles import LATCHED
from mtv_world_ros.ros.run_node import run
from mtv_world_ros.ros.status_publisher import StatusPublisher
from mtv_world_ros.success.estimator import verdict_word

_VIEW_TOPICS = ('predicted/image_raw', 'predicted/camera_info')
_TOPICS = ('predicted/joint_states', 'success', 'jaccard')
_TIMEOUT_S = 60.0


def predicted_topics(world_model: str, views: Sequence[str]) -> list[str]:
    """Topics of what the world model predicts."""
    topics = [f'{world_model}/{view}/{stream}' for view in views for stream in _VIEW_TOPICS]
    return topics + [f'{world_model}/{topic}' for topic in _TOPICS]


class RecorderProcess:
    """Starts and stops the recorder process, which closes its bag however it is stopped.

    Args:
        out: folder of the bags; logs go to `logs/` in it.
        peers: talks to the recorder.
    """

    def __init__(self, out: Path, peers: Peers) -> None:
        self._out, self._peers = out, peers
        self._process: subprocess.Popen[bytes] | None = None
        self._bag: Path | None = None
        self._stopped = StoppedProcesses()

    def start(self, topics: Sequence[str]) -> None:
        """Start the recorder and wait until it is connected to every topic.

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
        """Begin a bag; return its path, empty = nothing is recorded."""
        if self._process is None:
            return ''
        answer = self._peers.call(Trigger, 'episode_recorder/begin', Trigger.Request())
        if not answer.success:
            raise EpisodeError(f'nothing can be recorded: {answer.message}')
        self._bag = Path(answer.message)
        return answer.message

    def check(self) -> None:
        """Refuse to go on without the recorder.

        Raises:
            EpisodeError: the recorder ended, e.g. because the disk is full, or was stopped.
        """
        if self._process is None:
            return
        if self._process.poll() is not None:
            status, text = self._process.returncode, last_line(self._log, 'its log is empty')
            raise EpisodeError(f'the recorder ended with status {status}: {text}')
        if problem := self._stopped.report({'recorder': self._process}):
            raise EpisodeError(f"{problem}; its log is '{self._log}'")

    def end(self) -> None:
        """End the bag and wait until it is closed.

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
        """End the recorder."""
        stop_process(self._process)
        self._process = None

    def _is_on(self) -> bool:
        self.check()
        return ': recording' in self._log.read_text(errors='replace')


#: topics of what an episode starts from lie under this name, apart from a robot's own
START = 'start'
_PERIOD_S = 0.5


class EpisodeRunner(Node):
    """Runs episodes.

    Args:
        options: of the command line, see `_parse`.

    Raises:
        ConfigError: a node is missing.
        EpisodeError: a recorded episode cannot be used.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__('episode_runner')
        self._options = options
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._status = StatusPublisher(self)
        self._peers = Peers(self, self._spin_once)
        self._ended: dict[str, str] | None = None
        self._awaited = ''
        self._recording = RecorderProcess(options.out, self._peers)
        self._results: list[dict[str, Any]] = []
        self._running: dict[str, Any] = {}
        policy_report = f'{options.policy_node}/report'
        self.create_subscription(DiagnosticArray, policy_report, self._on_report, 100)
        self._outputs = {
            topic: self._offer(kind, topic)
            for topic, kind in {
                'joint_states': JointState,
                **{f'{view}/camera_info': CameraInfo for view in options.views},
                **{f'{view}/image_raw': Image for view in options.views},
            }.items()
        }
        self._live = LiveCameras(self, options.views) if options.live else None
        self._next_status_s = 0.0

    def run_all(self) -> None:
        """Run the episodes and write `episodes.json`.

        Raises:
            ConfigError: a node is missing, or died.
        """
        options = self._options
        options.out.mkdir(parents=True, exist_ok=True)
        request, timeout = SetBool.Request(data=True), options.wait_timeout
        self._peers.call(SetBool, f'{options.world_model}/imagine', request, timeout)
        for node in (options.policy_node, options.world_model):
            self._wait_for(
                lambda node=node: self._peers.silence_s(node) < timeout, f"the node '{node}'"
            )
        self._connect()
        for number, start in enumerate(self._starts()):
            self._running = {'episode': number, 'start': start.source, 'bag': ''}
            result = self._run_one(number, start)
            self._keep(result)
            why = f': {result["text"]}' if result['text'] else ''
            self.get_logger().info(f'episode {number}: {result["how"]}{why}')
            if result['how'].endswith('_died'):
                raise ConfigError(f'episode {number}: {result["how"]}; see its log')

    def close(self) -> None:
        """Close the bag of a running episode and list it as interrupted; end the node."""
        self._recording.stop()
        bag = self._options.out / f'episode_{self._running.get("episode", 0):05d}'
        if self._running and bag.is_dir():
            cut_off = {'how': 'interrupted', 'text': 'it was stopped before its end'}
            with suppress(OSError):  # the disk is full: reported already
                self._keep({**self._running, 'bag': str(bag), **_ending(cut_off)})
        self.destroy_node()

    def _keep(self, result: dict[str, Any]) -> None:
        """Add the result of an episode to `episodes.json`."""
        self._results.append(result)
        self._running = {}
        text = json.dumps(self._results, indent=2)
        write_whole(self._options.out / 'episodes.json', text + '\n')

    # one episode

    def _run_one(self, number: int, start: EpisodeStart) -> dict[str, Any]:
        begin_s = time.monotonic()
        result = {**self._running, 'bag': self._recording.begin()}
        begun_s = time.monotonic()
        try:
            seen = self._live_out(number, start)
            result['episode_s'] = round(time.monotonic() - begun_s, 3)
        finally:
            self._recording.end()
        result['total_s'] = round(time.monotonic() - begin_s, 3)
        how = seen['how']
        self._status.counts[f'episodes_{how}'] += 1
        if how not in (*GOOD_ENDS, 'max_seconds'):
            self._status.fault(how, seen.get('text', ''))
        return {**result, **_ending(seen)}

    def _live_out(self, number: int, start: EpisodeStart) -> dict[str, str]:
        """Run an episode; return the values of the report of its end."""
        options, peers = self._options, self._peers
        common = {'seed': options.seed + 1000 * number}
        if start.calibration_file:
            common['calibration_file'] = start.calibration_file
        peers.set_parameters(options.world_model, common)
        peers.set_parameters(
            options.policy_node,
            {
                **common,
                'max_chunks': options.max_chunks,
                'task': start.task,
                'scene_seed': start.scene_seed,
                'recording': start.recording,
                'recording_ns': start.recording_ns,
                'instruction': options.instruction or start.instruction,
            },
        )
        self._call_trigger(f'{options.world_model}/reset')
        # ahead of the images: nothing orders the topics, and an answer needs both
        self._show(start, only='camera_info')
        self._ended = None
        self._awaited = self._call_trigger(f'{options.policy_node}/start').split()[-1]
        self._show(start)
        return self._wait_for_end()

    def _show(self, start: EpisodeStart, only: str = '') -> None:
        """Publish the start once, on topics that end with `only`."""
        for topic, message in start.stamped(self.get_clock().now().nanoseconds):
            if topic.endswith(only):
                self._outputs[topic].publish(message)

    def _wait_for_end(self) -> dict[str, str]:
        options = self._options
        end_s = time.monotonic() + options.max_seconds
        while self._ended is None:
            self._spin_once()
            self._recording.check()
            if dead := self._dead():
                return dead
            if time.monotonic() > end_s:
                self._call_trigger(f'{options.policy_node}/stop')
                self._wait_for(lambda: self._ended is not None, 'the end of the episode')
                return {**(self._ended or {}), 'how': 'max_seconds'}
        return self._ended

    def _dead(self) -> dict[str, str]:
        """Return the end of the episode if one of its nodes has died, else None."""
        options = self._options
        nodes = {'policy_died': options.policy_node, 'world_model_died': options.world_model}
        for how, node in nodes.items():
            silence_s = self._peers.silence_s(node)
            if silence_s > options.heartbeat_timeout:
                return {'how': how, 'text': f"'{node}' has been silent for {silence_s:.1f} s"}
        return {}

    def _starts(self) -> Iterator[EpisodeStart]:
        options = self._options
        sources = options.episodes or ['live']
        for number in range(options.count or len(sources)):
            path = sources[number % len(sources)]
            if self._live is None:
                yield recorded_start(Path(path), options.views, options.start)
            else:
                yield self._live_start(self._live)

    def _live_start(self, live: LiveCameras) -> EpisodeStart:
        live.clear()
        self._wait_for(lambda: not live.missing(), 'images, camera_infos and joint states')
        return live.start(self._options.instruction)

    def _connect(self) -> None:
        """Start the recorder and wait until it is connected to every publisher."""
        options = self._options
        shown = [output.topic_name for output in self._outputs.values()]
        least = 2  # the world model and the policy
        if not options.no_record:
            predicted = predicted_topics(options.world_model, options.views)
            others = [*shown, 'joint_trajectory', 'instruction', '/diagnostics']
            others += [f'{node}/report' for node in (options.world_model, options.policy_node)]
            self._recording.start([*predicted, *others])
            self._peers.forget(options.world_model)
            self._wait_for(lambda: self._are_recorded(predicted), 'connections to the recorder')
            least = 3
        self._wait_for(
            lambda: all(
                output.get_subscription_count() >= least + options.viewers * _is_viewed(name)
                for name, output in self._outputs.items()
            ),
            f'{least} subscribers of {shown}, and {options.viewers} viewers',
        )

    def _are_recorded(self, topics: Sequence[str]) -> bool:
        is_known = bool(self._peers.state(self._options.world_model))
        # the policy sees these too
        shared = [t for t in topics if t.endswith(('/image_raw', '/joint_states'))]
        unconnected = self._peers.unconnected(topics)
        for topic in shared:
            # viewers take JPEG images
            viewers = 0 if topic.endswith('/image_raw') else self._options.viewers
            unconnected += self._peers.unconnected([topic], least=2 + viewers)
        return is_known and not unconnected

    # plumbing

    def _offer(self, kind: Any, topic: str) -> Publisher:
        # what is shown once also reaches those who only now connect as they want to
        return self.create_publisher(kind, f'{START}/{topic}', LATCHED)

    def _on_report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = values_of(status)
            if values.get('state') == 'ended' and values.get('episode') == self._awaited:
                self._ended = values

    def _call_trigger(self, name: str) -> str:
        answer = self._peers.call(Trigger, name, Trigger.Request())
        if not answer.success:
            raise ConfigError(f"'{name}': {answer.message}")
        return answer.message

    def _wait_for(self, condition: Any, what: str) -> None:
        self._peers.wait(condition, what, self._options.wait_timeout)

    def _spin_once(self) -> None:
        self._executor.spin_once(timeout_sec=0.05)
        if time.monotonic() > self._next_status_s:
            self._next_status_s = time.monotonic() + _PERIOD_S
            self._status.publish_diagnostics({'episodes': len(self._results)})
            if self._live is not None:
                self._live.refresh()


def _is_viewed(topic: str) -> bool:
    return not topic.endswith('/camera_info')


def _ending(seen: Mapping[str, str]) -> dict[str, Any]:
    """The report of an episode's end; numbers of the estimate are null where it abstains."""
    kept = ('how', 'text', 'policy', 'task', 'scene_seed', 'seed', 'num_chunks')
    numbers = {key: float(seen.get(key, 'nan')) for key in ESTIMATE[:3]}
    return {
        **{key: seen.get(key, '') for key in kept},
        **{key: value if isfinite(value) else None for key, value in numbers.items()},
        'verdict': verdict_word(numbers['success']),
        'reasons': seen.get(ESTIMATE[3], ''),
    }


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog='episode_runner', description=__doc__)
    add = parser.add_argument
    add('out', type=Path, help='folder for the records and episodes.json')
    add('--episodes', nargs='+', default=[], help='recorded episodes to start from, in turn')
    add('--live', action='store_true', help='start from what the cameras show')
    add('--views', nargs='+', required=True, help="the world model's")
    add('--count', type=int, default=0, help='default: one for each recorded episode, or one')
    add('--start', type=float, default=0.0, help='time of the recorded frame to start from [s]')
    add('--seed', type=int, default=0, help='episode k uses seed + 1000 k')
    add('--max-chunks', type=int, default=0, help='0 = until the policy says it is over')
    add('--max-seconds', type=float, default=3600.0, help='of an episode, on the wall [s]')
    add('--instruction', default='', help="default: the recorded episode's")
    add('--no-record', action='store_true', help='no bags')
    add('--viewers', type=int, default=0, help='wait until this number of viewers is connected')
    add('--world-model', default='/world_model', help='name of the node')
    add('--policy-node', default='/policy', help='name of the node')
    add('--wait-timeout', type=float, default=120.0, help='wait for nodes this long [s]')
    add('--heartbeat-timeout', type=float, default=10.0, help='a node this silent is dead [s]')
    options = parser.parse_args(arguments)
    if bool(options.episodes) == options.live:
        parser.error('give either --episodes or --live')
    return options


def main(args: Sequence[str] | None = None) -> int:
    """Run episodes; return the exit status."""
    arguments = list(sys.argv if args is None else ('episode_runner', *args))
    options = _parse(remove_ros_args(arguments)[1:])
    return run(lambda: EpisodeRunner(options), arguments, spin=EpisodeRunner.run_all)


if __name__ == '__main__':
    sys.exit(main())
