"""Grips that measured fingers show: what stops them short of shut is held, and goes along.

Recordings whose commands are measured positions say when a gripper holds something: its fingers
stop on the way. Contact computed from masks and cameras that are off by a centimetre drops such an
object; here it keeps its pose in the tool until the fingers open.

Shape letters: S rows, A arms, O solids.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.robot.model import RobotModel


@dataclass(frozen=True, slots=True, kw_only=True)
class GripSettings:
    """Definition of a grip.

    Attributes:
        max_opening: largest opening of a gripper that holds something [fraction of its range].
        min_opening: smallest opening of one that is not shut on nothing [fraction of its range].
        max_step: largest change of the opening between two rows of fingers that have stopped
            [fraction of the range].
        opens_by: increase of the opening at which a gripper lets go [fraction of its range].
        reach_m: largest distance of the tool point from the outline of what it holds: the error of
            the cameras [m].
        max_width_ratio: largest narrow side of what fits between the fingers [widest opening].
    """

    max_opening: float = 0.8
    min_opening: float = 0.03
    max_step: float = 0.03
    opens_by: float = 0.06
    reach_m: float = 0.025
    max_width_ratio: float = 1.1


_SETTINGS = GripSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class Grip:
    """A solid that a gripper holds.

    Attributes:
        arm: index of the tool.
        T_tool_solid: (4, 4) pose of the solid in the tool [m].
        opening: opening at which the fingers stopped [fraction of the range].
    """

    arm: int
    T_tool_solid: FloatArray
    opening: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GripCourse:
    """Tools and fingers of a plan, at its rows.

    Attributes:
        tools: (A, S, 4, 4) T_base_tool [m].
        openings: (A, S) openings of the grippers, 0 closed to 1 open.
        stopped: (A, S) whether fingers stand still on something.
        widths: (A,) widest distance of the fingers [m].
        settings: definition of a grip.
    """

    tools: FloatArray
    openings: FloatArray
    stopped: BoolArray
    widths: FloatArray
    settings: GripSettings = _SETTINGS

    @classmethod
    def of(
        cls, robot: RobotModel, positions: FloatArray, settings: GripSettings = _SETTINGS
    ) -> GripCourse:
        """Return the course of measured joint positions (S, J) [rad or m]."""
        openings = np.asarray(robot.gripper_openings(positions))
        steps = np.abs(np.diff(openings, axis=1, append=openings[:, -1:]))
        before = np.abs(np.diff(openings, axis=1, prepend=openings[:, :1]))
        between = (openings > settings.min_opening) & (openings < settings.max_opening)
        still = (steps < settings.max_step) & (before < settings.max_step)
        return cls(
            tools=robot.tool_poses(positions),
            openings=openings,
            stopped=between & still,
            widths=2 * robot.finger_gaps(_wide_open(robot))[0],
            settings=settings,
        )

    def after(
        self,
        row: int,
        grips: dict[int, Grip],
        poses: FloatArray,
        solids: Sequence[Solid],
    ) -> tuple[dict[int, Grip], FloatArray]:
        """Return the grips at a row, and where the solids are then.

        Args:
            row: number of the row.
            grips: grip at the row before, by number of the solid.
            poses: (O, 4, 4) T_base_solid where nothing but contact holds the solids [m].
            solids: the O solids as found.
        """
        kept = {item: grip for item, grip in grips.items() if not self._lets_go(grip, row)}
        poses = poses.copy()
        for item, grip in kept.items():
            poses[item] = self.tools[grip.arm, row] @ grip.T_tool_solid
        busy = {grip.arm for grip in kept.values()}
        for arm in map(int, np.flatnonzero(self.stopped[:, row])):
            item = None if arm in busy else self._nearest(arm, row, poses, solids, kept)
            if item is not None:
                inside = np.linalg.inv(self.tools[arm, row]) @ poses[item]
                kept[item] = Grip(
                    arm=arm, T_tool_solid=inside, opening=float(self.openings[arm, row])
                )
        return kept, poses

    def _lets_go(self, grip: Grip, row: int) -> bool:
        return bool(self.openings[grip.arm, row] > grip.opening + self.settings.opens_by)

    def _nearest(
        self,
        arm: int,
        row: int,
        poses: FloatArray,
        solids: Sequence[Solid],
        kept: dict[int, Grip],
    ) -> int | None:
        """Number of the solid between the fingers; None = no solid is there."""
        settings, tool = self.settings, self.tools[arm, row]
        near: list[tuple[float, int]] = []
        for item, solid in enumerate(solids):
            if item in kept or min(solid.size[:2]) > settings.max_width_ratio * self.widths[arm]:
                continue
            local = np.linalg.inv(poses[item]) @ tool[:, 3]
            outside = np.maximum(np.abs(local[:3]) - np.asarray(solid.size) / 2, 0.0)
            distance = float(np.linalg.norm(outside))
            if distance < settings.reach_m:
                near.append((float(np.linalg.norm(local[:3])), item))
        return min(near)[1] if near else None


def _wide_open(robot: RobotModel) -> FloatArray:
    """Return joint positions (1, J) with all grippers wide open."""
    positions = np.zeros((1, len(robot.joint_names)))
    for tool in robot.tools:
        if tool.gripper_joint is not None:
            positions[0, robot.joint_names.index(tool.gripper_joint)] = tool.gripper_open
    return positions
