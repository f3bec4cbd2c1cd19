"""Middle between the finger tips of a gripper: the point that a user clicks in a picture."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import gripper_links, LinkShape

#: depth of a finger's tip: mesh points within this distance of the farthest one are averaged [m]
_TIP_DEPTH_M = 0.002
#: a link that ends farther than this behind the farthest link has no finger tip [m]
_MAX_SHORTER_BY_M = 0.015


def tip_middles(
    robot: RobotModel, shapes: Sequence[LinkShape], positions: FloatArray, arm: int = 0
) -> FloatArray:
    """Return (T, 3) the middle between the finger tips, in the base link [m].

    Fingers that turn reach less far when they open: those of a Robotiq 2F-85 by 13 mm. The only
    finger that a gripper joint moves, as of a hand, has its end. Of a tool
    without fingers, or of fingers without shapes, it is the tool point.

    Args:
        robot: robot of the positions.
        shapes: shapes of its links.
        positions: (T, J) positions of the joints [rad or m].
        arm: number of the tool.
    """
    tools = robot.tool_poses(positions)[arm]
    ends = _tips(robot, shapes, positions, arm)
    if not ends:
        return np.asarray(tools[:, :3, 3])
    return np.stack([np.mean(found, axis=0) for found in ends])


def num_tips(robot: RobotModel, shapes: Sequence[LinkShape], arm: int = 0) -> int:
    """Return how many finger tips the tool has, halfway open; 1 = the tool point alone."""
    tool = robot.tools[arm]
    positions = np.clip(np.zeros((1, len(robot.joint_names))), robot.lower, robot.upper)
    if tool.gripper_joint is not None:
        column = robot.joint_names.index(tool.gripper_joint)
        positions[0, column] = (tool.gripper_open + tool.gripper_closed) / 2
    return max([1, *map(len, _tips(robot, shapes, positions, arm))])


def _tips(
    robot: RobotModel, shapes: Sequence[LinkShape], positions: FloatArray, arm: int
) -> list[list[FloatArray]]:
    """Return the finger tips (3,) of each of T states [m], base frame; empty without shapes."""
    links = _last_links(robot, gripper_links(robot, robot.tools[arm]))
    parts = [part for part in shapes if part.link in links]
    if not parts:
        return []
    poses = robot.forward_kinematics(positions)
    return [
        _ends(parts, {link: T[row] for link, T in poses.items() if link in links}, tool)
        for row, tool in enumerate(robot.tool_poses(positions)[arm])
    ]


def _last_links(robot: RobotModel, links: Collection[str]) -> set[str]:
    """Return the links that carry no other of the links: a finger of phalanges has one tip."""
    model = robot.pinocchio_model
    joints = {f.name: f.parentJoint for f in model.frames if f.name in links}
    carriers = {j for joint in joints.values() for j in list(model.supports[joint])[:-1]}
    return {link for link in links if joints[link] not in carriers}


def _ends(
    parts: Sequence[LinkShape], poses: dict[str, FloatArray], tool: FloatArray
) -> list[FloatArray]:
    """Return the position (3,) of each tip in one state; the tool's z points away from the arm."""
    by_link: dict[str, list[FloatArray]] = {}
    for part in parts:
        T = poses[part.link]
        by_link.setdefault(part.link, []).append(part.points @ T[:3, :3].T + T[:3, 3])
    ends = []
    for found in by_link.values():
        points = np.concatenate(found)
        reach = (points - tool[:3, 3]) @ tool[:3, 2]
        ends.append((reach.max(), points[reach > reach.max() - _TIP_DEPTH_M].mean(axis=0)))
    farthest = max(reach for reach, _ in ends)
    return [end for reach, end in ends if reach > farthest - _MAX_SHORTER_BY_M]
