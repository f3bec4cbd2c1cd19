"""The predicted frames as a policy sees them: collected by stamp, checked, made an observation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sensor_msgs.msg import Image, JointState

from mtv_world_ros.data_types import Observation
from mtv_world_ros.geometry.camera import scaled
from mtv_world_ros.ros.messages.conversions import to_positions
from mtv_world_ros.ros.messages.image_messages import to_rgb
from mtv_world_ros.ros.messages.stamps import NANO, to_ns


def chunk_stamps(start_ns: int, num_frames: int, fps: float) -> list[int]:
    """Stamps of a chunk's frames [ns], from the stamp it starts at."""
    return [start_ns + round((k + 1) / fps * NANO) for k in range(num_frames)]


class PredictedFrames:
    """Keeps what the world model published since the last `clear`.

    Args:
        views: names of the V views, in the model's order.
        joint_names: J names, in the robot's order.
    """

    def __init__(self, views: Sequence[str], joint_names: Sequence[str]) -> None:
        self._joint_names = tuple(joint_names)
        self._images: dict[str, dict[int, Image]] = {view: {} for view in views}
        self._joints: dict[int, JointState] = {}

    def add_image(self, view: str, message: Image) -> None:
        """Stores a predicted image."""
        self._images[view][to_ns(message.header.stamp)] = message

    def add_joint_state(self, message: JointState) -> None:
        """Stores a predicted joint state."""
        self._joints[to_ns(message.header.stamp)] = message

    def clear(self) -> None:
        """Forgets all of them."""
        for stored in (*self._images.values(), self._joints):
            stored.clear()

    def missing(self, stamps: Sequence[int]) -> list[str]:
        """What is not here of the frames at these stamps, as text."""
        streams = {**self._images, 'joint_states': self._joints}
        return [
            f'{name} at {stamp} ns'
            for name, stored in streams.items()
            for stamp in stamps
            if stamp not in stored
        ]

    def unexpected(self, stamps: Sequence[int]) -> list[int]:
        """Stamps of images that are here and not among these."""
        found = {stamp for stored in self._images.values() for stamp in stored}
        return sorted(found - set(stamps))

    def observation(self, stamp_ns: int, before: Observation) -> Observation:
        """The frames at a stamp as an observation, with the cameras of an earlier one.

        Raises:
            Rejection: an image or the joint state cannot be read.
        """
        frames = [to_rgb(stored[stamp_ns]) for stored in self._images.values()]
        positions = to_positions(self._joints[stamp_ns])
        height, width = frames[0].shape[:2]
        return Observation(
            cameras=tuple(scaled(camera, width, height) for camera in before.cameras),
            frames=np.stack(frames),
            positions=np.array([positions[name] for name in self._joint_names]),
            stamp_ns=stamp_ns,
        )
