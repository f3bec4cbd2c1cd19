"""How a world model is served: what makes it faster or smaller, and its setting."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from mtv_world_ros.errors import ConfigError, nearest


@dataclass(frozen=True, slots=True, kw_only=True)
class ServingOptions:
    """Ways to serve a checkpoint; the defaults are the plain one.

    Attributes:
        fuse_lora: add the adapter into the weights; nothing to compute for it in a step.
        context_parallel: processes that share the token sequence, each on a device of its own.
    """

    fuse_lora: bool = True
    context_parallel: int = 1

    def __post_init__(self) -> None:
        if self.context_parallel < 1:
            raise ConfigError(
                f'serving: context_parallel is {self.context_parallel}; it must be 1 or more'
            )
        if self.context_parallel > 1 and not self.fuse_lora:
            raise ConfigError(
                'serving: context_parallel needs fuse_lora=true: processes share their weights'
            )

    @classmethod
    def parse(cls, text: str) -> ServingOptions:
        """Returns what a text like `context_parallel=2` says, settings apart by spaces.

        Raises:
            ConfigError: an unknown name or a value that is not one.
        """
        values: dict[str, Any] = {}
        kinds = {field.name: type(field.default) for field in fields(cls)}
        for part in text.split():
            name, _, value = part.partition('=')
            if name not in kinds:
                raise ConfigError(
                    f"serving: '{name}' is not one of {', '.join(kinds)}{nearest(name, kinds)}"
                )
            values[name] = _PARSERS[kinds[name]](name, value)
        return cls(**values)


def _number(name: str, value: str) -> int:
    if not value.isdecimal():
        raise ConfigError(f"serving: {name} is '{value}'; it must be a whole number")
    return int(value)


def _truth(name: str, value: str) -> bool:
    if value not in ('true', 'false'):
        raise ConfigError(f"serving: {name} is '{value}'; it must be true or false")
    return value == 'true'


_PARSERS: Mapping[type, Callable[[str, str], Any]] = {int: _number, bool: _truth}
