"""Kinds of policies by name, and policy files, whose key `kind` chooses one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mtv_world_ros.core.config import read_yaml, validated
from mtv_world_ros.core.entry_points import POLICIES as GROUP
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.registry import Registry
from mtv_world_ros.policies.policy import PolicySettings
from mtv_world_ros.robot.model import RobotModel

#: kind -> its settings, imported when a file chooses it. The last one reads episodes, and stands
#: in a room above this one
POLICY_KINDS: Mapping[str, str] = {
    'openpi': 'mtv_world_ros.policies.openpi_client:OpenPiConfig',
    'lerobot': 'mtv_world_ros.policies.lerobot_client:LeRobotConfig',
    'python': 'mtv_world_ros.policies.python_policy:PythonPolicyConfig',
    'scripted': 'mtv_world_ros.policies.scripted_settings:ScriptedPolicySettings',
    'recorded': 'mtv_world_ros.rollout.recorded_policy:RecordedPolicySettings',
}
_REGISTRY = Registry(
    kind='policy kind',
    bundled=POLICY_KINDS,
    group=GROUP,
    setting="the key 'kind' of a policy file",
    required=('make', 'check', 'model_validate'),
    protocol='mtv_world_ros.policies.policy.PolicySettings',
)


def load_policy_config(path: Path, robot: RobotModel) -> PolicySettings:
    """Read a file like those in `config/policies`.

    Raises:
        ConfigError: it cannot be read, a key is unknown or missing, a value is wrong.
    """
    return policy_config(read_yaml(path, 'policy file', 'policy'), robot, str(path))


def policy_config(values: Any, robot: RobotModel, where: str) -> PolicySettings:
    """Return the settings that a file's values describe; errors begin with `where`.

    Raises:
        ConfigError: a key is unknown or missing, a value is wrong.
    """
    kind = settings_class(values, where)
    return validated(kind, values, where, context={'robot': robot})


def settings_class(values: Any, where: str) -> type[PolicySettings]:
    """Return the class of the settings that a file's key `kind` chooses.

    Raises:
        ConfigError: there is no such key or kind, or its class cannot be imported.
    """
    kind = values.get('kind') if isinstance(values, Mapping) else None
    if not isinstance(kind, str):
        raise ConfigError(
            f"{where}: expected a key 'kind', a text: {', '.join(_REGISTRY.names())}"
        )
    try:
        return _REGISTRY.load(kind)
    except ConfigError as error:
        raise ConfigError(f'{where}: {error}') from error
