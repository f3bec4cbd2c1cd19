"""Calibration YAML files: one camera per view."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mtv_world_ros.config import check_keys, read_yaml
from mtv_world_ros.data_types import CameraModel, FloatArray
from mtv_world_ros.errors import CalibrationError
from mtv_world_ros.files import write_whole
from mtv_world_ros.geometry.camera import check_plausible
from mtv_world_ros.geometry.transforms import is_rigid, pose

_KEYS = ('width', 'height', 'K', 'distortion_model', 'distortion', 'mount_link',
         'T_mount_camera', 'position', 'quaternion_xyzw')  # fmt: skip
_REQUIRED = ('width', 'height', 'K', 'mount_link')


def load_calibration(path: Path | str) -> dict[str, CameraModel]:
    """Reads `views: {<view>: {...}}`.

    Each view has `width`, `height`, `K` (3 x 3 or fx, fy, cx, cy), optional
    `distortion_model` and `distortion`, `mount_link`, and the pose of the optical frame in it:
    `T_mount_camera` (4 x 4) or `position` and `quaternion_xyzw`.

    Raises:
        CalibrationError: names the file, the view and what is wrong.
    """
    path = Path(path)
    values = read_yaml(path, 'calibration file', 'calibration_file', error=CalibrationError)
    views = values.get('views') if isinstance(values, dict) else None
    if not isinstance(views, dict) or list(values) != ['views']:
        raise CalibrationError(f"'{path}' must hold 'views: {{<view>: {{...}}}}' and nothing else")
    return {str(view): _camera(str(view), row, f"'{path}' view '{view}'")
            for view, row in views.items()}  # fmt: skip


def save_calibration(path: Path | str, cameras: Mapping[str, CameraModel]) -> None:
    """Writes cameras; `load_calibration` reads back exactly the same values."""
    views = {
        view: {
            'width': camera.width,
            'height': camera.height,
            'K': camera.K.tolist(),
            'distortion_model': camera.distortion_model,
            'distortion': camera.distortion.tolist(),
            'mount_link': camera.mount_link,
            'T_mount_camera': camera.T_mount_camera.tolist(),
        }
        for view, camera in cameras.items()
    }
    text = yaml.safe_dump({'views': views}, sort_keys=False, default_flow_style=None)
    write_whole(Path(path), text)


def _camera(view: str, row: Any, where: str) -> CameraModel:
    check_keys(row, _KEYS, _REQUIRED, where, error=CalibrationError)
    try:
        camera = CameraModel(
            view=view,
            width=int(row['width']),
            height=int(row['height']),
            K=_intrinsics(row['K']),
            distortion_model=str(row.get('distortion_model', 'none')),
            distortion=np.array(row.get('distortion', ()), dtype=float),
            mount_link=str(row['mount_link']),
            T_mount_camera=_pose(row),
        )
        check_plausible(camera)
        return camera
    except (ValueError, TypeError, ArithmeticError, CalibrationError) as error:
        raise CalibrationError(f'{where}: {error}') from error


def _intrinsics(value: Any) -> FloatArray:
    K = np.array(value, dtype=float)
    if K.shape == (4,):
        return np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1.0]])
    if K.shape != (3, 3):
        raise ValueError(f'K is {value!r}, must be 3 x 3 or fx, fy, cx, cy [px]')
    return K


def _pose(row: Mapping[str, Any]) -> FloatArray:
    given = {'T_mount_camera', 'position', 'quaternion_xyzw'} & set(row)
    if given == {'position', 'quaternion_xyzw'}:
        return pose(row['position'], row['quaternion_xyzw'])
    if given != {'T_mount_camera'}:
        raise ValueError("give either 'T_mount_camera', or 'position' and 'quaternion_xyzw'")
    T = np.array(row['T_mount_camera'], dtype=float)
    if T.shape != (4, 4) or not is_rigid(T):
        raise ValueError(
            f'T_mount_camera is {row["T_mount_camera"]!r}, must be a rigid pose: 4 x 4, its 3 x 3 '
            'part a rotation, its last row 0 0 0 1'
        )
    return T
