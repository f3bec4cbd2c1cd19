"""Configuration files of describers, and the describer that reads an object list."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from mtv_world_ros.core.config import read_yaml, Schema, validated
from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import ConfigError, DescriptionError, nearest, UnknownNameError
from mtv_world_ros.vision.describers.describer import check_objects, DescribedObject
from mtv_world_ros.vision.describers.openai_chat import OpenAIConfig


class ObjectList:
    """Looks objects up by instruction; uses no image.

    Args:
        by_instruction: objects per instruction; letter case, spacing and a full stop do not count.
        others: objects for every other instruction; None = there is no other.
        source: file of the list, for messages.
    """

    def __init__(
        self,
        by_instruction: Mapping[str, tuple[DescribedObject, ...]],
        others: tuple[DescribedObject, ...] | None = None,
        source: str = 'the object list',
    ) -> None:
        self.by_instruction = {_plain(key): value for key, value in by_instruction.items()}
        self.others = others
        self.source = source

    def describe(self, first_frame: ByteArray, instruction: str) -> tuple[DescribedObject, ...]:
        """Return the objects listed for the instruction.

        Raises:
            DescriptionError: `unlisted`.
        """
        del first_frame
        found = self.by_instruction.get(_plain(instruction), self.others)
        if found is None:
            known = list(self.by_instruction)
            raise DescriptionError(
                f"{self.source} has no objects for '{instruction}'"
                f'{nearest(_plain(instruction), known)}; add it under '
                "'instructions', or a list under 'objects' that holds for all others",
                'unlisted',
            )
        return found


def _checked(items: Any, where: str = '') -> tuple[DescribedObject, ...]:
    try:
        return check_objects(items, complete=False)
    except DescriptionError as error:
        raise ValueError(f'{where}{error}') from error


def _by_instruction(listed: Any) -> dict[str, tuple[DescribedObject, ...]]:
    if not isinstance(listed or {}, Mapping):
        raise ValueError("'instructions' has to map each instruction to its objects")
    return {
        str(key): _checked(items, f"instruction '{key}': ")
        for key, items in (listed or {}).items()
    }


class _Lists(Schema):
    objects: Annotated[Any, AfterValidator(_checked)] = None
    instructions: Annotated[Any, AfterValidator(_by_instruction)] = {}


def load_object_list(path: Path) -> ObjectList:
    """Read `objects` (for all instructions) and `instructions` (each with its own objects).

    An object is its name, or a mapping with `name` and other keys of `SceneObject`.

    Raises:
        ConfigError: the file cannot be read, or what it says is wrong.
    """
    source = f"object list '{path}'"
    values = read_yaml(path, 'object list', 'list')
    if not isinstance(values, Mapping) or not values:
        raise ConfigError(f"{source} needs the key 'objects' or 'instructions'")
    lists = validated(_Lists, values, source)
    return ObjectList(lists.instructions, lists.objects, source)


def _plain(instruction: str) -> str:
    return ' '.join(instruction.lower().split()).rstrip('.! ')


KINDS = ('instruction', 'list', 'openai', 'python')


def _known(kind: Any) -> str:
    if not isinstance(kind, str):
        raise ValueError(f"'kind' is {kind!r}; expected a text")
    if kind not in KINDS:
        raise UnknownNameError('kind', kind, KINDS, is_not=' is none', listed='; valid are')
    return kind


class DescriberConfig(Schema):
    """Settings of the description of the objects of a scene."""

    kind: Annotated[str, BeforeValidator(_known)] = Field(
        default='instruction',
        description='`instruction` (the words of the instruction, no model), `list` (a YAML '
        'file), `openai` (a server, also one on this machine) or `python` (a class of your own)',
    )
    list: str = Field(
        default='', description='the YAML file of `list`; in a file, relative to that file'
    )
    openai: OpenAIConfig | None = Field(default=None, description='the server of `openai`')
    python: str = Field(
        default='',
        description='the class of `python`: the name of an entry point of '
        '`mtv_world.describers`, or `module:Class`; it is called without arguments',
    )
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
    """Read a file like `config/describer.yaml`.

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
