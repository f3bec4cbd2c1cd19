"""Calibrations that other programs wrote: lenses without poses, and poses without lenses.

| written by | holds | T maps |
|---|---|---|
| camera_calibration (ROS), OpenCV FileStorage (YAML, JSON, XML) | K, distortion, size | |
| kalibr (camchain) | lenses, `T_cn_cnm1` | the camera before into this one |
| easy_handeye, easy_handeye2 | pose | the tracking frame into base or effector |
| MoveIt (static_transform_publisher in a launch file) | pose | the child frame into its parent |

Sources: https://wiki.ros.org/camera_calibration, https://docs.opencv.org (FileStorage),
https://github.com/ethz-asl/kalibr/wiki/yaml-formats,
https://github.com/marcoesposito1988/easy_handeye2, https://github.com/ros-planning/moveit_calibration
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
import re
import shlex
from typing import Any

import numpy as np
import yaml

from mtv_world_ros.cameras.camera import check_plausible
from mtv_world_ros.core.bounded_input import parse_yaml, read_text
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.core.transforms import inverse, is_rigid, pose

#: kalibr's names of the distortion models
_KALIBR_MODELS = {'radtan': 'plumb_bob', 'equidistant': 'equidistant', 'none': 'none'}
#: distortion model by number of coefficients, of OpenCV, which does not write its name
_OPENCV_MODELS = {0: 'none', 4: 'plumb_bob', 5: 'plumb_bob', 8: 'rational_polynomial'}
#: names of the same matrix in different programs
_MATRICES = ('camera_matrix', 'cameraMatrix', 'Camera_Matrix', 'intrinsic_matrix')
_DISTORTIONS = (
    'distortion_coefficients', 'distCoeffs', 'Distortion_Coefficients', 'dist_coeffs',
    'distortion_coeffs',
)  # fmt: skip
_FORMATS = (
    'camera_calibration of ROS, OpenCV FileStorage, kalibr (camchain), easy_handeye, '
    'easy_handeye2, MoveIt (launch file)'
)
_SUFFIXES = ('.yaml', '.yml', '.json', '.xml', '.calib', '.launch', '.py')
_XML_MATRIX = re.compile(
    r'<(?P<name>\w+) type_id="opencv-matrix">\s*<rows>\s*(?P<rows>\d+)\s*</rows>\s*'
    r'<cols>\s*(?P<cols>\d+)\s*</cols>\s*<dt>[^<]*</dt>\s*<data>(?P<data>[^<]*)</data>'
)
_XML_NUMBER = re.compile(r'<(?P<name>\w+)>\s*(?P<value>[-+.\deE]+)\s*</(?P=name)>')
_XML_NODE = re.compile(r'<node\s[^>]*?static_transform_publisher[^>]*?\bargs\s*=\s*"([^"]*)"')


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """Size, matrix and distortion of a camera.

    Attributes:
        width: width of the images that K is for [px].
        height: height of the images that K is for [px].
        K: (3, 3) camera matrix [px].
        distortion_model: as in calibration files.
        distortion: coefficients of the model.
    """

    width: int
    height: int
    K: FloatArray
    distortion_model: str
    distortion: FloatArray

    def camera(self, view: str, mount_link: str, T_mount_camera: FloatArray) -> CameraModel:
        """Return the camera with a pose."""
        return CameraModel(
            view=view,
            width=self.width,
            height=self.height,
            K=self.K,
            distortion_model=self.distortion_model,
            distortion=self.distortion,
            mount_link=mount_link,
            T_mount_camera=T_mount_camera,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FramePose:
    """Pose of a frame in another one.

    Attributes:
        parent: name of the frame that the pose is in.
        child: name of the frame whose pose it is.
        T_parent_child: (4, 4) pose [m].
        file: file that holds it.
        view: view that the file is of, by its name; empty = not known.
    """

    parent: str
    child: str
    T_parent_child: FloatArray
    file: Path
    view: str = ''

    @property
    def turned_round(self) -> FramePose:
        """Pose of the same numbers, taken as that of the parent in the child."""
        return FramePose(
            parent=self.parent,
            child=self.child,
            T_parent_child=inverse(self.T_parent_child),
            file=self.file,
            view=self.view,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ChainPose:
    """Pose of a camera in the one before it, of a chain of cameras.

    Attributes:
        before: view of the camera before.
        view: view of the camera.
        T_before_view: (4, 4) pose of this camera in the one before [m].
    """

    before: str
    view: str
    T_before_view: FloatArray


@dataclass(slots=True, kw_only=True)
class ForeignCalibration:
    """Content of the calibration files of other programs.

    Attributes:
        lenses: lens by view.
        poses: poses of frames.
        chain: poses of cameras in each other.
        notes: what of the files is not used, and why.
    """

    lenses: dict[str, Lens] = field(default_factory=dict)
    poses: list[FramePose] = field(default_factory=list)
    chain: list[ChainPose] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_foreign(path: Path, topics: Mapping[str, str]) -> ForeignCalibration | None:
    """Read a calibration of another program, or a folder of them, one or more a view.

    A file in a folder is of the view that its name begins with (`front.yaml`,
    `front_handeye.yaml`).

    Args:
        path: file or folder.
        topics: views to calibrate, and the topic of their images; empty = none.

    Returns:
        None for a calibration file of this package.

    Raises:
        CalibrationError: names the file and what is wrong.
    """
    found = ForeignCalibration()
    if not path.is_dir():
        view = _view_of(path, topics) or (next(iter(topics)) if len(topics) == 1 else '')
        return found if _Reader(path, view, topics, found).read() else None
    root = path.resolve()
    files = sorted(one for one in path.iterdir() if one.suffix in _SUFFIXES)
    for file in files:
        if root not in file.resolve().parents:
            raise CalibrationError(f"'{file}' leads out of its folder and is not followed")
        if not _Reader(file, _view_of(file, topics), topics, found).read():
            raise CalibrationError(
                f"'{file}' is a calibration file of this package, which has all cameras; give it "
                'alone as --calibration'
            )
    if not files:
        raise CalibrationError(f"'{path}' holds no calibration ({', '.join(_SUFFIXES)})")
    return found


def foreign_hint(path: Path, values: Any) -> str:
    """Return advice for a file of another program where one of this package is needed."""
    known = isinstance(values, Mapping) and (
        any(name in values for name in (*_MATRICES, 'cam0', 'transformation', 'transform'))
    )
    return (
        f"; '{path}' was written by another program: `mtv-world import bag --calibration` and "
        '`import videos --calibration` read it, and write calibration.yaml beside each episode'
        if known
        else ''
    )


def _view_of(file: Path, views: Mapping[str, str]) -> str:
    """Return the view that a file's name begins with; of several the longest; empty = none."""
    stem = file.name.split('.')[0]
    fits = [v for v in views if stem == v or re.match(rf'{re.escape(v)}[_\-.]', stem)]
    return max(fits, key=len, default='')


class _Reader:
    """Reader of one file.

    Args:
        path: the file.
        view: view that it is of, by its name; empty = not known.
        topics: views and the topics of their images.
        into: gets what the file holds.
    """

    def __init__(
        self, path: Path, view: str, topics: Mapping[str, str], into: ForeignCalibration
    ) -> None:
        self._path, self._view, self._topics, self._into = path, view, topics, into

    def read(self) -> bool:
        """Read the file; return False for one of this package.

        Raises:
            CalibrationError: it is no calibration, or one that is not read.
        """
        try:
            text = read_text(self._path, 'yaml_bytes')
        except (OSError, ValueError) as error:
            raise CalibrationError(f"'{self._path}' cannot be read: {error}") from error
        try:
            if self._path.suffix == '.py':
                self._take_transforms(_launch_arguments(text))
            elif text.lstrip().startswith('<'):
                self._xml(text)
            else:
                return self._yaml(text)
        except ValueError as error:  # a number or a quotation that is none
            if isinstance(error, CalibrationError):
                raise
            raise self._fail(str(error)) from error
        return True

    def _fail(self, text: str) -> CalibrationError:
        return CalibrationError(f"'{self._path}': {text}")

    def _xml(self, text: str) -> None:
        if '<opencv_storage>' not in text:
            self._take_transforms([shlex.split(one) for one in _XML_NODE.findall(text)])
            return
        values: dict[str, Any] = {
            one['name']: float(one['value']) for one in _XML_NUMBER.finditer(text)
        }
        for one in _XML_MATRIX.finditer(text):
            values[one['name']] = {'rows': int(one['rows']), 'cols': int(one['cols']),
                                   'data': one['data'].split()}  # fmt: skip
        self._mapping(values)

    def _yaml(self, text: str) -> bool:
        """Read YAML or JSON; the head and the tags of OpenCV's are no YAML 1.1."""
        plain = re.sub(r'\A\ufeff?%YAML:1\.0\s*(?:---)?', '', text)
        plain = re.sub(r'!!opencv-[\w-]+', '', plain)
        try:
            values = parse_yaml(plain)
        except (yaml.YAMLError, ValueError) as error:
            raise self._fail(f'it is no YAML: {error}') from error
        if isinstance(values, Mapping) and 'views' in values:
            return False
        if not isinstance(values, Mapping):
            raise self._fail(f'it holds no calibration; read are {_FORMATS}')
        self._mapping(values)
        return True

    def _mapping(self, values: Mapping[str, Any]) -> None:
        if any(name in values for name in _MATRICES):
            self._one_lens(values)
        elif any(re.fullmatch(r'cam\d+', str(name)) for name in values):
            self._kalibr(values)
        elif isinstance(values.get('transformation', values.get('transform')), Mapping):
            self._handeye(values)
        else:
            names = ', '.join(map(str, list(values)[:12])) or 'nothing'
            raise self._fail(f'it holds {names}, which is no calibration; read are {_FORMATS}')

    # Lenses

    def _one_lens(self, values: Mapping[str, Any]) -> None:
        """Take a file of camera_calibration or OpenCV."""
        name = next(name for name in _MATRICES if name in values)
        K = self._matrix(values[name], name, 9).reshape(3, 3)
        given = next((name for name in _DISTORTIONS if name in values), '')
        distortion = self._matrix(values[given], given) if given else np.zeros(0)
        model = values.get('distortion_model')
        if model is None and values.get('fisheye_model'):
            model = 'equidistant'
        if model is None:
            model, distortion = self._opencv_model(distortion)
        size = [values.get(key) for key in ('image_width', 'image_height')]
        if None in size:
            raise self._fail("it has no 'image_width' and 'image_height'; add them [px]")
        self._add(self._lens_view(values), size, K, str(model), distortion)

    def _opencv_model(self, distortion: FloatArray) -> tuple[str, FloatArray]:
        count = len(distortion)
        if count in (12, 14) and not distortion[8:].any():
            return 'rational_polynomial', distortion[:8]
        if count not in _OPENCV_MODELS:
            raise self._fail(
                f'it has {count} distortion coefficients, which are of the thin prism or tilted '
                'model; calibrate with 5 or 8'
            )
        return _OPENCV_MODELS[count], distortion

    def _lens_view(self, values: Mapping[str, Any]) -> str:
        """Return the view of a file with one lens: by the file's name, then by the camera's."""
        name = str(values.get('camera_name', ''))
        if self._view:
            return self._view
        if name in self._topics:
            return name
        raise self._fail(
            f"which view is it of? Its camera_name is '{name}', and views are "
            f'{", ".join(self._topics)}; give a folder with a file a view, named like the view'
        )

    def _kalibr(self, values: Mapping[str, Any]) -> None:
        before = ''
        for name, row in values.items():
            if not isinstance(row, Mapping) or 'intrinsics' not in row:
                raise self._fail(f"'{name}' has no 'intrinsics'")
            view = self._kalibr_view(str(name), row, len(values))
            if not view:
                topic = row.get('rostopic', '')
                self._into.notes.append(f"'{self._path}': {name} ({topic}) is of no view")
                before = ''
                continue
            K, model = self._kalibr_matrix(str(name), row)
            distortion = self._matrix(row.get('distortion_coeffs', []), 'distortion_coeffs')
            self._add(view, row.get('resolution'), K, model, distortion)
            if 'T_cn_cnm1' in row and before:
                T = self._rigid(row['T_cn_cnm1'], f'{name}: T_cn_cnm1')
                self._into.chain.append(
                    ChainPose(before=before, view=view, T_before_view=inverse(T))
                )
            before = view
        if any('T_cam_imu' in row for row in values.values()):
            self._into.notes.append(f"'{self._path}': T_cam_imu is not used: an imu is no link")

    def _kalibr_view(self, name: str, row: Mapping[str, Any], count: int) -> str:
        topic = str(row.get('rostopic', '')).removesuffix('/compressed')
        fits = [
            view
            for view, images in self._topics.items()
            if images.removesuffix('/compressed').removesuffix('/ffmpeg') == topic
        ]
        if fits:
            return fits[0]
        if name in self._topics:
            return name
        return self._view if count == 1 else ''

    def _kalibr_matrix(self, name: str, row: Mapping[str, Any]) -> tuple[FloatArray, str]:
        kind, model = str(row.get('camera_model')), str(row.get('distortion_model'))
        if kind != 'pinhole' or model not in _KALIBR_MODELS:
            raise self._fail(
                f"{name}: camera_model '{kind}' with distortion_model '{model}' is not read; "
                'calibrate with pinhole-radtan or pinhole-equi'
            )
        fx, fy, cx, cy = self._matrix(row['intrinsics'], f'{name}: intrinsics', 4)
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), _KALIBR_MODELS[model]

    def _add(
        self, view: str, size: Any, K: FloatArray, model: str, distortion: FloatArray
    ) -> None:
        try:
            width, height = (int(float(number)) for number in size)
            lens = Lens(
                width=width, height=height, K=K, distortion_model=model, distortion=distortion
            )
            check_plausible(lens.camera(view, 'base', np.eye(4)))
        except (TypeError, ValueError, OverflowError, CalibrationError) as error:
            raise self._fail(f"view '{view}': {error}") from error
        if view in self._into.lenses:
            raise self._fail(f"view '{view}' has a lens in another file, too")
        self._into.lenses[view] = lens

    # Poses

    def _handeye(self, values: Mapping[str, Any]) -> None:
        """Take a file of easy_handeye or easy_handeye2: the tracking frame in base or effector."""
        given = values.get('parameters', values)
        T = values.get('transformation', values.get('transform'))
        if not isinstance(given, Mapping) or not isinstance(T, Mapping):
            raise self._fail('it has no parameters and transformation')
        on_hand = given.get('eye_on_hand')
        if on_hand is None:
            on_hand = str(given.get('calibration_type', '')) in ('eye_in_hand', 'eye_on_hand')
        key = 'robot_effector_frame' if on_hand else 'robot_base_frame'
        parent, child = (given.get(name) for name in (key, 'tracking_base_frame'))
        if not parent or not child:
            raise self._fail(f"it has no '{key}' or no 'tracking_base_frame'")
        place, turn = T.get('translation', T), T.get('rotation', T)
        try:
            position = [place[name] for name in 'xyz']
            prefix = 'q' if 'qx' in turn else ''
            quaternion = [turn[f'{prefix}{name}'] for name in 'xyzw']
        except (KeyError, TypeError) as error:
            raise self._fail(f'its transform has no {error}') from error
        self._take(str(parent), str(child), position, quaternion)

    def _take_transforms(self, found: Sequence[Sequence[str]]) -> None:
        """Take arguments of static_transform_publisher."""
        if not found:
            raise self._fail(f'it starts no static_transform_publisher; read are {_FORMATS}')
        for given in found:
            # the period of tf's publisher comes last
            arguments = list(given[:-1] if given and _are_numbers(given[-1:]) else given)
            options = dict(zip(arguments, arguments[1:], strict=False))
            numbers: dict[str, Any]
            if '--child-frame-id' in options:
                options = dict(zip(given, given[1:], strict=False))
                numbers = {k: options[f'--{k}'] for k in _NUMBERS if f'--{k}' in options}
                names = options.get('--frame-id', ''), options['--child-frame-id']
            elif len(arguments) in (8, 9):
                keys = ('qx', 'qy', 'qz', 'qw') if len(arguments) == 9 else _EULER
                numbers = dict(zip(('x', 'y', 'z', *keys), arguments, strict=False))
                names = arguments[-2], arguments[-1]
            else:
                raise self._fail(f'static_transform_publisher has arguments {arguments[:12]}')
            self._take_numbers(names, numbers)

    def _take_numbers(self, names: tuple[str, str], numbers: Mapping[str, Any]) -> None:
        try:
            values = {key: float(text) for key, text in numbers.items()}
        except (TypeError, ValueError) as error:
            raise self._fail(f'a transform holds no number: {error}') from error
        position = [values.get(key, 0.0) for key in 'xyz']
        if {'roll', 'pitch', 'yaw'} & set(values):
            quaternion = _of_euler(*(values.get(key, 0.0) for key in ('roll', 'pitch', 'yaw')))
        else:
            quaternion = [values.get(f'q{key}', float(key == 'w')) for key in 'xyzw']
        self._take(*names, position, quaternion)

    def _take(self, parent: str, child: str, position: Any, quaternion: Any) -> None:
        try:
            T = pose([float(v) for v in position], [float(v) for v in quaternion])
        except (TypeError, ValueError) as error:
            raise self._fail(f"'{parent}' -> '{child}': {error}") from error
        self._into.poses.append(
            FramePose(
                parent=parent.lstrip('/'),
                child=child.lstrip('/'),
                T_parent_child=T,
                file=self._path,
                view=self._view,
            )
        )

    # Numbers

    def _matrix(self, value: Any, name: str, count: int | None = None) -> FloatArray:
        if isinstance(value, Mapping):
            value = value.get('data')
        try:
            found = np.array(value, dtype=float).ravel()
        except (TypeError, ValueError) as error:
            raise self._fail(f"'{name}' is no list of numbers: {error}") from error
        if not np.isfinite(found).all() or count is not None and len(found) != count:
            raise self._fail(f"'{name}' has {len(found)} numbers, must be {count} finite ones")
        return found

    def _rigid(self, value: Any, name: str) -> FloatArray:
        T = self._matrix(value, name, 16).reshape(4, 4)
        if not is_rigid(T):
            raise self._fail(f"'{name}' is no rotation and translation")
        return T


_NUMBERS = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'roll', 'pitch', 'yaw')
#: order of the angles of static_transform_publisher with eight arguments
_EULER = ('yaw', 'pitch', 'roll')


def _of_euler(roll: float, pitch: float, yaw: float) -> list[float]:
    """Return the quaternion (x, y, z, w) of turns about the fixed axes x, y, z [rad]."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.array([roll, pitch, yaw]) / 2) for f in (np.cos, np.sin))
    return [
        float(sr * cp * cy - cr * sp * sy),
        float(cr * sp * cy + sr * cp * sy),
        float(cr * cp * sy - sr * sp * cy),
        float(cr * cp * cy + sr * sp * sy),
    ]


def _launch_arguments(text: str) -> list[list[str]]:
    """Return the lists of texts in a launch file in Python that name a child frame.

    The file is parsed, not run.
    """
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise CalibrationError(f'a launch file in Python cannot be parsed: {error}') from error
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.List):
            continue
        items = [one.value for one in node.elts if isinstance(one, ast.Constant)]
        if '--child-frame-id' in items or len(items) == len(node.elts) in (8, 9):
            texts = [str(item) for item in items]
            if '--child-frame-id' in texts or _are_numbers(texts[:6]):
                found.append(texts)
    return found


def _are_numbers(texts: Sequence[str]) -> bool:
    try:
        return bool([float(text) for text in texts])
    except ValueError:
        return False
