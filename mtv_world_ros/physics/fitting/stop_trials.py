"""Stops of fingers in recordings, held or not held, as evidence of contact parameters.

Whole recordings seldom tell how objects slip: cameras are off by a centimetre, and a block that
slips out of simulated fingers at once is as far from its masks as one that they miss. A stop tells
more. The object is put between the fingers that stopped, the recorded motion is simulated from
just before they closed until after the hand has moved, and the object goes along or stays. Both
outcomes are evidence.

Shape letters: N frames, O objects, J joints, K draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.transforms import about_z
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.physics.arms.arm_response import PERIOD_S
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.engine.engine import Engine
from mtv_world_ros.physics.engine.futures import Future, shifted
from mtv_world_ros.physics.fitting.tracks import recorded_positions
from mtv_world_ros.physics.grips import watch_fingers
from mtv_world_ros.physics.solid_foresight import COMMANDS_A_STEP, STEP_S
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.vision.held_objects import Hold, judge_stops


@dataclass(frozen=True, slots=True)
class StopTrialSettings:
    """Settings of the simulation of a stop.

    Attributes:
        before_s: frames before the stop in which the object is looked for [s].
        open_by: opening beyond that of the stop at which the simulation begins [fraction].
        lead_s: time before that [s].
        after_s: longest time simulated after the fingers have closed [s].
        min_travel_m: shortest way of the tool that tells held from not held [m].
        along: largest distance of the object from where the tool would carry it, at which it is
            held [fraction of the way of the tool].
        error_rate: probability that masks or simulation are wrong about a stop, whatever the
            settings.
        max_width_ratio: largest narrow side of an object that fits between the fingers [widest
            opening].
        max_width_change: largest factor between the width of an object by its masks and by the
            fingers that hold it; beyond it they hold a part of it.
    """

    before_s: float = 4.0
    open_by: float = 0.15
    lead_s: float = 0.3
    after_s: float = 2.5
    min_travel_m: float = 0.04
    along: float = 0.5
    error_rate: float = 0.1
    max_width_ratio: float = 1.1
    max_width_change: float = 1.3


_SETTINGS = StopTrialSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservedStop:
    """Fingers that stopped at an object of a recording.

    Attributes:
        arm: index of the tool.
        item: index of the object.
        closed_s: time at which they have closed, from the first masks on [s].
        opened_s: time at which they open again, or of the last frame [s].
        is_held: whether the object went along with the hand.
    """

    arm: int
    item: int
    closed_s: float
    opened_s: float
    is_held: bool


def observed_stops(
    episode: Episode, robot: RobotModel, views: Sequence[str]
) -> tuple[ObservedStop, ...]:
    """Return the stops of a recording's fingers that masks call held or not held.

    Args:
        episode: recording with masks and joint states.
        robot: robot whose joints were measured.
        views: names of the V views.
    """
    assert episode.masks is not None and episode.joint_states is not None
    tracks = [episode.masks[view] for view in views]
    stamps = tracks[0].stamps_ns
    if len(stamps) < 2 or len({len(track.stamps_ns) for track in tracks}) > 1:
        return ()
    times = (stamps - stamps[0]) * 1e-9
    period_s = float(np.median(np.diff(times)))
    positions = recorded_positions(episode.joint_states, robot, stamps.astype(np.float64))
    stopped, _ = watch_fingers(robot.gripper_openings(positions), period_s)
    numbers = np.arange(len(episode.info.objects))[:, None, None, None] + 1
    found = []
    for arm, first, opened in _runs(stopped):
        begin = max(first - round(_SETTINGS.before_s / period_s), 0)
        frames = [np.stack([track.frames[k] for k in range(begin, opened)]) for track in tracks]
        masks = np.stack([of_view[None] == numbers for of_view in frames])
        cameras = tuple(episode.cameras[view] for view in views)
        motion = Motion.of(robot, cameras, positions[begin:opened])
        (stop,) = judge_stops(motion, masks, [(arm, first - begin, opened - begin)])
        if stop.item is not None and stop.hold in (Hold.HELD, Hold.NOT_HELD):
            found.append(
                ObservedStop(
                    arm=arm,
                    item=stop.item,
                    closed_s=float(times[first]),
                    opened_s=float(times[opened - 1]),
                    is_held=stop.hold is Hold.HELD,
                )
            )
    return tuple(found)


def _runs(stopped: BoolArray) -> list[tuple[int, int, int]]:
    """Return arm, first row, and row after the last of each run of stops (A, N)."""
    runs = []
    for arm, of_arm in enumerate(stopped):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], of_arm.astype(int), [0]])))
        runs += [(arm, int(first), int(last)) for first, last in edges.reshape(-1, 2)]
    return runs


@dataclass(frozen=True, slots=True, kw_only=True)
class StopTrial:
    """A stop that is simulated under several settings.

    Attributes:
        solid: object where it was when the fingers closed.
        positions: (1 + T * n, J) measured, `PERIOD_S` apart [rad or m].
        tools: (1 + T, 3) way of the tool point [m].
        closed_row: row at which the fingers have closed.
        is_held: whether it went along.
        table_m: height of its table.
    """

    solid: Solid
    positions: FloatArray
    tools: FloatArray
    closed_row: int
    is_held: bool
    table_m: float

    @classmethod
    def of(
        cls,
        stop: ObservedStop,
        robot: RobotModel,
        positions: FloatArray,
        displacements: FloatArray,
        solid: Solid,
        table_m: float,
    ) -> StopTrial | None:
        """Return the trial of a stop; None = it tells nothing in simulation.

        Args:
            stop: the stop.
            robot: robot whose joints were measured.
            positions: (1 + T * n, J) measured from the first masks on, `PERIOD_S` apart.
            displacements: (1 + T, 3) of the object since then, by its masks; NaN = not known [m].
            solid: object in the first frame.
            table_m: height of its table [m].
        """
        openings = np.asarray(robot.gripper_openings(positions))[stop.arm]
        closed = min(round(stop.closed_s / PERIOD_S), len(positions) - 1)
        wide = np.flatnonzero(openings[:closed] > openings[closed] + _SETTINGS.open_by)
        if not len(wide):
            return None
        first = max(int(wide[-1]) - round(_SETTINGS.lead_s / PERIOD_S), 0)
        last = round(min(stop.opened_s, stop.closed_s + _SETTINGS.after_s) / PERIOD_S)
        part = positions[first : last + 1]
        part = part[: 1 + (len(part) - 1) // COMMANDS_A_STEP * COMMANDS_A_STEP]
        poses = robot.tool_poses(part[::COMMANDS_A_STEP])[stop.arm]
        row = (closed - first) // COMMANDS_A_STEP
        if row >= len(poses):
            return None
        travel = float(np.linalg.norm(poses[-1, :3, 3] - poses[row, :3, 3]))
        if travel < _SETTINGS.min_travel_m:
            return None
        widest = 2 * float(robot.finger_gaps(positions)[:, stop.arm].max())
        if min(solid.size[:2]) > _SETTINGS.max_width_ratio * widest:
            return None
        before = displacements[: 1 + round(stop.closed_s / STEP_S)]
        known = np.flatnonzero(np.isfinite(before).all(-1))
        if not len(known):
            return None
        solid = replace(solid, centre=solid.centre + before[known[-1]])
        if stop.is_held:  # cameras may see it beside the fingers; it was between them
            gaps = robot.finger_gaps(part)[closed - first :, stop.arm]
            solid = _filling(solid, poses[row], 2 * float(np.median(gaps)))
            solid = replace(solid, centre=_between(solid, poses[row]))
        return cls(
            solid=solid,
            positions=part,
            tools=poses[:, :3, 3],
            closed_row=row,
            is_held=stop.is_held,
            table_m=table_m,
        )

    def likelihoods(
        self, engine: Engine, settings: Sequence[ContactSettings], shifts: FloatArray
    ) -> FloatArray:
        """Return (K,) log likelihoods of the outcome.

        Args:
            engine: engine of the robot.
            settings: K settings of contact.
            shifts: (K, 3) where the cameras see an object elsewhere, by draw [m].
        """
        still = np.zeros(len(engine.arms.drives.names))
        futures = [
            Future(
                settings=one.model_copy(update={'table_m': self.table_m}),
                solids=(self.solid if self.is_held else shifted(self.solid, shift),),
                zeros=still,
                delay_s=one.delay_s,
            )
            for one, shift in zip(settings, shifts * [1, 1, 0], strict=True)
        ]
        motion, state = engine.begin(futures).advance(self.positions, COMMANDS_A_STEP)
        way = self.tools[-1] - self.tools[self.closed_row]
        ways = motion.points[:, -1, 0] - motion.points[:, self.closed_row, 0]
        is_held = np.linalg.norm(ways - way, axis=-1) < _SETTINGS.along * np.linalg.norm(way)
        right = is_held == self.is_held
        found = np.log(np.where(right, 1 - _SETTINGS.error_rate, _SETTINGS.error_rate))
        found[list(state.lost)] = np.log(0.5)
        return found


def _filling(solid: Solid, tool: FloatArray, gap_m: float) -> Solid:
    """Return a solid as wide as the gap between the fingers of a tool (4, 4) that hold it.

    Masks tell a width to some millimetres, which is as far as fingers press; fingers that stopped
    measure it.
    """
    way = np.abs(about_z(-solid.yaw) @ tool[:3, 1])[:2]
    widths = solid.size[:2] / np.maximum(way, 1e-6)
    axis, width = int(widths.argmin()), float(widths.min())
    ratio = gap_m / width
    if not 1 / _SETTINGS.max_width_change < ratio < _SETTINGS.max_width_change:
        return solid
    size = solid.size.copy()
    size[:2] *= ratio if solid.is_round else np.where(np.arange(2) == axis, ratio, 1.0)
    return replace(solid, size=size)


def _between(solid: Solid, tool: FloatArray) -> FloatArray:
    """Return the centre (3,) of a solid between the fingers of a tool (4, 4) [m].

    Its place along the fingers' way is that of the tool point; across it, the nearest one at which
    the tool point is within its outline.
    """
    off = tool[:3, :3].T @ (solid.centre - tool[:3, 3])
    off[1] = 0.0
    half = min(solid.size[:2]) / 2
    off[0] = np.clip(off[0], -half, half)
    centre = tool[:3, 3] + tool[:3, :3] @ off
    centre[2] = solid.centre[2]
    return centre
