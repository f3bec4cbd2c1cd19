"""Texts from outside, cut and escaped before a log, a terminal or a page shows them."""

from __future__ import annotations

#: longest text from outside that is shown [characters]
MOST_CHARACTERS = 2_000


def shown(text: object, most: int = MOST_CHARACTERS) -> str:
    """Return a text with control characters as escapes, and cut where it is long.

    Args:
        text: text of a server, a file or a message.
        most: longest part that is shown [characters].
    """
    whole = str(text)
    kept = ''.join(
        char if char.isprintable() else char.encode('unicode_escape').decode()
        for char in whole[:most]
    )
    more = len(whole) - most
    return f'{kept} ... ({more} more characters)' if more > 0 else kept
