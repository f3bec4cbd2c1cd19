"""Robots: joints, limits, tools and forward kinematics on one Pinocchio model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import RobotError, TrajectoryError, nearest


@dataclass(frozen=True, slots=True, kw_only=True)
class Tool:
    """Where an arm acts.

    Attributes:
        arm: name of the arm.
        link: link that carries the tool.
        T_link_tool: (4, 4) pose of the tool centre point in the link [m].
        gripper_joint: joint that opens the gripper, or None.
        gripper_closed: its value when closed [rad or m].
        gripper_open: its value when open [rad or m].
    """

    arm: str
    link: str
    T_link_tool: FloatArray
    gripper_joint: str | None = None
    gripper_closed: float = 0.0
    gripper_open: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Mimic:
    """A joint that follows another: `value = multiplier * source + offset`."""

    joint: str
    source: str
    multiplier: float = 1.0
    offset: float = 0.0


class RobotModel:
    """A robot of any number of arms.

    Args:
        name: of the robot.
        model: its Pinocchio model; every joint is in `joint_names` or in `mimics`, others rest.
        joint_names: J commanded joints, in the order of all position vectors.
        tools: one per arm.
        base_link: link (frame) in which all poses are given.
        mimics: joints that follow others.

    Raises:
        RobotError: a joint or link is not in the model.
    """

    def __init__(
        self,
        *,
        name: str,
        model: pin.Model,
        joint_names: Sequence[str],
        tools: Sequence[Tool],
        base_link: str,
        mimics: Sequence[Mimic] = (),
    ) -> None:
        self.name = name
        self.pinocchio_model = model
        self.joint_names = tuple(joint_names)
        self.tools = tuple(tools)
        self.base_link = base_link
        self._data = model.createData()
        self._q_index = [self._configuration_index(joint) for joint in self.joint_names]
        self.lower = np.array([model.lowerPositionLimit[i] for i in self._q_index])
        self.upper = np.array([model.upperPositionLimit[i] for i in self._q_index])
        self._mimics = [self._mimic_row(mimic) for mimic in mimics]
        self._frames = {frame.name: index for index, frame in enumerate(model.frames)}
        for link in (base_link, *(tool.link for tool in self.tools)):
            self._frame(link)
        self._gripper_columns = [self._gripper_column(tool) for tool in self.tools]

    def forward_kinematics(self, positions: FloatArray) -> dict[str, FloatArray]:
        """Returns base_T_link (T, 4, 4) of every link for positions (T, J)."""
        links = [f.name for f in self.pinocchio_model.frames if f.type == pin.FrameType.BODY]
        poses = self._poses(positions, [self._frame(link) for link in links])
        return dict(zip(links, poses, strict=True))

    def link_poses(self, link: str, positions: FloatArray) -> FloatArray:
        """Returns base_T_link (T, 4, 4) of one link for positions (T, J)."""
        return self._poses(positions, [self._frame(link)])[0]

    def tool_poses(self, positions: FloatArray) -> FloatArray:
        """Returns base_T_tool (A, T, 4, 4) of the tool centre points for positions (T, J)."""
        links = self._poses(positions, [self._frame(tool.link) for tool in self.tools])
        offsets = np.stack([tool.T_link_tool for tool in self.tools])
        return links @ offsets[:, None]

    def gripper_openings(self, positions: FloatArray) -> FloatArray:
        """Returns (A, T) openings in [0, 1] for positions (T, J); 1 where there is no gripper."""
        openings = np.ones((len(self.tools), len(positions)))
        for arm, (tool, column) in enumerate(
            zip(self.tools, self._gripper_columns, strict=True)
        ):
            if column is not None:
                travel = tool.gripper_open - tool.gripper_closed
                openings[arm] = (positions[:, column] - tool.gripper_closed) / travel
        return openings.clip(0.0, 1.0)

    def _poses(self, positions: FloatArray, frames: Sequence[int]) -> FloatArray:
        """(len(frames), T, 4, 4)."""
        positions = np.asarray(positions, dtype=float)
        if positions.ndim != 2 or positions.shape[1] != len(self.joint_names):
            raise RobotError(
                f"positions have shape {positions.shape}, robot '{self.name}' needs "
                f'(T, {len(self.joint_names)})'
            )
        model, data = self.pinocchio_model, self._data
        base = self._frame(self.base_link)
        q = pin.neutral(model)
        out = np.empty((len(frames), len(positions), 4, 4))
        for t, row in enumerate(positions):
            q[self._q_index] = row
            for target, source, multiplier, offset in self._mimics:
                q[target] = multiplier * q[source] + offset
            pin.framesForwardKinematics(model, data, q)
            base_T_world = data.oMf[base].inverse()
            for f, frame in enumerate(frames):
                out[f, t] = (base_T_world * data.oMf[frame]).homogeneous
        return out

    def _configuration_index(self, joint: str) -> int:
        model = self.pinocchio_model
        if not model.existJointName(joint):
            known = list(model.names)[1:]
            raise RobotError(
                f"robot '{self.name}' has no joint '{joint}'{nearest(joint, known)}; it has {known}"
            )
        joint_model = model.joints[model.getJointId(joint)]
        if joint_model.nq != 1:
            raise RobotError(
                f"joint '{joint}' of robot '{self.name}' is of type {joint_model.shortname()}; "
                'only joints of one number (revolute with limits, prismatic) can be commanded'
            )
        return joint_model.idx_q

    def _mimic_row(self, mimic: Mimic) -> tuple[int, int, float, float]:
        target = self._configuration_index(mimic.joint)
        source = self._configuration_index(mimic.source)
        return target, source, mimic.multiplier, mimic.offset

    def _frame(self, link: str) -> int:
        if link not in self._frames:
            raise RobotError(
                f"robot '{self.name}' has no link '{link}'{nearest(link, self._frames)}"
            )
        return self._frames[link]

    def _gripper_column(self, tool: Tool) -> int | None:
        if tool.gripper_joint is None:
            return None
        if tool.gripper_joint not in self.joint_names:
            raise RobotError(
                f"gripper joint '{tool.gripper_joint}' of arm '{tool.arm}' is not among the "
                f'joints{nearest(tool.gripper_joint, self.joint_names)}'
            )
        if tool.gripper_open == tool.gripper_closed:
            raise RobotError(
                f"arm '{tool.arm}': gripper_open and gripper_closed are both {tool.gripper_open}"
            )
        return self.joint_names.index(tool.gripper_joint)


def check_positions(
    robot: RobotModel, positions: FloatArray, *, tolerance: float = 1e-3
) -> None:
    """Checks positions (T, J) against the joint limits.

    Raises:
        TrajectoryError: names the first joint outside, its value and the limits.
    """
    low, high = robot.lower - tolerance, robot.upper + tolerance
    outside = (positions < low) | (positions > high)
    if outside.any():
        point, joint = np.argwhere(outside)[0]
        raise TrajectoryError(
            f"joint '{robot.joint_names[joint]}' is {positions[point, joint]:.4f} at point "
            f'{point}, its limits are {robot.lower[joint]:.4f} .. {robot.upper[joint]:.4f} '
            f"(from the description of robot '{robot.name}')"
        )
