"""Values of YAML files, checked: every error says the file, the key and what would be valid."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mtv_world_ros.errors import ConfigError, MtvWorldError, nearest


def read_yaml(
    path: Path | str, what: str, setting: str, *, error: type[MtvWorldError] = ConfigError
) -> Any:
    """Returns the plain values of a file.

    Args:
        path: the file.
        what: what it is, e.g. `robot file`.
        setting: what names it, e.g. `robot_file`.
        error: raised instead of `ConfigError`.

    Raises:
        ConfigError: it cannot be read, or is not YAML.
    """
    try:
        return yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except FileNotFoundError as missing:
        raise error(f"{what} '{path}' does not exist; set '{setting}' to one") from missing
    except yaml.YAMLError as broken:
        raise error(f"{what} '{path}' cannot be read, it is not valid YAML: {broken}") from broken
    except (OSError, ValueError) as unread:
        raise error(f"{what} '{path}' cannot be read: {unread}; set '{setting}'") from unread


def check_keys(
    values: Any,
    known: Iterable[str],
    required: Iterable[str],
    where: str,
    *,
    error: type[MtvWorldError] = ConfigError,
) -> Mapping[str, Any]:
    """Returns `values` if it is a mapping with known and all required keys.

    Raises:
        ConfigError: or `error`, where it is not.
    """
    if not isinstance(values, Mapping):
        raise error(f'{where}: expected keys and values, got {values!r}')
    known = list(known)
    for key in values:
        if key not in known:
            raise error(
                f"{where}: unknown key '{key}'{nearest(str(key), known)}; known are "
                f'{", ".join(known)}'
            )
    for key in required:
        if key not in values:
            raise error(f"{where}: key '{key}' is missing")
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
