"""Where the tools are at the frames of a video and between them.

A arms, T frames, N trail points, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.geometry.robot import RobotModel

#: how much of a finger is drawn [m]
_FINGER_LENGTH_M = 0.03
#: most trail points from one frame to the next
_MOST_POINTS = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolMotion:
    """Tool points over time.

    Attributes:
        times: (N,) [s].
        points: (A, N, 3) in the base frame [m].
        closed: (A, T) 0 open .. 1 closed, at the frames.
        shown_at: (T,) index of each frame's own point.
        fingers: two of each arm: (2, T, 3) the ends of a line along the finger, at the frames [m];
            NaN where it is not known how the fingers travel.
    """

    times: FloatArray
    points: FloatArray
    closed: FloatArray
    shown_at: np.ndarray
    fingers: tuple[FloatArray, ...]


def tool_motion(
    robot: RobotModel,
    positions: FloatArray,
    times: FloatArray,
    points_per_frame: int,
    max_gap_m: float | None,
) -> ToolMotion:
    """Interpolates the joints between the frames, so that trails follow the arms' arcs.

    Args:
        robot: gives the tool points.
        positions: (T, J) at the frames [rad or m].
        times: (T,) of the frames [s].
        points_per_frame: least number of points from one frame to the next.
        max_gap_m: largest distance of neighbouring points [m]; None = any.
    """
    counts = np.full(len(times) - 1, points_per_frame)
    if max_gap_m is not None:
        points = robot.tool_poses(positions)[..., :3, 3]
        steps = np.linalg.norm(np.diff(points, axis=1), axis=-1).max(axis=0, initial=0.0)
        needed = np.ceil(np.minimum(steps / max_gap_m, _MOST_POINTS)).astype(int)
        counts = np.maximum(counts, needed)
    shown_at = np.concatenate([[0], np.cumsum(counts)])
    fine = np.interp(np.arange(shown_at[-1] + 1), shown_at, np.arange(len(times)))
    left = np.minimum(fine.astype(int), max(len(times) - 2, 0))
    right, share = np.minimum(left + 1, len(times) - 1), fine - left
    dense = (1 - share)[:, None] * positions[left] + share[:, None] * positions[right]
    return ToolMotion(
        times=(1 - share) * times[left] + share * times[right],
        points=robot.tool_poses(dense)[..., :3, 3],
        closed=1.0 - robot.gripper_openings(positions),
        fingers=_fingers(robot, positions),
        shown_at=shown_at,
    )


def _fingers(robot: RobotModel, positions: FloatArray) -> tuple[FloatArray, ...]:
    """Two points along each finger, (2, T, 3) [m]: of each arm the left, then the right one."""
    poses, openings = robot.tool_poses(positions), robot.gripper_openings(positions)
    lines = []
    for tool, pose, opening in zip(robot.tools, poses, openings, strict=True):
        apart = np.full(len(positions), np.nan)
        if tool.finger_travel_m is not None:
            apart = tool.finger_travel_m * opening
        for side in (1.0, -1.0):
            tip = pose[:, :3, 3] + (side * apart)[:, None] * pose[:, :3, 1]
            lines.append(np.stack([tip, tip - _FINGER_LENGTH_M * pose[:, :3, 2]]))
    return tuple(lines)
