"""The start of an imagined episode: a recorded frame, or the present one of the cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, JointState

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.episode import CALIBRATION_FILE, optical_frame
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.ros.messages.conversions import (
    make_header,
    NANO,
    to_joint_state,
    to_positions,
    to_stamp,
)
from mtv_world_ros.ros.messages.image_messages import info_of_camera, to_image
from mtv_world_ros.ros.sensing.subscriptions import Handler, MatchedSubscription


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeStart:
    """Images, camera infos and joint state of one moment.

    Attributes:
        source: recorded episode, or live topics.
        task: name of the task, if known.
        scene_seed: seed of the scene; -1 = not known.
        recording: folder of the recorded episode; empty = there is none.
        recording_ns: stamp of this moment in it [ns].
        instruction: text for the robot, if known.
        calibration_file: every view's pose; empty = the one the nodes have.
        images: image by view.
        camera_infos: CameraInfo by view.
        joint_state: positions of all joints.
    """

    source: str
    task: str = ''
    scene_seed: int = -1
    recording: str = ''
    recording_ns: int = 0
    instruction: str = ''
    calibration_file: str = ''
    images: Mapping[str, Image]
    camera_infos: Mapping[str, CameraInfo]
    joint_state: JointState

    def stamped(self, stamp_ns: int) -> list[tuple[str, Image | CameraInfo | JointState]]:
        """The messages by topic, all stamped alike, joint state first."""
        messages: list[tuple[str, Image | CameraInfo | JointState]] = [
            ('joint_states', self.joint_state)
        ]
        messages += [(f'{view}/camera_info', info) for view, info in self.camera_infos.items()]
        messages += [(f'{view}/image_raw', image) for view, image in self.images.items()]
        for _, message in messages:
            message.header.stamp = to_stamp(stamp_ns)
        return messages


def recorded_start(path: Path, views: Sequence[str], start_s: float = 0.0) -> EpisodeStart:
    """Read a moment of a recorded episode.

    Args:
        path: rosbag2 MCAP folder with a calibration.yaml.
        views: names of the views.
        start_s: time since the first frame of the first view [s].

    Raises:
        EpisodeError: the episode cannot be read, or ends before.
    """
    episode = read_episode(path, views=views, with_masks=False)
    stamps = np.asarray(episode.images[views[0]].stamps_ns)
    stamp_ns = int(stamps[0]) + round(start_s * NANO)
    states = episode.joint_states
    if states is None or stamp_ns > stamps[-1]:
        seconds = (stamps[-1] - stamps[0]) / NANO
        raise EpisodeError(
            f"episode '{path}' has no joint_states"
            if states is None
            else f"episode '{path}' is {seconds:.2f} s long; it has no frame at {start_s:g} s"
        )
    images = {}
    for view in views:
        track = episode.images[view]
        index = int(np.abs(np.asarray(track.stamps_ns) - stamp_ns).argmin())
        images[view] = to_image(
            np.asarray(track.frames[index]), make_header(0, optical_frame(view))
        )
    nearest = int(np.abs(np.asarray(states.stamps_ns) - stamp_ns).argmin())
    info, calibration = episode.info, path / CALIBRATION_FILE
    return EpisodeStart(
        source=str(path),
        task=info.task,
        scene_seed=-1 if info.seed is None else info.seed,
        recording=str(path.absolute()),
        recording_ns=stamp_ns,
        instruction=info.instruction,
        calibration_file=str(calibration.absolute()) if calibration.is_file() else '',
        images=images,
        camera_infos={
            view: info_of_camera(episode.cameras[view], make_header(0, optical_frame(view)))
            for view in views
        },
        joint_state=to_joint_state(states.joint_names, states.positions[nearest], make_header(0)),
    )


class LiveCameras:
    """Keeps the newest images, camera infos and joint states.

    Args:
        node: owner of the subscriptions.
        views: names of the views; topics `<view>/image_raw`, `<view>/camera_info`.
    """

    def __init__(self, node: Node, views: Sequence[str]) -> None:
        self._images: dict[str, Image] = {}
        self._infos: dict[str, CameraInfo] = {}
        self._positions: dict[str, float] = {}
        self._views = tuple(views)
        wanted: list[tuple[type, str, Handler]] = [
            (JointState, 'joint_states', self._add_joint_state)
        ]
        for view in views:
            wanted.append((Image, f'{view}/image_raw', partial(self._images.__setitem__, view)))
            info = partial(self._infos.__setitem__, view)
            wanted.append((CameraInfo, f'{view}/camera_info', info))
        self._subscriptions = [
            MatchedSubscription(node, kind, topic, handle, depth=1)
            for kind, topic, handle in wanted
        ]

    def refresh(self) -> None:
        """Match QoS to the publishers again; call it periodically."""
        for subscription in self._subscriptions:
            subscription.refresh()

    def clear(self) -> None:
        """Drop images and joint states, so that the next ones are new."""
        self._images.clear()
        self._positions.clear()

    def missing(self) -> list[str]:
        """Names of what was not received yet."""
        missing = [f"image of '{view}'" for view in self._views if view not in self._images]
        missing += [f"camera_info of '{v}'" for v in self._views if v not in self._infos]
        return missing + ([] if self._positions else ['joint_states'])

    def start(self, instruction: str) -> EpisodeStart:
        """Return the newest messages as the start of an episode."""
        names = tuple(self._positions)
        values = np.array([self._positions[name] for name in names])
        return EpisodeStart(
            source='live',
            instruction=instruction,
            images=dict(self._images),
            camera_infos=dict(self._infos),
            joint_state=to_joint_state(names, values, make_header(0)),
        )

    def _add_joint_state(self, message: JointState) -> None:
        self._positions |= to_positions(message)
