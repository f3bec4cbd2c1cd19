"""Words of success estimates: each has its state of trust and its first reason beside it."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

#: the three states of trust; a sentence about an estimate begins with one of them
FITTED_HERE, NOT_FITTED_HERE, CANNOT_TELL = 'fitted here', 'not fitted here', 'cannot tell'
#: begins the first reason where there is no estimate
BECAUSE = f'{CANNOT_TELL}, because '
#: the same in files of before
_ABSTAINS = 'abstains: '
#: separates reasons in reports
SEPARATOR = '; '
#: length to which a reason is cut [characters]
_LONGEST_REASON = 110


def cannot_tell(reason: object) -> str:
    """Return the sentence for an estimate that cannot be given."""
    return f'{BECAUSE}{reason}'


def without_state(reason: str) -> str:
    """Return the reason why there is no estimate, without the words that begin it."""
    return reason.removeprefix(BECAUSE).removeprefix(_ABSTAINS)


def is_trust(sentence: str) -> bool:
    """Return True if a reason is the sentence about the trust in an estimate."""
    return sentence.startswith((f'{FITTED_HERE}: ', f'{NOT_FITTED_HERE}: ', BECAUSE))


def trust_of(reasons: Sequence[str] | str) -> str:
    """Return the sentence that says how far an estimate is to be trusted.

    Args:
        reasons: reasons of the estimate, as a list or as a report joins them. The sentence is the
            first where there is no estimate, else the last.

    Returns:
        The sentence; empty where the reasons have none, as in files of before.
    """
    if not isinstance(reasons, str):
        return next((reason for reason in reversed(reasons) if is_trust(reason)), '')
    if is_trust(reasons):
        return reasons.split(SEPARATOR)[0] if reasons.startswith(BECAUSE) else reasons
    starts = (reasons.find(f'{SEPARATOR}{word}: ') for word in (FITTED_HERE, NOT_FITTED_HERE))
    start = max(starts)
    return '' if start < 0 else reasons[start + len(SEPARATOR) :]


def state_of(reasons: Sequence[str] | str) -> str:
    """Return the state of trust in two or three words; empty where it is not said.

    Args:
        reasons: see `trust_of`.
    """
    sentence = trust_of(reasons)
    states = (FITTED_HERE, NOT_FITTED_HERE, CANNOT_TELL)
    return next((state for state in states if sentence.startswith(state)), '')


def estimate_words(probability: float | None, reasons: Sequence[str] | str) -> str:
    """Return an estimate with its first reason and its state of trust.

    For example `0.05: 0 of 16 foreseen motions succeed (fitted here)`.

    Args:
        probability: probability of success; NaN or None = there is no estimate.
        reasons: reasons of the estimate, as a list or as a report joins them.
    """
    listed = reasons.split(SEPARATOR) if isinstance(reasons, str) else reasons
    first = without_state(listed[0] if listed else '').strip()
    if len(first) > _LONGEST_REASON:
        first = f'{first[:_LONGEST_REASON].rsplit(" ", 1)[0]} ...'
    if probability is None or not isfinite(probability):
        return cannot_tell(first) if first else 'no estimate'
    words = f'{probability:.2f}: {first}' if first else f'{probability:.2f}'
    state = state_of(reasons)
    return f'{words} ({state})' if state and not is_trust(first) else words


def estimate_lines(
    what: str, probabilities: Sequence[float | None], reasons: Sequence[Sequence[str] | str]
) -> list[str]:
    """Return estimates of a rollout with their first reasons: one line where all are alike.

    Args:
        what: heading, such as `success after each chunk`.
        probabilities: estimates in the order of time; NaN or None = there is none.
        reasons: reasons of each.
    """
    texts = [estimate_words(*pair) for pair in zip(probabilities, reasons, strict=True)]
    if len(texts) > 1 and len(set(texts)) == 1:
        return [f'{what}: {len(texts)} times {texts[0]}']
    if len(texts) == 1:
        return [f'{what}: {texts[0]}']
    return [f'{what}:', *(f'  {number}. {text}' for number, text in enumerate(texts, start=1))]
