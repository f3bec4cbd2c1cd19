"""Pictures without a camera pose: drawn robots, and frozen, still or mirrored recordings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.silhouettes import project_part
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray
from mtv_world_ros.core.transforms import looking_along
from mtv_world_ros.data.episode import Track
from mtv_world_ros.inspection.clocks import JointTrack, Stamps
from mtv_world_ros.inspection.inspection_report import broken, Finding, suspicious
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import load_shape, RobotShape

#: width and height of a picture of a robot [px]
_SIZE_PX = 480
#: focal length of its camera [px]
_FOCAL_PX = 520.0
#: colours of the x, y and z axes (RGB)
_AXES = ((220, 40, 40), (30, 160, 30), (40, 60, 230))
#: length of the axes that are drawn [m]
_AXIS_M = 0.08


def robot_picture(robot: RobotModel) -> ByteArray:
    """Return (H, W, 3) RGB: front and side, above with grippers shut, below with them open."""
    shape = load_shape(robot)
    rows = []
    for share in (0.0, 1.0):
        positions = middle_positions(robot, share)
        rows.append(np.hstack([_tile(robot, shape, positions, angle) for angle in (35, 125)]))
    return np.vstack(rows)


def middle_positions(robot: RobotModel, opening: float) -> FloatArray:
    """Return the middle (1, J) of the joint limits, at most a radian from zero."""
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in (robot.lower, robot.upper))
    positions = np.clip((lower + upper) / 2, -1.0, 1.0).clip(robot.lower, robot.upper)
    for tool in robot.tools:
        if tool.gripper_joint is not None:
            travel = tool.gripper_open - tool.gripper_closed
            column = robot.joint_names.index(tool.gripper_joint)
            positions[column] = tool.gripper_closed + opening * travel
    return positions[None]


def _tile(
    robot: RobotModel, shape: RobotShape, positions: FloatArray, angle_deg: float
) -> ByteArray:
    poses = robot.forward_kinematics(positions)
    points = [p.points @ poses[p.link][0, :3, :3].T + poses[p.link][0, :3, 3] for p in shape.parts]
    cloud = np.concatenate([*points, robot.tool_poses(positions)[:, 0, :3, 3]])
    camera = _camera(cloud, np.radians(angle_deg))
    image = np.full((_SIZE_PX, _SIZE_PX, 3), 245, np.uint8)
    depths = [float(project(camera, camera.T_mount_camera, p)[1].mean()) for p in points]
    for index in np.argsort(depths)[::-1]:
        part = shape.parts[int(index)]
        T = camera.T_mount_camera[None]
        pixels = project_part(part, poses[part.link], camera, T)[0]
        hull = cv2.convexHull(np.rint(pixels * 16).astype(np.int32))
        shade = 120 + 23 * (int(index) % 5)
        cv2.fillConvexPoly(image, hull, (shade, shade, shade + 12), cv2.LINE_AA, 4)
        cv2.polylines(image, [hull], True, (70, 70, 80), 1, cv2.LINE_AA, 4)
    for T in robot.tool_poses(positions)[:, 0]:
        _draw_axes(image, camera, T)
    return image


def _camera(cloud: FloatArray, angle: float) -> CameraModel:
    """Return a camera that sees all points, from a direction and slightly above."""
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 0.05)
    ahead = -np.array([np.cos(angle), np.sin(angle), 0.45])
    T = np.eye(4)
    T[:3, :3] = looking_along(ahead)
    T[:3, 3] = centre - T[:3, 2] * radius * 2.6
    K = np.array([[_FOCAL_PX, 0, _SIZE_PX / 2], [0, _FOCAL_PX, _SIZE_PX / 2], [0, 0, 1]])
    return CameraModel(
        view='picture', width=_SIZE_PX, height=_SIZE_PX, K=K, mount_link='', T_mount_camera=T
    )


def _draw_axes(image: ByteArray, camera: CameraModel, T: FloatArray) -> None:
    ends = np.stack([T[:3, 3], *(T[:3, 3] + _AXIS_M * T[:3, k] for k in range(3))])
    pixels, _ = project(camera, camera.T_mount_camera, ends)
    origin, *tips = [tuple(int(v) for v in np.rint(p)) for p in pixels]
    for tip, colour in zip(tips, _AXES, strict=True):
        cv2.line(image, origin, tip, colour, 2, cv2.LINE_AA)


#: mean difference of two frames below which they are the same picture [grey levels]
_SAME_PICTURE = 0.05
#: joints that move more between two frames must change the picture [rad or m]
_MOVES = 0.02
#: time for which a picture may stay: cameras are slower than the rows of a table [s]
_LONGEST_REPEAT_S = 0.25
#: fraction of frames of a picture that stays while joints move, above which a view is suspicious
_SUSPICIOUS_FROZEN_FRACTION = 0.1
#: fraction of such frames above which a view is broken
_BROKEN_FROZEN_FRACTION = 0.5
#: frames a second below which motions between frames are guessed
_LEAST_HZ = 2.5
#: joint states this long before the first or after the last frame [s]
_LONGEST_WITHOUT_FRAMES_S = 2.0
#: frames that are compared at most
_MOST_FRAMES = 80


def check_frozen(track: Track, joints: JointTrack) -> tuple[dict[str, str], list[Finding]]:
    """Check for frames that stay the same while joints move.

    A camera that is slower than the frames are stored repeats each picture for a moment.
    """
    covered = np.flatnonzero(joints.covers(track.stamps_ns))
    count = min(len(covered), _MOST_FRAMES)
    if count < 3:
        return {}, []
    first = int((len(covered) - count) // 2)
    chosen = covered[first : first + count]
    positions = joints.at(track.stamps_ns[chosen])
    moves = np.abs(np.diff(positions, axis=0)).max(axis=1) > _MOVES
    if moves.sum() < 3:
        return {}, []
    frames = [np.asarray(track.frames[int(n)])[::4, ::4].astype(np.int16) for n in chosen]
    changes = np.array([np.abs(b - a).mean() for a, b in zip(frames, frames[1:], strict=False)])
    repeats = changes < _SAME_PICTURE
    first_shown = np.maximum.accumulate(np.where(repeats, 0, np.arange(1, count)))
    shown_s = (track.stamps_ns[chosen[1:]] - track.stamps_ns[chosen[first_shown]]) * 1e-9
    moved = np.abs(positions[1:] - positions[first_shown]).max(axis=1) > _MOVES
    hangs = repeats & moved & (shown_s > _LONGEST_REPEAT_S)
    share = float(hangs.sum() / (moves | hangs).sum())
    measures = {
        'frames that repeat the one before while joints move': f'{repeats[moves].mean():.0%}',
        'frames that do not change while joints move': f'{share:.0%}',
    }
    text = (
        f'{share:.0%} of the frames in which joints move show the same picture for more than '
        f'{_LONGEST_REPEAT_S:g} s: the camera hangs, or this is not a view of this robot'
    )
    if share > _BROKEN_FROZEN_FRACTION:
        return measures, [broken(text)]
    return measures, [suspicious(text)] if share > _SUSPICIOUS_FROZEN_FRACTION else []


def check_lengths(stamps_ns: Stamps, joints: JointTrack) -> tuple[dict[str, str], list[Finding]]:
    """Return findings on frame rates too low to follow a motion, and on missing pictures."""
    findings = []
    if len(stamps_ns) > 1:
        rate = 1e9 / float(np.median(np.diff(stamps_ns)))
        if rate < _LEAST_HZ:
            findings.append(
                suspicious(f'{rate:.2g} frames a second: {_LEAST_HZ:g} or more are needed')
            )
    ends = (joints.stamps_ns[-1] - stamps_ns[-1], stamps_ns[0] - joints.stamps_ns[0])
    longest = max(ends) * 1e-9
    if longest > _LONGEST_WITHOUT_FRAMES_S:
        where = 'after the last' if ends[0] >= ends[1] else 'before the first'
        findings.append(
            suspicious(
                f'joint states go on for {longest:.1f} s {where} frame: video and joints are of '
                'different length'
            )
        )
    return {}, findings


@dataclass(frozen=True, slots=True)
class Orientation:
    """A way in which a camera or its driver turns or mirrors frames.

    Attributes:
        text: what the frames are.
        quarters: counterclockwise quarter turns that undo it, after the mirroring.
        is_mirrored: whether frames are mirrored left to right.
    """

    text: str
    quarters: int
    is_mirrored: bool = False

    def undo(self, frame: ByteArray) -> ByteArray:
        """Return a frame (H, W, 3) as it was before."""
        flipped = frame[:, ::-1] if self.is_mirrored else frame
        return np.rot90(flipped, self.quarters)


#: orientations that are tried where frames do not show the drawn robot
ORIENTATIONS = (
    Orientation('mirrored left to right', 0, is_mirrored=True),
    Orientation('turned by 180 degrees', 2),
    Orientation('mirrored top to bottom', 2, is_mirrored=True),
    Orientation('turned by 90 degrees clockwise', 1),
    Orientation('turned by 90 degrees counterclockwise', 3),
)


class TurnedFrames:
    """Frames that are turned or mirrored back when asked for.

    Args:
        track: frames of the recording.
        orientation: the way in which they were turned or mirrored.
    """

    def __init__(self, track: Track, orientation: Orientation) -> None:
        self._frames, self._orientation = track.frames, orientation

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> ByteArray:
        return self._orientation.undo(np.asarray(self._frames[index]))

    def __array__(self, dtype: object = None, copy: bool | None = None) -> NDArray[np.uint8]:
        return np.stack([self[index] for index in range(len(self))])


def turned_back(
    track: Track, camera: CameraModel, orientation: Orientation
) -> tuple[Track, CameraModel]:
    """Return the upright frames of a view and the camera that fits them.

    Args:
        track: frames as they were recorded, turned or mirrored.
        camera: camera of the recorded frames.
        orientation: how the recorded frames are turned or mirrored.
    """
    K = camera.K.copy()
    if orientation.is_mirrored:
        K[0, 2] = camera.width - 1 - K[0, 2]
    width, height = camera.width, camera.height
    for _ in range(orientation.quarters):  # (x, y) becomes (y, width - 1 - x)
        K[0, 0], K[1, 1], K[0, 2], K[1, 2] = K[1, 1], K[0, 0], K[1, 2], width - 1 - K[0, 2]
        width, height = height, width
    frames = TurnedFrames(track, orientation)
    return Track(track.stamps_ns, frames), replace(camera, K=K)  # type: ignore[arg-type]
