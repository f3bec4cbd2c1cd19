"""A policy that acts, and the files like those in `config/policies` that name one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from pydantic import BeforeValidator, Field

from mtv_world_ros.core.config import read_yaml, Schema, validated, Wait
from mtv_world_ros.core.data_types import FloatArray, JointTrajectory, Observation
from mtv_world_ros.core.errors import ConfigError, nearest
from mtv_world_ros.policies.lerobot_client import LeRobotConfig
from mtv_world_ros.policies.openpi_client import OpenPiConfig
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import cut_off, SAME_S


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeOrigin:
    """Origin of an episode, for policies that use it in place of pictures.

    Attributes:
        task: name of the task; empty = not known.
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


class ScriptedPolicySettings(Schema):
    """A scripted policy of the simulator."""

    kind: Literal['scripted'] = 'scripted'
    variant: str = Field(
        default='expert', description='e.g. `expert` or, with faults, `expert-noise-0.02`'
    )
    hold_s: Wait = Field(
        default=0.6, description='from the end of its plan to the end of the episode [s]'
    )


class RecordedPolicySettings(Schema):
    """The recorded commands of the episode that an imagined one begins from."""

    kind: Literal['recorded'] = 'recorded'
    hold_s: Wait = Field(
        default=0.6, description='from the last command to the end of the episode [s]'
    )


class PythonPolicyConfig(Schema):
    """A policy in Python code of the user's."""

    kind: Literal['python'] = 'python'
    factory: str = Field(
        description='`package.module:function`; called with the arguments it returns a `Policy`'
    )
    arguments: Annotated[dict[str, Any], BeforeValidator(lambda value: value or {})] = Field(
        default={}, description='by keyword'
    )

    def make(self) -> Policy:
        """Call the factory.

        Raises:
            ConfigError: there is no such function, or it does not take the arguments.
        """
        module, _, function = self.factory.partition(':')
        try:
            return getattr(import_module(module), function)(**self.arguments)
        except (ImportError, AttributeError, TypeError, ValueError) as error:
            raise ConfigError(
                f"policy factory '{self.factory}' cannot be used: {error}; it must be "
                "'package.module:function' of something that Python finds (PYTHONPATH)"
            ) from error


#: of these the layers above make the policy, once they know the episode's origin
OriginSettings = ScriptedPolicySettings | RecordedPolicySettings
PolicyConfig = OriginSettings | PythonPolicyConfig | OpenPiConfig | LeRobotConfig
_KINDS: dict[str, type[PolicyConfig]] = {
    'scripted': ScriptedPolicySettings,
    'recorded': RecordedPolicySettings,
    'python': PythonPolicyConfig,
    'openpi': OpenPiConfig,
    'lerobot': LeRobotConfig,
}


def load_policy_config(path: Path, robot: RobotModel) -> PolicyConfig:
    """Read a file like those in `config/policies`.

    Raises:
        ConfigError: it cannot be read, a key is unknown or missing, a value is wrong.
    """
    return policy_config(read_yaml(path, 'policy file', 'policy'), robot, str(path))


def policy_config(values: Any, robot: RobotModel, where: str) -> PolicyConfig:
    """Return the policy that a file's values describe; errors begin with `where`.

    Raises:
        ConfigError: a key is unknown or missing, a value is wrong.
    """
    if not isinstance(values, Mapping) or 'kind' not in values:
        raise ConfigError(f"{where}: expected a key 'kind': {', '.join(_KINDS)}")
    kind = values['kind']
    if kind not in _KINDS:
        raise ConfigError(
            f"{where}: kind '{kind}' is none{nearest(str(kind), _KINDS)}; valid are "
            f'{", ".join(_KINDS)}'
        )
    return validated(_KINDS[kind], values, where, context={'robot': robot})
