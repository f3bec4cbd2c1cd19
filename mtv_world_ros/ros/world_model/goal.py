"""A goal of the action `~/follow_joint_trajectory`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rclpy.action.server import ServerGoalHandle
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMsg

from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.world_model.worker import Request


@dataclass(eq=False, kw_only=True)
class Goal:
    """Accepted goal of the action.

    Attributes:
        handle: rclpy's goal handle.
        request: request that was made of it; None = it is still waiting.
        violation: name of the code and text of a tolerance that is violated.
    """

    handle: ServerGoalHandle
    request: Request | None = None
    violation: tuple[str, str] | None = None

    @property
    def message(self) -> JointTrajectoryMsg:
        """Trajectory of the goal."""
        return self.handle.request.trajectory

    def check(self, joint_names: Sequence[str]) -> None:
        """Raise if the goal has parts that a plan on the topic cannot have.

        Args:
            joint_names: joint names of the robot.

        Raises:
            Rejection: joints of several degrees of freedom, or a tolerance of another joint.
        """
        goal = self.handle.request
        if goal.multi_dof_trajectory.joint_names or goal.multi_dof_trajectory.points:
            raise Rejection(
                Reason.TRAJECTORY_MALFORMED,
                'joints of several degrees of freedom are not imagined; leave '
                'multi_dof_trajectory empty',
            )
        named = {one.name for one in (*goal.path_tolerance, *goal.goal_tolerance)}
        others = sorted(named - (set(goal.trajectory.joint_names) & set(joint_names)))
        if others:
            raise Rejection(
                Reason.JOINT_NAMES,
                f'tolerances name the joints {others}, which are no joints of the robot that the '
                'trajectory moves',
            )
