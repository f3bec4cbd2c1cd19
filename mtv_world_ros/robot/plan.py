"""Plans: joint trajectories that were matched to a robot and an observation, and checked."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import ceil, inf

import numpy as np

from mtv_world_ros.core.data_types import (
    FloatArray,
    freeze_array,
    JointTrajectory,
    Observation,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import PlanError, PlanFault, TrajectoryError
from mtv_world_ros.robot.model import check_positions, LIMIT_TOLERANCE, RobotModel
from mtv_world_ros.robot.plan_limits import check_speeds
from mtv_world_ros.robot.resample import match_joints, resample


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanLimits:
    """Limits within which a plan is accepted.

    Attributes:
        tolerance: distance outside the joint limits at which points are still accepted
            [rad or m].
        max_age_s: longest time from the start of a plan to its observation [s].
        max_horizon_s: longest time from the observation to the end of a plan [s].
        may_omit_joints: whether joints that a plan does not name stay where they are; else a plan
            without them is rejected.
    """

    tolerance: float = LIMIT_TOLERANCE
    max_age_s: float = inf
    max_horizon_s: float = inf
    may_omit_joints: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A joint trajectory that was matched to a robot and an observation, and checked.

    `Plan.of` makes it from what a policy sends; code that is given a plan checks nothing again.

    Attributes:
        trajectory: trajectory of the robot's joints in its order; times count from the observation
            [s].
        start_positions: (J,) joint positions at the observation [rad or m].
        stamp_ns: stamp of the observation [ns].
        given: the trajectory as it was sent.
        given_ns: stamp that the times of `given` count from [ns].
        robot: robot that the trajectory was matched to.
        limits: limits that the plan was held to.
    """

    trajectory: JointTrajectory
    start_positions: FloatArray
    stamp_ns: int
    given: JointTrajectory = field(repr=False)
    given_ns: int
    robot: RobotModel = field(repr=False)
    limits: PlanLimits

    def __post_init__(self) -> None:
        num_joints = len(self.trajectory.joint_names)
        freeze_array(self, 'start_positions', (num_joints,), np.float64, TrajectoryError)

    @classmethod
    def of(
        cls,
        trajectory: JointTrajectory,
        robot: RobotModel,
        observation: Observation,
        limits: PlanLimits = PlanLimits(),
        *,
        stamp_ns: int | None = None,
    ) -> Plan:
        """Return the plan to execute a trajectory after an observation.

        Args:
            trajectory: joints in any order; those that the robot lacks are dropped.
            robot: the robot.
            observation: observation that the plan starts from; joints in the robot's order.
            limits: limits that the plan is held to.
            stamp_ns: stamp that the trajectory's times count from [ns]; None = the observation's.

        Raises:
            PlanError: names are missing or unknown, a position, speed or time exceeds its limit.
        """
        start = observation.positions
        moved = np.isin(robot.joint_names, trajectory.joint_names)
        try:
            held = start if limits.may_omit_joints else None
            whole = match_joints(trajectory, robot, held)
        except TrajectoryError as error:
            raise PlanError(PlanFault.NAMES, str(error)) from error
        # joints that the plan does not move may rest anywhere
        checked = np.where(moved, whole.positions, np.clip(start, robot.lower, robot.upper))
        try:
            check_positions(robot, checked, tolerance=limits.tolerance)
        except TrajectoryError as error:
            raise PlanError(PlanFault.LIMITS, str(error)) from error
        if trajectory.times[0] < 0:
            raise PlanError(
                PlanFault.TIMES,
                f'point 0 is {-trajectory.times[0]:g} s before the stamp of the trajectory; '
                'time_from_start counts from there and must not be negative',
            )
        given_ns = observation.stamp_ns if stamp_ns is None else stamp_ns
        whole = _from_observation(whole, (given_ns - observation.stamp_ns) / 1e9, limits)
        check_speeds(robot, whole, start, tolerance=limits.tolerance)
        return cls(
            trajectory=whole,
            start_positions=start,
            stamp_ns=observation.stamp_ns,
            given=trajectory,
            given_ns=given_ns,
            robot=robot,
            limits=limits,
        )

    def after(self, observation: Observation) -> Plan:
        """Return the plan after an observation: this one, or the trajectory checked again.

        Raises:
            PlanError: as in `of`.
        """
        same = np.array_equal(observation.positions, self.start_positions)
        if same and observation.stamp_ns == self.stamp_ns:
            return self
        return Plan.of(self.given, self.robot, observation, self.limits, stamp_ns=self.given_ns)

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Return (N, J) joint positions at times (N,) from the observation [s]."""
        return resample(self.trajectory, self.start_positions, times)

    def chunks(self, spec: WorldModelSpec) -> tuple[ChunkPlan, ...]:
        """Return the plan on a model's clock, cut into chunks."""
        num_frames, fps = spec.num_frames, spec.fps
        total = max(1, ceil(float(self.trajectory.times[-1]) * fps - 1e-6))
        num_chunks = ceil(total / num_frames)
        times = np.arange(num_chunks * num_frames + 1) / fps
        positions = self.positions_at(times)
        return tuple(
            ChunkPlan(
                plan=self,
                times=times[first : first + num_frames + 1],
                positions=positions[first : first + num_frames + 1],
                num_frames=min(num_frames, total - first),
                chunk=chunk,
                num_chunks=num_chunks,
            )
            for chunk, first in enumerate(range(0, total, num_frames))
        )


def _from_observation(
    trajectory: JointTrajectory, offset_s: float, limits: PlanLimits
) -> JointTrajectory:
    """The trajectory with times from the observation, which is `offset_s` before its own stamp."""
    end_s = offset_s + float(trajectory.times[-1])
    if -offset_s > limits.max_age_s:
        raise PlanError(
            PlanFault.STALE,
            f'the trajectory is stamped {-offset_s:.3f} s before the observation it would start '
            f"from; 'max_trajectory_age_s' allows {limits.max_age_s:g} s",
        )
    if end_s < 0:
        raise PlanError(
            PlanFault.STALE,
            f'the trajectory ended {-end_s:.3f} s before the observation it would start from',
        )
    if end_s > limits.max_horizon_s:
        raise PlanError(
            PlanFault.TOO_LONG,
            f"the trajectory ends {end_s:.3f} s after its observation; 'max_horizon_s' allows "
            f'{limits.max_horizon_s:g} s (do its stamp and the images come from the same clock?)',
        )
    return replace(trajectory, times=trajectory.times + offset_s) if offset_s else trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkPlan:
    """The part of a plan that one chunk shows.

    Attributes:
        plan: the whole plan.
        times: (1 + T,) times of a whole chunk, from the plan's observation [s]; row 0 its start.
        positions: (1 + T, J) joint positions then [rad or m].
        num_frames: number of frames that are kept: the last chunk ends with the plan.
        chunk: index of the chunk in the plan.
        num_chunks: number of chunks of the plan.
    """

    plan: Plan
    times: FloatArray
    positions: FloatArray
    num_frames: int
    chunk: int
    num_chunks: int

    def __post_init__(self) -> None:
        freeze_array(self, 'times', (None,), np.float64, TrajectoryError)
        num_joints = len(self.plan.start_positions)
        shape = (len(self.times), num_joints)
        freeze_array(self, 'positions', shape, np.float64, TrajectoryError)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the observation that the plan starts from [ns]."""
        return self.plan.stamp_ns

    @property
    def frame_s(self) -> float:
        """Time between two frames [s]."""
        return float(self.times[1] - self.times[0])

    @property
    def num_left(self) -> int:
        """Number of frames at the end of a chunk that are dropped."""
        return len(self.times) - 1 - self.num_frames

    def fine_positions(self, step_s: float, each: int = 1) -> FloatArray:
        """Return the joint positions of the whole chunk, `each` in a step; row 0 its start."""
        count = round((self.times[-1] - self.times[0]) / step_s) * each
        return self.plan.positions_at(self.times[0] + step_s / each * np.arange(count + 1))
