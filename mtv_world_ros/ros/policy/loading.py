"""The policy and the robot that the parameters name."""

from __future__ import annotations

from mtv_world_ros.assembly import assemble_policy, checkpoint_robot, PolicyMaker
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.ros.policy.parameters import PolicySettings


def load_named_robot(settings: PolicySettings) -> RobotModel:
    """Loads the robot that is set, by default the checkpoint's."""
    return checkpoint_robot(settings.checkpoint, settings.robot_file or None)


def load_named_policy(settings: PolicySettings) -> PolicyMaker:
    """Returns how the policy that is set is made."""
    return assemble_policy(settings.policy, load_named_robot(settings))
