"""What names the objects of a scene, and the way to do it by the instruction's words alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import re
from typing import Protocol

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.vision.colour_words import PALETTE
from mtv_world_ros.vision.describers.scene_objects import check_objects, DescribedObject, names_of

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
        """Returns the objects; empty if there are none.

        Args:
            first_frame: (H, W, 3) uint8 RGB, a real frame, never a predicted one.
            instruction: text for the robot.

        Raises:
            DescriptionError: naming them failed.
        """
        ...


class InstructionDescriber:
    """Names the objects that the instruction names by colour; looks at no image."""

    def describe(self, first_frame: ByteArray, instruction: str) -> tuple[DescribedObject, ...]:
        """Returns what `objects_from_instruction` finds; no more than colours is known of it."""
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
    """Returns the names of a scene's objects; empty if there are none.

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
    """Returns the objects an instruction names by colour, in order of appearance.

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
    """Words from a leading colour word up to the end of its noun phrase; empty if none leads."""
    if tokens[0] not in PALETTE and tokens[0] not in OTHER_COLOURS:
        return []
    phrase = tokens[:1]
    for word in tokens[1:]:
        if ends_phrase(word) or word in PALETTE or not word[0].isalpha():
            break
        phrase.append(word)
    return phrase if len(phrase) > 1 else []


def ends_phrase(word: str) -> bool:
    """Returns whether a word belongs to no object's name: a preposition, an article."""
    return _STOP.fullmatch(word) is not None
