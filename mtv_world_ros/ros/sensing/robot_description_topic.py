"""The topic `robot_description`: the live robot's lengths, offsets and limits, or a refusal."""

from __future__ import annotations

from collections.abc import Callable
import hashlib
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from mtv_world_ros.bounded_input import check_limit
from mtv_world_ros.errors import RobotError
from mtv_world_ros.geometry.robot.description import described_robot
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.ros.messages.rejection import bounded, Reason, Rejection
from mtv_world_ros.ros.qos_profiles import LATCHED

Handler = Callable[[Any], None]
TOPIC = 'robot_description'


class RobotDescription:
    """Holds what is described against the robot that the checkpoint was trained on.

    Args:
        node: owner of the subscription.
        expected: the checkpoint's robot.
        on_robot: gets the same robot with the described kinematics and limits.
        guarded: wraps a handler so that it never raises.
    """

    def __init__(
        self,
        node: Node,
        expected: RobotModel,
        on_robot: Callable[[RobotModel], None],
        guarded: Callable[[Handler], Handler],
    ) -> None:
        self._expected, self._on_robot = expected, on_robot
        self._log = node.get_logger()
        self._seen = b''
        self._problem = ''
        self._offset_m: float | None = None
        self._topic = node.resolve_topic_name(TOPIC)
        node.create_subscription(String, TOPIC, guarded(self._take), LATCHED)

    def problems(self) -> list[str]:
        """What is wrong with the description; empty = nothing."""
        return [self._problem] if self._problem else []

    def values(self) -> dict[str, object]:
        """For `/diagnostics`."""
        if self._problem:
            return {TOPIC: 'another robot'}
        if self._offset_m is None:
            return {TOPIC: 'none'}
        return {TOPIC: 'used', f'{TOPIC}.offset_m': self._offset_m}

    def _take(self, message: String) -> None:
        with bounded(Reason.ROBOT_DESCRIPTION):
            check_limit('urdf_bytes', len(message.data), f'{self._topic}')
        text = message.data.encode()
        digest = hashlib.sha256(text).digest()
        if digest == self._seen:  # several nodes may publish the same one
            return
        self._seen = digest
        try:
            found = described_robot(self._expected, message.data)
        except RobotError as error:
            self._offset_m = None
            self._problem = (
                f"{self._topic}: {error}. Set 'use_robot_description' to false, or remap the "
                'topic, if it is meant for somebody else'
            )
            raise Rejection(Reason.ROBOT_DESCRIPTION, self._problem) from error
        self._problem, self._offset_m = '', found.offset_m
        self._on_robot(found.robot)
        self._log.info(
            f"{self._topic}: robot '{found.robot.name}'; its tools are up to "
            f"{1000 * found.offset_m:.1f} mm off those of the checkpoint's description"
        )
