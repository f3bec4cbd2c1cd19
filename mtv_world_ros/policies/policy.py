"""A policy that acts, and the settings of a policy: the content of its file."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from mtv_world_ros.core.config import Schema
from mtv_world_ros.core.data_types import FloatArray, JointTrajectory, Observation
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import cut_off, SAME_S


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeOrigin:
    """Origin of an episode, for policies that use it in place of pictures.

    Attributes:
        task: name of the task; empty = not known.
        task_definition: definition of a task that is not bundled, as JSON; empty = the task is
            bundled, or not known.
        scene_seed: seed of the simulated scene; -1 = not known.
        recording: folder of the recorded episode; empty = there is none.
        recording_ns: stamp of the recorded frame that it begins from [ns].
    """

    task: str = ''
    task_definition: str = ''
    scene_seed: int = -1
    recording: str = ''
    recording_ns: int = 0


class Policy(Protocol):
    """A policy: maps an observation to commands, in imagination, simulator or on the robot."""

    @property
    def name(self) -> str:
        """Under which its results are listed."""
        ...

    def reset(self, *, seed: int) -> None:
        """Begin an episode; the next observation is its first.

        Args:
            seed: seed of the policy's own randomness.
        """
        ...

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Return the commands that follow the observation, or None if the episode is over.

        Times count from the observation's stamp. The caller may execute only the first part of the
        commands and then call again.

        Raises:
            PolicyError: the policy cannot answer, e.g. its server is gone.
        """
        ...


@runtime_checkable
class PlannedPolicy(Protocol):
    """A policy that plans the whole episode at its begin, and answers with parts of that plan."""

    @property
    def plan(self) -> JointTrajectory:
        """Commands of the whole episode; times count from its first observation."""
        ...


class PolicySettings(Schema):
    """Settings of one kind of policies: a file like those in `config/policies`.

    A new kind is a subclass in a file of its own. A policy file chooses it by `kind`: a name of
    `policies/kinds.py`, the name of an entry point of `mtv_world.policies`, or `module:Class`.

    Attributes:
        is_made_for_episode: the policy depends on the origin of its episode, so that one is made
            for each; else one serves all episodes.
        needs_recording: an episode must begin from a recorded one.
        server_address: address of a server that a ranking starts, with `{port}`; such settings
            have a field `server`. Empty = there is no server.
        serves_one_client: the server serves one client at a time.
    """

    is_made_for_episode: ClassVar[bool] = False
    needs_recording: ClassVar[bool] = False
    server_address: ClassVar[str] = ''
    serves_one_client: ClassVar[bool] = False

    kind: str

    def check(self) -> None:
        """Raise if no policy can be made of the settings; no server is asked.

        Raises:
            ConfigError, PolicyError: a package is missing, or a value is wrong.
        """

    @abstractmethod
    def make(self, origin: EpisodeOrigin, robot: RobotModel) -> Policy:
        """Return the policy.

        Args:
            origin: origin of the episode; without values unless `is_made_for_episode`.
            robot: the robot that the policy moves.

        Raises:
            ConfigError, PolicyError: a package is missing, or the origin is not enough.
        """


def first_part(
    trajectory: JointTrajectory, start_positions: FloatArray, seconds: float
) -> JointTrajectory:
    """Return the trajectory up to a time, with a point at that time if the trajectory is longer.

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


class RecordedPolicy:
    """Answers with the commands of the recording, by the time since the start.

    Args:
        commands: times count from the moment that the episode begins from [s].
        hold_s: time from the last command, or from the begin where that is later, to the end of
            the episode [s].
    """

    name = 'recorded'

    def __init__(self, commands: JointTrajectory, hold_s: float) -> None:
        end_s = max(float(commands.times[-1]), 0.0) + hold_s
        self._commands = cut_off(commands, commands.positions[0], end_s)
        self._first_ns: int | None = None

    def reset(self, *, seed: int) -> None:
        """Begin an episode."""
        self._first_ns = None

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Return all commands after the observation's stamp; None = the episode is over."""
        if self._first_ns is None:
            self._first_ns = observation.stamp_ns
        times = self._commands.times - (observation.stamp_ns - self._first_ns) / 1e9
        rest = np.flatnonzero(times > SAME_S)
        return self._commands.points(rest, times) if len(rest) else None
