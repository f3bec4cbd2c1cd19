"""What a policy is: an observation and an instruction in, a joint trajectory out."""

from __future__ import annotations

from typing import Protocol

from mtv_world_ros.data_types import JointTrajectory, Observation


class Policy(Protocol):
    """Decides what the robot does next; the same object runs in imagination and elsewhere."""

    @property
    def name(self) -> str:
        """Under which its results are listed."""
        ...

    def reset(self, *, seed: int) -> None:
        """Begins an episode; the next observation is its first.

        Args:
            seed: of the policy's own randomness.
        """
        ...

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Returns the commands that follow the observation, or None where the episode is over.

        Times count from the observation's stamp. Whoever runs the policy may execute the first
        part of them alone and ask again.

        Raises:
            PolicyError: it cannot answer, e.g. its server is gone.
        """
        ...
