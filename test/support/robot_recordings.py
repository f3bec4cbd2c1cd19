"""Recordings of the bundled `franka` on topics of its own: 4 s, two views of 32 x 24 px."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import CameraModel, JointTrajectory
from mtv_world_ros.core.images import encode_jpeg
from mtv_world_ros.data.bag import messages

NANO = 1_000_000_000
START = 1_750_000_000 * NANO
SECONDS, FPS, RATE = 4.0, 10, 50
JOINTS = [*(f'panda_joint{k}' for k in range(1, 8)), 'panda_finger_joint1']
HOME = np.array([0, -0.4, 0, -2.2, 0, 1.9, 0.785, 0.03])
VIEWS = ('front', 'side')
IMAGE = '/{}/image_raw/compressed'

Event = tuple[float, str, str, Any]


def positions(seconds: float) -> np.ndarray:
    row = HOME.copy()
    row[0] += 0.4 * np.sin(0.9 * seconds)
    row[5] += 0.2 * np.sin(1.7 * seconds)
    return row


def camera(view: str) -> CameraModel:
    T = np.array([[1.0, 0, 0, 0.1], [0, 0, 1, -1.0], [0, -1, 0, 0.4], [0, 0, 0, 1]])
    K = np.array([[40.0, 0, 15.5], [0, 40, 11.5], [0, 0, 1]])
    return CameraModel(view=view, width=32, height=24, K=K, mount_link='base', T_mount_camera=T)


def ns(seconds: float) -> int:
    return START + round(seconds * NANO)


def plan(seconds: float) -> Any:
    """The positions of the second that follows."""
    times = np.arange(1, 11) / 10
    rows = np.stack([positions(seconds + t) for t in times])
    trajectory = JointTrajectory(joint_names=tuple(JOINTS), times=times, positions=rows)
    return messages.make_joint_trajectory(ns(seconds), trajectory)


def events() -> list[Event]:
    """Messages of a recording: receive time [s], topic, type, message."""
    found: list[Event] = []
    for view in VIEWS:
        tf = messages.make_tf(
            START, 'panda_link0', f'{view}_optical_frame', camera(view).T_mount_camera
        )
        found.append((0.0, '/tf_static', messages.TF_MESSAGE, tf))
    for k in range(round(SECONDS * RATE)):
        t = k / RATE
        state = messages.make_joint_state(ns(t), JOINTS, positions(t))
        found.append((t, '/joint_states', messages.JOINT_STATE, state))
    jpeg = encode_jpeg(np.full((24, 32, 3), 90, np.uint8), 90)
    for k in range(round(SECONDS * FPS)):
        t = k / FPS + 0.003
        for view in VIEWS:
            frame = f'{view}_optical_frame'
            image = messages.make_compressed(ns(t), frame, jpeg)
            info = messages.make_camera_info(ns(t), camera(view), frame)
            found.append((t, IMAGE.format(view), messages.COMPRESSED_IMAGE, image))
            found.append((t, f'/{view}/camera_info', messages.CAMERA_INFO, info))
    for k in range(round(SECONDS)):
        found.append((k + 0.004, '/joint_trajectory', messages.JOINT_TRAJECTORY, plan(k + 0.004)))
    return found


Edit = Callable[[str, float, int], int | None]
