"""What urdfdom prints of a URDF that it refuses: its only account of the reason."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
import re

_ERROR = re.compile(rb'^Error: *(.+)$', re.MULTILINE)


@contextmanager
def parser_errors() -> Iterator[list[str]]:
    """Takes the parser's errors off stderr; all else that is written there meanwhile goes on.

    Yields:
        The errors, filled at the end.
    """
    found: list[str] = []
    try:
        stderr = os.dup(2)
    except OSError:  # a process without stderr prints nothing
        yield found
        return
    with os.fdopen(os.memfd_create('urdfdom'), 'w+b') as taken:
        os.dup2(taken.fileno(), 2)
        try:
            yield found
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            taken.seek(0)
            text = taken.read()
            found += [line.decode(errors='replace').strip() for line in _ERROR.findall(text)]
            os.write(2, _without_errors(text))


def _without_errors(text: bytes) -> bytes:
    """What is left without errors and the places in urdfdom's source that follow them."""
    return re.sub(rb'^Error: .+\n(?: +at line \d+ in .+\n)?', b'', text, flags=re.MULTILINE)
