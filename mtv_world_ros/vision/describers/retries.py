"""When a server that is busy or broken is asked again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, UTC
from email.utils import parsedate_to_datetime
from math import isfinite
import time

#: longest wait between attempts where the server names none [s]
_LONGEST_WAIT_S = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RetryConfig:
    """How long to go on.

    Attributes:
        budget_s: no attempt starts later than this after the first [s].
        first_wait_s: before the second attempt; doubles after each [s].
    """

    budget_s: float
    first_wait_s: float


def attempt(request: Callable[[], bytes], config: RetryConfig) -> bytes:
    """Calls until it succeeds, fails for good, or the next attempt would exceed the budget.

    Raises:
        openai.OpenAIError: the last failure.
    """
    import openai

    deadline = time.monotonic() + config.budget_s
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
    """Whether the same request may succeed later; an account without credit will not."""
    return status >= 500 or (status == 429 and code != 'insufficient_quota')


def retry_after(headers: Mapping[str, str]) -> float | None:
    """Returns the wait that a server asks for [s], given in seconds or as a date; else None.

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
    """NaN for what is no date."""
    try:
        moment = parsedate_to_datetime(date)
    except ValueError:
        return float('nan')
    if moment.tzinfo is None:  # '-0000', which RFC 5322 gives to a UTC time of unknown zone
        moment = moment.replace(tzinfo=UTC)
    return (moment - datetime.now(UTC)).total_seconds()
