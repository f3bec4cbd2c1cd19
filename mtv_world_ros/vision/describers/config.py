"""Which describer to use: YAML read into dataclasses, unknown keys refused."""

from __future__ import annotations

from dataclasses import dataclass, fields, MISSING, replace
from pathlib import Path
from typing import Any, get_type_hints

from mtv_world_ros.config import check_keys, read_yaml
from mtv_world_ros.errors import ConfigError, nearest
from mtv_world_ros.vision.describers.local_vlm import LocalVlmConfig
from mtv_world_ros.vision.describers.openai_chat import OpenAIConfig

KINDS = ('instruction', 'list', 'openai', 'local')


@dataclass(frozen=True, slots=True, kw_only=True)
class DescriberConfig:
    """How the objects of a scene are named.

    Attributes:
        kind: `instruction` (the words of the instruction, no model), `list` (a YAML file),
            `openai` (a server) or `local` (a model that runs here).
        list: the YAML file of `list`; in a file, relative to that file.
        openai: the server of `openai`.
        local: the model of `local`.
        cache: folder in which models' answers are kept; empty = they are not. In a file,
            relative to that file.
    """

    kind: str = 'instruction'
    list: str = ''
    openai: OpenAIConfig | None = None
    local: LocalVlmConfig | None = None
    cache: str = ''


def load_describer_config(path: Path) -> DescriberConfig:
    """Reads a file like `config/describer.yaml`.

    Raises:
        ConfigError: it cannot be read, a key is unknown or missing, a value is wrong.
    """
    values = read_yaml(path, 'describer file', '--describer') or {}
    config = describer_config(values, str(path))
    folder = Path(path).parent
    near = {
        key: str(folder / Path(name).expanduser())
        for key, name in (('list', config.list), ('cache', config.cache))
        if name
    }
    return replace(config, **near)


def describer_config(values: Any, where: str = 'describer') -> DescriberConfig:
    """Returns the configuration that plain values describe.

    Raises:
        ConfigError: a key is unknown or missing, a value is wrong.
    """
    config: DescriberConfig = _read(DescriberConfig, values, where)
    if config.kind not in KINDS:
        raise ConfigError(
            f"{where}: kind '{config.kind}' is none{nearest(config.kind, KINDS)}; valid are "
            f'{", ".join(KINDS)}'
        )
    if config.kind != 'instruction' and not getattr(config, config.kind):
        raise ConfigError(f"{where}: kind '{config.kind}' needs the key '{config.kind}'")
    return config


_SECTIONS = {'openai': OpenAIConfig, 'local': LocalVlmConfig}


def _read(kind: Any, values: Any, where: str) -> Any:
    known = {item.name: item for item in fields(kind)}
    required = [key for key, item in known.items() if item.default is MISSING]
    check_keys(values, known, required, where)
    types = get_type_hints(kind)
    return kind(**{key: _value(key, v, types[key], where) for key, v in values.items()})


def _value(key: str, value: Any, wanted: Any, where: str) -> Any:
    if key in _SECTIONS:
        return None if value is None else _read(_SECTIONS[key], value, f'{where}: {key}')
    if wanted is str and isinstance(value, str):
        return value
    if wanted in (int, float) and _is_positive(value, wanted):
        return wanted(value)
    expected = 'a text' if wanted is str else f'a positive {"whole " * (wanted is int)}number'
    raise ConfigError(f"{where}: '{key}' is {value!r}; expected {expected}")


def _is_positive(value: Any, wanted: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | wanted):
        return False
    return 0 < value < 1e9
