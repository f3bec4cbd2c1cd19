"""Naming of a scene's objects; the default uses the words of the instruction alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
import re
from typing import Any, Protocol

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import DescriptionError, UnknownNameError
from mtv_world_ros.vision.segmenters.colour import PALETTE

ROLES = ('manipuland', 'support', 'container')
MAX_WORDS = 5
MAX_OBJECTS = 40
#: boxes count in thousandths of the image's width and height, as most VLMs were taught
BOX_SCALE = 1000

Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class DescribedObject:
    """Description of one object; None = not known.

    Attributes:
        id: unique in the scene.
        name: noun phrase of at most `MAX_WORDS` words, unique in the scene; what a segmenter
            looks for.
        colour: main colour of the object.
        category: kind of object, e.g. `block`.
        role: role of the object, one of `ROLES`: what is moved, what things stand on, what things
            go into.
        box: edges (left, top, right, bottom) of the object in thousandths of the image's width and
            height.
    """

    id: str
    name: str
    colour: str | None = None
    category: str | None = None
    role: str | None = None
    box: Box | None = None


KEYS = tuple(item.name for item in fields(DescribedObject))


def names_of(objects: Iterable[DescribedObject]) -> tuple[str, ...]:
    """Return the objects' names, in order."""
    return tuple(item.name for item in objects)


def check_objects(items: Any, *, complete: bool) -> tuple[DescribedObject, ...]:
    """Return the objects that a list of plain values describes; an empty list is a valid answer.

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
    """Return the faults of the description of one object."""
    if not isinstance(item, Mapping):
        return [f'expected keys and values, got {_short(item)}']
    problems = [
        str(UnknownNameError('unknown key', str(key), KEYS, listed='; valid are'))
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


#: colour words that name an object although the colour segmenter cannot find it
OTHER_COLOURS = frozenset({'black', 'white', 'grey', 'gray', 'brown', 'beige', 'silver', 'gold'})
#: words that end a noun phrase
_STOP = re.compile(
    'a|an|the|to|of|on|in|into|onto|at|by|with|from|and|or|then|left|right|over|under|above|below|'
    'behind|before|between|beside|near|next|front|back|is|are|it|its|so|towards|toward|away|up|down|'
    'off|out|around|against|along|across|through|until|while'
)
_MAX_WORDS = 4


class Describer(Protocol):
    """Names the objects of a scene."""

    def describe(self, first_frame: ByteArray, instruction: str) -> tuple[DescribedObject, ...]:
        """Return the objects; empty if there are none.

        Args:
            first_frame: (H, W, 3) uint8 RGB, a real frame, never a predicted one.
            instruction: text for the robot.

        Raises:
            DescriptionError: naming them failed.
        """
        ...


class InstructionDescriber:
    """Finds the objects that the instruction names by colour; uses no image."""

    def describe(self, first_frame: ByteArray, instruction: str) -> tuple[DescribedObject, ...]:
        """Return what `objects_from_instruction` finds; no more than colours is known of it."""
        del first_frame
        names = objects_from_instruction(instruction)
        return check_objects(
            [{'name': name, 'colour': name.split()[0]} for name in names], complete=False
        )


def name_objects(
    instruction: str,
    *,
    given: Sequence[str] = (),
    describer: Describer | None = None,
    first_frame: Callable[[], ByteArray] | None = None,
    stored: Sequence[str] = (),
) -> tuple[str, ...]:
    """Return the names of a scene's objects; empty if there are none.

    Import, training, node, replay, evaluation and ranking name objects by this rule: the names
    that are `given`, else the describer's, else those `stored` with the episode, else those that
    the instruction names by colour.

    Args:
        instruction: text for the robot.
        given: names that a user gave for every scene.
        describer: names the objects; None = the user chose none.
        first_frame: returns a real frame (H, W, 3) uint8 RGB; needed by a describer.
        stored: names in the episode's metadata.

    Raises:
        DescriptionError: the describer failed.
    """
    if given:
        return tuple(given)
    if describer is not None and first_frame is not None:
        return names_of(describer.describe(first_frame(), instruction))
    return tuple(stored) or objects_from_instruction(instruction)


def objects_from_instruction(instruction: str) -> tuple[str, ...]:
    """Return the objects an instruction names by colour, in order of appearance.

    `place the red block to the left of the blue block` gives `('red block', 'blue block')`.
    A name starts at its colour word and ends at the first preposition, article or mark.
    """
    tokens = re.findall(r"[a-z][a-z'-]*|[^\sa-z]", instruction.lower())
    names: list[str] = []
    at = 0
    while at < len(tokens):
        phrase = _phrase(tokens[at : at + _MAX_WORDS])
        if phrase and ' '.join(phrase) not in names:
            names.append(' '.join(phrase))
        at += max(1, len(phrase))
    return tuple(names)


def _phrase(tokens: list[str]) -> list[str]:
    """Return the words from a leading colour word up to the end of its noun phrase.

    Empty if none leads.
    """
    if tokens[0] not in PALETTE and tokens[0] not in OTHER_COLOURS:
        return []
    phrase = tokens[:1]
    for word in tokens[1:]:
        if ends_phrase(word) or word in PALETTE or not word[0].isalpha():
            break
        phrase.append(word)
    return phrase if len(phrase) > 1 else []


def ends_phrase(word: str) -> bool:
    """Return whether a word belongs to no object's name: a preposition, an article."""
    return _STOP.fullmatch(word) is not None
