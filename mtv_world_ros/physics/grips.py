"""Grips that measured fingers show: what stops them short of shut is held, and goes along.

Recordings whose commands are measured positions say when a gripper holds something: its fingers
close, stop on the way and stay there. Contact computed from masks and cameras that are off by a
centimetre drops such an object; here it keeps its pose in the tool until the fingers open.
Fingers that rest half open hold nothing, unless they closed before or a command to close is not
followed.

Shape letters: S rows, A arms, O solids.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
        closes_by: decrease of the opening since the fingers last opened at which they have
            closed; also the distance from a command to close at which it is not followed
            [fraction of the range].
        rest_change: largest change of the opening of fingers that rest [fraction of the range].
        min_rest_s: time for which fingers rest that something stopped; a gripper that turns
            around on its way stands still for a moment [s].
        opens_by: increase of the opening at which a gripper lets go [fraction of its range].
        reach_m: largest distance of the tool point from the outline of what it holds: the error of
            the cameras [m].
        max_width_ratio: largest narrow side of what fits between the fingers [widest opening].
        max_gap_m: largest distance of the fingers from each other beyond the longest side of what
            they hold: the error of its size [m].
        beside_m: distance of the tool point from every solid beyond which stopped fingers
            contradict a future: something is between them, and no solid is [m].
        max_overlap_m: largest overlap of a held solid with the one below that comes from the error
            of the cameras: it is put upon it; a larger one pushes [m].
        contradiction: factor by which such a stop makes a future less likely; fingers may also
            stop at something that has no name.
    """

    max_opening: float = 0.8
    min_opening: float = 0.03
    closes_by: float = 0.05
    rest_change: float = 0.015
    min_rest_s: float = 0.5
    opens_by: float = 0.06
    reach_m: float = 0.025
    max_width_ratio: float = 1.1
    max_gap_m: float = 0.015
    beside_m: float = 0.04
    max_overlap_m: float = 0.015
    contradiction: float = 0.1


_SETTINGS = GripSettings()
#: tolerance of sums of row periods [s]
_TIME_TOLERANCE_S = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class FingerState:
    """Motion of the fingers of A grippers until now, as measured.

    Attributes:
        widest: (A,) largest opening since the fingers last opened [fraction of the range].
        narrowest: (A,) smallest opening since then [fraction of the range].
        rest: (A,) opening that the fingers have stayed near [fraction of the range].
        rest_s: (A,) time for which they have stayed near that opening [s].
        is_refused: (A,) whether they rest although they are commanded to close further.
        is_refuted: (A,) whether masks have shown since they stopped that they hold nothing.
    """

    widest: FloatArray
    narrowest: FloatArray
    rest: FloatArray
    rest_s: FloatArray
    is_refused: BoolArray
    is_refuted: BoolArray

    @classmethod
    def at(cls, openings: FloatArray) -> FingerState:
        """Return the finger state from openings (A,) alone."""
        return cls(
            widest=openings,
            narrowest=openings,
            rest=openings,
            rest_s=np.zeros(len(openings)),
            is_refused=np.zeros(len(openings), np.bool_),
            is_refuted=np.zeros(len(openings), np.bool_),
        )

    def after(
        self,
        openings: FloatArray,
        passed_s: float,
        commanded: FloatArray | None = None,
        settings: GripSettings = _SETTINGS,
    ) -> FingerState:
        """Return the state at the next openings.

        Args:
            openings: (A,) measured [fraction of the range].
            passed_s: time since the state [s].
            commanded: (A,) commanded openings [fraction of the range]; None = not known.
            settings: definition of a grip.
        """
        has_opened = openings > self.narrowest + settings.opens_by
        is_widest = has_opened | (openings > self.widest)
        is_moving = np.abs(openings - self.rest) > settings.rest_change
        rest_s = np.where(is_moving, 0.0, self.rest_s + passed_s)
        is_refused = self.is_refused & ~is_moving
        if commanded is not None:
            is_refused |= (openings - commanded >= settings.closes_by) & _rests(rest_s, settings)
        return FingerState(
            widest=np.where(is_widest, openings, self.widest),
            narrowest=np.where(is_widest, openings, np.minimum(self.narrowest, openings)),
            rest=np.where(is_moving, openings, self.rest),
            rest_s=rest_s,
            is_refused=is_refused,
            is_refuted=self.is_refuted & ~has_opened,
        )

    def are_stopped(self, settings: GripSettings = _SETTINGS) -> BoolArray:
        """Return (A,) True where an object keeps the fingers from closing, and may be held."""
        is_between = (self.rest > settings.min_opening) & (self.rest < settings.max_opening)
        has_closed = self.widest - self.rest >= settings.closes_by
        is_stopped = is_between & (has_closed | self.is_refused) & _rests(self.rest_s, settings)
        return is_stopped & ~self.is_refuted


def _rests(rest_s: FloatArray, settings: GripSettings) -> BoolArray:
    return rest_s >= settings.min_rest_s - _TIME_TOLERANCE_S


def watch_fingers(
    openings: FloatArray,
    period_s: float,
    fingers: FingerState | None = None,
    commanded: FloatArray | None = None,
    settings: GripSettings = _SETTINGS,
) -> tuple[BoolArray, FingerState]:
    """Return (A, S) True where an object blocks the fingers, and the end state.

    The fingers are blocked if they have closed, or do not follow a command to close further,
    and rest for long enough; the rows of a rest count from its first one on.

    Args:
        openings: (A, S) measured openings, 0 closed to 1 open.
        period_s: time between two rows [s].
        fingers: state at row 0; None = what was before is not known.
        commanded: (A, S) commanded openings; None = not known.
        settings: definition of a grip.
    """
    state = FingerState.at(openings[:, 0]) if fingers is None else fingers
    stopped = np.zeros(openings.shape, np.bool_)
    since = np.zeros(len(openings), np.int64)
    for row, now in enumerate(openings.T):
        told = None if commanded is None else commanded[:, row]
        state = state.after(now, period_s if row else 0.0, told, settings)
        since[state.rest_s == 0.0] = row
        for arm in np.flatnonzero(state.are_stopped(settings)):
            stopped[arm, since[arm] : row + 1] = True
    return stopped, state


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
    """Motion of tools and fingers at the rows of a plan.

    Attributes:
        tools: (A, S, 4, 4) T_base_tool [m].
        openings: (A, S) openings of the grippers, 0 closed to 1 open.
        stopped: (A, S) whether an object keeps the fingers from closing.
        widths: (A,) widest distance of the fingers [m].
        fingers: state of the fingers at the last row.
        settings: definition of a grip.
    """

    tools: FloatArray
    openings: FloatArray
    stopped: BoolArray
    widths: FloatArray
    fingers: FingerState
    settings: GripSettings = _SETTINGS

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        positions: FloatArray,
        period_s: float,
        fingers: FingerState | None = None,
        settings: GripSettings = _SETTINGS,
    ) -> GripCourse:
        """Return the tool and finger motion of measured joint positions.

        Args:
            robot: robot with the grippers.
            positions: (S, J) [rad or m].
            period_s: time between two rows [s].
            fingers: state of the fingers at row 0; None = what was before is not known.
            settings: definition of a grip.
        """
        openings = np.asarray(robot.gripper_openings(positions))
        stopped, fingers = watch_fingers(openings, period_s, fingers, settings=settings)
        return cls(
            tools=robot.tool_poses(positions),
            openings=openings,
            stopped=stopped,
            widths=2 * robot.finger_gaps(_wide_open(robot))[0],
            fingers=fingers,
            settings=settings,
        )

    def after(
        self,
        row: int,
        grips: dict[int, Grip],
        poses: FloatArray,
        solids: Sequence[Solid],
        holds: Callable[[int], bool] = lambda arm: True,
    ) -> tuple[dict[int, Grip], FloatArray]:
        """Return the grips at a row, and the poses of the solids.

        Args:
            row: number of the row.
            grips: grip at the row before, by number of the solid.
            poses: (O, 4, 4) T_base_solid where nothing but contact holds the solids [m].
            solids: the O solids as found.
            holds: whether the stopped fingers of an arm hold what is between them.
        """
        kept = {item: grip for item, grip in grips.items() if not self._lets_go(grip, row)}
        poses = poses.copy()
        for item, grip in kept.items():
            poses[item] = self.tools[grip.arm, row] @ grip.T_tool_solid
        for item in kept:
            poses[item, 2, 3] += _overlap(item, poses, solids, self.settings.max_overlap_m)
        busy = {grip.arm for grip in kept.values()}
        for arm in map(int, np.flatnonzero(self.stopped[:, row])):
            if arm in busy or not holds(arm):
                continue
            item = self._nearest(arm, row, poses, solids, kept)
            if item is not None:
                inside = np.linalg.inv(self.tools[arm, row]) @ poses[item]
                kept[item] = Grip(
                    arm=arm, T_tool_solid=inside, opening=float(self.openings[arm, row])
                )
        return kept, poses

    def begins(self, arm: int, row: int, was_stopped: BoolArray) -> bool:
        """Return whether something begins to stop the fingers of an arm at a row.

        Args:
            arm: number of the arm.
            row: number of the row.
            was_stopped: (A,) whether something stopped the fingers before row 0.
        """
        before = self.stopped[arm, row - 1] if row else was_stopped[arm]
        return bool(self.stopped[arm, row] and not before)

    def is_beside(self, arm: int, row: int, poses: FloatArray, solids: Sequence[Solid]) -> bool:
        """Return whether no solid is where the fingers of an arm are at a row.

        Args:
            arm: number of the arm.
            row: number of the row.
            poses: (O, 4, 4) T_base_solid [m].
            solids: the O solids as found.
        """
        tool = self.tools[arm, row]
        away = [_outside(solid, pose, tool)[0] for solid, pose in zip(solids, poses, strict=True)]
        return min(away, default=np.inf) > self.settings.beside_m

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
        gap = self.openings[arm, row] * self.widths[arm]
        near: list[tuple[bool, float, int]] = []
        for item, solid in enumerate(solids):
            is_too_wide = min(solid.size[:2]) > settings.max_width_ratio * self.widths[arm]
            if item in kept or is_too_wide or gap > max(solid.size) + settings.max_gap_m:
                continue
            outside_m, from_centre_m = _outside(solid, poses[item], tool)
            if outside_m < settings.reach_m + solid.error_m:
                # at the start frames may have shown what goes along with the hand
                near.append((row > 0 or not solid.is_held, from_centre_m, item))
        return min(near)[2] if near else None


def _outside(solid: Solid, pose: FloatArray, tool: FloatArray) -> tuple[float, float]:
    """Return how far a tool point is from the outline of a solid, and from its centre [m]."""
    local = np.linalg.inv(pose) @ tool[:, 3]
    outside = np.maximum(np.abs(local[:3]) - np.asarray(solid.size) / 2, 0.0)
    return float(np.linalg.norm(outside)), float(np.linalg.norm(local[:3]))


def _overlap(item: int, poses: FloatArray, solids: Sequence[Solid], most: float) -> float:
    """Return how far a solid reaches into the one that its centre is above [m]; 0 = none.

    Args:
        item: number of the solid.
        poses: (O, 4, 4) T_base_solid [m].
        solids: the O solids as found.
        most: largest overlap that counts [m].
    """
    halves = np.stack([np.asarray(solid.size) / 2 for solid in solids])
    heights = (np.abs(poses[:, 2, :3]) * halves).sum(-1)
    found = 0.0
    for other, solid in enumerate(solids):
        if other == item or solid.is_open:
            continue
        local = np.linalg.inv(poses[other]) @ poses[item, :, 3]
        into = poses[other, 2, 3] + heights[other] - (poses[item, 2, 3] - heights[item])
        if (np.abs(local[:2]) < halves[other, :2]).all() and into <= most:
            found = max(found, float(into))
    return found


def _wide_open(robot: RobotModel) -> FloatArray:
    """Return joint positions (1, J) with all grippers wide open."""
    positions = np.zeros((1, len(robot.joint_names)))
    for tool in robot.tools:
        if tool.gripper_joint is not None:
            positions[0, robot.joint_names.index(tool.gripper_joint)] = tool.gripper_open
    return positions
