"""Calibration YAML files: one camera a view."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mtv_world_ros.data_types import CameraModel
from mtv_world_ros.errors import CalibrationError, nearest
from mtv_world_ros.geometry.transforms import pose

_KEYS = ('width', 'height', 'K', 'distortion_model', 'distortion', 'mount_link',
         'T_mount_camera', 'position', 'quaternion_xyzw')  # fmt: skip


def load_calibration(path: Path) -> dict[str, CameraModel]:
    """Reads `views: {<view>: {...}}`.

    Each view has `width`, `height`, `K` (3 x 3 or fx, fy, cx, cy), optional
    `distortion_model` and `distortion`, `mount_link`, and the pose of the optical frame in it:
    `T_mount_camera` (4 x 4) or `position` and `quaternion_xyzw`.

    Raises:
        CalibrationError: names the file, the view and what is wrong.
    """
    path = Path(path)
    if not path.is_file():
        raise CalibrationError(
            f"calibration file '{path}' does not exist; set 'calibration_file' to one"
        )
    try:
        values = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise CalibrationError(f"'{path}' is not valid YAML: {error}") from error
    if not isinstance(values, dict) or not isinstance(values.get('views'), dict):
        raise CalibrationError(f"'{path}' must hold 'views: {{<view>: {{...}}}}'")
    return {view: _camera(view, row, f"'{path}' view '{view}'") for view, row in
            values['views'].items()}  # fmt: skip


def _camera(view: str, row: Any, where: str) -> CameraModel:
    if not isinstance(row, Mapping):
        raise CalibrationError(f'{where}: expected keys and values, got {row!r}')
    for key in row:
        if key not in _KEYS:
            raise CalibrationError(f"{where}: unknown key '{key}'{nearest(str(key), _KEYS)}")
    for key in ('width', 'height', 'K', 'mount_link'):
        if key not in row:
            raise CalibrationError(f"{where}: key '{key}' is missing")
    if 'T_mount_camera' in row:
        T = np.asarray(row['T_mount_camera'], dtype=float)
    elif 'position' in row and 'quaternion_xyzw' in row:
        T = pose(row['position'], row['quaternion_xyzw'])
    else:
        raise CalibrationError(f"{where}: give 'T_mount_camera', or 'position' and "
                               "'quaternion_xyzw'")  # fmt: skip
    K = np.asarray(row['K'], dtype=float)
    if K.shape == (4,):
        K = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1.0]])
    return CameraModel(
        view=view,
        width=int(row['width']),
        height=int(row['height']),
        K=K,
        distortion_model=row.get('distortion_model', 'none'),
        distortion=np.asarray(row.get('distortion', ()), dtype=float),
        mount_link=row['mount_link'],
        T_mount_camera=T,
    )


def save_calibration(path: Path, cameras: Mapping[str, CameraModel]) -> None:
    """Writes cameras so that `load_calibration` gives them back to the last bit."""
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
    Path(path).write_text(yaml.safe_dump({'views': views}, sort_keys=False))
