"""What the node subscribes to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from mtv_world_ros.ros import parameters
from mtv_world_ros.ros.sensing.matched_subscription import MatchedSubscription
from mtv_world_ros.ros.sensing.observations import ObservationBuffer

Handler = Callable[[Any], None]


class Inputs:
    """Subscriptions to the cameras, joint states, instruction and trajectories.

    Args:
        node: owner of the subscriptions.
        views: names of the views; parameters give each its camera topic.
        compressed: whether images come as JPEG or PNG.
        buffer: gets images, camera infos and joint states.
        on_instruction: gets the instruction.
        on_trajectory: gets the trajectories.
        guarded: wraps a handler so that it never raises.
    """

    def __init__(
        self,
        node: Node,
        views: Sequence[str],
        *,
        compressed: bool,
        buffer: ObservationBuffer,
        on_instruction: Handler,
        on_trajectory: Handler,
        guarded: Callable[[Handler], Handler],
    ) -> None:
        self._all = subscribe_observations(
            node, views, compressed=compressed, buffer=buffer, guarded=guarded
        )
        instruction = guarded(on_instruction)
        self._all.append(MatchedSubscription(node, String, 'instruction', instruction, depth=1))
        handle = guarded(on_trajectory)
        self._plans = MatchedSubscription(
            node, JointTrajectory, 'joint_trajectory', handle, depth=10, default='reliable'
        )
        self._all.append(self._plans)

    def refresh(self) -> None:
        """Looks at the publishers again; to be called now and then."""
        for subscription in self._all:
            subscription.refresh()

    def publisher_counts(self) -> dict[str, int]:
        """Publishers by topic, as `publishers.<topic>`, and `policies`: those of trajectories."""
        counts = {f'publishers.{i.topic}': i.num_publishers for i in self._all}
        return {**counts, 'policies': self._plans.num_publishers}


def subscribe_observations(
    node: Node,
    views: Sequence[str],
    *,
    compressed: bool,
    buffer: ObservationBuffer,
    guarded: Callable[[Handler], Handler],
) -> list[MatchedSubscription]:
    """Subscribes to the cameras and joint states; see `Inputs`."""
    kind, suffix = (CompressedImage, '/compressed') if compressed else (Image, '')
    newest: list[tuple[Any, str, Handler, int]] = []
    for view, topic in parameters.declare_camera_topics(node, views).items():
        newest += [
            (CameraInfo, f'{topic}/camera_info', partial(buffer.add_camera_info, view), 1),
            (kind, f'{topic}/image_raw{suffix}', partial(buffer.add_image, view), 1),
        ]
    newest.append((JointState, 'joint_states', buffer.add_joint_state, 10))
    return [
        MatchedSubscription(node, kind, topic, guarded(handle), depth=depth)
        for kind, topic, handle, depth in newest
    ]
