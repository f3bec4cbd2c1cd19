"""Describes a scene by asking a vision-language model; answers are kept on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import ConfigError, DescriptionError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.vision.describers.describer import (
    BOX_SCALE,
    check_objects,
    DescribedObject,
    MAX_WORDS,
    ROLES,
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
    """Return the text that goes with the frame."""
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
    """Return the text that follows an answer that could not be used."""
    return (
        f'That answer is not valid: {problem}. Answer again with the whole JSON in the form that '
        'was asked for, and nothing else.'
    )


def read_answer(text: str) -> tuple[DescribedObject, ...]:
    """Return the objects of an answer; prose, a code fence or thoughts around the JSON are fine.

    Raises:
        DescriptionError: `invalid`; its text says what is wrong.
    """
    answer = _json_in(text.rpartition('</think>')[2])
    for key in answer:
        if key != 'objects':
            raise DescriptionError.unknown('unknown key', key, ['objects'], most=0)
    if 'objects' not in answer:
        raise DescriptionError("the key 'objects' is missing")
    return check_objects(answer['objects'], complete=True)


def _json_in(text: str) -> dict[str, Any]:
    """Return the first JSON object in a text."""
    start = text.find('{')
    if start < 0:
        raise DescriptionError('it holds no JSON object')
    try:
        value, _ = json.JSONDecoder().raw_decode(text, start)
    except (ValueError, RecursionError) as error:
        raise DescriptionError(f'it is not JSON ({error})') from error
    return value


def excerpt(text: str, length: int = 160) -> str:
    """Return the start of a text on one line, for messages."""
    line = ''.join(c if c.isprintable() else ' ' for c in text)
    line = ' '.join(line.split())
    return line if len(line) <= length else f'{line[:length]}...'


#: of a broken answer this much is shown to the model again
_MAX_QUOTED = 4000


class ChatAnswer(NamedTuple):
    """Text of a model, and the flag that a token limit stopped it."""

    text: str
    is_cut_off: bool = False


class Chat(Protocol):
    """A vision-language model that answers about one image."""

    @property
    def identity(self) -> str:
        """Name the model; other weights or another server, another text."""
        ...

    def ask(self, frame: ByteArray, turns: Sequence[str]) -> ChatAnswer:
        """Return the answer to the last turn.

        Args:
            frame: (H, W, 3) uint8 RGB, shown with the first turn.
            turns: texts of user, model, user, ... in turn; an odd number.

        Raises:
            DescriptionError: the model gave no answer, or a refusal.
        """
        ...


class VlmDescriber:
    """Asks once a frame; an answer that is not valid is asked for a second time, with the error.

    Args:
        chat: client of the model.
        cache: cache of answers; None = none are kept.
    """

    def __init__(self, chat: Chat, cache: DescriptionCache | None = None) -> None:
        self.chat = chat
        self.cache = cache

    def describe(self, first_frame: ByteArray, instruction: str) -> tuple[DescribedObject, ...]:
        """Return the objects that the model sees; empty if it sees none.

        Raises:
            DescriptionError: the call failed; its status says how.
        """
        if self.cache is None:
            return self._ask(first_frame, instruction)
        model = self.chat.identity
        key = self.cache.key(first_frame, instruction, PROMPT_VERSION, model)
        kept = self.cache.get(key)
        if kept is None:
            kept = self._ask(first_frame, instruction)
            self.cache.put(key, kept, model)
        return kept

    def _ask(self, frame: ByteArray, instruction: str) -> tuple[DescribedObject, ...]:
        asked = question(instruction)
        answer = self.chat.ask(frame, [asked])
        try:
            return _read(answer)
        except DescriptionError as error:
            first = error
        turns = [asked, answer.text[:_MAX_QUOTED], repair_request(str(first))]
        answer = self.chat.ask(frame, turns)
        try:
            return _read(answer)
        except DescriptionError as error:
            raise DescriptionError(
                f'{self.chat.identity} gave no valid object list, also when told why. First: '
                f"{first}. Then: {error}. It said '{excerpt(answer.text)}'. Use a more capable "
                "model, or an object list (describer 'kind: list')"
            ) from error


def _read(answer: ChatAnswer) -> tuple[DescribedObject, ...]:
    try:
        return read_answer(answer.text)
    except DescriptionError as error:
        if answer.is_cut_off:
            raise DescriptionError(f'cut off at the token limit; {error}') from error
        raise


class DescriptionCache:
    """One JSON file per description in a folder.

    Scenes without objects are kept like others; failures are never written here.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder).expanduser()

    @staticmethod
    def key(frame: ByteArray, instruction: str, prompt_version: str, model: str) -> str:
        """Return the sha256 of everything that the answer depends on."""
        digest = hashlib.sha256()
        for part in (str(frame.shape), instruction, prompt_version, model):
            digest.update(f'{len(part)}:{part}'.encode())
        digest.update(frame.tobytes())
        return digest.hexdigest()

    def get(self, key: str) -> tuple[DescribedObject, ...] | None:
        """Return a stored description; None if there is none that can be read."""
        try:
            kept = read_json(self._file(key))
            return check_objects(kept['objects'], complete=False)
        except (OSError, ValueError, KeyError, TypeError, DescriptionError):
            return None  # asked again, and written over

    def put(self, key: str, objects: tuple[DescribedObject, ...], model: str) -> None:
        """Store a description; a reader sees the whole file or none.

        Raises:
            ConfigError: the folder cannot be written to.
        """
        content = {'model': model, 'objects': [asdict(item) for item in objects]}
        try:
            write_whole(self._file(key), json.dumps(content, indent=1) + '\n')
        except OSError as error:
            raise ConfigError(
                f"the describer's 'cache' folder '{self.folder}' cannot be written to ({error}); "
                'name another one, or none'
            ) from error

    def _file(self, key: str) -> Path:
        return self.folder / f'{key}.json'
