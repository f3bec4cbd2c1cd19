"""Tiers of tests: what `make test` runs, and what only `make test-all` does.

A test is marked `slow` if it took FAST_LIMIT_S or more on a quiet core. `make tiers` measures all
of them and lists those whose marker is wrong.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import pytest

#: time that an item of the fast tier may take on a quiet core, fixtures included [s]
FAST_LIMIT_S = 3.0
#: a test function whose items all take less need not be marked slow [s]
SLOW_LEAST_S = 1.0


def rest_slow(values: Iterable[Any], fast: Collection[Any]) -> list[Any]:
    """Return parameters of which only those in `fast` stand for the others in the fast tier."""
    found = list(values)
    missing = [value for value in fast if value not in found]
    assert not missing, f'no parameters: {missing}'
    slow = pytest.mark.slow
    return [
        value
        if value in fast
        else pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=slow)
        for value in found
    ]


def file_seconds(
    reports: Iterable[pytest.TestReport], before: Mapping[str, float]
) -> dict[str, float]:
    """Return the most seconds that a run of each file of tests took.

    Args:
        reports: reports of set-up, call and tear-down of passed items.
        before: seconds by file of the runs before.
    """
    found: dict[str, float] = defaultdict(float)
    for report in reports:
        if isinstance(report, pytest.TestReport):
            found[report.nodeid.partition('::')[0]] += report.duration
    return {**before, **{file: max(took, before.get(file, 0.0)) for file, took in found.items()}}


def tier_lines(reports: Iterable[pytest.TestReport], most: int | None = None) -> list[str]:
    """Return lines that name tests in the wrong tier, the slowest first.

    Args:
        reports: reports of set-up, call and tear-down of passed items.
        most: number of tests to name; None = all, and also those that need no marker any more.
    """
    seconds: dict[str, float] = defaultdict(float)
    slow: set[str] = set()
    for report in reports:
        if isinstance(report, pytest.TestReport):
            seconds[report.nodeid] += report.duration
            slow |= {report.nodeid} if 'slow' in report.keywords else set()
    outgrown = [item for item in seconds if item not in slow and seconds[item] >= FAST_LIMIT_S]
    outgrown.sort(key=lambda item: -seconds[item])
    lines = [f'{seconds[item]:.1f} s: {item}' for item in outgrown[:most]]
    if outgrown:
        lines.insert(
            0,
            f'{len(outgrown)} tests took {FAST_LIMIT_S:g} s or more and are not marked slow, '
            'on this machine as busy as it was (make tiers)',
        )
    if most is None:
        longest: dict[str, float] = defaultdict(float)
        for item in slow:
            function = item.partition('[')[0]
            longest[function] = max(longest[function], seconds[item])
        quick = sorted(name for name, most_s in longest.items() if most_s < SLOW_LEAST_S)
        lines += [f'below {SLOW_LEAST_S:g} s and marked slow: {name}' for name in quick]
    return lines
