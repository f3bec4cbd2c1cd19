"""Tables of cases: one test item tries all rows and names those that fail."""

from __future__ import annotations

from collections.abc import Callable, Iterable
import inspect
import traceback
from typing import Any


def table(names: str, rows: Iterable[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that calls a test for every row, as `parametrize` would, in one item.

    It is for many rows of one behaviour, each too small for an item of its own. Fixtures are
    shared by the rows.

    Args:
        names: arguments that a row fills, separated by commas.
        rows: a value each, or as many as there are names.
    """
    arguments = [name.strip() for name in names.split(',')]
    cases = [row if len(arguments) > 1 else (row,) for row in rows]
    assert cases, f'no rows of {names}'

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        def run(**fixtures: Any) -> None:
            failed = []
            for case in cases:
                try:
                    test(**fixtures, **dict(zip(arguments, case, strict=True)))
                except (Exception, SystemExit):
                    failed.append(f'{case}:\n{traceback.format_exc()}')
            assert not failed, f'{len(failed)} of {len(cases)} rows: ' + '\n'.join(failed)

        signature = inspect.signature(test)
        left = [p for p in signature.parameters.values() if p.name not in arguments]
        run.__signature__ = signature.replace(parameters=left)  # type: ignore[attr-defined]
        run.__name__, run.__doc__, run.__module__ = test.__name__, test.__doc__, test.__module__
        return run

    return decorate
