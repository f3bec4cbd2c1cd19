"""Rigid bodies of DART as a world that is commanded period by period."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mtv_world_ros.bench.dart.contact_motions import course_of, run_period, STEP_S
from mtv_world_ros.bench.dart.rigid_bodies import RigidBodies
from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.foresight.arm_response import ArmResponse, ArmState
from mtv_world_ros.foresight.contact_settings import ContactSettings
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.geometry.solids import Solid


class SteppedWorld:
    """A table, a robot and O solids; J joints.

    Args:
        robot: from a URDF with inertias.
        response: how its joints follow; all have a compliance.
        settings: of contact.
        solids: O, on the table.
        masses: (O,) [kg].
        home: (J,) where the joints rest at first [rad or m].

    Raises:
        RobotError: the robot cannot be a tree of rigid bodies.
    """

    def __init__(
        self,
        robot: RobotModel,
        response: ArmResponse,
        settings: ContactSettings,
        solids: Sequence[Solid],
        masses: Sequence[float],
        home: FloatArray,
    ) -> None:
        self._robot, self._response = robot, response
        self._bodies = RigidBodies(robot, response, solids, settings, STEP_S, home, masses)
        self._free = ArmState(positions=home, velocities=np.zeros(len(home)), commands=home)
        self._swings: FloatArray | None = None
        self._still = 0

    @property
    def joints(self) -> FloatArray:
        """(J,) where the joints are [rad or m]."""
        return self._bodies.arms.joints

    @property
    def poses(self) -> FloatArray:
        """T_base_solid (O, 4, 4) [m]."""
        return self._bodies.poses()

    def advance(self, command: FloatArray) -> None:
        """Goes on by one period of commands, towards joints (J,).

        Raises:
            SimulatorError: the engine has lost something.
            TrajectoryError: the arms run away from the commands.
        """
        arms, before = self._bodies.arms, self._free
        rows = np.stack([before.commands, command])
        where, self._free = self._response.follow(self._robot, rows, before)
        # of the degrees of freedom, which offsets do not change
        speeds = arms.ways(np.stack([before.velocities, self._free.velocities]))
        speeds -= arms.ways(np.zeros((1, len(command))))
        course, _, self._swings = course_of(arms, where, speeds[0], self._swings, speeds[1])
        self._still = run_period(self._bodies, course, 0, self._still)
        if self._bodies.is_lost:
            raise SimulatorError('the engine dart has lost an object (--physics dart)')
