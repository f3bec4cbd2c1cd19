"""One observation of the running robot and its cameras, from which an imagined episode starts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
import time
from typing import Any

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from mtv_world_ros.core.bounded_input import check_limit
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.errors import ObservationError
from mtv_world_ros.policies.policy import EpisodeOrigin
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.imagined_episodes import EpisodeStart
from mtv_world_ros.ros import parameters
from mtv_world_ros.ros.messages.bounded import bounded
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as, Rejection
from mtv_world_ros.ros.parameters import at_start, LiveSettings
from mtv_world_ros.ros.qos_profiles import QosWatch
from mtv_world_ros.ros.receive_paths import receive_paths
from mtv_world_ros.ros.run_node import find_log_folder, guard_node, init_ros
from mtv_world_ros.ros.sensing.live_robot import Extrinsics, RobotDescription, TOPIC
from mtv_world_ros.ros.sensing.observations import ObservationBuffer
from mtv_world_ros.ros.sensing.samples import NodeTime
from mtv_world_ros.ros.sensing.subscriptions import MatchedSubscription, subscribe_observations
from mtv_world_ros.ros.world_model.loading import read_cameras

NAME = 'imagine'
#: least time of an observation, in which publishers are discovered [s]
SETTLE_S = 1.0
#: longest wait for a robot description that somebody offers [s]
LATCHED_WAIT_S = 3.0
#: period of the attempts to make an observation [s]
_PERIOD_S = 0.1
_SPIN_S = 0.02
#: refused messages that an error names
NUM_REFUSALS = 3


class StartSettings(LiveSettings):
    """ROS parameters of `mtv-world imagine --live`."""

    observation_timeout_s: float = at_start(
        30.0,
        'The command ends without an observation for this time [s].',
        (0.001, 86400.0),
    )


def live_starts(
    spec: WorldModelSpec,
    robot: RobotModel,
    cameras_file: Path,
    ros_arguments: Sequence[str] = (),
    tell: Callable[[str], object] = lambda _: None,
) -> Iterator[EpisodeStart]:
    """Yield starts of episodes without end; each observes the cameras anew.

    Args:
        spec: spec of the world model; names the views.
        robot: the checkpoint's; its description and limits are taken from `robot_description`.
        cameras_file: poses of the views where neither `calibration_file` nor TF has them.
        ros_arguments: `--ros-args` and what follows, e.g. `-r low/image_raw:=/camera/image_raw`;
            parameters are those of `StartSettings` and `camera_topics.VIEW`.
        tell: called with a line that says what was observed.

    Raises:
        ConfigError: a parameter or remapping cannot be used.
        CalibrationError: the calibration file is wrong or lacks a view.
        ObservationError: nothing came on a topic in time, or what came cannot be used.
    """
    while True:
        yield _observe(spec, robot, cameras_file, ros_arguments, tell)


def _observe(
    spec: WorldModelSpec,
    robot: RobotModel,
    cameras_file: Path,
    ros_arguments: Sequence[str],
    tell: Callable[[str], object],
) -> EpisodeStart:
    """Return the present observation, by a node that lives as long as this takes."""
    find_log_folder()
    context = Context()
    init_ros([NAME, *ros_arguments], context)
    try:
        with receive_paths(()):
            observer = LiveObserver(spec, robot, cameras_file, context)
        guard_node(observer)
        try:
            start = observer.observe()
            tell(observer.summary(start))
            return start
        finally:
            observer.destroy_node()
    finally:
        context.try_shutdown()


class LiveObserver(Node):
    """Node that makes one observation of cameras, joint states, description and TF.

    Images may be raw or compressed; raw images are preferred where both are published.

    Args:
        spec: spec of the world model; names the views.
        robot: robot of the checkpoint.
        cameras_file: poses of the views where neither `calibration_file` nor TF has them.
        context: ROS context of the node.

    Raises:
        ConfigError: a parameter cannot be used.
        CalibrationError: the calibration file is wrong or lacks a view.
    """

    def __init__(
        self, spec: WorldModelSpec, robot: RobotModel, cameras_file: Path, context: Context
    ) -> None:
        super().__init__(NAME, context=context)
        parameters.declare(self, StartSettings)
        self._robot, self._views = robot, spec.views
        self._begin_s, self._instruction = time.monotonic(), ''
        self._refused: deque[str] = deque(maxlen=NUM_REFUSALS)
        settings = self.settings()
        self._end_s = self._begin_s + settings.observation_timeout_s
        self._topics = parameters.declare_camera_topics(self, spec.views)
        self._description = None
        if settings.use_robot_description:
            self._description = RobotDescription(self, robot, self)
        self._extrinsics = Extrinsics(self, robot.posed_links, self, publishes=False)
        self._buffer = ObservationBuffer(
            cameras=read_cameras(Path(settings.calibration_file or cameras_file), spec),
            robot=robot,
            width=spec.width,
            height=spec.height,
            limits=self.settings,
            pose=self._extrinsics.pose,
            time=NodeTime.of(self),
        )
        self._compressed = self._find_compressed()
        self._observations = subscribe_observations(
            self,
            self._topics,
            compressed=self._compressed,
            states=settings.joint_state_topics,
            buffer=self._buffer,
            guarded=self.guarded,
        )
        take = self.guarded(bounded(String, self._take_instruction))
        self._words = MatchedSubscription(self, String, 'instruction', take, depth=1)
        self._watch = QosWatch(self)
        parameters.refuse_unknown(self)
        self._listens_s = time.monotonic()

    def settings(self) -> StartSettings:
        """Return the present parameters."""
        return parameters.read(self, StartSettings)

    def guarded(self, handle: Callable[..., None]) -> Callable[..., None]:
        """Return a callback that keeps the reason why the handler refused a message."""

        def callback(*arguments: Any) -> None:
            try:
                handle(*arguments)
            except Rejection as error:
                self._refuse(f'{error.reason}: {error}')
            except Exception as error:  # a message of any publisher does not end the command
                self._refuse(f'{type(error).__name__}: {error}')

        return callback

    def _refuse(self, text: str) -> None:
        if text not in self._refused:
            self._refused.append(text)

    def on_robot(self, robot: RobotModel) -> None:
        """Take the robot as it describes itself."""
        self._robot = robot
        self._buffer.use_robot(robot)

    def observe(self) -> EpisodeStart:
        """Wait for an observation of all views and joints, and return it.

        Raises:
            ObservationError: there is none in time, or another robot is described.
        """
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self)
        why = ''
        try:
            while time.monotonic() < self._end_s:
                self._spin(executor)
                if not self._is_settled():
                    continue
                try:
                    return self._start()
                except Rejection as error:
                    why = f'{error.reason}: {error}'
            raise ObservationError(self._problem(why))
        finally:
            executor.shutdown(timeout_sec=0)

    def summary(self, start: EpisodeStart) -> str:
        """Return the topics and sources of an observation, as a line."""
        height, width = start.observation.frames.shape[1:3]
        images = ', '.join(self._image_topics(view)[0] for view in self._views)
        poses = self._extrinsics.values()
        words = ', '.join(f'{view} {poses[f"extrinsics.{view}"]}' for view in self._views)
        robot = TOPIC if self._is_described() else "the checkpoint's"
        parts = [
            f'observed {images} at {width}x{height}',
            f'camera poses: {words}',
            f'robot: {robot}',
            *self._buffer.notes,
        ]
        return '; '.join(parts)

    def _start(self) -> EpisodeStart:
        """Return the newest observation.

        Raises:
            Rejection: something is missing, stale, out of sync or changed.
        """
        if self._description is not None and self._description.problem:
            raise ObservationError(self._description.problem)
        observation = self._buffer.observe(self._now_ns()).observation
        return EpisodeStart(
            source='live',
            observation=observation,
            instruction=self._instruction,
            origin=EpisodeOrigin(task='', scene_seed=-1),
            robot=self._robot,
        )

    def _spin(self, executor: SingleThreadedExecutor) -> None:
        """Handle callbacks for a while, then look at the publishers again."""
        until_s = time.monotonic() + _PERIOD_S
        while time.monotonic() < until_s:
            executor.spin_once(timeout_sec=_SPIN_S)
        for subscription in (*self._observations, self._words):
            subscription.refresh()
        self._watch.refresh()

    def _find_compressed(self) -> Collection[str]:
        """Wait for publishers of images; return the views that have compressed ones alone."""
        raw: set[str] = set()
        compressed: set[str] = set()
        settled_s = self._begin_s + SETTLE_S
        while time.monotonic() < self._end_s:
            for view in self._views:
                names = self._image_names(view)
                for found, name in zip((raw, compressed), names, strict=True):
                    found.update([view] if self.count_publishers(name) else [])
            if len(raw | compressed) == len(self._views) and time.monotonic() > settled_s:
                break
            time.sleep(_SPIN_S)
        return compressed - raw

    def _is_settled(self) -> bool:
        """Return whether publishers are known, and what they offer to late subscribers is here."""
        waited_s = time.monotonic() - self._begin_s
        if waited_s < SETTLE_S:
            return False
        if self._description is None or self._description.problem or self._is_described():
            return True
        is_offered = self.count_publishers(TOPIC) > 0
        return not is_offered or waited_s > SETTLE_S + LATCHED_WAIT_S

    def _is_described(self) -> bool:
        """Return whether the robot's description is used."""
        return self._description is not None and self._description.values()[TOPIC] == 'used'

    def _take_instruction(self, message: String) -> None:
        with rejected_as(Reason.INSTRUCTION_TOO_LONG):
            check_limit('instruction_characters', len(message.data), 'the instruction')
        self._instruction = message.data

    def _now_ns(self) -> int:
        """Return the node's time [ns].

        Raises:
            Rejection: it comes from /clock, and nothing came there.
        """
        now_ns = self.get_clock().now().nanoseconds
        if not now_ns:
            raise Rejection(
                Reason.NO_CLOCK, "'use_sim_time' is set, and nothing was received on /clock"
            )
        return now_ns

    def _image_names(self, view: str) -> tuple[str, str]:
        """Return the names of a view's raw and compressed images."""
        raw, compressed = f'{self._topics[view]}/image_raw', '/compressed'
        return self.resolve_topic_name(raw), self.resolve_topic_name(raw + compressed)

    def _image_topics(self, view: str) -> list[str]:
        """Return the topics that a view's images come from; both where nobody publishes any."""
        raw, compressed = self._image_names(view)
        if view in self._compressed:
            return [compressed]
        return [raw] if self.count_publishers(raw) else [raw, compressed]

    def _problem(self, why: str) -> str:
        """Return the reason why there is no observation, with the topics."""
        either = {self._image_names(view)[0]: self._image_topics(view) for view in self._views}
        silent, unheard = [], []
        for subscription in self._observations:
            if not self.count_publishers(subscription.topic):
                names = either.get(subscription.topic, [subscription.topic])
                silent.append(f'nobody publishes {" or ".join(names)}')
            elif not subscription.num_received:
                unheard.append(f'nothing was received on {subscription.topic}')
        if silent and time.monotonic() - self._listens_s < SETTLE_S:
            unheard = []  # the whole time was spent waiting for images
        found = [*silent, *unheard, *self._watch.mismatches]
        found += [why] if why and not (silent or unheard) else []
        found += [f'refused: {text}' for text in self._refused if text != why]
        seconds = time.monotonic() - self._begin_s
        hint = ''
        if silent:
            view = self._views[0]
            hint = (
                '. Are robot and cameras running, with the same ROS_DOMAIN_ID? Other names: '
                f'--ros-args -p camera_topics.{view}:=/camera, -r joint_states:=/arm/joint_states'
            )
        text = '; '.join(found or ['nothing was received'])
        return (
            f"no observation within {seconds:.0f} s ('observation_timeout_s' of --ros-args -p): "
            f'{text}{hint}'
        )
