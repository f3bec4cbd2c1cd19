"""Small charts as inline SVG; their colours are classes of the report's style sheet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import cos, isfinite, pi, sin

from mtv_world_ros.evaluation.metrics.success_agreement import Bin
from mtv_world_ros.evaluation.report.markup import element, join, Markup

_WIDTH = 440.0
_TICKS = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Dot:
    """A value with its interval; NaN = not measured.

    Attributes:
        label: on the left.
        value: in [0, 1].
        interval: (low, high).
        style: class of the style sheet.
    """

    label: str
    value: float
    interval: tuple[float, float]
    style: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """Values over time, with a band around them where it is known.

    Attributes:
        label: for those who cannot see it.
        values: in [0, 1], one per frame; NaN leaves a gap.
        band: (low, high) per frame; empty = none.
        style: class of the style sheet.
    """

    label: str
    values: Sequence[float]
    band: Sequence[tuple[float, float]] = ()
    style: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """Two values of one thing with their intervals; NaN = not known.

    Attributes:
        label: short, beside the mark.
        title: for those who point at it or cannot see it.
        x: in [0, 1].
        y: in [0, 1].
        x_interval: (low, high).
        y_interval: (low, high).
        style: class of the style sheet.
    """

    label: str
    title: str
    x: float
    y: float
    x_interval: tuple[float, float]
    y_interval: tuple[float, float]
    style: str


def dot_chart(title: str, dots: Sequence[Dot]) -> Markup:
    """Returns values in [0, 1] with their intervals, one below the other."""
    left, right, top, row = 92.0, 142.0, 8.0, 28.0
    height = top + row * len(dots) + 26

    def x(value: float) -> float:
        return left + min(max(value, 0.0), 1.0) * (_WIDTH - left - right)

    bottom = height - 22
    parts = [_line((x(t), top), (x(t), bottom), 'grid') for t in _TICKS]
    parts += [_text(f'{t:g}', x(t), height - 6, 'tick', 'middle') for t in _TICKS]
    for index, dot in enumerate(dots):
        parts.append(_dot_row(dot, top + row * (index + 0.5), x))
    return _svg(height, title, parts)


def _dot_row(dot: Dot, y: float, x: Callable[[float], float]) -> Markup:
    label = _text(dot.label, 0.0, y + 4, 'label')
    if not isfinite(dot.value):
        return join([label, _text('not measured', _WIDTH, y + 4, 'tick', 'end')])
    low, high = dot.interval
    text = f'{dot.value:.3f}'
    interval = None
    if isfinite(low) and isfinite(high):
        text = f'{text} [{low:.3f}, {high:.3f}]'
        ends = [
            _line((x(at), y - 5), (x(at), y + 5), f'interval {dot.style}') for at in dot.interval
        ]
        interval = join([_line((x(low), y), (x(high), y), f'interval {dot.style}'), *ends])
    mark = element('circle', cx=x(dot.value), cy=y, r=5.0, class_=f'mark {dot.style}')
    return join([label, interval, mark, _text(text, _WIDTH, y + 4, 'value', 'end')])


def line_chart(
    title: str, lines: Sequence[Line], seconds: Sequence[float], y_label: str
) -> Markup:
    """Returns values in [0, 1] over time.

    Args:
        title: for those who cannot see it.
        lines: what to draw; the last one on top.
        seconds: time of each frame [s].
        y_label: what the values are.
    """
    left, top, bottom, height = 34.0, 22.0, 222.0, 262.0
    longest = max(seconds, default=1.0)

    def place(index: int, value: float) -> tuple[float, float]:
        share = min(max(value, 0.0), 1.0)
        x = left + (_WIDTH - left - 8) * seconds[index] / longest
        return x, bottom - share * (bottom - top)

    parts: list[Markup] = [_text(y_label, 0.0, 10.0, 'tick')]
    for tick in _TICKS:
        y = bottom - tick * (bottom - top)
        parts += [
            _line((left, y), (_WIDTH - 8, y), 'grid'),
            _text(f'{tick:g}', 26, y + 4, 'tick', 'end'),
        ]
    for tick in _seconds_ticks(longest):
        x = left + (_WIDTH - left - 8) * tick / longest
        parts.append(_text(f'{tick:g}', x, bottom + 17, 'tick', 'middle'))
    parts.append(_text('seconds imagined ahead', _WIDTH - 8, height - 6, 'tick', 'end'))
    for line in lines:
        parts += _drawn(line, place)
    return _svg(height, title, parts)


def _drawn(line: Line, place: Callable[[int, float], tuple[float, float]]) -> list[Markup]:
    parts = []
    known = [i for i, (low, high) in enumerate(line.band) if isfinite(low) and isfinite(high)]
    if known:
        around = [place(i, line.band[i][1]) for i in known]
        around += [place(i, line.band[i][0]) for i in reversed(known)]
        points = ' '.join(f'{x:.1f},{y:.1f}' for x, y in around)
        parts.append(element('polygon', points=points, class_=f'band {line.style}'))
    path, pen_is_down = [], False
    for index, value in enumerate(line.values):
        if isfinite(value):
            x, y = place(index, value)
            path.append(f'{"L" if pen_is_down else "M"}{x:.1f} {y:.1f}')
        pen_is_down = isfinite(value)
    title = element('title', line.label)
    parts.append(element('path', title, d=''.join(path), class_=f'line {line.style}'))
    return parts


def _seconds_ticks(longest: float) -> list[float]:
    steps = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 60.0, 120.0)
    step = next((s for s in steps if longest / s <= 7), 300.0)
    return [step * k for k in range(int(longest / step + 1e-6) + 1)]


def reliability_chart(title: str, bins: Sequence[Bin], style: str) -> Markup:
    """Returns how often it came true against what was said; the diagonal is honest."""
    left, top, size, height = 34.0, 22.0, 200.0, 276.0

    def x(value: float) -> float:
        return left + value * size

    def y(value: float) -> float:
        return top + (1 - value) * size

    parts: list[Markup] = [_text('share that really succeeded', 0.0, 10.0, 'tick')]
    for tick in _TICKS:
        parts += [
            _line((x(0), y(tick)), (x(1), y(tick)), 'grid'),
            _text(f'{tick:g}', 26.0, y(tick) + 4, 'tick', 'end'),
            _text(f'{tick:g}', x(tick), top + size + 17, 'tick', 'middle'),
        ]
    parts.append(_line((x(0), y(0)), (x(1), y(1)), 'honest'))
    parts.append(_text('estimated probability of success', x(1), height - 6, 'tick', 'end'))
    for found in bins:
        low, high = found.interval
        ends = (x(found.said), y(low)), (x(found.said), y(high))
        parts.append(_line(*ends, f'interval {style}'))
        at = (x(found.said), y(found.came_true))
        parts.append(element('circle', cx=at[0], cy=at[1], r=5.0, class_=f'mark {style}'))
        parts.append(_text(f'n={found.count}', x(found.middle), top + size + 31, 'tick', 'middle'))
    return _svg(height, title, parts, width=left + size + 44)


def scatter_chart(title: str, points: Sequence[Point], x_label: str, y_label: str) -> Markup:
    """Returns values against values, both in [0, 1], with intervals; equal ones on the diagonal.

    Marks at the same place lie on a small ring around it, so that none hides another.
    """
    left, top, size, height = 34.0, 22.0, 300.0, 366.0

    def place(x: float, y: float) -> tuple[float, float]:
        return left + x * size, top + (1 - y) * size

    parts: list[Markup] = [_text(y_label, 0.0, 10.0, 'tick')]
    for tick in _TICKS:
        parts += [
            _line(place(0, tick), place(1, tick), 'grid'),
            _line(place(tick, 0), place(tick, 1), 'grid'),
            _text(f'{tick:g}', 26.0, place(0, tick)[1] + 4, 'tick', 'end'),
            _text(f'{tick:g}', place(tick, 0)[0], top + size + 17, 'tick', 'middle'),
        ]
    parts.append(_line(place(0, 0), place(1, 1), 'honest'))
    parts.append(_text(x_label, left + size, height - 6, 'tick', 'end'))
    shown = [point for point in points if isfinite(point.x) and isfinite(point.y)]
    for point in shown:
        together = [p for p in shown if (p.x, p.y) == (point.x, point.y)]
        angle = 2 * pi * together.index(point) / len(together)
        radius = 0.0 if len(together) == 1 else 9.0
        x, y = place(point.x, point.y)
        shift = (radius * cos(angle), radius * sin(angle))
        parts.append(_point(point, (x + shift[0], y + shift[1]), shift, place))
    return _svg(height, title, parts, width=left + size + 44)


def _point(
    point: Point,
    at: tuple[float, float],
    shift: tuple[float, float],
    place: Callable[[float, float], tuple[float, float]],
) -> Markup:
    """A mark with its label, intervals through it."""
    ends = [(place(value, point.y)[0] + shift[0], at[1]) for value in point.x_interval]
    ends += [(at[0], place(point.x, value)[1] + shift[1]) for value in point.y_interval]
    style = f'interval thin {point.style}'
    return element(
        'g',
        element('title', f'{point.title}: {point.x:.2f}, {point.y:.2f}'),
        _line(ends[0], ends[1], style),
        _line(ends[2], ends[3], style),
        element('circle', cx=at[0], cy=at[1], r=4.5, class_=f'mark {point.style}'),
        _text(point.label, at[0] + 6, at[1] - 6, 'label'),
    )


def _svg(height: float, title: str, parts: Sequence[Markup], width: float = _WIDTH) -> Markup:
    box = f'0 0 {width:g} {height:g}'
    return element(
        'svg', element('title', title), *parts, viewBox=box, role='img', class_='chart',
        style=f'max-width:{width * 1.2:.0f}px',
    )  # fmt: skip


def _text(text: str, x: float, y: float, style: str, anchor: str = 'start') -> Markup:
    return element('text', text, x=x, y=y, class_=style, text_anchor=anchor)


def _line(start: tuple[float, float], end: tuple[float, float], style: str) -> Markup:
    return element('line', x1=start[0], y1=start[1], x2=end[0], y2=end[1], class_=style)
