"""Where the middle between the finger tips is: what somebody clicks in a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.geometry.robot.shape import gripper_links, LinkShape

#: a finger ends in its points this far behind its farthest one, and a link that ends this far
#: behind the farthest one has no tip [m]
_TIP_M, _BESIDE_TIP_M = 0.002, 0.015


def tip_middles(
    robot: RobotModel, shapes: Sequence[LinkShape], positions: FloatArray, arm: int = 0
) -> FloatArray:
    """Returns (T, 3) the middle between the finger tips, in the base link [m].

    Fingers that turn reach less far when they open: those of a Robotiq 2F-85 by 13 mm. Of a tool
    without fingers, or of fingers without shapes, it is the tool point.

    Args:
        robot: of the positions.
        shapes: of its links.
        positions: (T, J) of the joints [rad or m].
        arm: number of the tool.
    """
    tools = robot.tool_poses(positions)[arm]
    links = gripper_links(robot, robot.tools[arm])
    parts = [part for part in shapes if part.link in links]
    if not parts:
        return np.asarray(tools[:, :3, 3])
    poses = robot.forward_kinematics(positions)
    return np.stack(
        [
            _middle(parts, {link: T[row] for link, T in poses.items() if link in links}, tool)
            for row, tool in enumerate(tools)
        ]
    )


def _middle(
    parts: Sequence[LinkShape], poses: dict[str, FloatArray], tool: FloatArray
) -> FloatArray:
    """(3,) of one state; the tool's z axis points away from the arm."""
    by_link: dict[str, list[FloatArray]] = {}
    for part in parts:
        T = poses[part.link]
        by_link.setdefault(part.link, []).append(part.points @ T[:3, :3].T + T[:3, 3])
    ends = []
    for found in by_link.values():
        points = np.concatenate(found)
        reach = (points - tool[:3, 3]) @ tool[:3, 2]
        ends.append((reach.max(), points[reach > reach.max() - _TIP_M].mean(axis=0)))
    farthest = max(reach for reach, _ in ends)
    return np.asarray(
        np.mean([end for reach, end in ends if reach > farthest - _BESIDE_TIP_M], axis=0)
    )
