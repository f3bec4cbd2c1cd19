"""What a policy is (observation and instruction in, trajectory out), and how much is executed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from mtv_world_ros.data_types import FloatArray, JointTrajectory, Observation
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.geometry.resample import cut_off, SAME_S


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeOrigin:
    """Where an episode comes from, for policies that know it instead of looking at it.

    Attributes:
        task: its name; empty = not known.
        scene_seed: seed of the simulated scene; -1 = not known.
        recording: folder of the recorded episode; empty = there is none.
        recording_ns: stamp of the recorded frame that it begins from [ns].
    """

    task: str = ''
    scene_seed: int = -1
    recording: str = ''
    recording_ns: int = 0


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
            PolicyError: the policy cannot answer, e.g. its server is gone.
        """
        ...


def first_part(
    trajectory: JointTrajectory, start_positions: FloatArray, seconds: float
) -> JointTrajectory:
    """Returns the trajectory up to a time, with a point at that time where it goes on after it.

    Args:
        trajectory: times count from the observation it answers; joints in any order.
        start_positions: (J,) positions at time 0, in the trajectory's joint order.
        seconds: time of the cut, from the observation [s].

    Raises:
        ConfigError: the time is not positive.
    """
    if seconds <= 0:
        raise ConfigError(f'answers are executed for {seconds} s; it must be positive')
    if trajectory.times[-1] <= seconds + SAME_S:
        return trajectory
    return cut_off(trajectory, start_positions, seconds)
