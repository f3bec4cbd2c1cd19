"""Objects that a person wrote down, for work without any model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator

from mtv_world_ros.config import read_yaml, Schema, validated
from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import ConfigError, DescriptionError, nearest
from mtv_world_ros.vision.describers.scene_objects import check_objects, DescribedObject


class ObjectList:
    """Looks objects up by instruction; looks at no image.

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
        """Returns the objects listed for the instruction.

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
    """Reads `objects` (for all instructions) and `instructions` (each with its own objects).

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
