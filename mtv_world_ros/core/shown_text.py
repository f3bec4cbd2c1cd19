"""Texts from outside, cut and escaped before a log, a terminal or a page shows them."""

from __future__ import annotations

#: longest text from outside that is shown [characters]
MOST_CHARACTERS = 2_000
#: longest text of an error, which may list several things, line by line [characters]
MOST_OF_ERROR = 8_000


def shown(text: object, most: int = MOST_CHARACTERS, kept: str = '') -> str:
    """Return a text with control characters as escapes, and cut where it is long.

    Args:
        text: text of a server, a file or a message.
        most: longest part that is shown [characters].
        kept: control characters that stay, such as line ends.
    """
    whole = str(text)
    begin = whole[:most]
    if not begin.isprintable():
        begin = ''.join(
            char if char.isprintable() or char in kept else repr(char)[1:-1] for char in begin
        )
    more = len(whole) - most
    return f'{begin} ... ({more} more characters)' if more > 0 else begin


def markdown_cell(text: str) -> str:
    """Return a text, maybe of a file, as one cell of Markdown: no HTML, no bars, one line."""
    plain = ' '.join(shown(text, kept='\n\t').split('\n'))
    return plain.replace('&', '&amp;').replace('<', '&lt;').replace('|', '\\|')
