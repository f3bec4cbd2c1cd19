"""A policy that a function of the user's makes."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.policies.policy import EpisodeOrigin, Policy, PolicySettings
from mtv_world_ros.robot.model import RobotModel


class PythonPolicyConfig(PolicySettings):
    """A policy in Python code of the user's."""

    kind: Literal['python'] = 'python'
    factory: str = Field(
        description='`package.module:function`; called with the arguments it returns a `Policy`'
    )
    arguments: Annotated[dict[str, Any], BeforeValidator(lambda value: value or {})] = Field(
        default={}, description='by keyword'
    )

    def make(self, origin: EpisodeOrigin, robot: RobotModel) -> Policy:
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
