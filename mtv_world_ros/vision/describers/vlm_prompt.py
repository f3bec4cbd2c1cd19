"""What a vision-language model is asked about a frame, and how its answer is read."""

from __future__ import annotations

import json
from typing import Any

from mtv_world_ros.errors import DescriptionError, nearest
from mtv_world_ros.vision.describers.scene_objects import (
    BOX_SCALE,
    check_objects,
    MAX_WORDS,
    ROLES,
    SceneObject,
)

#: part of the cache's key: change it with every change of the texts or the schema below
PROMPT_VERSION = '1'

_EXAMPLE = {
    'id': 'red_block',
    'name': 'red block',
    'colour': 'red',
    'category': 'block',
    'role': 'manipuland',
    'box': [412, 530, 468, 601],
}

#: within the subset of JSON Schema that servers accept as strict: every key required, no limits
ANSWER_SCHEMA: dict[str, Any] = {
    'type': 'object',
    'additionalProperties': False,
    'required': ['objects'],
    'properties': {
        'objects': {
            'type': 'array',
            'items': {
                'type': 'object',
                'additionalProperties': False,
                'required': list(_EXAMPLE),
                'properties': {
                    'id': {'type': 'string'},
                    'name': {'type': 'string'},
                    'colour': {'type': ['string', 'null']},
                    'category': {'type': 'string'},
                    'role': {'type': 'string', 'enum': list(ROLES)},
                    'box': {'type': ['array', 'null'], 'items': {'type': 'number'}},
                },
            },
        }
    },
}


def question(instruction: str) -> str:
    """Returns the text that goes with the frame."""
    told = f'The robot was told: "{instruction}".' if instruction.strip() else ''
    return f"""This is a camera image of a robot's workspace. {told}
Which separate objects can the robot move, put things on, or put things into? Leave out the robot \
itself, the table or floor that everything stands on, walls and people.
Answer with JSON alone, in this form:
{json.dumps({'objects': [_EXAMPLE]})}
- id: unique; letters, digits and _ only.
- name: unique noun phrase of at most {MAX_WORDS} words that starts with the colour. For an \
object that the robot was told about, the very words it was told.
- colour: the main colour in one word, or null.
- category: what kind of thing it is, in one or two words.
- role: manipuland (is moved), support (things stand on it) or container (things go into it).
- box: [left, top, right, bottom] in thousandths (0 to {BOX_SCALE}) of the image's width and \
height, or null.
If there are no such objects, answer {{"objects": []}}."""


def repair_request(problem: str) -> str:
    """Returns the text that follows an answer that could not be used."""
    return (
        f'That answer is not valid: {problem}. Answer again with the whole JSON in the form that '
        'was asked for, and nothing else.'
    )


def read_answer(text: str) -> tuple[SceneObject, ...]:
    """Returns the objects of an answer; prose, a code fence or thoughts around the JSON are fine.

    Raises:
        DescriptionError: `invalid`; its text says what is wrong.
    """
    answer = _json_in(text.rpartition('</think>')[2])
    for key in answer:
        if key != 'objects':
            raise DescriptionError(f"unknown key '{key}'{nearest(key, ['objects'])}")
    if 'objects' not in answer:
        raise DescriptionError("the key 'objects' is missing")
    return check_objects(answer['objects'], complete=True)


def _json_in(text: str) -> dict[str, Any]:
    """The first JSON object in a text."""
    start = text.find('{')
    if start < 0:
        raise DescriptionError('it holds no JSON object')
    try:
        value, _ = json.JSONDecoder().raw_decode(text, start)
    except (ValueError, RecursionError) as error:
        raise DescriptionError(f'it is not JSON ({error})') from error
    return value


def excerpt(text: str, length: int = 160) -> str:
    """Returns the start of a text on one line, for messages."""
    line = ''.join(c if c.isprintable() else ' ' for c in text)
    line = ' '.join(line.split())
    return line if len(line) <= length else f'{line[:length]}...'
