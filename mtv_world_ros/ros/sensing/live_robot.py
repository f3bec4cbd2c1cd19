"""The live robot's description, and the poses of its cameras by TF."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
import hashlib
from importlib import import_module
from typing import Any

from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from mtv_world_ros.core.bounded_input import check_limit
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError, ConfigError, RobotError
from mtv_world_ros.core.transforms import inverse, quaternion
from mtv_world_ros.data.transform_tree import Mount, STILL, TransformTree
from mtv_world_ros.robot.file import described_robot
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.ros.messages.bounded import bounded
from mtv_world_ros.ros.messages.conversions import make_header, NANO
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as, Rejection
from mtv_world_ros.ros.node_events import SensingEvents
from mtv_world_ros.ros.parameters import LiveSettings
from mtv_world_ros.ros.qos_profiles import LATCHED
from mtv_world_ros.ros.sensing.observations import SensedScene

TOPIC = 'robot_description'


class RobotDescription:
    """Compares `robot_description` with the robot that the checkpoint was trained on.

    Attributes:
        problem: fault of the description; empty = none.

    Args:
        node: owner of the subscription.
        expected: the checkpoint's robot.
        events: takes the same robot with the described kinematics and limits.
    """

    def __init__(
        self,
        node: Node,
        expected: RobotModel,
        events: SensingEvents,
    ) -> None:
        self._expected, self._events = expected, events
        self._log = node.get_logger()
        self._seen = b''
        self.problem = ''
        self._offset_m: float | None = None
        self._topic = node.resolve_topic_name(TOPIC)
        take = events.guarded(bounded(String, self._take, 'urdf_bytes'))
        node.create_subscription(String, TOPIC, take, LATCHED, raw=True)

    def check(self) -> None:
        """Refuse to go on while another robot is described.

        Raises:
            Rejection: with what is different.
        """
        if self.problem:
            raise Rejection(Reason.ROBOT_DESCRIPTION, self.problem)

    def values(self) -> dict[str, object]:
        """Keys and values for `/diagnostics`."""
        if self.problem:
            return {TOPIC: 'another robot'}
        if self._offset_m is None:
            return {TOPIC: 'none'}
        return {TOPIC: 'used', f'{TOPIC}.offset_m': self._offset_m}

    def _take(self, message: String) -> None:
        with rejected_as(Reason.ROBOT_DESCRIPTION):
            check_limit('urdf_bytes', len(message.data), f'{self._topic}')
        text = message.data.encode()
        digest = hashlib.sha256(text).digest()
        if digest == self._seen:  # several nodes may publish the same one
            return
        self._seen = digest
        try:
            robot, offset_m = described_robot(self._expected, message.data)
        except RobotError as error:
            self._offset_m = None
            self.problem = (
                f"{self._topic}: {error}. Set 'use_robot_description' to false, or remap the "
                'topic, if it is meant for somebody else'
            )
            raise Rejection(Reason.ROBOT_DESCRIPTION, self.problem) from error
        self.problem, self._offset_m = '', offset_m
        self._events.on_robot(robot)
        self._log.info(
            f"{self._topic}: robot '{robot.name}'; its tools are up to "
            f"{1000 * offset_m:.1f} mm off those of the checkpoint's description"
        )


def tf_message() -> Any | None:
    """Return tf2_msgs/TFMessage; None = it is not installed."""
    try:
        return import_module('tf2_msgs.msg').TFMessage
    except ModuleNotFoundError:
        return None


class Extrinsics:
    """Camera poses by TF; publishes the frames of views that TF lacks.

    Args:
        node: owner of the subscriptions and the publisher.
        links: links of the robot whose pose follows from its joint states.
        events: events of the node, with its present parameters.
        publishes: whether frames that TF lacks are published.

    Raises:
        ConfigError: poses are to come from TF, and tf2_msgs is not installed.
    """

    def __init__(
        self,
        node: Node,
        links: Collection[str],
        events: SensingEvents,
        *,
        publishes: bool,
    ) -> None:
        self._node, self._links, self._settings = node, frozenset(links), events.settings
        self._tree = TransformTree(events.settings().tf_prefix)
        self._used: dict[str, Mount] = {}
        self._sources: dict[str, str] = {}
        self._own: dict[str, tuple[str, FloatArray]] = {}
        self._published: list[TransformStamped] = []
        self._message = tf_message()
        self._publisher: Publisher | None = None
        if self._message is None:
            self._log_absence()
            return
        if publishes:
            self._publisher = node.create_publisher(self._message, '/tf_static', LATCHED)
        for topic, qos, latched in (
            ('/tf', QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT), False),
            ('/tf_static', QoSProfile(depth=100, durability=LATCHED.durability), True),
        ):
            take = bounded(self._message, partial(self._take, latched=latched))
            node.create_subscription(self._message, topic, events.guarded(take), qos, raw=True)

    def pose(self, view: str, frame: str, stamp_ns: int) -> Mount | None:
        """Return the link and pose of a view's camera by TF; None = use the calibration file.

        Args:
            view: name of the view.
            frame: optical frame of the camera, as images or CameraInfo name it.
            stamp_ns: stamp of the image [ns].

        Raises:
            Rejection: TF does not say it, what it says is too old, or it changed.
        """
        settings = self._settings()
        if not self._uses_tf(frame, settings):
            self._sources[view] = 'file'
            return None
        try:
            if self._tree.is_moving(frame, self._links):
                mount = self._tree.moving_mount(frame, self._links, stamp_ns)
                self._check_age(view, frame, mount, stamp_ns, settings.max_tf_age_s)
                self._sources[view] = 'tf, moving'
                self._used.pop(view, None)  # it may be anywhere when /tf starts over
                return mount
            mount = self._tree.mount(frame, self._links)
        except CalibrationError as error:
            raise Rejection(
                Reason.CAMERA_POSE_MISSING, f"the camera of view '{view}': {error}"
            ) from error
        self._check_age(view, frame, mount, stamp_ns, settings.max_tf_age_s)
        before = self._used.setdefault(view, mount)
        if before.link != mount.link or _differ(before.T_link_frame, mount.T_link_frame):
            raise Rejection(
                Reason.CAMERA_POSE_CHANGED,
                f"TF has another pose of view '{view}' than before: {_words(mount)}, it was "
                f'{_words(before)}; call ~/reset to accept it',
            )
        if self._sources.get(view) != 'tf':
            self._node.get_logger().info(f"the camera of view '{view}' is {_words(mount)} (TF)")
        self._sources[view] = 'tf'
        return mount

    def accept(self) -> None:
        """Accept changed poses."""
        self._used.clear()

    def forget_moving(self) -> None:
        """Drop the transforms of /tf after the clock jumped back."""
        self._tree.forget_moving()

    def values(self) -> dict[str, object]:
        """Source of each view's camera pose, for `/diagnostics`."""
        return {f'extrinsics.{view}': source for view, source in self._sources.items()}

    def show(self, scene: SensedScene) -> None:
        """Publish the frames of a scene's views that TF lacks, so that viewers can place them.

        A camera whose frames TF has, but not where the whole camera is (drivers publish those
        inside of it), gets its topmost frame placed.
        """
        if self._publisher is None:
            return
        views = zip(scene.observation.cameras, scene.camera_infos, strict=True)
        news = [self._place(info.header.frame_id, camera) for camera, info in views]
        if any(news):
            self._published += self._transforms()
            latest = self._published[-len(self._own) :]
            self._publisher.publish(self._message(transforms=latest))  # type: ignore

    def _place(self, frame: str, camera: CameraModel) -> bool:
        """Add a camera's frame that TF lacks; return whether it is new or has moved."""
        name, link, T_link_frame = self._tree.name(frame), camera.mount_link, camera.T_mount_camera
        if not name or name in self._links or self._tree.is_connected(name, self._links):
            return False
        if name in self._tree.frames:
            mount = self._tree.mount(name, ())
            if self._tree.parent(mount.link) is not None:
                return False  # on something that moves and that is not the robot
            frame = self._settings().tf_prefix + mount.link
            T_link_frame = T_link_frame @ inverse(mount.T_link_frame)
        placed = self._own.get(frame)
        if placed is not None and placed[0] == link and not _differ(placed[1], T_link_frame):
            return False
        self._own[frame] = (link, T_link_frame)
        return True

    def _transforms(self) -> list[TransformStamped]:
        prefix, now_ns = self._settings().tf_prefix, self._node.get_clock().now().nanoseconds
        transforms = []
        for frame, (link, T) in self._own.items():
            x, y, z, w = quaternion(T[:3, :3]).tolist()
            place = Vector3(**dict(zip('xyz', T[:3, 3].tolist(), strict=True)))
            transforms.append(
                TransformStamped(
                    header=make_header(now_ns, prefix + link),
                    child_frame_id=frame,
                    transform=Transform(
                        translation=place, rotation=Quaternion(x=x, y=y, z=z, w=w)
                    ),
                )
            )
        return transforms

    def _take(self, message: Any, *, latched: bool) -> None:
        if self._own:  # what this node placed itself is no news
            message.transforms = [t for t in message.transforms if t not in self._published]
        self._tree.add(message, latched=latched)

    def _uses_tf(self, frame: str, settings: LiveSettings) -> bool:
        if settings.extrinsics != 'auto':
            return settings.extrinsics == 'tf'
        is_given = bool(settings.calibration_file)
        return not is_given and bool(frame) and self._tree.is_connected(frame, self._links)

    def _check_age(
        self, view: str, frame: str, mount: Mount, stamp_ns: int, longest_s: float
    ) -> None:
        if mount.stamp_ns is None:
            return
        age_s = (stamp_ns - mount.stamp_ns) / NANO
        if age_s > longest_s:
            raise Rejection(
                Reason.CAMERA_POSE_STALE,
                f"/tf from '{mount.link}' to '{frame}', the camera of view '{view}', is "
                f"{age_s:.3f} s older than the image; 'max_tf_age_s' allows {longest_s:g} s",
            )

    def _log_absence(self) -> None:
        if self._settings().extrinsics == 'tf':
            raise ConfigError(
                "parameter 'extrinsics' is 'tf', which needs tf2_msgs: it is part of a native ROS "
                "installation (ros-jazzy-tf2-msgs), not of the wheels; set it to 'file'"
            )
        self._node.get_logger().info(
            "tf2_msgs is not installed: the cameras' poses come from the calibration file, and no "
            'frames are published'
        )


def _differ(one: FloatArray, other: FloatArray) -> bool:
    return bool(np.abs(one - other).max() > STILL)


def _words(mount: Mount) -> str:
    ahead, place = (', '.join(f'{v:.3f}' for v in mount.T_link_frame[:3, k]) for k in (2, 3))
    return f"at ({place}) m in '{mount.link}', looking along ({ahead})"
