"""The objects of a scene: the type, and the check of what a model or a person wrote about them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
import re
from typing import Any

from mtv_world_ros.errors import DescriptionError, nearest

ROLES = ('manipuland', 'support', 'container')
MAX_WORDS = 5
MAX_OBJECTS = 40
#: boxes count in thousandths of the image's width and height, as most VLMs were taught
BOX_SCALE = 1000

Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class DescribedObject:
    """One object; what is None is not known.

    Attributes:
        id: unique in the scene.
        name: noun phrase of at most `MAX_WORDS` words, unique in the scene; what a segmenter
            looks for.
        colour: its main colour.
        category: kind of object, e.g. `block`.
        role: one of `ROLES`: what is moved, what things stand on, what things go into.
        box: left, top, right, bottom in thousandths of the image's width and height.
    """

    id: str
    name: str
    colour: str | None = None
    category: str | None = None
    role: str | None = None
    box: Box | None = None


KEYS = tuple(item.name for item in fields(DescribedObject))


def names_of(objects: Iterable[DescribedObject]) -> tuple[str, ...]:
    """Returns the objects' names, in order."""
    return tuple(item.name for item in objects)


def check_objects(items: Any, *, complete: bool) -> tuple[DescribedObject, ...]:
    """Returns the objects that a list of plain values describes; an empty list is a valid answer.

    Args:
        items: list of mappings with the keys of `SceneObject`.
        complete: every key has to be there (`box` and `colour` may be null); else `name` is
            enough, and a bare text is a name.

    Raises:
        DescriptionError: `invalid`; its text lists everything that is wrong.
    """
    if not isinstance(items, list):
        raise DescriptionError(f"'objects' has to be a list, got {_short(items)}")
    problems: list[str] = []
    if len(items) > MAX_OBJECTS:
        problems.append(f'{len(items)} objects; at most {MAX_OBJECTS} are taken')
    found: list[DescribedObject] = []
    for index, given in enumerate(items):
        item: Any = {'name': given} if isinstance(given, str) and not complete else given
        where = f'objects[{index}]'
        wrong = _problems(item, complete)
        problems += [f'{where}: {text}' for text in wrong]
        if not wrong:
            found.append(_object(item, index))
    problems += _repeated('id', [item.id for item in found])
    problems += _repeated('name', [item.name for item in found])
    if problems:
        raise DescriptionError('; '.join(problems))
    return tuple(found)


def _object(item: Mapping[str, Any], index: int) -> DescribedObject:
    values = {key: ' '.join(v.split()) if isinstance(v, str) else v for key, v in item.items()}
    box = values.get('box')
    values['box'] = tuple(map(float, box)) if box else None
    return DescribedObject(**{'id': f'object_{index + 1}', **values})


def _problems(item: Any, complete: bool) -> list[str]:
    """What is wrong with one object."""
    if not isinstance(item, Mapping):
        return [f'expected keys and values, got {_short(item)}']
    problems = [
        f"unknown key '{key}'{nearest(str(key), KEYS)}; valid are {', '.join(KEYS)}"
        for key in item
        if key not in KEYS
    ]
    required = KEYS if complete else ('name',)
    problems += [f"'{key}' is missing" for key in required if key not in item]
    for key, check in _CHECKS.items():
        if key not in item or (item[key] is None and _may_be_null(key, complete)):
            continue
        wanted = check(item[key])
        if wanted:
            problems.append(f"'{key}' is {_short(item[key])}; expected {wanted}")
    return problems


def _may_be_null(key: str, complete: bool) -> bool:
    return key in ('box', 'colour') or (not complete and key in ('category', 'role'))


def _words(limit: int) -> Callable[[Any], str]:
    def check(value: Any) -> str:
        if isinstance(value, str) and 1 <= len(value.split()) <= limit and value.isprintable():
            return ''
        return f'a text of 1 to {limit} words'

    return check


def _identifier(value: Any) -> str:
    if isinstance(value, str) and re.fullmatch(r'[\w-]{1,64}', value):
        return ''
    return 'a text of letters, digits, _ and -'


def _role(value: Any) -> str:
    return '' if value in ROLES else f'one of {", ".join(ROLES)}'


def _box(value: Any) -> str:
    wanted = f'[left, top, right, bottom] within 0 ... {BOX_SCALE}, or null'
    if not isinstance(value, list | tuple) or len(value) != 4:
        return wanted
    if not all(_is_coordinate(number) for number in value):
        return wanted
    left, top, right, bottom = value
    return '' if left < right and top < bottom else f'{wanted}, with left < right and top < bottom'


def _is_coordinate(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return 0 <= value <= BOX_SCALE


_CHECKS: dict[str, Callable[[Any], str]] = {
    'id': _identifier,
    'name': _words(MAX_WORDS),
    'colour': _words(3),
    'category': _words(3),
    'role': _role,
    'box': _box,
}


def _repeated(key: str, values: Sequence[str]) -> list[str]:
    """Two masks under one name could not be told apart."""
    lowered = [value.lower() for value in values]
    twice = sorted({value for value in lowered if lowered.count(value) > 1})
    hint = ', say how the objects differ' if key == 'name' else ''
    return [f"{key} '{value}' is given to more than one object{hint}" for value in twice]


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f'{text[:77]}...'
