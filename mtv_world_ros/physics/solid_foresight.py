"""Objects as solids on MuJoCo: found in masks, foreseen in several futures.

Shape letters: V views, O objects, S solids, K futures, T steps, J joints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import copy
from dataclasses import dataclass, field, replace

import numpy as np

from mtv_world_ros.cameras.mask_geometry import centroids, locate_all
from mtv_world_ros.core.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.physics.arms.arm_response import ArmResponse, PERIOD_S
from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.engine.engine import Batch, BatchState, Engine
from mtv_world_ros.physics.engine.futures import draw_futures, Future, STANDS_M
from mtv_world_ros.physics.grips import FingerState
from mtv_world_ros.physics.object_motion import ObjectMotion
from mtv_world_ros.physics.sights import KeptPose
from mtv_world_ros.physics.solids import bottom_of, find_solid, fit_solid, is_box, is_vessel, Solid
from mtv_world_ros.robot.model import RobotModel

#: positions that are commanded in a step of a motion, and its length [s]
COMMANDS_A_STEP = 5
STEP_S = COMMANDS_A_STEP * PERIOD_S
#: futures that must be left for a verdict, as a share
_ENOUGH = 0.5
#: solids that reach into each other by more were not found well [m]
_OVERLAP_M = 0.01
#: largest height difference of the bottoms of solids that stand on one table [m]
LEVEL_TOLERANCE_M = 0.004
#: largest distance from the fitted table height at which that height is kept [m]
SAME_TABLE_M = 0.003
#: largest distance from the fitted table height that is corrected; beyond it is an error [m]
MAX_TABLE_CORRECTION_M = 0.03
#: depth below the middle of objects at which the search for an unknown table begins [m]
TABLE_SEARCH_DEPTH_M = 0.02
#: number of fits of that search
NUM_TABLE_FITS = 3
#: largest distance of a table from the robot's base [m]
_TABLE_REACH_M = 2.0


class SolidForesight:
    """Finds objects in a frame, and simulates their motion under plans in K futures.

    Args:
        robot: robot with a fixed base.
        response: response of the arms to their commands; None = not known yet.
        settings: settings of contact.
        threads: number of computing threads.

    Raises:
        RobotError: contact of the robot cannot be computed, see `Arms`.
    """

    def __init__(
        self,
        robot: RobotModel,
        response: ArmResponse | None,
        settings: ContactSettings,
        threads: int = 1,
    ) -> None:
        self.robot, self.response, self.settings = robot, response, settings
        #: contact parameters were fitted in the robot cell, or confirmed there; else futures draw
        #: them from the prior
        self.is_fitted = True
        #: settings before the prior took their place
        self._as_fitted = settings
        self._threads = threads
        self.engine = Engine(Arms(robot, response), threads)
        self.engine.scene_of(())

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions about the robot, in words."""
        return self.engine.arms.notes

    def with_robot(self, robot: RobotModel) -> SolidForesight:
        """Return the foresight for a robot with the same joints and tools."""
        other = SolidForesight(robot, self.response, self.settings, self._threads)
        other.is_fitted, other._as_fitted = self.is_fitted, self._as_fitted
        return other

    def at_place(self, place: str) -> SolidForesight:
        """Return the foresight for a robot cell: with the wide prior if it was fitted elsewhere.

        Args:
            place: name of the robot cell; empty = not stated.
        """
        if not self.is_fitted or self.settings.is_fitted_at(place):
            return self
        other = copy.copy(self)
        other.settings, other.is_fitted = self.settings.as_prior(), False
        return other

    def as_fitted(self) -> SolidForesight:
        """Return the foresight with the fitted parameters in place of the prior around them."""
        if self.is_fitted:
            return self
        other = copy.copy(self)
        other.settings, other.is_fitted = self._as_fitted, True
        return other

    def find(
        self,
        names: Sequence[str],
        masks: BoolArray,
        cameras: Sequence[CameraModel],
        poses: Sequence[FloatArray],
    ) -> TrackedSolids:
        """Find the objects of masks (V, O, H, W), preferably at the camera's resolution.

        Args:
            names: names of the O objects; the name of a vessel makes it hollow.
            masks: masks of one frame.
            cameras: V cameras at the masks' size.
            poses: T_base_camera (4, 4) of each view.
        """
        given, unknown = (names, masks, cameras, poses), [None] * len(names)
        if self.settings.table_varies:
            height = table_in(*given)
            here = self._on_table(height if np.isfinite(height) else self.settings.table_m)
            return here._found(*given, unknown)
        found, told = self._found(*given, unknown), self.settings.table_m
        table = _table_under(found.solids)
        if not SAME_TABLE_M < abs(table - told) < MAX_TABLE_CORRECTION_M:
            return found
        # solids are drawn to the table that they are fitted on
        found = self._on_table(table)._found(*given, unknown)
        again = _table_under(found.solids)
        table = again if np.isfinite(again) else table
        word = 'higher' if table > told else 'lower'
        note = (
            f'the table seems {1e3 * abs(table - told):.0f} mm {word} than contact.json has it; '
            'corrected for this episode (mtv-world fit contact finds it)'
        )
        return replace(found, foresight=self._on_table(table), note=note)

    def _on_table(self, height: float) -> SolidForesight:
        """Return this foresight for a table of another height [m]."""
        other = copy.copy(self)
        other.settings = self.settings.model_copy(update={'table_m': height})
        return other

    def find_again(
        self,
        whole: TrackedSolids,
        names: Sequence[str],
        masks: BoolArray,
        cameras: Sequence[CameraModel],
        poses: Sequence[FloatArray],
        kept: Sequence[KeptPose | None] = (),
        held: Sequence[bool] = (),
    ) -> tuple[TrackedSolids, BoolArray, BoolArray]:
        """Find objects that may be partly hidden; see `ObjectMotionModel.find_again`."""
        points = locate_all(cameras, poses, centroids(masks))
        floor = whole.foresight.settings.table_m
        solids: list[Solid | None] = [None] * len(whole.solids)
        is_kept = np.zeros(len(solids), np.bool_)
        for item, solid in enumerate(whole.solids):
            if solid is None:
                continue
            one = kept[item] if kept else None
            before = one and _solid_then(one, solid, floor)
            if before is not None:
                solids[item], is_kept[item] = before, True
            else:
                given = masks[:, item], points[item], cameras, poses, floor
                solids[item] = find_solid(solid, *given)
        for item in map(int, np.flatnonzero(held)):
            solid = solids[item]
            solids[item] = solid and replace(solid, is_held=True)
        anew = whole.foresight._found(names, masks, cameras, poses, solids)
        same = np.array([solid is not None for solid in solids], np.bool_)
        hidden = np.array([solid is not None and solid.is_hidden for solid in solids], np.bool_)
        turned = np.tile(np.eye(3), (len(names), 1, 1))
        reference = anew.centres
        for item in map(int, np.flatnonzero(hidden)):
            was, now = whole.solids[item], solids[item]
            assert was is not None and now is not None
            turned[item], reference[item] = was.turn_to(now), was.centre
        # one view alone tells how far away it is by its size, which is not to be relied on
        by_two = np.asarray(masks.any((-2, -1)).sum(0) > 1) | is_kept
        anew = replace(anew, reference=reference, turned=turned, note=whole.note)
        return anew, same & by_two, hidden

    def _found(
        self,
        names: Sequence[str],
        masks: BoolArray,
        cameras: Sequence[CameraModel],
        poses: Sequence[FloatArray],
        known: Sequence[Solid | None],
    ) -> TrackedSolids:
        """Return the objects; those that are not known are fitted to their masks."""
        points, floor = locate_all(cameras, poses, centroids(masks)), self.settings.table_m
        solids = tuple(
            solid
            or fit_solid(
                masks[:, item],
                points[item],
                cameras,
                poses,
                floor,
                is_vessel(names[item]),
                is_box(names[item]),
            )
            for item, solid in enumerate(known)
        )
        return TrackedSolids(
            foresight=self,
            names=tuple(names),
            solids=solids,
            doubts=_doubts(names, masks, solids, floor),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedSolids:
    """State of the objects between two chunks.

    Attributes:
        foresight: motion model of the objects.
        names: names of the O objects.
        solids: the O solids as fitted; None = not seen by two views.
        doubts: index of an object -> reason why its motion is not simulated.
        note: corrections that were made, as text; empty = none.
        reference: (O, 3) origin of the motions [m]; None = where the objects were found.
        turned: (O, 3, 3) rotation from the origin to where the objects were found.
        batch: simulation of the futures; None = nothing has moved yet.
        state: present state of the futures.
        seen_fingers: measured motion of the fingers before the futures; None = not known.
    """

    foresight: SolidForesight
    names: tuple[str, ...]
    solids: tuple[Solid | None, ...]
    doubts: Mapping[int, str] = field(default_factory=dict)
    note: str = ''
    reference: FloatArray | None = None
    turned: FloatArray | None = None
    batch: Batch | None = None
    state: BatchState | None = None
    seen_fingers: FingerState | None = None

    @property
    def fingers(self) -> FingerState | None:
        """Motion of the fingers until now; None = not known."""
        return self.seen_fingers if self.state is None else self.state.fingers

    def with_fingers(self, fingers: FingerState | None) -> TrackedSolids:
        """Return the objects with the motion of the fingers before the first plan."""
        return replace(self, seen_fingers=fingers)

    @property
    def step_s(self) -> float:
        """Time between the rows of a motion [s]."""
        return STEP_S

    @property
    def commands_a_step(self) -> int:
        """Number of joint positions that `advance` takes per step."""
        return COMMANDS_A_STEP

    @property
    def is_fitted(self) -> bool:
        """Return True if contact parameters were fitted in this robot cell."""
        return self.foresight.is_fitted

    @property
    def centres(self) -> FloatArray:
        """Positions (O, 3) at which the solids were found [m]; NaN = not seen by two views."""
        unknown = np.full(3, np.nan)
        centres = [unknown if one is None else one.centre for one in self.solids]
        return np.array(centres).reshape(-1, 3)

    @property
    def sizes(self) -> FloatArray:
        """(K, O, 3) extents in each of the futures [m], NaN = not known."""
        sizes = np.full((self.foresight.settings.num_motions, len(self.solids), 3), np.nan)
        for number, future in enumerate(self.futures()):
            found = [solid.size for solid in future.solids]
            sizes[number, self._known] = np.reshape(found, (len(found), 3))  # also of none
        return sizes

    @property
    def refusal(self) -> str:
        """Reason why no verdict is given: most futures are implausible; empty = none."""
        count = self.foresight.settings.num_motions
        if self.state is None or not _too_many(self.state, count):
            return ''
        return f'{len(self.state.lost)} of {count} foreseen futures are implausible'

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons why no motion is simulated, and doubts about it, in words."""
        doubts = (*dict.fromkeys(self.doubts.values()), *([self.note] if self.note else ()))
        if self.state is None or not self.state.lost:
            return doubts
        lost, count = self.state.lost, self.foresight.settings.num_motions
        why = max(set(lost.values()), key=list(lost.values()).count)
        return (*doubts, f'{len(lost)} of {count} foreseen futures do not count: {why}')

    def simulated_by(self, model: SolidForesight) -> TrackedSolids:
        """Return the objects as they were found, to be simulated by another model.

        Args:
            model: foresight of the same robot; it takes the table of this one.
        """
        on_table = model._on_table(self.foresight.settings.table_m)
        return replace(self, foresight=on_table, batch=None, state=None)

    def advance(
        self, positions: FloatArray, should_stop: Callable[[], bool] = lambda: False
    ) -> tuple[tuple[ObjectMotion, ...], TrackedSolids]:
        """Simulate T steps in K futures; return the motions at 1 + T rows, and the end state.

        In the first future all is as it was found. Row 0 is where they are now. What cannot be
        foreseen is NaN.

        Args:
            positions: (1 + T * `commands_a_step`, J) commanded positions [rad or m].
            should_stop: polled while futures are simulated; true cancels.

        Raises:
            RolloutPreempted: `should_stop` said so.
        """
        rows = (len(positions) - 1) // COMMANDS_A_STEP
        positions = positions[: 1 + rows * COMMANDS_A_STEP]
        batch = self.batch or self.foresight.engine.begin(self.futures())
        doubts = (
            self.doubts if self.batch else {**self._floating(batch, positions[0]), **self.doubts}
        )
        before = self.state or batch.start(positions[0], self.seen_fingers)
        motion, state = batch.advance(positions, COMMANDS_A_STEP, before, should_stop)
        num, known = self.foresight.settings.num_motions, self._known
        points = np.full((num, rows + 1, len(self.solids), 3), np.nan)
        turns = np.tile(np.eye(3), (num, rows + 1, len(self.solids), 1, 1))
        # the cameras will see them where they see them now
        shifts = np.stack([future.shift for future in batch.futures])
        points[:, :, known] = motion.points - shifts[:, None, None]
        upright = [_upright(solid) for future in batch.futures for solid in future.solids]
        first = np.reshape(upright, (num, len(known), 3, 3))  # also of none
        turns[:, :, known] = motion.rotations @ np.swapaxes(first, -1, -2)[:, None]
        if self.turned is not None:
            turns = turns @ self.turned
        points[:, :, list(doubts)] = np.nan
        if _too_many(state, num):
            points[:] = np.nan
        reference = self.centres if self.reference is None else self.reference
        openings = self.foresight.robot.gripper_openings
        weights = _weights(state, num)
        motions = tuple(
            ObjectMotion(
                reference=reference,
                points=points[k],
                rotations=turns[k],
                openings=openings(motion.joints[k]).T,
                weight=float(weights[k]),
            )
            for k in range(num)
        )
        return motions, replace(self, batch=batch, state=state, doubts=doubts)

    @property
    def _known(self) -> list[int]:
        return [number for number, solid in enumerate(self.solids) if solid is not None]

    def _floating(self, batch: Batch, positions: FloatArray) -> dict[int, str]:
        """Return the objects that nothing holds, with the robot at joints (J,)."""
        if batch.touches_arms(positions):
            return {}
        table, known = self.foresight.settings.table_m, self._known
        solids = [solid for solid in self.solids if solid is not None]
        return {
            number: f"'{self.names[number]}' seems to float {1e3 * height:.0f} mm above the table"
            for number, solid in zip(known, solids, strict=True)
            if not solid.is_held
            and (height := _floats(solid, [s for s in solids if s is not solid], table)) > 0
        }

    def futures(self) -> tuple[Future, ...]:
        """Return the K futures."""
        if self.batch is not None:
            return self.batch.futures
        solids = [solid for solid in self.solids if solid is not None]
        drives = self.foresight.engine.arms.drives
        return draw_futures(self.foresight.settings, solids, drives)


def _solid_then(kept: KeptPose, solid: Solid, floor: float) -> Solid | None:
    """Return a solid where a kept pose has it by now; None = it did not look so then."""
    poses = list(kept.poses)
    (point,) = locate_all(kept.cameras, poses, centroids(kept.masks)[:, None])
    found = find_solid(solid, kept.masks, point, kept.cameras, poses, floor)
    if found is None:
        return None
    found = found.moved_by(kept.moved)
    is_held = kept.is_held and kept.is_told
    return replace(found, is_hidden=True, is_held=is_held, error_m=kept.error_m)


def table_in(
    names: Sequence[str],
    masks: BoolArray,
    cameras: Sequence[CameraModel],
    poses: Sequence[FloatArray],
) -> float:
    """Estimate the height of the table from objects that stand on it [m]; NaN = not known.

    It is the middle one of where objects end below; see `SolidForesight.find`.
    """
    points = locate_all(cameras, poses, centroids(masks))
    bottoms = [
        bottom_of(
            masks[:, item],
            point,
            cameras,
            poses,
            names[item],
            point[2] - TABLE_SEARCH_DEPTH_M,
            NUM_TABLE_FITS,
        )
        for item, point in enumerate(points)
        if np.isfinite(point).all()
    ]
    return float(np.median(bottoms)) if bottoms else float('nan')


def _too_many(state: BatchState, count: int) -> bool:
    """Return True if too few futures remain for a verdict."""
    return len(state.lost) > (1 - _ENOUGH) * count


def _weights(state: BatchState, count: int) -> FloatArray:
    """Return (K,) weights of futures, 1 for the likeliest: lost ones do not count."""
    weights = np.ones(count) if state.stops is None else state.stops.weights.copy()
    weights[list(state.lost)] = 0.0
    return weights / max(weights.max(initial=0.0), 1e-12)


def _upright(solid: Solid) -> FloatArray:
    """Return (3, 3) of a solid as it was found."""
    return replace(solid, yaw=0.0).turn_to(solid)


def _table_under(solids: Sequence[Solid | None]) -> float:
    """Return the height of the table that the lowest solids stand on [m].

    NaN = one alone does not tell.
    """
    bottoms = np.array([solid.bottom for solid in solids if solid is not None])
    level = bottoms[bottoms < bottoms.min(initial=np.inf) + LEVEL_TOLERANCE_M]
    return float(level.mean()) if len(level) > 1 else float('nan')


def _doubts(
    names: Sequence[str], masks: BoolArray, solids: Sequence[Solid | None], table: float
) -> dict[int, str]:
    """Return contradictions between the objects, in words that name them."""
    doubts: dict[int, str] = {}
    seen = masks.any((-2, -1)).sum(0)
    for number, (name, solid) in enumerate(zip(names, solids, strict=True)):
        if solid is None and seen[number] == 1:
            doubts[number] = f"'{name}' is seen by one view alone: where it is is not known"
        elif solid is not None and np.abs(solid.centre[:2]).max() > _TABLE_REACH_M:
            doubts[number] = f"'{name}' seems to lie off the table"
        elif solid is not None and solid.bottom < table - MAX_TABLE_CORRECTION_M:
            depth = 1e3 * (table - solid.bottom)
            doubts[number] = f"'{name}' seems to lie {depth:.0f} mm below the table"
    known = [(n, s) for n, s in enumerate(solids) if s is not None]
    for count, (one, solid) in enumerate(known):
        for other, second in known[:count]:
            if _overlap(solid, second):
                text = f"'{names[other]}' and '{names[one]}' seem to be in one place"
                doubts[one] = doubts[other] = text
    return doubts


def _floats(solid: Solid, others: Sequence[Solid], table: float) -> float:
    """Return the height of an unsupported solid above the table [m]; 0 if it stands."""
    height = solid.bottom - table
    if height < 3 * STANDS_M or any(_apart(solid, other) < 0 for other in others):
        return 0.0
    return height


def _overlap(one: Solid, other: Solid) -> bool:
    """Return whether solids overlap and neither stands in or on the other."""
    depth = -_apart(one, other)
    tops = [solid.centre[2] + solid.size[2] / 2 for solid in (one, other)]
    bottoms = [solid.bottom for solid in (one, other)]
    over = min(tops) - max(bottoms)
    return depth > _OVERLAP_M and over > _OVERLAP_M and not (one.is_open or other.is_open)


def _apart(one: Solid, other: Solid) -> float:
    """Return the gap between the circles within two solids' outlines, seen from above [m]."""
    way = float(np.linalg.norm(one.centre[:2] - other.centre[:2]))
    return way - (min(one.size[:2]) + min(other.size[:2])) / 2
