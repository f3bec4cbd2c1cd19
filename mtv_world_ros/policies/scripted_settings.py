"""Settings of the scripted policies, which the simulator makes."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from mtv_world_ros.core.config import Wait
from mtv_world_ros.core.entry_points import policy_kind
from mtv_world_ros.policies.policy import EpisodeOrigin, Policy, PolicySettings
from mtv_world_ros.robot.model import RobotModel


class ScriptedPolicySettings(PolicySettings):
    """A scripted policy of the simulator, with its name under `variant`."""

    is_made_for_episode: ClassVar[bool] = True

    kind: Literal['scripted'] = 'scripted'
    variant: str = Field(
        default='expert', description='e.g. `expert` or, with faults, `expert-noise-0.02`'
    )
    hold_s: Wait = Field(
        default=0.6, description='from the end of its plan to the end of the episode [s]'
    )

    def check(self) -> None:
        """Raise if there is no such variant, or the simulator is not installed."""
        policy_kind(self.kind).check(self)

    def make(self, origin: EpisodeOrigin, robot: RobotModel) -> Policy:
        """Return the policy for the scene of an episode; see `PolicySettings.make`."""
        return policy_kind(self.kind).make(self, origin, robot)
