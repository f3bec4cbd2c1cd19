"""Words of success estimates: each has its first reason beside it."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

#: begins the first reason where there is no estimate
_ABSTAINS = 'abstains: '
#: separates reasons in reports
SEPARATOR = '; '
#: length to which a reason is cut [characters]
_LONGEST_REASON = 110


def estimate_words(probability: float | None, reasons: Sequence[str] | str) -> str:
    """Return an estimate and its first reason, e.g. `0.05: 0 of 16 foreseen motions succeed`.

    Args:
        probability: probability of success; NaN or None = there is no estimate.
        reasons: reasons of the estimate, as a list or as a report joins them.
    """
    listed = reasons.split(SEPARATOR) if isinstance(reasons, str) else reasons
    first = (listed[0] if listed else '').removeprefix(_ABSTAINS).strip()
    if len(first) > _LONGEST_REASON:
        first = f'{first[:_LONGEST_REASON].rsplit(" ", 1)[0]} ...'
    is_known = probability is not None and isfinite(probability)
    value = f'{probability:.2f}' if is_known else 'no estimate'
    return f'{value}: {first}' if first else value


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
