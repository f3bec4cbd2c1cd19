"""Which policy: files like those in `config/policies`."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from mtv_world_ros.config import read_yaml, Schema, validated, Wait
from mtv_world_ros.errors import ConfigError, nearest
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.policies.lerobot_client import LeRobotConfig
from mtv_world_ros.policies.openpi_client import OpenPiConfig
from mtv_world_ros.policies.policy import Policy


class ScriptedPolicySettings(Schema):
    """A policy of the simulator, which this layer does not know."""

    kind: Literal['scripted'] = 'scripted'
    variant: str = Field(
        default='expert', description='e.g. `expert` or, with faults, `expert-noise-0.02`'
    )
    hold_s: Wait = Field(
        default=0.6, description='from the end of its plan to the end of the episode [s]'
    )


class RecordedPolicySettings(Schema):
    """What was commanded in the episode that an imagined one begins from."""

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
        """Calls the factory.

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
    """Reads a file like those in `config/policies`.

    Raises:
        ConfigError: it cannot be read, a key is unknown or missing, a value is wrong.
    """
    return policy_config(read_yaml(path, 'policy file', 'policy'), robot, str(path))


def policy_config(values: Any, robot: RobotModel, where: str) -> PolicyConfig:
    """Returns the policy that the values of such a file describe.

    Args:
        values: of the file.
        robot: whose joints it moves.
        where: beginning of error texts, e.g. the file.

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
