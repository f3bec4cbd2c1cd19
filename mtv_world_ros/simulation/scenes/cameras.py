"""Camera poses of the benchmark and their OpenCV calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field

from mtv_world_ros.core.config import Length, Point
from mtv_world_ros.core.data_types import CameraModel, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSpec:
    """A fixed camera on a sphere around the point it looks at.

    Attributes:
        view: name of the view.
        target: x, y, z of the point looked at, in the base frame [m].
        distance: distance from the camera to the target [m].
        azimuth: 0 = opposite the robot; positive moves the camera to the robot's right [deg].
        elevation: angle above the table [deg].
        visible_width: width of what the view shows at the target [m].
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    view: str
    target: Point
    distance: Length
    azimuth: Annotated[float, Field(ge=-360, le=360)]
    elevation: Annotated[float, Field(ge=-90, le=90)]
    visible_width: Length


@dataclass(frozen=True, slots=True, kw_only=True)
class WristCameraSpec:
    """A camera on a link, which moves with the arm.

    Attributes:
        view: name of the view.
        link: name of the link that carries the camera.
        position: x, y, z of the camera in the link [m].
        target: x, y, z of the point looked at, in the link [m].
        right: x, y, z of the approximate direction of the image's x axis, in the link.
        visible_width: width of what the view shows at the target [m].
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    view: str
    link: str
    position: Point
    target: Point
    right: Point
    visible_width: Length

    @property
    def distance(self) -> float:
        """Camera to target [m]."""
        return float(np.linalg.norm(np.subtract(self.target, self.position)))


AnyCameraSpec = CameraSpec | WristCameraSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraJitter:
    """Half widths of the uniform camera randomisation of an episode."""

    target_m: float = 0.008
    distance_m: float = 0.03
    angle_deg: float = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraMoves:
    """Ranges of camera offsets from the nominal poses; the defaults give zero-shot views.

    Attributes:
        azimuth: turn about the table to either side [deg].
        elevation: change of the elevation [deg].
        distance: factor on the distance.
        visible_width: width of the view's plane through the target at the nominal distance [m].
    """

    azimuth: tuple[float, float] = (25.0, 55.0)
    elevation: tuple[float, float] = (-6.0, 16.0)
    distance: tuple[float, float] = (0.95, 1.2)
    visible_width: float = 0.76


#: of training sets: on either side of the angles that zero-shot views have, jitter left room
TRAINING_MOVES = (
    CameraMoves(
        azimuth=(0.0, 22.0), elevation=(-8.0, 18.0), distance=(0.9, 1.25), visible_width=0.68
    ),
    CameraMoves(azimuth=(58.0, 75.0), elevation=(-8.0, 18.0), distance=(0.9, 1.25)),
)


def moved_camera(
    spec: AnyCameraSpec, moves: CameraMoves, generator: np.random.Generator
) -> AnyCameraSpec:
    """Return a camera that stands elsewhere and looks at the same point; one on a link stays."""
    if isinstance(spec, WristCameraSpec):
        return spec
    side = float(generator.choice((-1.0, 1.0)))
    factor = float(generator.uniform(*moves.distance))
    return replace(
        spec,
        azimuth=spec.azimuth + side * float(generator.uniform(*moves.azimuth)),
        elevation=spec.elevation + float(generator.uniform(*moves.elevation)),
        distance=spec.distance * factor,
        # the lens stays the same
        visible_width=moves.visible_width * factor,
    )


def jittered(
    spec: AnyCameraSpec, jitter: CameraJitter, generator: np.random.Generator
) -> AnyCameraSpec:
    """Return the spec with target, distance and angles moved within the jitter.

    A camera on a link is moved and turned by a quarter of it: its mount is a fixed part.
    """
    draw = generator.uniform(-1.0, 1.0, 6)
    if isinstance(spec, WristCameraSpec):
        shifts = jitter.target_m / 4 * draw.reshape(2, 3)
        return replace(
            spec,
            position=tuple((np.asarray(spec.position) + shifts[0]).tolist()),
            target=tuple((np.asarray(spec.target) + shifts[1]).tolist()),
        )
    target = np.asarray(spec.target) + jitter.target_m * draw[:3]
    distance = spec.distance + jitter.distance_m * draw[3]
    return CameraSpec(
        view=spec.view,
        target=tuple(float(value) for value in target),  # type: ignore[arg-type]
        distance=distance,
        azimuth=spec.azimuth + jitter.angle_deg * draw[4],
        elevation=spec.elevation + jitter.angle_deg * draw[5],
        # the lens stays the same
        visible_width=spec.visible_width * distance / spec.distance,
    )


def optical_pose(spec: AnyCameraSpec) -> FloatArray:
    """Return T_mount_camera (4, 4) of the optical frame: x right, y down, z ahead."""
    if isinstance(spec, WristCameraSpec):
        ahead = np.subtract(spec.target, spec.position) / spec.distance
        across = np.asarray(spec.right) - ahead * (ahead @ np.asarray(spec.right))
        return _pose(across / np.linalg.norm(across), ahead, np.asarray(spec.position))
    azimuth, elevation = np.deg2rad(spec.azimuth), np.deg2rad(spec.elevation)
    outward = np.array(
        [
            np.cos(elevation) * np.sin(azimuth),
            np.cos(elevation) * np.cos(azimuth),
            np.sin(elevation),
        ]
    )
    ahead = -outward
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return _pose(right, ahead, np.asarray(spec.target) + spec.distance * outward)


def _pose(right: FloatArray, ahead: FloatArray, position: FloatArray) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = position
    return pose


def camera_model(
    spec: AnyCameraSpec, width: int, height: int, base_link: str = 'base'
) -> CameraModel:
    """Return the calibrated camera for images of `width` x `height` px; no distortion.

    Args:
        spec: pose and field of view of the camera.
        width: image width [px].
        height: image height [px].
        base_link: link that carries the fixed cameras.
    """
    focal = width * spec.distance / spec.visible_width
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return CameraModel(
        view=spec.view,
        width=width,
        height=height,
        K=K,
        mount_link=spec.link if isinstance(spec, WristCameraSpec) else base_link,
        T_mount_camera=optical_pose(spec),
    )


def camera_xml(camera: CameraModel, pose: FloatArray) -> str:
    """Return the MJCF camera of a centred, undistorted camera.

    MuJoCo's camera looks along its own -z with y up; the optical frame has y down, z ahead.

    Args:
        camera: name of the camera, size and K.
        pose: (4, 4) pose of its optical frame in the body that carries it.
    """
    x, y, z = pose[:3, 3]
    right, down = pose[:3, 0], pose[:3, 1]
    axes = ' '.join(f'{value:.12g}' for value in (*right, *-down))
    fovy = np.rad2deg(2 * np.arctan(camera.height / 2 / camera.K[1, 1]))
    return (
        f'<camera name="{camera.view}" pos="{x:.12g} {y:.12g} {z:.12g}" xyaxes="{axes}" '
        f'fovy="{fovy:.12g}"/>'
    )
