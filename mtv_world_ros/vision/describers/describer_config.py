"""Which describer to use: files like `config/describer.yaml`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, model_validator

from mtv_world_ros.config import read_yaml, Schema, validated
from mtv_world_ros.errors import nearest
from mtv_world_ros.vision.describers.local_vlm import LocalVlmConfig
from mtv_world_ros.vision.describers.openai_chat import OpenAIConfig

KINDS = ('instruction', 'list', 'openai', 'local')


def _known(kind: Any) -> str:
    if not isinstance(kind, str):
        raise ValueError(f"'kind' is {kind!r}; expected a text")
    if kind not in KINDS:
        raise ValueError(
            f"kind '{kind}' is none{nearest(kind, KINDS)}; valid are {', '.join(KINDS)}"
        )
    return kind


class DescriberConfig(Schema):
    """How the objects of a scene are named."""

    kind: Annotated[str, BeforeValidator(_known)] = Field(
        default='instruction',
        description='`instruction` (the words of the instruction, no model), `list` (a YAML '
        'file), `openai` (a server) or `local` (a model that runs here)',
    )
    list: str = Field(
        default='', description='the YAML file of `list`; in a file, relative to that file'
    )
    openai: OpenAIConfig | None = Field(default=None, description='the server of `openai`')
    local: LocalVlmConfig | None = Field(default=None, description='the model of `local`')
    cache: str = Field(
        default='',
        description="folder in which models' answers are kept; empty = they are not; in a file, "
        'relative to that file',
    )

    @model_validator(mode='after')
    def _has_what_its_kind_needs(self) -> Self:
        if self.kind != 'instruction' and not getattr(self, self.kind):
            raise ValueError(f"kind '{self.kind}' needs the key '{self.kind}'")
        return self


def load_describer_config(path: Path) -> DescriberConfig:
    """Reads a file like `config/describer.yaml`.

    Raises:
        ConfigError: it cannot be read, a key is unknown or missing, a value is wrong.
    """
    values = read_yaml(path, 'describer file', '--describer') or {}
    config = validated(DescriberConfig, values, str(path))
    folder = Path(path).parent
    near = {
        key: str(folder / Path(name).expanduser())
        for key, name in (('list', config.list), ('cache', config.cache))
        if name
    }
    return config.replace(**near)
