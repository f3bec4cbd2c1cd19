"""HTML and SVG elements with everything escaped."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

#: elements that have no end tag
_VOID = frozenset({'br', 'img', 'meta', 'source'})


class Markup(str):
    """Text that is HTML already; any other text is escaped on its way in."""

    __slots__ = ()


def element(tag: str, *children: str | None, **attributes: str | float | bool | None) -> Markup:
    """Returns an element; children that are not Markup are escaped, None is left out.

    Attribute names: a trailing underscore goes (`class_`), others become hyphens. True is an
    attribute without a value; None and False are left out.
    """
    written = ''.join(_attribute(name, value) for name, value in attributes.items())
    if tag in _VOID:
        return Markup(f'<{tag}{written}>')
    return Markup(f'<{tag}{written}>{join(children)}</{tag}>')


def _attribute(name: str, value: str | float | bool | None) -> str:
    if value is None or value is False:
        return ''
    name = name.rstrip('_').replace('_', '-')
    if value is True:
        return f' {name}'
    text = f'{value:.2f}'.rstrip('0').rstrip('.') if isinstance(value, float) else str(value)
    return f' {name}="{escape(text)}"'


def join(children: Iterable[str | None]) -> Markup:
    """Returns children in a row, those that are not Markup escaped."""
    return Markup(
        ''.join(
            child if isinstance(child, Markup) else escape(child)
            for child in children
            if child is not None
        )
    )


def data_uri(data: bytes, kind: str) -> str:
    """Returns bytes of a media type as a `data:` address."""
    return f'data:{kind};base64,{base64.b64encode(data).decode()}'


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, num_labels: int = 1, caption: str = ''
) -> Markup:
    """Returns a table that scrolls sideways where it is wider than the page.

    Args:
        head: headings.
        rows: cells, as many as headings.
        num_labels: columns on the left that hold text, not numbers.
        caption: above the table.
    """
    lines = [
        element(
            'tr',
            *(
                element('th', cell, scope='row') if i < num_labels else element('td', cell)
                for i, cell in enumerate(row)
            ),
        )
        for row in rows
    ]
    styles = ['label' if i < num_labels else None for i in range(len(head))]
    heading = element(
        'tr',
        *(element('th', c, scope='col', class_=s) for c, s in zip(head, styles, strict=True)),
    )
    whole = element(
        'table',
        element('caption', caption) if caption else None,
        element('thead', heading),
        element('tbody', *lines),
    )
    return element('div', whole, class_='scroll')
