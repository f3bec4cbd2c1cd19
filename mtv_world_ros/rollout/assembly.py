"""Policies and describers by the names of their files."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mtv_world_ros.core.entry_points import DESCRIBERS as GROUP
from mtv_world_ros.core.files import bundled
from mtv_world_ros.core.registry import Registry
from mtv_world_ros.policies.kinds import load_policy_config, policy_config
from mtv_world_ros.policies.policy import EpisodeOrigin, Policy, PolicySettings
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.vision.describers.describer import Describer, InstructionDescriber

if TYPE_CHECKING:
    from mtv_world_ros.vision.describers.describer_config import DescriberConfig

#: describers in Python code of the user's
DESCRIBERS = Registry(
    kind='describer',
    bundled={},
    group=GROUP,
    setting="the key 'python' of a describer file",
    protocol='mtv_world_ros.vision.describers.describer.Describer',
    made_required=('describe',),
)
#: makes a policy for an episode's origin; most do not look at it
PolicyMaker = Callable[[EpisodeOrigin], Policy]


def assemble_policy(name: str | Path, robot: RobotModel) -> PolicyMaker:
    """Return the function that makes the policy of a name for an episode.

    Args:
        name: YAML file, name of one in `config/policies`, or a scripted policy such as
            `expert-noise-0.02`.
        robot: the robot that the policy moves.

    Raises:
        ConfigError, PolicyError: no such policy, or its file is wrong.
    """
    config = policy_settings(name, robot)
    if config.is_made_for_episode:
        return partial(config.make, robot=robot)
    made = config.make(EpisodeOrigin(), robot)
    return lambda origin: made


def policy_settings(name: str | Path, robot: RobotModel) -> PolicySettings:
    """Return the checked settings of a named policy, without asking its server.

    Raises:
        ConfigError, PolicyError: as in `assemble_policy`.
    """
    if str(name).startswith('expert'):
        config = policy_config({'kind': 'scripted', 'variant': str(name)}, robot, f"'{name}'")
    else:
        config = load_policy_config(bundled('policies', name, 'policy'), robot)
    config.check()
    return config


def asked_describer(file: str | Path | None) -> Describer | None:
    """Return the describer of `--describer` or the parameter `describer`; None = none is asked.

    Raises:
        ConfigError, CheckpointError: see `assemble_describer`.
    """
    return assemble_describer(file) if file else None


def assemble_describer(config: DescriberConfig | str | Path | None = None) -> Describer:
    """Return the describer of a scene's objects; by default that of the instruction's words.

    Args:
        config: a configuration, or a YAML file like `config/describer.yaml`.

    Raises:
        ConfigError: the configuration is wrong, a key or a package is missing.
    """
    from mtv_world_ros.vision.describers.describer_config import (
        DescriberConfig,
        load_describer_config,
        load_object_list,
    )

    if config is None:
        return InstructionDescriber()
    if not isinstance(config, DescriberConfig):
        config = load_describer_config(Path(config))
    if config.kind == 'list':
        return load_object_list(Path(config.list))
    if config.kind == 'python':
        return DESCRIBERS.create(config.python)
    if config.kind != 'openai' or not config.openai:
        return InstructionDescriber()
    from mtv_world_ros.vision.describers.openai_chat import OpenAIChat
    from mtv_world_ros.vision.describers.vlm import DescriptionCache, VlmDescriber

    cache = DescriptionCache(Path(config.cache)) if config.cache else None
    return VlmDescriber(OpenAIChat(config.openai), cache)
