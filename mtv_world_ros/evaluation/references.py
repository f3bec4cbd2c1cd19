"""Actions that a world model is given instead of the recorded ones, to see that it obeys."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mtv_world_ros.data.recording import Recording
from mtv_world_ros.data_types import FloatArray, JointTrajectory
from mtv_world_ros.errors import ConfigError, nearest
from mtv_world_ros.evaluation.rollouts import Stretch
from mtv_world_ros.geometry.mirror import mirrored
from mtv_world_ros.geometry.robot import RobotModel

#: true: the recorded ones; shuffled: another episode's; zero: the joints stay where they are at
#: the start of the rollout; mirrored: each arm does what the other did, mirrored at x = 0
ACTIONS = ('true', 'shuffled', 'zero', 'mirrored')


def check_actions(actions: Sequence[str]) -> None:
    """Raises ConfigError unless all are of `ACTIONS` and the true ones are among them."""
    for name in actions:
        if name not in ACTIONS:
            raise ConfigError(
                f"actions '{name}'{nearest(name, ACTIONS)} is not one of {', '.join(ACTIONS)}"
            )
    if 'true' not in actions:
        raise ConfigError(
            f"actions are {', '.join(actions) or 'empty'}; 'true' must be among them, since the "
            'others are compared with it'
        )


def with_actions(
    name: str,
    recording: Recording,
    stretch: Stretch,
    donor: Recording | None,
    robot: RobotModel,
) -> Recording | None:
    """Returns the episode whose commands are executed; None without an episode to lend them.

    Args:
        name: of `ACTIONS`.
        recording: the episode that is imagined.
        stretch: the part of it that is imagined.
        donor: lends its commands for `shuffled`.
        robot: of the episode.

    Raises:
        RobotError: `mirrored`, and the robot has no mirror image.
    """
    commands = recording.commands
    if name == 'shuffled':
        return donor
    if name == 'zero':
        held = np.repeat(recording.positions[stretch.start][None], len(commands.times), axis=0)
        return _commanding(recording, held)
    if name == 'mirrored':
        return _commanding(recording, mirrored(robot, commands.positions))
    return recording


def _commanding(recording: Recording, positions: FloatArray) -> Recording:
    commands = recording.commands
    other = JointTrajectory(
        joint_names=commands.joint_names, times=commands.times, positions=positions
    )
    return replace(recording, commands=other)
