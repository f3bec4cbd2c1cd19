"""Trajectory videos: tool points projected into each view, drawn as fading glowing trails.

Paper, Trajectory Representation. A arms, V views, T frames, O objects, H W pixels.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import (
    BoolArray,
    CameraModel,
    FloatArray,
    MultiViewVideo,
)
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.geometry.camera import camera_poses, project
from mtv_world_ros.geometry.robot import RobotModel


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryVideoConfig:
    """How trajectory videos look; a model is served with what it was trained with.

    Attributes:
        half_life_s: time after which a point of the trail is half as bright [s].
        point_radius_m: standard deviation of the glow, at the point's depth [m].
        min_radius_px: smallest standard deviation of the glow [px].
        object_fill: brightness of object fills, 0 .. 1.
        show_gripper: whether a closed gripper turns the newest point white.
        points_per_frame: trail points between two frames, so that trails have no gaps.
    """

    half_life_s: float = 0.5
    point_radius_m: float = 0.012
    min_radius_px: float = 0.8
    object_fill: float = 0.35
    show_gripper: bool = True
    points_per_frame: int = 3

    def __post_init__(self) -> None:
        for name in ('half_life_s', 'point_radius_m', 'min_radius_px'):
            if not getattr(self, name) > 0:
                raise ConfigError(f'rendering.{name} is {getattr(self, name)}, must be > 0')
        if not 0 <= self.object_fill <= 1:
            raise ConfigError(f'rendering.object_fill is {self.object_fill}, must be in 0 .. 1')
        if self.points_per_frame < 1:
            raise ConfigError(
                f'rendering.points_per_frame is {self.points_per_frame}, must be >= 1'
            )


#: a point is dropped when it has faded below this share of its brightness
_FAINTEST = 0.01
#: glow is cut off at this many standard deviations
_REACH = 3.0


def render_trajectory_video(
    *,
    cameras: Sequence[CameraModel],
    robot: RobotModel,
    positions: FloatArray,
    times: FloatArray,
    object_masks: BoolArray | None,
    config: TrajectoryVideoConfig,
) -> MultiViewVideo:
    """Draws the trajectory into each view, at the cameras' size.

    Args:
        cameras: V cameras of one size.
        robot: gives the tool points.
        positions: (T, J) joint positions; frame k shows row k, row 0 is the current state.
        times: (T,) [s], increasing.
        object_masks: (V, O, H, W) masks of the first frame, held over all frames; or None.
        config: how it looks.

    Returns:
        (V, T, H, W, 3) frames.
    """
    fine_times, fine_positions, shown_at = _refine(positions, times, config.points_per_frame)
    points = robot.tool_poses(fine_positions)[..., :3, 3]
    closed = 1.0 - robot.gripper_openings(fine_positions)
    frames = []
    for view, camera in enumerate(cameras):
        masks = None if object_masks is None else object_masks[view]
        canvas = _canvas(camera, masks, config)
        poses = camera_poses(camera, robot, np.asarray(positions))
        fixed = camera.mount_link == robot.base_link
        draw = _draw_fixed if fixed else _draw_moving
        glow = draw(camera, poses, points, closed, fine_times, shown_at, config)
        frames.append(_compose(canvas, glow))
    return MultiViewVideo(
        views=tuple(camera.view for camera in cameras), times=times, frames=np.stack(frames)
    )


def arm_colour(arm: int, num_arms: int) -> FloatArray:
    """Returns the (3,) linear RGB of an arm: hues spread evenly from orange on."""
    return np.array(colorsys.hsv_to_rgb((0.08 + arm / max(num_arms, 1)) % 1.0, 0.85, 1.0))


def object_colour(index: int, fill: float) -> FloatArray:
    """Returns the (3,) RGB in 0 .. 1 of an object's fill, by the golden angle from green on."""
    return np.array(colorsys.hsv_to_rgb((0.36 + index * 0.381966) % 1.0, 0.7, fill))


def _refine(
    positions: FloatArray, times: FloatArray, per_frame: int
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Times and positions with points between frames, and the index of each frame's own."""
    num_frames = len(times)
    fine = np.arange((num_frames - 1) * per_frame + 1) / per_frame
    left = np.minimum(fine.astype(int), max(num_frames - 2, 0))
    right = np.minimum(left + 1, num_frames - 1)
    share = fine - left
    fine_times = (1 - share) * times[left] + share * times[right]
    fine_positions = (1 - share)[:, None] * positions[left] + share[:, None] * positions[right]
    return fine_times, fine_positions, np.arange(num_frames) * per_frame


def _canvas(
    camera: CameraModel, masks: BoolArray | None, config: TrajectoryVideoConfig
) -> FloatArray:
    canvas = np.zeros((camera.height, camera.width, 3), dtype=np.float32)
    if masks is not None:
        for index, mask in enumerate(masks):
            canvas[mask] = object_colour(index, config.object_fill)
    return canvas


def _radii(camera: CameraModel, depth: FloatArray, config: TrajectoryVideoConfig) -> FloatArray:
    focal = (camera.K[0, 0] + camera.K[1, 1]) / 2
    near = np.maximum(depth, 0.05)
    return np.maximum(config.point_radius_m * focal / near, config.min_radius_px)


def _colours(closed: FloatArray, config: TrajectoryVideoConfig) -> FloatArray:
    """(A, N, 3) colour of every point: the arm's hue, whitened as the gripper closes."""
    num_arms, num_points = closed.shape
    hues = np.stack([arm_colour(arm, num_arms) for arm in range(num_arms)])[:, None]
    white = closed[..., None] if config.show_gripper else np.zeros((num_arms, num_points, 1))
    return (1 - white) * hues + white


def _stamp(
    buffer: FloatArray, pixel: FloatArray, radius: float, colour: FloatArray
) -> None:
    """Lays the part of a Gaussian glow that is inside onto an (H, W, 3) buffer (brightest wins)."""
    if not np.isfinite(pixel).all():
        return
    height, width = buffer.shape[:2]
    reach = _REACH * radius
    x0, x1 = max(int(np.ceil(pixel[0] - reach)), 0), min(int(pixel[0] + reach), width - 1)
    y0, y1 = max(int(np.ceil(pixel[1] - reach)), 0), min(int(pixel[1] + reach), height - 1)
    if x0 > x1 or y0 > y1 or pixel[0] + reach < 0 or pixel[1] + reach < 0:
        return
    gx = np.exp(-0.5 * ((np.arange(x0, x1 + 1) - pixel[0]) / radius) ** 2)
    gy = np.exp(-0.5 * ((np.arange(y0, y1 + 1) - pixel[1]) / radius) ** 2)
    glow = (gy[:, None] * gx)[..., None] * colour
    box = buffer[y0 : y1 + 1, x0 : x1 + 1]
    np.maximum(box, glow, out=box)


def _draw_fixed(
    camera: CameraModel,
    poses: FloatArray,
    points: FloatArray,
    closed: FloatArray,
    times: FloatArray,
    shown_at: np.ndarray,
    config: TrajectoryVideoConfig,
) -> FloatArray:
    """(A, T, H, W, 3) glow and, in the last place, depth order: one decaying buffer an arm."""
    pixels, depth = project(camera, poses[0], points)
    radii, colours = _radii(camera, depth, config), _colours(closed, config)
    layers = []
    for arm in range(len(points)):
        buffer = np.zeros((camera.height, camera.width, 3), dtype=np.float32)
        frames = np.empty((len(shown_at), *buffer.shape), dtype=np.float32)
        last = times[0]
        for index in range(len(times)):
            buffer *= np.float32(0.5 ** ((times[index] - last) / config.half_life_s))
            last = times[index]
            _stamp(buffer, pixels[arm, index], radii[arm, index], colours[arm, index])
            if index % config.points_per_frame == 0:
                frames[index // config.points_per_frame] = buffer
        layers.append((depth[arm, shown_at], frames))
    return _by_depth(layers)


def _draw_moving(
    camera: CameraModel,
    poses: FloatArray,
    points: FloatArray,
    closed: FloatArray,
    times: FloatArray,
    shown_at: np.ndarray,
    config: TrajectoryVideoConfig,
) -> FloatArray:
    """As `_draw_fixed`, for a camera that moves: all past points projected anew each frame."""
    colours = _colours(closed, config)
    memory = config.half_life_s * np.log2(1 / _FAINTEST)
    shape = (len(shown_at), camera.height, camera.width, 3)
    layers = []
    for arm in range(len(points)):
        frames = np.zeros(shape, dtype=np.float32)
        depths = np.empty(len(shown_at))
        for frame, newest in enumerate(shown_at):
            past = np.flatnonzero(times[: newest + 1] >= times[newest] - memory)
            pixels, depth = project(camera, poses[frame], points[arm, past])
            radii = _radii(camera, depth, config)
            fade = 0.5 ** ((times[newest] - times[past]) / config.half_life_s)
            for k, index in enumerate(past):
                _stamp(frames[frame], pixels[k], radii[k], fade[k] * colours[arm, index])
            depths[frame] = depth[-1]
        layers.append((depths, frames))
    return _by_depth(layers)


def _by_depth(layers: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """(A, T, H, W, 3) layers sorted so that in each frame the farther arm comes first."""
    depths = np.stack([depth for depth, _ in layers])
    frames = np.stack([frame for _, frame in layers])
    order = np.argsort(-depths, axis=0, kind='stable')
    return np.take_along_axis(frames, order[..., None, None, None], axis=0)


def _compose(canvas: FloatArray, glow: FloatArray) -> np.ndarray:
    """(T, H, W, 3) uint8: each layer covers what is behind it as far as it glows."""
    out = np.repeat(canvas[None].astype(np.float32), glow.shape[1], axis=0)
    for layer in glow:
        cover = layer.max(axis=-1, keepdims=True)
        out *= 1 - cover
        out += layer
    return (255 * out.clip(0, 1) + 0.5).astype(np.uint8)
