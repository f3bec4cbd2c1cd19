"""Grippers whose range of positions is no finger's."""

from __future__ import annotations

import math

from mtv_world_ros.robot.model import RobotModel

#: turns of a finger about its axis from which its range is doubtful [rad]
_MAX_TURN_RAD = 2 * math.pi
#: largest travel of a finger that slides [m]
_MAX_SLIDE_M = 0.5


def gripper_doubts(robot: RobotModel) -> tuple[str, ...]:
    """Return a line for each gripper whose joint goes farther than a finger, e.g. in percent."""
    doubts = []
    for tool in robot.tools:
        if tool.gripper_joint is None:
            continue
        travel = abs(tool.gripper_open - tool.gripper_closed)
        slides = (tool.finger_travel_m or 0.0) > _MAX_SLIDE_M
        if travel > _MAX_TURN_RAD or slides:
            doubts.append(
                f"arm '{tool.arm}': gripper '{tool.gripper_joint}' goes from "
                f'{tool.gripper_closed:g} to {tool.gripper_open:g} rad or m, which no finger does '
                '(percent, degrees or millimetres?): correct the limits in its URDF, and '
                "'gripper_open' and 'gripper_closed' in its YAML"
            )
    return tuple(doubts)
