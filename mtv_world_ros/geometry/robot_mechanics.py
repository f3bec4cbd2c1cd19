"""Inertia of a robot, and how its fingertips move with its joints, from its description.

Shape letters: J joints, P points.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.geometry.robot import RobotModel


class RobotMechanics:
    """Evaluates one configuration after the other.

    Args:
        robot: of which.
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
        self._travels = np.array([tool.finger_travel_m or 0.0 for tool in robot.tools])

    def inertia(
        self, positions: FloatArray, velocities: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the mass matrix (J, J), and the forces (J,) of joints (J,) without gravity.

        Both are zero where the description has no inertias.
        """
        model, data, follows = self._model, self._data, self._follows
        q = self._robot.configurations(positions[None])[0]
        mass = follows.T @ pin.crba(model, data, q) @ follows
        still = pin.computeGeneralizedGravity(model, data, q)
        moving = pin.nonLinearEffects(model, data, q, follows @ velocities)
        return mass, follows.T @ (moving - still)

    def fingertips(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the tips of all fingers (P, 3) in the base frame, and their Jacobians (P, 3, J).

        Two of each tool, as far apart as the gripper is open; that it opens is not in them.
        """
        model, data = self._model, self._data
        q = self._robot.configurations(positions[None])[0]
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        base = data.oMf[self._base]
        gaps = self._robot.gripper_openings(positions[None])[:, 0] * self._travels
        points, jacobians = [], []
        for (frame, offset), gap in zip(self._tools, gaps, strict=True):
            link = data.oMf[frame]
            jacobian = pin.getFrameJacobian(
                model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            )
            tool = link * offset
            for side in (gap, -gap):
                tip = tool.translation + side * tool.rotation[:, 1]
                arm = pin.skew(tip - link.translation)
                moves = (jacobian[:3] - arm @ jacobian[3:]) @ self._follows
                points.append(base.actInv(tip))
                jacobians.append(base.rotation.T @ moves)
        return np.array(points), np.array(jacobians)
