"""Calibration YAML files: one camera per view."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, Strict
import yaml

from mtv_world_ros.cameras.camera import check_plausible
from mtv_world_ros.cameras.foreign_calibrations import foreign_hint
from mtv_world_ros.core.config import (
    expected,
    ListOf,
    Metres,
    Number,
    Quaternion,
    read_yaml,
    Schema,
    validated,
    wrong,
)
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.core.transforms import is_rigid, pose


def _numbers(value: Any) -> FloatArray:
    try:
        return np.array(value, dtype=float)
    except (TypeError, ArithmeticError) as error:
        raise ValueError(f'{value!r} is no list of numbers: {error}') from error


def _intrinsics(value: Any) -> FloatArray:
    K = _numbers(value)
    if K.shape == (4,):
        return np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1.0]])
    if K.shape != (3, 3):
        raise wrong('3 x 3 or fx, fy, cx, cy [px]')
    return K


def _rigid(value: Any) -> FloatArray:
    T = _numbers(value)
    if T.shape != (4, 4) or not is_rigid(T):
        raise wrong('a rigid pose: 4 x 4, its 3 x 3 part a rotation, its last row 0 0 0 1')
    return T


def _no_truth(value: Any) -> Any:
    if isinstance(value, bool):
        raise wrong('a whole number')
    return value


_Pixels = Annotated[
    int,
    Strict(False),
    Field(ge=2, le=100_000),
    expected('a whole number from 2 to 100000'),
    BeforeValidator(_no_truth),
]


class CalibratedView(Schema):
    """Camera of a calibration file; see `load_calibration`."""

    basic: ClassVar = ('width', 'height', 'K', 'mount_link', 'T_mount_camera')

    section = ''

    width: _Pixels = Field(description='width of the images that K is for [px]')
    height: _Pixels = Field(description='height of the images that K is for [px]')
    K: Annotated[Any, AfterValidator(_intrinsics)] = Field(
        description='fx, fy, cx, cy, or a 3 x 3 matrix [px]'
    )
    distortion_model: str = Field(
        default='none', description='none, plumb_bob, rational_polynomial or equidistant (fisheye)'
    )
    distortion: ListOf[Number] = Field(
        default=(), description="coefficients of the model, in OpenCV's order"
    )
    mount_link: str = Field(description='link that carries the camera')
    T_mount_camera: Annotated[Any, AfterValidator(_rigid)] = Field(
        default=None, description='pose of the optical frame in `mount_link`, 4 x 4 [m]'
    )
    position: ListOf[Metres] = Field(
        default=(),
        description='x, y, z of the optical frame in `mount_link` [m], without a matrix',
    )
    quaternion_xyzw: ListOf[Quaternion] = Field(
        default=(), description='rotation of the optical frame in `mount_link`, without a matrix'
    )
    error_px: Annotated[float, Field(gt=0, le=1e4)] | None = Field(
        default=None,
        description='standard error of where a point is drawn, in x and in y, at this size [px]; '
        '`fit camera` states it; null = not known',
    )

    def camera(self, view: str) -> CameraModel:
        """Return the camera.

        Raises:
            ValueError: its pose is not given once.
        """
        given = self.model_fields_set & {'T_mount_camera', 'position', 'quaternion_xyzw'}
        if given not in ({'T_mount_camera'}, {'position', 'quaternion_xyzw'}):
            raise ValueError("give either 'T_mount_camera', or 'position' and 'quaternion_xyzw'")
        T = self.T_mount_camera
        return CameraModel(
            view=view,
            width=self.width,
            height=self.height,
            K=self.K,
            distortion_model=self.distortion_model,
            distortion=np.array(self.distortion),
            mount_link=self.mount_link,
            T_mount_camera=pose(self.position, self.quaternion_xyzw) if T is None else T,
            error_px=self.error_px,
        )


def load_calibration(path: Path | str) -> dict[str, CameraModel]:
    """Read `views: {<view>: {...}}`.

    Each view has `width`, `height`, `K` (3 x 3 or fx, fy, cx, cy), optional
    `distortion_model` and `distortion`, `mount_link`, and the pose of the optical frame in it:
    `T_mount_camera` (4 x 4) or `position` and `quaternion_xyzw`; optional `error_px`.

    Raises:
        CalibrationError: names the file, the view and what is wrong.
    """
    path = Path(path)
    values = read_yaml(path, 'calibration file', 'calibration_file', error=CalibrationError)
    views = values.get('views') if isinstance(values, dict) else None
    if not isinstance(views, dict) or list(values) != ['views']:
        raise CalibrationError(
            f"'{path}' must hold 'views: {{<view>: {{...}}}}' and nothing else"
            f'{foreign_hint(path, values)}'
        )
    if not views:
        raise CalibrationError(f"'{path}' has no view; give one for each camera under 'views'")
    return {str(view): _camera(str(view), row, f"'{path}' view '{view}'")
            for view, row in views.items()}  # fmt: skip


def save_calibration(path: Path | str, cameras: Mapping[str, CameraModel]) -> None:
    """Write cameras; `load_calibration` reads back exactly the same values."""
    write_whole(Path(path), calibration_text(cameras))


def calibration_text(cameras: Mapping[str, CameraModel]) -> str:
    """Return the text of a calibration file."""
    views = {
        view: {
            'width': camera.width,
            'height': camera.height,
            'K': camera.K.tolist(),
            'distortion_model': camera.distortion_model,
            'distortion': camera.distortion.tolist(),
            'mount_link': camera.mount_link,
            'T_mount_camera': camera.T_mount_camera.tolist(),
            **({} if camera.error_px is None else {'error_px': camera.error_px}),
        }
        for view, camera in cameras.items()
    }
    return yaml.safe_dump({'views': views}, sort_keys=False, default_flow_style=None)


def _camera(view: str, row: Any, where: str) -> CameraModel:
    given = validated(CalibratedView, row, where, error=CalibrationError)
    try:
        camera = given.camera(view)
        check_plausible(camera)
        return camera
    except (ValueError, CalibrationError) as error:
        raise CalibrationError(f'{where}: {error}') from error
