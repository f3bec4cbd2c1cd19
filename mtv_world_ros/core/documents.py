"""HTML pages and Markdown from the templates in `resource/report/`, and the tables in them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import isfinite
from typing import Any

import cv2
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.shown_text import markdown_cell

#: instead of a number that was not measured
DASH = '–'
#: characters of a line on a console
MAX_WIDTH = 100
#: suffix of templates whose values are escaped
_HTML = '.html.j2'


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table, for Markdown and HTML alike.

    Attributes:
        head: headings.
        rows: cells, as many as headings.
        caption: title of the table.
        num_labels: columns on the left that hold text, not numbers.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[object]]
    caption: str = ''
    num_labels: int = 1

    def narrow(self, width: int = MAX_WIDTH) -> list[Table]:
        """Return the table in parts that fit a width of text, without columns of dashes alone.

        Every part has the columns of labels, and as many of the others as fit, at least one.
        """
        columns = list(zip(self.head, *self.rows, strict=True))
        shown = [
            column
            for number, column in enumerate(columns)
            if number < self.num_labels or not {str(cell) for cell in column[1:]} <= {DASH, ''}
        ]
        widths = [max(len(str(cell)) for cell in column) + 3 for column in shown]
        labels, used = shown[: self.num_labels], sum(widths[: self.num_labels]) + 1
        parts: list[list[tuple[object, ...]]] = [[]]
        room = width - used
        for column, needed in zip(
            shown[self.num_labels :], widths[self.num_labels :], strict=True
        ):
            if parts[-1] and needed > room:
                parts.append([])
                room = width - used
            parts[-1].append(column)
            room -= needed
        return [
            replace(self, head=[str(head) for head in heads], rows=rows)
            for part in parts
            for heads, *rows in [list(zip(*labels, *part, strict=True))]
        ]

    def text(self, width: int = MAX_WIDTH) -> str:
        """Return it as Markdown that fits a console, see `narrow`."""
        return '\n\n'.join(part.markdown() for part in self.narrow(width))

    def markdown(self, *, aligned: bool = True) -> str:
        """Return the table without its caption, its columns `aligned` for reading as text."""
        lines = [[markdown_cell(str(cell)) for cell in row] for row in (self.head, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        if not aligned:
            widths = [0] * len(widths)
        lines.insert(1, ['-' * (width or 3) for width in widths])
        return '\n'.join(
            '| ' + ' | '.join(c.ljust(n) for c, n in zip(line, widths, strict=True)) + ' |'
            for line in lines
        )


def number(value: float | None, digits: int = 3) -> str:
    """Return a number as text; a dash where there is none."""
    return DASH if value is None or not isfinite(value) else f'{value:.{digits}f}'


def with_interval(
    value: float | None, interval: Sequence[float | None] | None, digits: int = 3
) -> str:
    """Return a number with its interval in brackets; unknown parts are left out."""
    text = number(value, digits)
    low, high = interval or (None, None)
    if text == DASH or low is None or high is None or not isfinite(low):
        return text
    return f'{text} [{low:.{digits}f}, {high:.{digits}f}]'


def render(template: str, **values: Any) -> str:
    """Render a template of `resource/report/` with values; HTML is escaped."""
    return _environment().get_template(template).render(**values)


def clicked_frame(recording: str, seconds: float, frame: ByteArray) -> dict[str, object]:
    """Return the values of `clicks.html.j2` for a frame (H, W, 3) uint8 RGB at a time [s]."""
    done, data = cv2.imencode('.jpg', frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    assert done
    return {
        'episode': recording,
        'seconds': round(seconds, 3),
        'width': frame.shape[1],
        'height': frame.shape[0],
        'jpeg': base64.b64encode(data.tobytes()).decode(),
    }


@cache
def _environment() -> Environment:
    folder = share_path('resource', 'report')
    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=lambda name: name is not None and name.endswith(_HTML),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters['number'] = number
    environment.filters['counted'] = _counted
    environment.filters['data_uri'] = _data_uri
    environment.globals['style'] = (folder / 'style.css').read_text(encoding='utf-8')
    return environment


def _counted(count: int, noun: str) -> str:
    return f'{count} {noun}{"" if count == 1 else "s"}'


def _data_uri(data: bytes, kind: str) -> str:
    """Return the bytes of a media type as a `data:` address."""
    return f'data:{kind};base64,{base64.b64encode(data).decode()}'
