"""Requests of rollouts: a trajectory, checked, with the scene that it starts from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import Plan
from mtv_world_ros.ros.messages.conversions import to_ns, to_trajectory
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as, Rejection
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.sensing.observations import ObservationBuffer, SensedScene
from mtv_world_ros.ros.world_model.worker import Request

#: measured joints may be beyond their limits by this, and by this share of their range
_MEASURED_SLACK = 0.1


class RequestMaker:
    """Makes requests: checks a trajectory, adds the scene, instruction and options.

    Attributes:
        imagine: whether rollouts start from the last predicted frames.
        instruction: text for the robot.
        stored_objects: names of the objects that came with the recording.
        num_requests: number of requests made.
        robot: robot that the trajectories command.

    Args:
        robot: robot that the trajectories command.
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
        self.stored_objects: tuple[str, ...] = ()

    def make(self, message: JointTrajectoryMsg, now_ns: int, received_s: float) -> Request:
        """Check a trajectory and return its request.

        Args:
            message: the policy's plan.
            now_ns: the node's time [ns].
            received_s: when it came in [s], of `time.monotonic`.

        Raises:
            Rejection: the trajectory or the present observation cannot be used.
        """
        settings, stamp_ns = self._settings(), to_ns(message.header.stamp)
        trajectory = to_trajectory(message)
        last = self._last_scene() if self.imagine else None
        scene = last or self._real_scene(now_ns)
        with rejected_as(Reason.ROLLOUT_INVALID):
            plan = Plan.of(
                trajectory,
                self.robot,
                scene.observation,
                settings.plan_limits,
                stamp_ns=stamp_ns or None,
            )
        self.num_requests += 1
        return Request(
            rollout=self.num_requests,
            plan=plan,
            stamp_ns=stamp_ns,
            scene=scene,
            imagine=self.imagine,
            instruction=settings.instruction if self.instruction is None else self.instruction,
            settings=settings,
            received_s=received_s,
            received_ns=now_ns,
            stored_objects=self.stored_objects,
        )

    def is_stop(self, message: JointTrajectoryMsg) -> bool:
        """Return True if the message is a stop: a trajectory without points for this robot.

        It names no joints, or some of the robot's.
        """
        names = message.joint_names
        return not message.points and (
            not names or any(name in self.robot.joint_names for name in names)
        )

    def _real_scene(self, now_ns: int) -> SensedScene:
        if now_ns == 0:
            raise Rejection(
                Reason.NO_CLOCK, "'use_sim_time' is set but nothing was received on /clock"
            )
        scene = self._buffer.observe(now_ns)
        self._check_measured(scene.observation.positions)
        return scene

    def _check_measured(self, positions: FloatArray) -> None:
        """Refuse measured joints that are far beyond their limits (wrong unit or joint)."""
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
