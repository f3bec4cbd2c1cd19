"""Describes a scene by asking a vision-language model, wherever that model runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import DescriptionError
from mtv_world_ros.vision.describers.description_cache import DescriptionCache
from mtv_world_ros.vision.describers.scene_objects import SceneObject
from mtv_world_ros.vision.describers.vlm_prompt import (
    excerpt,
    PROMPT_VERSION,
    question,
    read_answer,
    repair_request,
)

#: of a broken answer this much is shown to the model again
_MAX_QUOTED = 4000


class Answer(NamedTuple):
    """What a model said, and whether it was stopped by a token limit."""

    text: str
    is_cut_off: bool = False


class Chat(Protocol):
    """A vision-language model that answers about one image."""

    @property
    def identity(self) -> str:
        """Names the model; other weights or another server, another text."""
        ...

    def ask(self, frame: ByteArray, turns: Sequence[str]) -> Answer:
        """Returns the answer to the last turn.

        Args:
            frame: (H, W, 3) uint8 RGB, shown with the first turn.
            turns: what user, model, user, ... said; an odd number.

        Raises:
            DescriptionError: no answer could be had, or it is a refusal.
        """
        ...


class VlmDescriber:
    """Asks once a frame; an answer that is not valid is asked for a second time, with the error.

    Args:
        chat: the model.
        cache: where answers are kept; None = nowhere.
    """

    def __init__(self, chat: Chat, cache: DescriptionCache | None = None) -> None:
        self.chat = chat
        self.cache = cache

    def describe(self, first_frame: ByteArray, instruction: str) -> tuple[SceneObject, ...]:
        """Returns the objects that the model sees; empty if it sees none.

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

    def _ask(self, frame: ByteArray, instruction: str) -> tuple[SceneObject, ...]:
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


def _read(answer: Answer) -> tuple[SceneObject, ...]:
    try:
        return read_answer(answer.text)
    except DescriptionError as error:
        if answer.is_cut_off:
            raise DescriptionError(f'cut off at the token limit; {error}') from error
        raise
