"""The policy kind `recorded`: the commands of the episode that an imagined one begins from."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from mtv_world_ros.core.config import Wait
from mtv_world_ros.core.errors import PolicyError
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import stitched_commands
from mtv_world_ros.policies.policy import EpisodeOrigin, PolicySettings, RecordedPolicy
from mtv_world_ros.robot.model import RobotModel


class RecordedPolicySettings(PolicySettings):
    """The recorded commands of the episode that an imagined one begins from, on any robot."""

    is_made_for_episode: ClassVar[bool] = True
    needs_recording: ClassVar[bool] = True

    kind: Literal['recorded'] = 'recorded'
    hold_s: Wait = Field(
        default=0.6, description='from the last command to the end of the episode [s]'
    )

    def make(self, origin: EpisodeOrigin, robot: RobotModel) -> RecordedPolicy:
        """Return the policy that sends the commands of the recording.

        Raises:
            PolicyError: the episode begins from no recording.
            EpisodeError: the recording cannot be read.
        """
        if not origin.recording:
            raise PolicyError(
                "policy 'recorded' repeats the commands of the episode that it begins from, and "
                'there is none: give --episodes instead of --live, or set the parameter '
                "'recording'"
            )
        episode = read_episode(Path(origin.recording), with_cameras=False, with_masks=False)
        commands = stitched_commands(episode, robot, origin.recording_ns)
        return RecordedPolicy(commands, self.hold_s)
