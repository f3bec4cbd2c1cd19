"""Inertia of a robot, and how its fingertips move with its joints, from its description.

Shape letters: J joints, P points.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.robot.model import RobotModel


class RobotMechanics:
    """Inertia and fingertip kinematics of a robot, at one configuration a call.

    Args:
        robot: the robot.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._model = robot.pinocchio_model
        self._data = self._model.createData()
        self._follows = robot.joint_motions
        self._tools = [
            (self._model.getFrameId(tool.link, pin.BODY), pin.SE3(np.asarray(tool.T_link_tool)))
            for tool in robot.tools
        ]
        self._base = self._model.getFrameId(robot.base_link, pin.BODY)

    def inertia(
        self, positions: FloatArray, velocities: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the mass matrix (J, J), and the forces (J,) of joints (J,) without gravity.

        Both are zero where the description has no inertias.
        """
        model, data, follows = self._model, self._data, self._follows
        q = self._robot.configurations(positions[None])[0]
        mass = follows.T @ pin.crba(model, data, q) @ follows
        still = pin.computeGeneralizedGravity(model, data, q)
        moving = pin.nonLinearEffects(model, data, q, follows @ velocities)
        return mass, follows.T @ (moving - still)

    def fingertips(self, positions: FloatArray) -> FloatArray:
        """Return the tips of all fingers (P, 3) in the base frame [m].

        Two tips a tool; their distance is the gripper's opening.
        """
        model, data = self._model, self._data
        q = self._robot.configurations(positions[None])[0]
        pin.forwardKinematics(model, data, q)
        base = pin.updateFramePlacement(model, data, self._base).inverse()
        gaps = self._robot.finger_gaps(positions[None])[0]
        points = []
        for (frame, offset), gap in zip(self._tools, gaps, strict=True):
            tool = base * pin.updateFramePlacement(model, data, frame) * offset
            middle, way = tool.translation, gap * tool.rotation[:, 1]
            points += [middle + way, middle - way]
        return np.array(points)

    def fingertip_jacobians(self, positions: FloatArray, points: FloatArray) -> FloatArray:
        """Return the Jacobians (P, 3, J) of `fingertips` at joint positions (J,).

        The motion of the fingers relative to their tool is left out.
        """
        model, data = self._model, self._data
        q = self._robot.configurations(positions[None])[0]
        pin.computeJointJacobians(model, data, q)
        base = pin.updateFramePlacement(model, data, self._base)
        jacobians = []
        for number, (frame, _) in enumerate(self._tools):
            link = pin.updateFramePlacement(model, data, frame)
            for tip in points[2 * number : 2 * number + 2]:
                place = base.act(tip)
                # a base link that joints move takes the point along
                moves = self._carried(frame, place - link.translation) - self._carried(
                    self._base, place - base.translation
                )
                jacobians.append(base.rotation.T @ moves)
        return np.array(jacobians)

    def _carried(self, frame: int, arm: FloatArray) -> FloatArray:
        """(3, J) how a point that is `arm` (3,) away from a frame moves with it, in the world."""
        jacobian = pin.getFrameJacobian(
            self._model, self._data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        return (jacobian[:3] - pin.skew(arm) @ jacobian[3:]) @ self._follows
