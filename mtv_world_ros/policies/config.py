"""Which policy: YAML read into dataclasses, unknown keys refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from mtv_world_ros.config import check_keys, number, read_yaml, text
from mtv_world_ros.errors import ConfigError, nearest
from mtv_world_ros.geometry.robot import RobotModel
from mtv_world_ros.policies.lerobot_client import lerobot_config
from mtv_world_ros.policies.openpi_client import openpi_config
from mtv_world_ros.policies.policy import Policy

_SERVERS = {'openpi': openpi_config, 'lerobot': lerobot_config}
KINDS = ('scripted', 'python', 'openpi', 'lerobot')


class PolicyConfig(Protocol):
    """What describes a policy and makes it."""

    def make(self, robot: RobotModel) -> Policy:
        """Returns the policy for a robot."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ScriptedPolicySettings:
    """A policy of the simulator, which this layer does not know.

    Attributes:
        variant: e.g. `expert` or `expert-noise-0.02`.
        hold_s: from the end of its plan to the end of the episode [s].
    """

    variant: str = 'expert'
    hold_s: float = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class PythonPolicyConfig:
    """A policy in Python code of the user's.

    Attributes:
        factory: `package.module:function`; called with the arguments it returns a `Policy`.
        arguments: by keyword.
    """

    factory: str
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def make(self, robot: RobotModel) -> Policy:
        """Calls the factory.

        Raises:
            ConfigError: there is no such function, or it does not take the arguments.
        """
        del robot
        module, _, function = self.factory.partition(':')
        try:
            return getattr(import_module(module), function)(**self.arguments)
        except (ImportError, AttributeError, TypeError, ValueError) as error:
            raise ConfigError(
                f"policy factory '{self.factory}' cannot be used: {error}; it must be "
                "'package.module:function' of something that Python finds (PYTHONPATH)"
            ) from error


def load_policy_config(path: Path) -> PolicyConfig | ScriptedPolicySettings:
    """Reads a file like those in `config/policies`.

    Raises:
        ConfigError: it cannot be read, a key is unknown or missing, a value is wrong.
    """
    values = read_yaml(path, 'policy file', 'policy')
    return policy_config(values, str(path))


def policy_config(values: Any, where: str = 'policy') -> PolicyConfig | ScriptedPolicySettings:
    """Returns the configuration that plain values describe; see `load_policy_config`."""
    if not isinstance(values, Mapping) or 'kind' not in values:
        raise ConfigError(f"{where}: expected a key 'kind': {', '.join(KINDS)}")
    kind, rest = values['kind'], {k: v for k, v in values.items() if k != 'kind'}
    if kind not in KINDS:
        raise ConfigError(
            f"{where}: kind '{kind}' is none{nearest(str(kind), KINDS)}; valid are "
            f'{", ".join(KINDS)}'
        )
    if kind == 'scripted':
        check_keys(rest, ('variant', 'hold_s'), (), where)
        default = ScriptedPolicySettings()
        return ScriptedPolicySettings(
            variant=text(rest, 'variant', default.variant, where),
            hold_s=number(rest, 'hold_s', default.hold_s, where),
        )
    if kind in _SERVERS:
        return _SERVERS[kind](rest, where)
    check_keys(rest, ('factory', 'arguments'), ('factory',), where)
    arguments = check_keys(rest.get('arguments') or {}, rest.get('arguments') or (), (), where)
    return PythonPolicyConfig(factory=text(rest, 'factory', '', where), arguments=arguments)
