"""Rollout from still images of the views and a table of joints, without a recording.

V views, T rows, J joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.core.data_types import (
    ByteArray,
    CameraModel,
    FloatArray,
    JointTrajectory,
    Observation,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import CalibrationError, ConfigError
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import match_joints

#: names of the column with the time of each row [s]
TIME_COLUMNS = ('time', 'time_s', 't', 'timestamp')


def view_images(spec: WorldModelSpec, images: Mapping[str, ByteArray]) -> ByteArray:
    """Return the images (V, H, W, 3) of all views at one size, that of the largest.

    Args:
        spec: views of the model.
        images: image (H, W, 3) uint8 RGB of each view.

    Raises:
        ConfigError: an image of a view is missing, or one of another view is given.
    """
    if set(images) != set(spec.views):
        raise ConfigError(
            f'images are of {", ".join(images) or "no view"}; the model has the views '
            f'{", ".join(spec.views)}, and needs one of each: --image '
            + ','.join(f'{view}.png' for view in spec.views)
        )
    height, width = max((image.shape[:2] for image in images.values()), key=np.prod)
    return np.stack([resize_frames(images[v][None], width, height)[0] for v in spec.views])


def read_view_cameras(spec: WorldModelSpec, calibration: Path) -> tuple[CameraModel, ...]:
    """Return the cameras of the views of a calibration file, in the model's order.

    Raises:
        CalibrationError: the file is wrong, or lacks a view.
    """
    cameras = load_calibration(calibration)
    missing = [view for view in spec.views if view not in cameras]
    if missing:
        raise CalibrationError(f"'{calibration}' has no camera of view '{missing[0]}'")
    return tuple(cameras[view] for view in spec.views)


def table_start(
    robot: RobotModel,
    spec: WorldModelSpec,
    frames: ByteArray,
    cameras: tuple[CameraModel, ...],
    names: tuple[str, ...],
    values: FloatArray,
) -> tuple[Observation, JointTrajectory]:
    """Return the observation that a rollout starts from, and the commands of a table.

    Args:
        robot: robot whose joints the table names.
        spec: rate of rows without times.
        frames: (V, H, W, 3) uint8 RGB.
        cameras: cameras of the V views at any size.
        names: names of the columns: the joints, and one of `TIME_COLUMNS` if rows have times.
        values: (T, C); row 0 is measured at the images, the others are commanded [rad or m].

    Raises:
        ConfigError: there are fewer than two rows, or times do not increase.
        TrajectoryError: joints of the robot are missing.
    """
    if len(values) < 2:
        raise ConfigError(
            f'the table of joints has {len(values)} rows; the first is where the robot stands, '
            'and at least one command must follow'
        )
    times = np.arange(len(values)) / spec.fps
    found = [name for name in names if name.lower() in TIME_COLUMNS]
    if found:
        times = values[:, names.index(found[0])] - values[0, names.index(found[0])]
        if not (np.diff(times) > 0).all():
            raise ConfigError(f"column '{found[0]}' of the table of joints must increase [s]")
    columns = [index for index, name in enumerate(names) if name not in found]
    whole = match_joints(
        JointTrajectory(
            joint_names=tuple(names[index] for index in columns),
            times=times,
            positions=values[:, columns],
        ),
        robot,
    )
    height, width = frames.shape[1:3]
    observation = Observation(
        cameras=tuple(scaled(camera, width, height) for camera in cameras),
        frames=frames,
        positions=whole.positions[0],
        stamp_ns=0,
    )
    return observation, whole.points(np.arange(len(times)) > 0, times)
