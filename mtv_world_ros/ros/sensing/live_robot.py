"""What a live robot says of itself: its description and, by TF, where its cameras are."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from mtv_world_ros.data.transform_tree import Mount
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.sensing.extrinsics import Extrinsics
from mtv_world_ros.ros.sensing.observations import SensedScene
from mtv_world_ros.ros.sensing.robot_description_topic import Handler, RobotDescription


class LiveRobot:
    """Listens to `robot_description` and TF, as far as the parameters say so.

    Args:
        node: owner of the subscriptions.
        expected: the robot that the checkpoint was trained on.
        settings: the present parameters.
        on_robot: gets the same robot as it is described.
        guarded: wraps a handler so that it never raises.

    Raises:
        ConfigError: poses are to come from TF, and tf2_msgs is not installed.
    """

    def __init__(
        self,
        node: Node,
        expected: RobotModel,
        settings: Callable[[], Settings],
        on_robot: Callable[[RobotModel], None],
        guarded: Callable[[Handler], Handler],
    ) -> None:
        self._extrinsics = Extrinsics(node, expected.posed_links, settings, guarded)
        self._description: RobotDescription | None = None
        if settings().use_robot_description:
            self._description = RobotDescription(node, expected, on_robot, guarded)

    def pose(self, view: str, frame: str, stamp_ns: int) -> Mount | None:
        """See `Extrinsics.pose`."""
        return self._extrinsics.pose(view, frame, stamp_ns)

    def check(self) -> None:
        """Refuses to go on while another robot is described.

        Raises:
            Rejection: with what is different.
        """
        for problem in self.problems():
            raise Rejection(Reason.ROBOT_DESCRIPTION, problem)

    def problems(self) -> list[str]:
        """What keeps the robot from being imagined; empty = nothing."""
        return [] if self._description is None else self._description.problems()

    def values(self) -> dict[str, object]:
        """For `/diagnostics`."""
        described = {} if self._description is None else self._description.values()
        return {**described, **self._extrinsics.values()}

    def show(self, scene: SensedScene) -> None:
        """Publishes the frames of a scene's views that TF lacks."""
        self._extrinsics.show(scene)

    def accept(self) -> None:
        """Takes changed camera poses as the valid ones from now on."""
        self._extrinsics.accept()

    def forget_moving(self) -> None:
        """Forgets what /tf said: the clock went back."""
        self._extrinsics.forget_moving()
