"""Commanded poses of an arm's tool, or differences of poses, and their inverse kinematics.

T rows, J joints, n joints of an arm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
import pinocchio as pin
from pydantic import Field

from mtv_world_ros.core.config import Pair, Schema
from mtv_world_ros.core.data_types import FloatArray, JointTrajectory
from mtv_world_ros.core.errors import EpisodeError, TrajectoryError, UnknownNameError
from mtv_world_ros.data.episode import JointStates
from mtv_world_ros.robot.arm_solver import ArmSolver
from mtv_world_ros.robot.model import RobotModel, Tool

#: share of the poses that may be out of reach before the episode fails
_MOST_OUT_OF_REACH = 0.5


class ToolTargets(Schema):
    """The meaning of commanded poses of an arm's tool."""

    scale: Pair = Field(
        default=(1.0, 1.0), description='factors of position and rotation (of a controller)'
    )
    difference: Literal['', 'fixed', 'tool'] = Field(
        default='',
        description='empty = poses; else added to the measured pose of the row: along the axes '
        'of `frame` (fixed), or of the tool',
    )
    frame: str = Field(default='', description='link that poses are in; empty = the base link')
    link: str = Field(default='', description='whose pose it is; empty = the tool point')

    @property
    def has_rotation(self) -> bool:
        """True if the targets have a rotation; otherwise the tool keeps its own."""
        return True

    def check(self, arm: str, robot: RobotModel) -> Tool:
        """Return the tool, whose point is the one that the poses are of.

        Raises:
            ValueError: the robot has no such arm or link.
        """
        tools = {tool.arm: tool for tool in robot.tools}
        if arm not in tools:
            raise UnknownNameError(
                f"tools: robot '{robot.name}' has no arm", arm, tools, listed='; it has'
            )
        for link in filter(None, (self.frame, self.link)):
            if link not in robot.link_names:
                raise UnknownNameError(
                    f"tools: robot '{robot.name}' has no link", link, robot.link_names, most=0
                )
        if not self.link:
            return tools[arm]
        return replace(tools[arm], link=self.link, T_link_tool=np.eye(4))


def tool_joints(tools: Mapping[str, ToolTargets], robot: RobotModel) -> set[str]:
    """Return the joints whose positions follow from tool poses.

    Raises:
        ValueError: the robot has no such arm or link.
    """
    solvers = [ArmSolver(robot, poses.check(arm, robot)) for arm, poses in tools.items()]
    return {robot.joint_names[index] for solver in solvers for index in solver.indices}


def add_tool_poses(
    positions: FloatArray,
    measured: FloatArray,
    robot: RobotModel,
    arm: str,
    poses: ToolTargets,
    wanted: FloatArray,
) -> str:
    """Write an arm's joints for poses of its tool into `positions` (T, J).

    Each solution is the one nearest to the row's measured joints. A pose out of reach is replaced
    by the measured positions of the row that follows.

    Args:
        positions: (T, J) [rad or m]; the arm's columns are overwritten.
        measured: (T, J) measured positions [rad or m].
        robot: the robot.
        arm: name of the arm.
        poses: frame, units and reference of the poses.
        wanted: (T, 4, 4) commanded poses of the tool, or differences [m].

    Returns:
        How many poses are out of reach, in words; empty where none is.

    Raises:
        EpisodeError: most poses are out of reach.
    """
    tool = poses.check(arm, robot)
    solver, lost = ArmSolver(robot, tool), 0
    goals = _goals(measured, robot, tool, poses, wanted)
    for k, goal in enumerate(goals):
        try:
            row = solver.solve(goal, measured[k, solver.indices])
        except TrajectoryError:
            row = measured[min(k + 1, len(measured) - 1), solver.indices]
            lost += 1
        positions[k, solver.indices] = row
    text = f"arm '{arm}': {lost} of {len(goals)} poses are out of reach"
    if lost > _MOST_OUT_OF_REACH * len(goals):
        raise EpisodeError(f'{text}: are frame, link, unit, scale and rotation_is right?')
    return f'{text}; the measured positions that follow stand in' if lost else ''


def _goals(
    measured: FloatArray, robot: RobotModel, tool: Tool, poses: ToolTargets, wanted: FloatArray
) -> FloatArray:
    """Return the poses (T, 4, 4) of the tool in the base link."""
    frame = poses.frame or robot.base_link
    T_base_frame = robot.link_poses(frame, measured)
    now = np.linalg.inv(T_base_frame) @ robot.link_poses(tool.link, measured) @ tool.T_link_tool
    if poses.difference == 'tool':
        goals = now @ wanted
    elif poses.difference == 'fixed':
        goals = wanted @ now  # turns about the frame's axes ...
        goals[:, :3, 3] = now[:, :3, 3] + wanted[:, :3, 3]  # ... through the tool's own point
    else:
        goals = wanted.copy()
        if not poses.has_rotation:
            goals[:, :3, :3] = now[:, :3, :3]
    return T_base_frame @ goals


class ToolTrack(NamedTuple):
    """Commanded poses of a tool over time.

    Attributes:
        targets: frame, units and reference of the tool targets.
        stamps_ns: (N,) int64, increasing.
        poses: (N, 4, 4) poses or differences.
    """

    targets: ToolTargets
    stamps_ns: NDArray[np.int64]
    poses: FloatArray


def joints_of_tools(
    tools: Mapping[str, ToolTrack],
    robot: RobotModel,
    states: JointStates,
    others: Sequence[tuple[int, JointTrajectory]],
) -> tuple[JointStates, list[str]]:
    """Return joint positions that follow commanded tool poses, and warnings.

    The first tool's stamps are the clock; of the other tools the newest pose before counts. A
    pose is reached at its own stamp, a difference at the stamp that follows.

    Args:
        tools: commanded poses, by arm.
        robot: the robot.
        states: measured joint positions.
        others: commands of the other joints; those that have none keep the measured positions.

    Raises:
        ValueError: the robot has no such arm or link.
        EpisodeError: most poses of a tool are out of reach, or none comes while positions are
            measured.
    """
    known = states.stamps_ns
    begins = max([known[0], *(track.stamps_ns[0] for track in tools.values())])
    stamps = next(iter(tools.values())).stamps_ns
    stamps = stamps[(stamps >= begins) & (stamps <= known[-1])]
    if len(stamps) < 2:
        raise EpisodeError(
            f'{len(stamps)} tool poses come while joint positions are measured; do their stamps '
            'come from the same clock?'
        )
    measured = states.at(stamps, robot)
    positions, warnings = measured.copy(), []
    led = tool_joints({arm: track.targets for arm, track in tools.items()}, robot)
    free = [name for name in robot.joint_names if name not in led]
    uncommanded = _add_others(positions, robot, free, stamps, others)
    if uncommanded:
        warnings.append(
            f'joints {", ".join(uncommanded)} have no commands; they keep what is measured'
        )
    for arm, (targets, known_ns, poses) in tools.items():
        newest = np.searchsorted(known_ns, stamps, side='right') - 1
        wanted = _scaled(poses[newest], targets.scale)
        warnings.append(add_tool_poses(positions, measured, robot, arm, targets, wanted))
    if any(track.targets.difference for track in tools.values()):
        stamps, positions = stamps[1:], positions[:-1]
    reached = JointStates(stamps_ns=stamps, joint_names=robot.joint_names, positions=positions)
    return reached, list(filter(None, warnings))


def _add_others(
    positions: FloatArray,
    robot: RobotModel,
    free: Sequence[str],
    stamps: NDArray[np.int64],
    others: Sequence[tuple[int, JointTrajectory]],
) -> list[str]:
    """Write the commands of joints into `positions` (T, J); return those that have none."""
    without = []
    for name in free:
        points: dict[int, float] = {}
        for start, trajectory in others:
            if name in trajectory.joint_names:
                column = trajectory.positions[:, trajectory.joint_names.index(name)]
                times = start + (trajectory.times * 1e9).round().astype(np.int64)
                points = {stamp: value for stamp, value in points.items() if stamp <= start}
                points |= dict(zip(times.tolist(), column.tolist(), strict=True))
        if not points:
            without.append(name)
            continue
        times = np.array(list(points), np.float64)
        values = np.array(list(points.values()))
        positions[:, robot.joint_names.index(name)] = np.interp(stamps, times, values)
    return without


def _scaled(poses: FloatArray, scale: tuple[float, float]) -> FloatArray:
    """Return the poses (T, 4, 4) with positions and angles multiplied."""
    if scale == (1.0, 1.0):
        return poses
    scaled = poses.copy()
    scaled[:, :3, 3] *= scale[0]
    scaled[:, :3, :3] = [pin.exp3(scale[1] * pin.log3(R)) for R in poses[:, :3, :3]]
    return scaled
