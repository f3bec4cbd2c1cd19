"""ROS messages with faults, and what the node makes of them in process: refused, or plausible.

A case is a scene (images, camera infos, joint state) and a plan of which one message is damaged;
the node's own checks look at it, as its callbacks do. What they let through is judged here anew,
with numbers of its own: a plan that would be imagined from implausible input is a failure.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import cache
import importlib
from pathlib import Path
import subprocess
from typing import Any

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
FLOATS = (
    float('nan'), float('inf'), -float('inf'), 1e300, -1e300, 1e30, 1e9, 1e-320, 0.0, -0.0, -1.0,
    7.0, 100.0, 3.2, 0.031, -0.001,
)  # fmt: skip
COUNTS = (0, 1, 2, 35, 36, 72, 96, 97, 1000, 65_535, 2**31 - 1, 2**32 - 1)
WORDS = ('', 'rgb8', 'bgr8', 'mono8', 'rgba8', 'bgra8', '16UC1', '32FC1', 'bayer_rggb8', 'yuv422',
         'jpeg', 'png', 'plumb_bob', 'equidistant', 'rational_polynomial', 'left_joint1',
         'left_gripper', '\N{SNOWMAN}' * 9, 'x' * 20_000, '../../x', '%s%n')  # fmt: skip
#: of a list that was changed
MOST_ITEMS = 30_000
NOW_NS = 1_000_000_000_000


@cache
def ros() -> Any:
    """The messages and sizes of the tests over ROS."""
    return importlib.import_module('test.support.ros_nodes')


def commit() -> str:
    """Short name of the commit that is tried; a + says that files were changed."""
    words = ['git', '-C', str(ROOT), 'describe', '--always', '--dirty=+']
    return subprocess.run(words, capture_output=True, text=True).stdout.strip()


def number(rng: np.random.Generator) -> float:
    """A number, mostly at the end of a format."""
    return float(rng.choice(FLOATS)) if rng.random() < 0.7 else float(rng.normal() * 3)


def count(rng: np.random.Generator) -> int:
    """A size of something."""
    return int(rng.choice(COUNTS)) if rng.random() < 0.8 else int(rng.integers(0, 300))


def stamp(rng: np.random.Generator, message: Any) -> None:
    """Another time in the message's header."""
    message.header.stamp.sec = int(rng.choice([0, -1, 1000, 999, 1001, 2**31 - 1, -(2**31)]))
    message.header.stamp.nanosec = int(rng.choice([0, 10**9 - 1, 10**9, 2**32 - 1]))


def changed_list(rng: np.random.Generator, values: list[Any], new: Callable[[], Any]) -> list[Any]:
    """The list with elements replaced, repeated, left out, put in, or in another order."""
    out = list(values)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, len(out) + 1))
        how = int(rng.integers(6))
        if how == 0:
            out[at : at + 1] = [new()]
        elif how == 1:
            out[at:at] = [new()]
        elif how == 2:
            out[at : at + int(rng.integers(1, 4))] = []
        elif how == 3:
            out[at:at] = out[: int(rng.integers(1, 9))]
        elif how == 4:
            out = [out[k] for k in rng.permutation(len(out))]
        else:
            times = int(rng.choice([0, 2, 2, 300]))
            # no more copies than are kept: 300 of a list that is long already take 72 MB
            out = (out * min(times, MOST_ITEMS // max(len(out), 1) + 1))[:MOST_ITEMS]
    return out


def _joint_state(rng: np.random.Generator, message: Any) -> None:
    if rng.random() < 0.5:
        message.name = changed_list(rng, list(message.name), lambda: str(rng.choice(WORDS)))
    if rng.random() < 0.7:
        new = changed_list(rng, list(message.position), lambda: number(rng))
        message.position = array('d', new)


def _plan(rng: np.random.Generator, message: Any) -> None:
    names = list(message.joint_names)
    if rng.random() < 0.3:
        message.joint_names = changed_list(rng, names, lambda: str(rng.choice(WORDS)))
    if rng.random() < 0.3:
        first = message.points[0]
        message.points = changed_list(rng, list(message.points), lambda: first)
    for point in [p for p in message.points[:8] if rng.random() < 0.3]:
        if rng.random() < 0.6:
            point.positions = array(
                'd', changed_list(rng, list(point.positions), lambda: number(rng))
            )
        if rng.random() < 0.3:
            point.velocities = array('d', [number(rng) for _ in range(int(rng.integers(16)))])
        if rng.random() < 0.3:
            after = point.time_from_start
            after.sec = int(rng.choice([0, -1, 1, 2**31 - 1, -(2**31)]))
            after.nanosec = int(rng.choice([0, 1, 2**32 - 1]))


def _image(rng: np.random.Generator, message: Any) -> None:
    for field in [f for f in ('height', 'width', 'step') if rng.random() < 0.3]:
        setattr(message, field, count(rng))
    if rng.random() < 0.3:
        message.encoding = str(rng.choice(WORDS))
    if rng.random() < 0.3:
        data = bytes(message.data)
        message.data = array('B', data[: int(rng.integers(0, len(data) + 1))])
    message.is_bigendian = int(rng.integers(0, 256)) if rng.random() < 0.1 else 0


def _compressed(rng: np.random.Generator, message: Any) -> None:
    if rng.random() < 0.3:
        message.format = str(rng.choice(WORDS))
    data = bytearray(bytes(message.data))
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, len(data) + 1))
        data[at : at + int(rng.integers(0, 9))] = rng.bytes(int(rng.integers(0, 9)))
    if rng.random() < 0.2:
        del data[int(rng.integers(0, len(data) + 1)) :]
    message.data = array('B', bytes(data))


def _info(rng: np.random.Generator, message: Any) -> None:
    for field in [f for f in ('k', 'p', 'r') if rng.random() < 0.4]:
        values = np.array(getattr(message, field), float)
        values[int(rng.integers(len(values)))] = number(rng)
        setattr(message, field, values)
    if rng.random() < 0.5:
        message.d = [number(rng) for _ in range(int(rng.choice([0, 1, 4, 5, 8, 12, 14, 20])))]
    if rng.random() < 0.3:
        message.distortion_model = str(rng.choice(WORDS))
    for field in [f for f in ('height', 'width', 'binning_x') if rng.random() < 0.2]:
        setattr(message, field, count(rng))


#: kind -> how it is damaged
DAMAGE: dict[str, Callable[[np.random.Generator, Any], None]] = {
    'joints': _joint_state,
    'plan': _plan,
    'image_low': _image,
    'compressed_low': _compressed,
    'info_low': _info,
}


@cache
def _png(view: str) -> bytes:
    return cv2.imencode('.png', ros().make_pixels(view))[1].tobytes()


def whole(key: str) -> Any:
    """An undamaged message of `DAMAGE`'s keys, of now."""
    name, _, view = key.partition('_')
    if name == 'joints':
        return ros().make_joint_state(NOW_NS)
    if name == 'plan':
        return ros().make_trajectory()
    if name == 'info':
        return ros().make_info(view, NOW_NS)
    if name == 'image':
        return ros().make_image(view, NOW_NS)
    return ros().make_jpeg(view, NOW_NS)


def damaged(key: str, rng: np.random.Generator) -> Any:
    """A damaged message."""
    message = whole(key)
    if key == 'compressed_low' and rng.random() < 0.3:
        message.data, message.format = array('B', _png('low')), 'rgb8; png compressed bgr8'
    DAMAGE[key](rng, message)
    if rng.random() < 0.1:
        stamp(rng, message)
    return message


@cache
def _fixed() -> Any:
    """Robot, cameras and settings, which no case changes."""
    import tempfile

    from mtv_world_ros.cameras.calibration_file import load_calibration
    from mtv_world_ros.core.files import share_path
    from mtv_world_ros.robot.file import load_robot
    from mtv_world_ros.ros.parameters import Settings

    with tempfile.TemporaryDirectory() as folder:
        cameras = load_calibration(ros().make_calibration(Path(folder) / 'calibration.yaml'))
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    return robot, tuple(cameras.values()), Settings()


def send(key: str, message: Any) -> None:
    """Show a scene with this message to the node's checks, and then ask for a rollout.

    Raises:
        Rejection: as the node says.
        AssertionError: the rollout would begin, from implausible input.
    """
    from mtv_world_ros.core.bounded_input import check_limit
    from mtv_world_ros.ros.messages.rejection import Reason, rejected_as
    from mtv_world_ros.ros.sensing.observations import ObservationBuffer
    from mtv_world_ros.ros.world_model.request_maker import RequestMaker

    robot, cameras, settings = _fixed()
    if key == 'instruction':
        with rejected_as(Reason.INSTRUCTION_TOO_LONG):
            check_limit('instruction_characters', len(message.data), 'the instruction')
        return
    buffer = ObservationBuffer(
        cameras=cameras,
        robot=robot,
        width=48,
        height=36,
        limits=lambda: settings,
    )
    maker = RequestMaker(robot, buffer, lambda: settings, lambda: None)
    kind = 'compressed' if key == 'compressed_low' else 'image'
    for view in ros().VIEWS:
        info, image = f'info_{view}', f'{kind}_{view}'
        buffer.add_camera_info(view, message if info == key else whole(info))
        buffer.add_image(view, message if image == key else whole(image))
    buffer.add_joint_state(message if key == 'joints' else whole('joints'))
    request = maker.make(message if key == 'plan' else whole('plan'), NOW_NS, 0.0)
    check_plausible(request, robot)


def check_plausible(request: Any, robot: Any) -> None:
    """Judge what would be imagined, by numbers that are not the node's.

    Raises:
        AssertionError: no robot and no camera is like that.
    """
    trajectory, observation = request.plan.trajectory, request.scene.observation
    names = trajectory.joint_names
    assert 0 < len(names) <= len(set(names)) <= 14, 'joint names'
    assert set(names) <= set(robot.joint_names), 'joint names of another robot'
    limits = dict(zip(robot.joint_names, zip(robot.lower, robot.upper, strict=True), strict=True))
    for column, name in enumerate(names):
        low, high = limits[name]
        values = trajectory.positions[:, column]
        assert (values >= low - 0.01).all() and (values <= high + 0.01).all(), (
            f'{name} in the plan'
        )
    assert np.isfinite(trajectory.times).all() and (np.diff(trajectory.times) > 0).all(), 'times'
    assert 0 <= trajectory.times[-1] < 3600, 'duration'
    measured = observation.positions
    assert np.isfinite(measured).all() and (np.abs(measured) < 10).all(), 'measured joints'
    views, height, width, channels = observation.frames.shape
    assert (views, channels) == (2, 3) and observation.frames.dtype == np.uint8
    assert min(width, height) > 0 and width * height < 1.01 * 640 * 480, 'size of the frames'
    for camera in observation.cameras:
        focal = camera.K[[0, 1], [0, 1]]
        assert np.isfinite(camera.K).all(), 'intrinsics'
        assert (focal > 2).all() and (focal < 5000).all(), 'focal lengths'
        assert (camera.width, camera.height) == (width, height), 'size of the cameras'
        assert -1 < camera.K[0, 2] < width + 1 and -1 < camera.K[1, 2] < height + 1, (
            'principal point'
        )
        assert np.isfinite(camera.distortion).all(), 'distortion'
