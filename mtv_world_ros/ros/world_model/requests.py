"""Turns a trajectory message into a request for the worker, or says why it is refused."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from mtv_world_ros.data.joint_plans import check_plan_joints
from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.geometry.plan_limits import check_plan
from mtv_world_ros.geometry.resample import match_joints
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.ros.messages.conversions import to_trajectory
from mtv_world_ros.ros.messages.rejection import Reason, refused_plan, rejected_as, Rejection
from mtv_world_ros.ros.messages.stamps import to_ns
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.sensing.observations import ObservationBuffer, SensedScene
from mtv_world_ros.ros.world_model.worker import from_observation, Request, TimeLimits

#: measured joints may be beyond their limits by this, and by this share of their range
_MEASURED_SLACK = 0.1


class RequestMaker:
    """Checks trajectories and gives each what it is imagined with.

    Attributes:
        imagine: whether rollouts go on from the last predicted frames.
        instruction: text for the robot.
        num_requests: made so far.
        robot: whose joints trajectories move.

    Args:
        robot: whose joints trajectories move.
        buffer: newest real images and joint states.
        settings: the present parameters.
        last_scene: the last predicted frames; None = there are none yet.
    """

    def __init__(
        self,
        robot: RobotModel,
        buffer: ObservationBuffer,
        settings: Callable[[], Settings],
        last_scene: Callable[[], SensedScene | None],
    ) -> None:
        self.robot, self._buffer = robot, buffer
        self._settings, self._last_scene = settings, last_scene
        self.num_requests = 0
        self.imagine = settings().mode == 'imagine'
        self.instruction: str | None = None

    def make(self, message: JointTrajectoryMsg, now_ns: int, received_s: float) -> Request:
        """Returns the request.

        Args:
            message: the policy's plan.
            now_ns: the node's time [ns].
            received_s: when it came in [s], of `time.monotonic`.

        Raises:
            Rejection: the trajectory or the present observation cannot be used.
        """
        settings = self._settings()
        trajectory = to_trajectory(message)
        with refused_plan():
            check_plan_joints(trajectory, self.robot, settings.limit_tolerance)
        stamp_ns = to_ns(message.header.stamp)
        limits = TimeLimits(
            trajectory_age=settings.max_trajectory_age_s, horizon=settings.max_horizon_s
        )
        last = self._last_scene() if self.imagine else None
        scene = last or self._real_scene(now_ns)
        seen = scene.observation
        from_now = from_observation(trajectory, stamp_ns, seen.stamp_ns, limits)
        self._check_speeds(from_now, seen.positions, settings.limit_tolerance)
        self.num_requests += 1
        return Request(
            rollout=self.num_requests,
            trajectory=trajectory,
            stamp_ns=stamp_ns,
            scene=scene,
            imagine=self.imagine,
            instruction=settings.instruction if self.instruction is None else self.instruction,
            objects=settings.objects,
            seed=settings.seed,
            num_seeds=settings.num_seeds,
            num_inference_steps=settings.num_inference_steps,
            limits=limits,
            received_s=received_s,
            received_ns=now_ns,
            limit_tolerance=settings.limit_tolerance,
        )

    def _check_speeds(
        self, trajectory: JointTrajectory, positions: FloatArray, tolerance: float
    ) -> None:
        """From (J,) measured positions on, none is to be quicker than it can."""
        robot = self.robot
        positions = np.clip(positions, robot.lower, robot.upper)
        whole = match_joints(trajectory, robot, positions, allow_missing=True)
        with rejected_as(Reason.JOINT_SPEEDS):
            check_plan(robot, whole, positions, tolerance=tolerance)

    def _real_scene(self, now_ns: int) -> SensedScene:
        if now_ns == 0:
            raise Rejection(
                Reason.NO_CLOCK, "'use_sim_time' is set but nothing was received on /clock"
            )
        scene = self._buffer.observe(now_ns)
        self._check_measured(scene.observation.positions)
        return scene

    def _check_measured(self, positions: FloatArray) -> None:
        """Refuses measured joints that are far beyond their limits (wrong unit or joint)."""
        robot = self.robot
        slack = _MEASURED_SLACK * (1.0 + np.abs(robot.upper - robot.lower))
        outside = (positions < robot.lower - slack) | (positions > robot.upper + slack)
        if outside.any():
            joint = int(np.argmax(outside))
            raise Rejection(
                Reason.JOINT_STATE_INVALID,
                f"joint '{robot.joint_names[joint]}' is measured at {positions[joint]:g}; its "
                f'limits are {robot.lower[joint]:g} to {robot.upper[joint]:g} (rad or m)',
            )
