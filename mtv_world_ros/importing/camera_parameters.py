"""Sources of a view's images and calibration: a calibration file, JSON, or features."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator, ValidationInfo

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.cameras.image_window import windowed_camera
from mtv_world_ros.core.bounded_input import fill_template, read_json
from mtv_world_ros.core.config import Pair, Schema, wrong
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError, ConfigError
from mtv_world_ros.core.transforms import inverse, is_rigid, rotation
from mtv_world_ros.robot.joint_columns import Unit, UNITS

#: names that a camera's four numbers go by
_FOCAL_NAMES = (('fx', 'fy', 'cx', 'cy'), ('fx', 'fy', 'ppx', 'ppy'))
_POSE_KEYS = ('extrinsics', 'rotation', 'translation')
_PATHS = ('intrinsics', 'extrinsics', 'rotation', 'translation', 'distortion')


class CameraParameters(Schema):
    """The dataset's own camera parameters: paths in a JSON file, or names of features."""

    file: str | None = Field(
        default=None, description='JSON, may hold `{episode_index}`; null = features'
    )
    intrinsics: str = Field(description='path of K, or of fx, fy, cx and cy [px]')
    extrinsics: str | None = Field(default=None, description='path of the pose as a matrix')
    rotation: str | None = Field(
        default=None, description='path of the rotation, with `translation` in place of a matrix'
    )
    translation: str | None = Field(default=None, description='path of the translation')
    pose: Literal['camera_in_mount', 'mount_in_camera'] = Field(
        default='camera_in_mount', description='what the pose maps: from camera to mount, or back'
    )
    axes: Literal['opencv', 'opengl'] = Field(
        default='opencv', description='axes of the camera: z ahead (OpenCV) or backward (OpenGL)'
    )
    quaternion: Literal['xyzw', 'wxyz'] = Field(
        default='xyzw', description='order of a rotation with four numbers'
    )
    unit: Unit = Field(default='m', description='unit of the translation')
    distortion: str | None = Field(default=None, description='path of the coefficients')
    distortion_model: str | None = Field(
        default=None, description='model of the distortion, see the calibration file'
    )
    size: Pair | None = Field(default=None, description='width and height that K is for [px]')
    mount_link: str = Field(description='link that carries the camera')
    moves: bool = Field(
        default=False,
        description='the pose is a feature that changes from row to row: a camera that no joint '
        'of the robot moves',
    )

    @model_validator(mode='after')
    def _has_one_pose(self) -> Self:
        if bool(self.extrinsics) == bool(self.rotation and self.translation):
            raise ValueError("give either 'extrinsics', or 'rotation' and 'translation'")
        if self.moves and self.file is not None:
            raise ValueError("'moves' needs poses that are features: leave 'file' out")
        return self


def _is_there(name: Any, info: ValidationInfo[dict[str, Any]]) -> Path | None:
    if name is None:
        return None
    if not isinstance(name, str):
        raise wrong('the name of a file')
    file = info.context['folder'] / name
    if not file.is_file():
        raise ValueError(f"calibration file '{file}' does not exist")
    return file


class CameraSource(Schema):
    """Source of a view: image feature and calibration; without one its camera is not known."""

    view: str = Field(default='', description='its name; set by the mapping')
    feature: str = Field(description='feature of the images')
    calibration: Annotated[Path | None, BeforeValidator(_is_there)] = Field(
        default=None, description='YAML with this view'
    )
    camera: CameraParameters | None = Field(
        default=None, description="the dataset's own camera parameters, in place of a file"
    )

    @model_validator(mode='after')
    def _has_one_source(self) -> Self:
        if self.calibration is not None and self.camera is not None:
            raise ValueError(
                "give either 'calibration' (a calibration YAML) or 'camera' (keys of the "
                "dataset's own camera parameters), or none of both where the camera is not known"
            )
        return self

    @property
    def is_known(self) -> bool:
        """True if the mapping states the camera."""
        return self.calibration is not None or self.camera is not None

    @property
    def where(self) -> str:
        """The place in the mapping file, for error texts."""
        return f"view '{self.view}': camera"

    def features(self) -> list[str]:
        """Return the features that the camera parameters are read from."""
        if self.camera is None or self.camera.file is not None:
            return []
        return [path for key in _PATHS if (path := getattr(self.camera, key)) is not None]


class CameraTrack(NamedTuple):
    """A view's camera in an episode.

    Attributes:
        camera: camera at the images' size, posed as at the first row.
        poses: (T, 4, 4) T_mount_camera [m] of the rows, where it moves.
        note: treatment of images of another size than the calibration's; empty = they have its
            size.
    """

    camera: CameraModel
    poses: FloatArray | None = None
    note: str = ''


def camera_track(
    source: CameraSource,
    dataset: Path,
    episode_index: int,
    values: Mapping[str, FloatArray],
    size: tuple[int, int],
) -> CameraTrack:
    """Return a view's camera for images of a width and height [px].

    Args:
        source: calibration file or camera parameters of the view.
        dataset: root of the dataset.
        episode_index: episode index, for file names that hold `{episode_index}`.
        values: (T, ...) values of the features that the source names.
        size: width and height of the images [px].

    Raises:
        CalibrationError: the parameters are missing or wrong, or change within the episode.
    """
    if source.calibration is not None:
        cameras = load_calibration(source.calibration)
        if source.view not in cameras:
            raise CalibrationError.unknown(
                f"'{source.calibration}' has no view", source.view, cameras, listed='; it has'
            )
        return sized_camera(cameras[source.view], size)
    row = source.camera
    assert row is not None
    look_up = _Lookup(source, dataset, episode_index, values)
    K = _intrinsics(look_up('intrinsics'), source.where)
    poses = [_pose(row, look_up, source.where)]
    if row.moves:
        count = len(next(iter(values.values())))
        poses = [_pose(row, look_up.at(k), source.where) for k in range(count)]
    model = row.distortion_model or ('plumb_bob' if row.distortion else 'none')
    width, height = (int(n) for n in row.size or size)
    camera = CameraModel(
        view=source.view,
        width=width,
        height=height,
        K=K,
        distortion_model=model,
        distortion=np.ravel(look_up('distortion')) if row.distortion else np.zeros(0),
        mount_link=row.mount_link,
        T_mount_camera=poses[0],
    )
    return sized_camera(camera, size, np.stack(poses) if row.moves else None)


def sized_camera(
    camera: CameraModel, size: tuple[int, int], poses: FloatArray | None = None
) -> CameraTrack:
    """Return the camera for images of a size; a note says where they were stretched.

    Raises:
        CalibrationError: images are turned by 90 degrees against the calibrated ones.
    """
    if (camera.width - camera.height) * (size[0] - size[1]) < 0:
        raise CalibrationError(
            f"view '{camera.view}': images of {size[0]}x{size[1]}, but its K is for "
            f'{camera.width}x{camera.height}: they are turned against each other; calibrate the '
            'images as players show them'
        )
    try:
        sized, note = windowed_camera(camera, *size)
    except CalibrationError:
        sized = scaled(camera, *size)
        note = (
            f"view '{camera.view}': images of {size[0]}x{size[1]}, but its K is for "
            f'{camera.width}x{camera.height}: taken as stretched, fx times '
            f'{size[0] / camera.width:.4g} and fy times {size[1] / camera.height:.4g}; where they '
            "were cropped, give the K of the cropped images, and their 'size'"
        )
    return CameraTrack(sized, poses, note)


class _Lookup:
    """Values of the camera parameters, by the keys of the mapping."""

    def __init__(
        self,
        source: CameraSource,
        dataset: Path,
        episode_index: int,
        values: Mapping[str, FloatArray],
    ) -> None:
        assert source.camera is not None
        self._source, self._row, self._values = source, source.camera, values
        self._at = 0
        self._file: Path | None = None
        self._document: Any = None
        if self._row.file is not None:
            self._file = dataset / _formatted(self._row.file, episode_index, source.where)
            self._document = _read_json(self._file, source.where)

    def at(self, row: int) -> _Lookup:
        """Return a copy that looks up the pose of another row."""
        other = copy(self)
        other._at = row
        return other

    def __call__(self, key: str) -> Any:
        path = getattr(self._row, key)
        if self._file is None and self._row.moves and key in _POSE_KEYS:
            return self._values[path][self._at]
        if self._file is None:
            return self._constant(path)
        found = self._document
        for part in path.split('.'):
            found = self._step(found, part, path)
        return found

    def _step(self, found: Any, part: str, path: str) -> Any:
        if isinstance(found, list) and part.isdigit() and int(part) < len(found):
            return found[int(part)]
        if isinstance(found, Mapping) and part in found:
            return found[part]
        known = list(found) if isinstance(found, Mapping) else []
        raise CalibrationError.unknown(
            f"{self._source.where}: '{self._file}' has no '{path}':",
            part,
            known or [type(found).__name__],
            is_not=' is not there',
            listed='; there are',
        )

    def _constant(self, feature: str) -> FloatArray:
        values = self._values[feature]
        differs = ~np.isclose(values, values[0], atol=1e-5).reshape(len(values), -1).all(axis=1)
        if differs.any():
            frame = int(np.argmax(differs))
            raise CalibrationError(
                f"{self._source.where}: feature '{feature}' changes at frame {frame}; a camera "
                'that moves needs its pose in the link that carries it (mount_link), or, where no '
                'link does, `moves: true`'
            )
        return values[0]


def _formatted(name: str, episode_index: int, where: str) -> str:
    try:
        return fill_template(name, {'episode_index': episode_index})
    except ValueError as error:
        raise ConfigError(
            f"{where}: 'file' is '{name}'; it may hold {{episode_index}} or "
            f'{{episode_index:06d}} and no other braces'
        ) from error


def _read_json(file: Path, where: str) -> Any:
    try:
        return read_json(file)
    except OSError as error:
        raise CalibrationError(f"{where}: cannot read '{file}': {error}") from error
    except ValueError as error:
        raise CalibrationError(f"{where}: '{file}' is not JSON: {error}") from error


def _intrinsics(value: Any, where: str) -> FloatArray:
    if isinstance(value, Mapping):
        for names in _FOCAL_NAMES:
            if set(names) <= set(value):
                value = [value[name] for name in names]
                break
    K = _numbers(value, where, 'intrinsics')
    if K.size == 4:
        fx, fy, cx, cy = K.ravel()
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    if K.size != 9:
        raise CalibrationError(
            f"{where}: 'intrinsics' is {value!r}, must be 3 x 3, or fx, fy, cx, cy"
        )
    return K.reshape(3, 3)


def _pose(row: CameraParameters, look_up: _Lookup, where: str) -> FloatArray:
    T = np.eye(4)
    if row.extrinsics is not None:
        given = _numbers(look_up('extrinsics'), where, 'extrinsics')
        if given.size not in (12, 16):
            raise CalibrationError(f"{where}: 'extrinsics' has {given.size} numbers, not 12 or 16")
        T[: given.size // 4] = given.reshape(-1, 4)
    else:
        T[:3, :3] = _rotation(_numbers(look_up('rotation'), where, 'rotation'), row, where)
        translation = _numbers(look_up('translation'), where, 'translation').ravel()
        if translation.size != 3:
            raise CalibrationError(f"{where}: 'translation' has {translation.size} numbers, not 3")
        T[:3, 3] = translation
    T[:3, 3] *= UNITS[row.unit]
    if not is_rigid(T):
        raise CalibrationError(
            f'{where}: the pose is {T.tolist()}, not a rotation and a translation (is it stored '
            'transposed, or in another order?)'
        )
    T = inverse(T) if row.pose == 'mount_in_camera' else T
    # OpenGL's camera looks along -z with y up
    return T @ np.diag([1.0, -1, -1, 1]) if row.axes == 'opengl' else T


def _rotation(value: FloatArray, row: CameraParameters, where: str) -> FloatArray:
    if value.size == 9:
        return value.reshape(3, 3)
    if value.size == 4:
        x, y, z, w = value.ravel() if row.quaternion != 'wxyz' else np.roll(value.ravel(), -1)
        return rotation([x, y, z, w])
    raise CalibrationError(f"{where}: 'rotation' has {value.size} numbers, not 9 or 4")


def _numbers(value: Any, where: str, key: str) -> FloatArray:
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{where}: '{key}' is {value!r}, must be numbers") from error
