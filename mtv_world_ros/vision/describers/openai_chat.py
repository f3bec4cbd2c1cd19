"""A vision-language model behind a server that speaks OpenAI's chat completions protocol."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, UTC
from email.utils import parsedate_to_datetime
from math import isfinite
import os
import time
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import Field

from mtv_world_ros.core.bounded_input import parse_json
from mtv_world_ros.core.config import expected, Schema, Seconds
from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import ConfigError, DescriptionError, masked, MissingPackageError
from mtv_world_ros.core.shown_text import shown
from mtv_world_ros.vision.describers.vlm import ANSWER_SCHEMA, ChatAnswer, excerpt

#: from the strictest to none; a server that refuses one is asked with the next
_FORMATS: tuple[dict[str, Any] | None, ...] = (
    {
        'type': 'json_schema',
        'json_schema': {'name': 'scene_objects', 'strict': True, 'schema': ANSWER_SCHEMA},
    },
    {'type': 'json_object'},
    None,
)
#: how servers say that they do not know a parameter's value
_REFUSED_FORMAT = (400, 422)
_MAX_ANSWER_BYTES = 4_000_000


_Seconds = Annotated[Seconds, expected('a positive number of at most 86400')]


class OpenAIConfig(Schema):
    """Server, model, timeout and retries."""

    model: str = Field(description='name as the server knows it')
    base_url: str = Field(
        default='https://api.openai.com/v1',
        description='up to the version: Ollama has `http://localhost:11434/v1`, Ark '
        '`https://ark.cn-beijing.volces.com/api/v3`',
    )
    key_variable: str = Field(
        default='OPENAI_API_KEY',
        description='environment variable that holds the API key; empty = none is needed',
    )
    timeout_s: _Seconds = Field(default=60.0, description='longest wait for one answer [s]')
    retry_budget_s: _Seconds = Field(
        default=120.0, description='no new attempt starts later than this after the first [s]'
    )
    first_wait_s: _Seconds = Field(
        default=1.0,
        description='wait before the second attempt [s]; doubles after each. What the server '
        'asks for in Retry-After goes first',
    )


class OpenAIChat:
    """Asks the server; see `Chat`.

    Raises:
        ConfigError: the key is not set, or `openai` is not installed.
    """

    def __init__(self, config: OpenAIConfig) -> None:
        self.config = config
        self._key = _api_key(config)
        self._client = _client(config, self._key)
        self._format = 0  # index of the strictest format that the server took

    @property
    def identity(self) -> str:
        """The model and its server."""
        return f'{self.config.model} at {self.config.base_url}'

    def ask(self, frame: ByteArray, turns: Sequence[str]) -> ChatAnswer:
        """Return the answer to the last turn; see `Chat`. No error quotes the key."""
        try:
            return self._ask(frame, turns)
        except DescriptionError as error:
            text = masked(str(error), self._key)
            if text == str(error):
                raise
            raise DescriptionError(text, error.status) from None

    def _ask(self, frame: ByteArray, turns: Sequence[str]) -> ChatAnswer:
        messages = _messages(frame, turns)
        for index in range(self._format, len(_FORMATS)):
            try:
                body = self._complete(messages, _FORMATS[index])
            except _FormatRefused:
                continue
            self._format = index
            return self._answer(body)
        raise AssertionError('without a format there is none to refuse')

    def _complete(self, messages: list[Any], wanted: dict[str, Any] | None) -> bytes:
        """Return the body of a completion, after as many attempts as the budget allows."""
        import openai

        try:
            return _attempt(lambda: self._post(messages, wanted), self.config)
        except openai.APITimeoutError as error:
            raise self._too_slow() from error
        except openai.APIStatusError as error:
            if wanted is not None and error.status_code in _REFUSED_FORMAT:
                raise _FormatRefused from error
            raise self._failed(error.status_code, shown(error)) from error
        except openai.OpenAIError as error:
            cause = shown(f'{error} {error.__cause__ or ""}')
            raise DescriptionError(
                f'{self.identity} cannot be reached ({cause}); is the server '
                "up, and the describer's 'base_url' right?",
                'unreachable',
            ) from error

    def _post(self, messages: list[Any], wanted: dict[str, Any] | None) -> bytes:
        """Send one request; read piece by piece, as some servers keep a slow answer alive."""
        import httpx2

        deadline = time.monotonic() + self.config.timeout_s
        extra: dict[str, Any] = {} if wanted is None else {'response_format': wanted}
        create = self._client.chat.completions.with_streaming_response.create
        body = bytearray()
        try:
            with create(
                model=self.config.model, messages=messages, temperature=0, **extra
            ) as response:
                for piece in response.iter_bytes():
                    body += piece
                    if time.monotonic() > deadline:
                        raise self._too_slow()
                    if len(body) > _MAX_ANSWER_BYTES:
                        raise self._unusable(f'it is longer than {_MAX_ANSWER_BYTES} bytes')
        except httpx2.TimeoutException as error:
            raise self._too_slow() from error
        except httpx2.HTTPError as error:
            raise DescriptionError(
                f'{self.identity} broke off in its answer: {shown(error)}', 'unreachable'
            ) from error
        return bytes(body)

    def _answer(self, body: bytes) -> ChatAnswer:
        """Return the answer in a completion, whose form is checked."""
        try:
            completion = parse_json(body, 'the answer')
            choice = completion['choices'][0]
            message = choice['message']
            reason = choice.get('finish_reason')
            refusal, text = message.get('refusal'), message.get('content') or ''
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            raise self._unusable(f"'{excerpt(body.decode(errors='replace'))}'") from error
        if not isinstance(text, str):
            raise self._unusable(f'its content is {excerpt(repr(text))}')
        if refusal or reason == 'content_filter':
            why = refusal or text or 'its content filter stopped it'
            raise DescriptionError(
                f"{self.identity} refuses to describe the frame: '{excerpt(str(why))}'; use "
                "another model, or an object list (describer 'kind: list')",
                'refused',
            )
        return ChatAnswer(text, is_cut_off=reason == 'length')

    def _too_slow(self) -> DescriptionError:
        return DescriptionError(
            f'{self.identity} did not answer within {self.config.timeout_s:g} s; a larger '
            "'timeout_s' of the describer waits longer",
            'timeout',
        )

    def _unusable(self, what: str) -> DescriptionError:
        return DescriptionError(
            f"{self.identity} sent no chat completion: {what}; the describer's 'base_url' has to "
            'be the root of an OpenAI-compatible API, such as http://localhost:11434/v1'
        )

    def _failed(self, status: int, text: str) -> DescriptionError:
        """Return the error for an HTTP status that is final."""
        reply = f'{self.identity} answers with status {status}: {excerpt(text)}'
        budget = f"'retry_budget_s' ({self.config.retry_budget_s:g} s)"
        if status == 429:
            return DescriptionError(
                f'{reply}; the rate limit did not clear within {budget}', 'rate_limited'
            )
        if status >= 500:
            return DescriptionError(f'{reply}; it did not recover within {budget}', 'server_error')
        where = {
            401: f"check the key in '{self.config.key_variable}'",
            403: f"check the key in '{self.config.key_variable}'",
            404: "check the describer's 'model' and 'base_url'",
        }.get(status, "check that 'model' takes images")
        return DescriptionError(f'{reply}; {where}', 'rejected')


class _FormatRefused(Exception):
    """The server rejected the request, perhaps because of its `response_format`."""


def _api_key(config: OpenAIConfig) -> str:
    if not config.key_variable:
        return ''
    key = os.environ.get(config.key_variable, '').strip()
    if not key:
        raise ConfigError(
            f"the environment variable '{config.key_variable}' is not set; export the API key of "
            f"{config.base_url} in it, or set the describer's 'key_variable' to another one ('' "
            'for a server that needs none)'
        )
    return key


def _client(config: OpenAIConfig, key: str) -> Any:
    try:
        import openai
    except ImportError as error:
        raise MissingPackageError("the describer 'openai'", 'openai') from error
    return openai.OpenAI(
        api_key=key or 'none',
        base_url=config.base_url,
        timeout=config.timeout_s,
        max_retries=0,  # `_attempt` has the only budget
    )


def _messages(frame: ByteArray, turns: Sequence[str]) -> list[Mapping[str, Any]]:
    """Return the turns as messages; the frame goes with the first, as PNG, so nothing is lost."""
    is_encoded, png = cv2.imencode('.png', np.ascontiguousarray(frame[..., ::-1]))
    assert is_encoded
    url = f'data:image/png;base64,{base64.b64encode(png.tobytes()).decode()}'
    first = [
        {'type': 'image_url', 'image_url': {'url': url}},
        {'type': 'text', 'text': turns[0]},
    ]
    later = [
        {'role': 'user' if index % 2 else 'assistant', 'content': turn}
        for index, turn in enumerate(turns[1:])
    ]
    return [{'role': 'user', 'content': first}, *later]


#: longest wait between attempts where the server names none [s]
_LONGEST_WAIT_S = 30.0


def _attempt(request: Callable[[], bytes], config: OpenAIConfig) -> bytes:
    """Call until it succeeds, fails for good, or the next attempt would exceed the budget.

    The SDK's own retries know a number of attempts but no budget of time, and repeat timeouts and
    what an account without credit asks.

    Raises:
        openai.OpenAIError: the last failure.
    """
    import openai

    deadline = time.monotonic() + config.retry_budget_s
    backoff = config.first_wait_s
    while True:
        try:
            return request()
        except openai.APIStatusError as error:
            if not _is_passing(error.status_code, error.code):
                raise
            asked = retry_after(error.response.headers)
            # "at once" would end in a flood of requests
            wait = backoff if asked is None else max(asked, config.first_wait_s)
            if time.monotonic() + wait > deadline:
                raise
        time.sleep(wait)
        backoff = min(2 * backoff, _LONGEST_WAIT_S)


def _is_passing(status: int, code: str | None) -> bool:
    """Return True if the same request may succeed later; False without credit."""
    return status >= 500 or (status == 429 and code != 'insufficient_quota')


def retry_after(headers: Mapping[str, str]) -> float | None:
    """Return the wait that a server asks for [s], given in seconds or as a date; else None.

    Source: RFC 9110, section 10.2.3.
    """
    value = headers.get('retry-after')
    if value is None:
        return None
    try:
        seconds = float(value)
    except ValueError:
        seconds = _seconds_until(value)
    return max(seconds, 0.0) if isfinite(seconds) else None


def _seconds_until(date: str) -> float:
    """Return the seconds until a date; NaN for what is no date."""
    try:
        moment = parsedate_to_datetime(date)
    except ValueError:
        return float('nan')
    if moment.tzinfo is None:  # '-0000', which RFC 5322 gives to a UTC time of unknown zone
        moment = moment.replace(tzinfo=UTC)
    return (moment - datetime.now(UTC)).total_seconds()
