"""Charts as inline SVG; their colours are those of the page's style sheet, light or dark."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from io import StringIO
from math import isfinite
import re
from typing import Any

from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
import numpy as np

from mtv_world_ros.evaluation.metrics.success_agreement import Bin

#: variables of the style sheet, each drawn in a colour that stands for it and then replaced
_VARIABLES = ('ink', 'faint', 'rule', 'card', 'held', 'shuffled', *(f'c{k}' for k in range(6)))
_COLOURS = {name: f'#0000{index + 16:02x}' for index, name in enumerate(_VARIABLES)}
_STYLE: Any = {
    'svg.fonttype': 'none',
    'svg.hashsalt': 'mtv_world_ros',
    'font.sans-serif': ['DejaVu Sans'],
    'font.size': 9,
    'text.color': _COLOURS['ink'],
    'axes.edgecolor': _COLOURS['rule'],
    'axes.labelcolor': _COLOURS['faint'],
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.axisbelow': True,
    'grid.color': _COLOURS['rule'],
    'grid.linewidth': 0.8,
    'xtick.color': _COLOURS['faint'],
    'ytick.color': _COLOURS['faint'],
    'xtick.major.size': 0,
    'ytick.major.size': 0,
}
_TICKS = (0.0, 0.25, 0.5, 0.75, 1.0)
_WIDTH = 440


@dataclass(frozen=True, slots=True, kw_only=True)
class Dot:
    """A value with its interval; NaN = not measured.

    Attributes:
        label: label on the left.
        value: value in [0, 1].
        interval: 95 % interval (low, high).
        colour: variable of the style sheet.
        is_filled: whether the dot is drawn full, not as a ring.
    """

    label: str
    value: float
    interval: tuple[float, float]
    colour: str
    is_filled: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class ChartLine:
    """Values over time, with a band around them where it is known.

    Attributes:
        label: shown where the mouse is, and for those who cannot see it.
        values: values in [0, 1], one per frame; NaN leaves a gap.
        band: (low, high) per frame; empty = none.
        colour: variable of the style sheet.
        dashes: matplotlib's line style.
    """

    label: str
    values: Sequence[float]
    band: Sequence[tuple[float, float]] = ()
    colour: str
    dashes: str = '-'


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """Two values in [0, 1] of one thing with their intervals (low, high); NaN = not known.

    Attributes:
        label: short text next to the mark.
        title: tooltip, also read by screen readers.
        colour: variable of the style sheet.
    """

    label: str
    title: str
    x: float
    y: float
    x_interval: tuple[float, float]
    y_interval: tuple[float, float]
    colour: str


def dot_chart(title: str, dots: Sequence[Dot]) -> Markup:
    """Return values in [0, 1] with their intervals, one below the other."""
    height = 26 * len(dots) + 30
    with _axes(_WIDTH, height, left=92, right=142, top=4, bottom=26) as axes:
        axes.set(xlim=(0, 1), ylim=(len(dots) - 0.5, -0.5), xticks=_TICKS)
        axes.set_yticks(range(len(dots)), [dot.label for dot in dots])
        axes.tick_params(axis='y', pad=88, labelcolor=_COLOURS['ink'])
        for label in axes.get_yticklabels():
            label.set_horizontalalignment('left')
        axes.grid(axis='x')
        axes.spines[['left', 'bottom']].set_visible(False)
        for row, dot in enumerate(dots):
            _draw_dot(axes, row, dot)
        return _svg(axes, title, _WIDTH, height, {})


def _draw_dot(axes: Axes, row: int, dot: Dot) -> None:
    text = 'not measured'
    if isfinite(dot.value):
        text, colour = f'{dot.value:.3f}', _COLOURS[dot.colour]
        low, high = dot.interval
        if isfinite(low) and isfinite(high):
            text = f'{text} [{low:.3f}, {high:.3f}]'
            axes.plot([low, high], [row, row], '|-', color=colour, markersize=7, lw=1.8)
        fill = colour if dot.is_filled else _COLOURS['card']
        axes.plot(
            dot.value, row, 'o', color=colour, markerfacecolor=fill, clip_on=False,
            gid=f'dot-{row}', markersize=7,
        )  # fmt: skip
    place = axes.get_yaxis_transform()
    axes.text(1.45, row, text, transform=place, ha='right', va='center')


def line_chart(
    title: str, lines: Sequence[ChartLine], seconds: Sequence[float], y_label: str
) -> Markup:
    """Return values in [0, 1] over time, the last line on top.

    Args:
        title: description of the chart for readers who cannot see it.
        lines: the curves.
        seconds: time of each frame [s].
        y_label: name and unit of the values.
    """
    height = 262
    with _axes(_WIDTH, height, left=34, right=8, top=22, bottom=40) as axes:
        axes.set(xlim=(0, max(seconds, default=1.0)), ylim=(0, 1), yticks=_TICKS)
        axes.grid(axis='y')
        axes.set_title(y_label, loc='left', fontsize=9, color=_COLOURS['faint'], x=-0.08, pad=9)
        axes.set_xlabel('seconds imagined ahead', loc='right')
        for index, line in enumerate(lines):
            colour, times = _COLOURS[line.colour], seconds[: len(line.values)]
            if len(line.band):
                low, high = np.array(line.band, np.float64).T
                axes.fill_between(times, low, high, color=colour, alpha=0.14, lw=0)
            axes.plot(
                times, line.values, line.dashes, color=colour, lw=1.9, clip_on=False,
                gid=f'line-{index}', marker='o' if len(times) == 1 else '',
            )  # fmt: skip
        titles = {f'line-{index}': line.label for index, line in enumerate(lines)}
        return _svg(axes, title, _WIDTH, height, titles)


def reliability_chart(title: str, bins: Sequence[Bin], colour: str) -> Markup:
    """Return how often estimates came true; calibrated ones lie on the diagonal."""
    width, height, drawn = 290, 300, _COLOURS[colour]
    with _axes(width, height, left=40, right=10, top=22, bottom=60) as axes:
        _square(axes, 'estimated probability of success', 'share that really succeeded')
        axes.xaxis.labelpad = 20
        for index, found in enumerate(bins):
            x = found.estimate
            axes.plot([x, x], found.interval, '_-', color=drawn, clip_on=False)
            axes.plot(x, found.came_true, 'o', color=drawn, clip_on=False, gid=f'bin-{index}')
            place = axes.get_xaxis_transform()
            axes.text(
                found.middle, -0.14, f'n={found.count}', transform=place, ha='center',
                color=_COLOURS['faint'], fontsize=8,
            )  # fmt: skip
        titles = {
            f'bin-{index}': f'said {found.estimate:.2f}, came true {found.came_true:.2f}'
            for index, found in enumerate(bins)
        }
        return _svg(axes, title, width, height, titles)


def scatter_chart(title: str, points: Sequence[Point], x_label: str, y_label: str) -> Markup:
    """Return values against values, both in [0, 1], with intervals; equal ones on the diagonal.

    Points at the same place are one mark with all their labels.
    """
    width, height = 380, 390
    together: dict[tuple[float, float], list[Point]] = {}
    for point in points:
        if isfinite(point.x) and isfinite(point.y):
            together.setdefault((point.x, point.y), []).append(point)
    titles = {}
    with _axes(width, height, left=40, right=24, top=22, bottom=44) as axes:
        _square(axes, x_label, y_label)
        for index, ((x, y), found) in enumerate(together.items()):
            colour = _COLOURS[found[0].colour]
            for point in found:
                thin = {'color': _COLOURS[point.colour], 'lw': 0.9, 'alpha': 0.5}
                axes.plot(point.x_interval, [y, y], **thin)
                axes.plot([x, x], point.y_interval, **thin)
            axes.plot(x, y, 'o', color=colour, clip_on=False, gid=f'point-{index}', markersize=6)
            axes.annotate(
                ', '.join(point.label for point in found), (x, y), (5, 5), annotation_clip=False,
                textcoords='offset points', fontsize=8,
            )  # fmt: skip
            names = ', '.join(point.title for point in found)
            titles[f'point-{index}'] = f'{names}: {x:.2f}, {y:.2f}'
        return _svg(axes, title, width, height, titles)


def _square(axes: Axes, x_label: str, y_label: str) -> None:
    """Draw both axes from 0 to 1, with the diagonal on which both are equal."""
    axes.set(xlim=(0, 1), ylim=(0, 1), xticks=_TICKS, yticks=_TICKS)
    axes.grid()
    axes.plot([0, 1], [0, 1], ':', color=_COLOURS['faint'], lw=1.2)
    axes.set_title(y_label, loc='left', fontsize=9, color=_COLOURS['faint'], x=-0.1, pad=9)
    axes.set_xlabel(x_label, loc='right')


@contextmanager
def _axes(
    width: int, height: int, *, left: int, right: int, top: int, bottom: int
) -> Iterator[Axes]:
    """Yield the axes with margins in pixels, drawn in the page's style within the context."""
    with rc_context(_STYLE):
        figure = Figure(figsize=(width / 72, height / 72))
        FigureCanvasSVG(figure)
        yield figure.add_axes(
            (
                left / width,
                bottom / height,
                1 - (left + right) / width,
                1 - (top + bottom) / height,
            )
        )


def _svg(axes: Axes, title: str, width: int, height: int, titles: Mapping[str, str]) -> Markup:
    """Return the figure of the axes as an element that names what is at `titles`' ids."""
    stream = StringIO()
    figure = axes.get_figure(root=True)
    assert figure is not None
    metadata = dict.fromkeys(('Creator', 'Date', 'Format', 'Type'))
    figure.savefig(stream, format='svg', transparent=True, metadata=metadata)
    drawn = stream.getvalue()
    body = drawn[drawn.index('>', drawn.index('<svg')) + 1 :]
    body = re.sub(r'<metadata>.*?</metadata>|<style.*?</style>', '', body, flags=re.DOTALL)
    body = body.replace('xlink:href', 'href').replace(
        " font-family: 'DejaVu Sans', sans-serif;", ''
    )
    body = re.sub(r'\s*\n\s*', ' ', body)
    for name, text in titles.items():
        body = body.replace(f'<g id="{name}">', f'<g id="{name}"><title>{escape(text)}</title>', 1)
    # ids would occur once a chart; those of clip paths and marks tell what they are
    body = re.sub(r' id="([a-z]+)-\d+"', r' class="\1"', body)
    body = re.sub(r' id="(?![pm][0-9a-f]{10}")[^"]*"', '', body)
    for name, colour in _COLOURS.items():
        body = body.replace(colour, f'var(--{name})')
    return Markup(
        f'<svg viewBox="0 0 {width} {height}" role="img" class="chart" '
        f'style="max-width:{width * 1.2:.0f}px"><title>{escape(title)}</title>{body}'
    )
