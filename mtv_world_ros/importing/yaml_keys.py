"""Checks of the mapping file's values; every error says the key and what would be valid."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from mtv_world_ros.errors import ConfigError, nearest


def check_keys(
    values: Any, known: Iterable[str], required: Iterable[str], where: str
) -> Mapping[str, Any]:
    """Returns `values` if it is a mapping with known and all required keys."""
    if not isinstance(values, Mapping):
        raise ConfigError(f'{where}: expected keys and values, got {values!r}')
    known = list(known)
    for key in values:
        if key not in known:
            raise ConfigError(
                f"{where}: unknown key '{key}'{nearest(str(key), known)}; known are "
                f'{", ".join(known)}'
            )
    for key in required:
        if key not in values:
            raise ConfigError(f"{where}: key '{key}' is missing")
    return values


def number(values: Mapping[str, Any], key: str, default: float, where: str) -> float:
    """Returns a finite number."""
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ConfigError(f"{where}: '{key}' is {value!r}, must be a finite number")
    return float(value)


def numbers(values: Mapping[str, Any], key: str, count: int, where: str) -> tuple[float, ...]:
    """Returns so many finite numbers."""
    value = values[key]
    if not isinstance(value, list) or len(value) != count:
        raise ConfigError(f"{where}: '{key}' is {value!r}, must be a list of {count} numbers")
    return tuple(number({key: item}, key, 0.0, where) for item in value)


def text(values: Mapping[str, Any], key: str, default: str, where: str) -> str:
    """Returns a text."""
    value = values.get(key, default)
    if not isinstance(value, str):
        raise ConfigError(f"{where}: '{key}' is {value!r}, must be a text")
    return value


def word(values: Mapping[str, Any], key: str, known: Iterable[str], where: str) -> str:
    """Returns one of the known words, the first by default."""
    known = list(known)
    value = values.get(key, known[0])
    if value not in known:
        raise ConfigError(
            f"{where}: '{key}' is {value!r}{nearest(str(value), known)}; valid are "
            f'{", ".join(known)}'
        )
    return value
