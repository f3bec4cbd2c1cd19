"""The policy and the robot that the parameters name."""

from __future__ import annotations

from mtv_world_ros.assembly import assemble_policy, PolicyMaker, robot_path
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.geometry.robot_file import load_robot
from mtv_world_ros.ros.policy.parameters import PolicySettings
from mtv_world_ros.ros.world_model.loading import load_spec


def load_named_robot(settings: PolicySettings) -> RobotModel:
    """Loads the robot that is set, by default the checkpoint's."""
    return load_robot(robot_path(settings.robot_file or load_spec(settings.checkpoint).robot))


def load_named_policy(settings: PolicySettings) -> PolicyMaker:
    """Returns how the policy that is set is made."""
    return assemble_policy(settings.policy, load_named_robot(settings))
