"""Overlay pictures: tool points, trails and the drawn robot's outline in the real frames."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mtv_world_ros.data.episode import Episode, Track
from mtv_world_ros.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.geometry.camera import camera_poses, project
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.inspection.robot_shape import draw_silhouettes, LinkShape
from mtv_world_ros.rendering.trajectory_video import (
    arm_colour,
    render_trajectory_video,
    TrajectoryVideoConfig,
)

#: frames of a picture, side by side in rows of two
_NUM_FRAMES = 4
#: width of one frame in the picture [px]
_WIDTH = 640
#: longest trail that is drawn [s], and its points a second
_TRAIL_S, _TRAIL_HZ = 2.0, 20


def overlay_picture(
    episode: Episode,
    view: str,
    robot: RobotModel,
    shapes: Sequence[LinkShape],
    joints: JointTrack,
) -> ByteArray:
    """Returns (H, W, 3) RGB: frames of a view with what the calibration draws into them.

    Per arm the fading trail of the last seconds and a cross at the tool point; white the outline
    of the robot. Frames without joint states are drawn as they are.
    """
    track, camera = episode.images[view], episode.cameras[view]
    covered = np.flatnonzero(joints.covers(track.stamps_ns))
    indices = covered if len(covered) else np.arange(len(track.stamps_ns))
    chosen = indices[np.linspace(0, len(indices) - 1, _NUM_FRAMES + 2).astype(int)[1:-1]]
    tiles = [_tile(track, int(i), camera, robot, shapes, joints) for i in chosen]
    rows = [np.hstack(tiles[i : i + 2]) for i in range(0, len(tiles), 2)]
    return np.ascontiguousarray(np.vstack(rows))


def _tile(
    track: Track,
    index: int,
    camera: CameraModel,
    robot: RobotModel,
    shapes: Sequence[LinkShape],
    joints: JointTrack,
) -> ByteArray:
    stamp = int(track.stamps_ns[index])
    frame = np.array(track.frames[index])
    if joints.covers(np.array([stamp])).all():
        positions = joints.at(np.array([stamp]))
        frame = _with_trails(frame, stamp, camera, robot, joints)
        outline = draw_silhouettes(shapes, camera, robot, positions)[0]
        contours, _ = cv2.findContours(outline, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(frame, contours, -1, (255, 255, 255), 1)
        _draw_crosses(frame, camera, robot, positions)
    height = round(frame.shape[0] * _WIDTH / frame.shape[1])
    tile = np.asarray(cv2.resize(frame, (_WIDTH, height)), np.uint8)
    seconds = (stamp - int(track.stamps_ns[0])) * 1e-9
    cv2.putText(tile, f'{seconds:.2f} s', (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 0))
    return tile


def _with_trails(
    frame: ByteArray, stamp_ns: int, camera: CameraModel, robot: RobotModel, joints: JointTrack
) -> ByteArray:
    start = max(stamp_ns - round(_TRAIL_S * 1e9), int(joints.stamps_ns[0]))
    count = max(2, round((stamp_ns - start) * 1e-9 * _TRAIL_HZ))
    stamps = np.linspace(start, stamp_ns, count).astype(np.int64) if stamp_ns > start else None
    if stamps is None:
        return frame
    video = render_trajectory_video(
        cameras=(camera,),
        robot=robot,
        positions=joints.at(stamps),
        times=np.asarray((stamps - start) * 1e-9, np.float64),
        object_masks=None,
        config=TrajectoryVideoConfig(half_life_s=1.0, point_radius_m=0.006, max_gap_m=0.005),
    )
    trails = video.frames[0, -1]
    share = trails.max(axis=-1, keepdims=True) / 255.0
    return np.asarray(frame * (1 - share) + trails, np.uint8)


def _draw_crosses(
    frame: ByteArray, camera: CameraModel, robot: RobotModel, positions: FloatArray
) -> None:
    points = robot.tool_poses(positions)[:, 0, :3, 3]
    pixels, _ = project(camera, camera_poses(camera, robot, positions)[0], points)
    size = max(7, camera.width // 40)
    for arm, pixel in enumerate(pixels):
        if np.isfinite(pixel).all() and (np.abs(pixel) < 10 * camera.width).all():
            colour = tuple(int(255 * c) for c in arm_colour(arm, len(pixels)))
            at = (round(float(pixel[0])), round(float(pixel[1])))
            cv2.drawMarker(frame, at, (0, 0, 0), cv2.MARKER_CROSS, size + 2, 3)
            cv2.drawMarker(frame, at, colour, cv2.MARKER_CROSS, size, 1)
