"""Inverse kinematics of an arm on the robot's Pinocchio model, by damped least squares."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import TrajectoryError
from mtv_world_ros.robot.model import RobotModel, Tool

#: of damped least squares: added to the diagonal of J^T J
_DAMPING = 1e-5
#: accepted position error of inverse kinematics [m]
POSITION_TOLERANCE_M = 3e-4
#: accepted orientation error of inverse kinematics [rad]
ROTATION_TOLERANCE_RAD = 2e-3
#: steps before a pose counts as out of reach
_NUM_ITERATIONS = 60
#: distance kept from the joint limits [rad]
_LIMIT_MARGIN = 0.005


class ArmSolver:
    """Solves the joints of one arm for tool poses, starting from the previous solution.

    Damped least squares, iterated until the tool is there. An arm of more than six joints has
    many solutions: of those around the start it takes the one nearest to `rest`.

    Args:
        robot: the robot.
        tool: the tool that is brought to a pose.
        rest: joint positions at rest [rad or m]; None = those where a search starts.
    """

    def __init__(self, robot: RobotModel, tool: Tool, rest: FloatArray | None = None) -> None:
        self._model = robot.pinocchio_model
        self._data = self._model.createData()
        self._frame = self._model.getFrameId(tool.link, pin.FrameType.BODY)
        self._tool = pin.SE3(np.asarray(tool.T_link_tool, dtype=float))
        chain = self._model.supports[self._model.frames[self._frame].parentJoint]
        carrying = {self._model.names[joint] for joint in chain}
        self.indices = [index for index, name in enumerate(robot.joint_names) if name in carrying]
        self._rest = rest
        joints = [
            self._model.joints[self._model.getJointId(robot.joint_names[i])] for i in self.indices
        ]
        self._q_at = [(joint.idx_q, joint.nq) for joint in joints]
        self._v_at = np.array([joint.idx_v for joint in joints])
        self._lower = np.asarray(robot.lower)[self.indices] + _LIMIT_MARGIN
        self._upper = np.asarray(robot.upper)[self.indices] - _LIMIT_MARGIN
        self._neutral = pin.neutral(self._model)
        pin.forwardKinematics(self._model, self._data, self._neutral)
        base = self._model.getFrameId(robot.base_link, pin.FrameType.BODY)
        self._base = pin.updateFramePlacement(self._model, self._data, base)

    def solve(self, pose: FloatArray, start: FloatArray) -> FloatArray:
        """Return the arm's joints (n,) [rad] that bring the tool to `pose` (4, 4).

        Args:
            pose: pose of the tool in the robot's base link.
            start: (n,) joints to start from [rad].

        Raises:
            TrajectoryError: the pose is out of reach from `start`.
        """
        goal = self._base * pin.SE3(np.asarray(pose))
        joints = np.clip(start, self._lower, self._upper)
        rest, slack = (joints if self._rest is None else self._rest), np.zeros(len(joints))
        for _ in range(_NUM_ITERATIONS):
            q = self._configuration(joints)
            pin.computeJointJacobians(self._model, self._data, q)
            pin.updateFramePlacement(self._model, self._data, self._frame)
            placement = self._data.oMf[self._frame] * self._tool
            error = pin.log6(placement.actInv(goal)).vector
            there = (
                np.linalg.norm(error[:3]) < POSITION_TOLERANCE_M
                and np.linalg.norm(error[3:]) < ROTATION_TOLERANCE_RAD
            )
            if there and len(joints) <= 6:
                return joints
            jacobian = (
                self._tool.actionInverse
                @ pin.getFrameJacobian(
                    self._model, self._data, self._frame, pin.ReferenceFrame.LOCAL
                )[:, self._v_at]
            )
            if len(joints) > 6:
                slack = _slack(jacobian, rest - joints)
                if there and np.abs(slack).max() < ROTATION_TOLERANCE_RAD:
                    return joints
            normal = jacobian.T @ jacobian + _DAMPING * np.eye(len(joints))
            step = np.linalg.solve(normal, jacobian.T @ error) + slack
            joints = np.clip(joints + np.clip(step, -0.5, 0.5), self._lower, self._upper)
        x, y, z = pose[:3, 3]
        raise TrajectoryError(f'tool pose at ({x:.3f}, {y:.3f}, {z:.3f}) m is out of reach')

    def _configuration(self, joints: FloatArray) -> FloatArray:
        """Return Pinocchio's configuration (nq,); endless joints are given by cosine and sine."""
        q = self._neutral.copy()
        for (at, count), value in zip(self._q_at, joints, strict=True):
            q[at : at + count] = value if count == 1 else (np.cos(value), np.sin(value))
        return q


def _slack(jacobian: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the part of a joint motion (n,) that leaves the tool where it is."""
    square = jacobian @ jacobian.T + _DAMPING * np.eye(6)
    return wanted - jacobian.T @ np.linalg.solve(square, jacobian @ wanted)
