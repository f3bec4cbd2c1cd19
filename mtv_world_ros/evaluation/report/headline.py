"""The report's headline and horizon, and how it writes numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite, nan
from typing import Any

from mtv_world_ros.evaluation.metrics.horizon import curve
from mtv_world_ros.evaluation.metrics.statistics import METHOD, MIN_EPISODES
from mtv_world_ros.evaluation.report.charts import Dot, dot_chart, Line, line_chart
from mtv_world_ros.evaluation.report.markup import element, join, Markup, table
from mtv_world_ros.evaluation.report.read_back import Evaluated

#: what is imagined, held and shuffled: (of objects that move, of all objects)
_KEYS = (
    ('j_moving', 'j_copy_moving', 'j_shuffled_moving'),
    ('j_object_mean', 'j_copy_mean', 'j_shuffled_mean'),
)
#: shown where they were measured
_MORE = {
    'j_zero_moving': 'joints held',
    'j_mirrored_moving': 'mirrored',
    'j_ceiling_moving': 'round trip',
    'j_self_moving': 'recorded',
}
_MEANINGS = {
    'j_zero_moving': 'Joints held: imagined with joints that stay where they are.',
    'j_mirrored_moving': "Mirrored: imagined with the arms' actions mirrored.",
    'j_ceiling_moving': 'Round trip: recorded frames through the autoencoder.',
    'j_self_moving': 'Recorded: the recorded frames themselves, the ceiling of the segmenter.',
}
_MARGINS = {
    'margin_moving': 'the first frame held',
    'margin_over_shuffled': "another episode's actions",
}
_FIELDS = {
    'j_shuffled_frames': 'shuffled',
    'j_copy_frames': 'held',
    'j_frames': '',
}
_NUM_HUES = 6


def number(value: float | None, digits: int = 3) -> str:
    """Returns a number as text; a dash where there is none."""
    return '–' if value is None or not isfinite(value) else f'{value:.{digits}f}'


def with_interval(numbers: Mapping[str, Any], key: str) -> str:
    """Returns a number of metrics.json with its interval."""
    low, high = interval(numbers, key)
    text = number(numbers.get(key))
    return f'{text} [{low:.3f}, {high:.3f}]' if isfinite(low) and text != '–' else text


def stacked(numbers: Mapping[str, Any], key: str) -> str:
    """Returns the same with the interval below the number."""
    text, bracket, rest = with_interval(numbers, key).partition(' [')
    return join([text, element('small', f'[{rest}')]) if bracket else text


def interval(numbers: Mapping[str, Any], key: str) -> tuple[float, float]:
    """Returns the interval of a number of metrics.json, NaN where there is none."""
    low, high = numbers.get('intervals', {}).get(key) or (None, None)
    return (nan, nan) if low is None or high is None else (low, high)


def letter(index: int) -> str:
    """Returns how the report calls an evaluation: A, B, ... Z, A2, ..."""
    return chr(ord('A') + index % 26) + (str(index // 26 + 1) if index >= 26 else '')


def hue(index: int) -> str:
    """Returns the class of an evaluation's colour."""
    return f'c{index % _NUM_HUES}'


def badge(index: int, evaluations: Sequence[Evaluated]) -> Markup | None:
    """Returns an evaluation's letter in its colour; None where there is only one."""
    if len(evaluations) == 1:
        return None
    return element('span', letter(index), class_=f'badge {hue(index)}')


def all_views(evaluations: Sequence[Evaluated]) -> list[str]:
    """Returns the names of all views, in the order in which they come first."""
    return list(dict.fromkeys(view for found in evaluations for view in found.views))


def headline(evaluations: Sequence[Evaluated]) -> Markup:
    """Returns J per view with intervals, against what knows nothing."""
    keys, words = _keys(evaluations)
    panels = [
        element('figure', element('h3', f'View {view}'), _dots(evaluations, view, keys))
        for view in all_views(evaluations)
    ]
    return element(
        'section',
        element('h2', 'Does it beat knowing nothing?'),
        *(_verdict(index, evaluations) for index in range(len(evaluations))),
        element(
            'p',
            f'Jaccard index J of the {words}, 1 = the masks agree in every pixel. Held: the '
            "first frame stands still. Shuffled: imagined with another episode's actions. "
            + ' '.join([*_meanings(evaluations), f'Whiskers: {METHOD}.']),
            class_='faint',
        ),
        element('div', *panels, class_='panels'),
        id='headline',
    )


def _keys(evaluations: Sequence[Evaluated]) -> tuple[tuple[str, str, str], str]:
    moving, every = _KEYS
    measured = any(found.metrics['overall'].get(moving[0]) is not None for found in evaluations)
    return (moving, 'objects that really move') if measured else (every, 'objects')


def _meanings(evaluations: Sequence[Evaluated]) -> list[str]:
    overall = [found.metrics['overall'] for found in evaluations]
    return [
        words
        for key, words in _MEANINGS.items()
        if any(numbers.get(key) is not None for numbers in overall)
    ]


def _verdict(index: int, evaluations: Sequence[Evaluated]) -> Markup:
    doubts = [
        doubt
        for view, numbers in evaluations[index].metrics['views'].items()
        for key, words in _MARGINS.items()
        if (doubt := _doubt(numbers, key, f'{view}: margin over {words}'))
    ]
    text = (
        f'Not shown in every view ({"; ".join(doubts)}).'
        if doubts
        else 'Yes: in every view the intervals of the margins over the held frame and over '
        'shuffled actions lie above 0.'
    )
    style = 'verdict doubt' if doubts else 'verdict'
    return element('p', badge(index, evaluations), text, class_=style)


def _doubt(numbers: Mapping[str, Any], key: str, words: str) -> str:
    """What keeps a margin from being shown; empty = nothing."""
    if number(numbers.get(key)) == '–':
        return f'{words} not measured'
    count = numbers['num_episodes_with'][key]
    if count < MIN_EPISODES:
        return f'{words} of too few episodes ({count})'
    return '' if interval(numbers, key)[0] > 0 else f'{words} not above 0'


def _dots(evaluations: Sequence[Evaluated], view: str, keys: tuple[str, str, str]) -> Markup:
    """All evaluations' dots of one kind below each other, so that they are compared."""
    words = {**dict(zip(keys, ('', 'held', 'shuffled'), strict=True)), **_MORE}
    dots = [
        dot
        for key, word in words.items()
        for index in range(len(evaluations))
        if (dot := _dot(index, evaluations, view, key, word)) is not None
    ]
    return dot_chart(f'J in view {view}', dots)


def _dot(
    index: int, evaluations: Sequence[Evaluated], view: str, key: str, word: str
) -> Dot | None:
    numbers = evaluations[index].metrics['views'].get(view)
    if numbers is None or (key in _MORE and numbers.get(key) is None):
        return None
    prefix = '' if len(evaluations) == 1 else f'{letter(index)} '
    return Dot(
        label=f'{prefix}{word or "imagined"}',
        value=nan if numbers.get(key) is None else numbers[key],
        interval=interval(numbers, key),
        style='held' if key in _MORE else _style(index, evaluations, word),
    )


def horizon_section(evaluations: Sequence[Evaluated]) -> Markup | None:
    """Returns J against how far ahead was imagined; None if no object moves anywhere."""
    panels = []
    for view in all_views(evaluations):
        lines = [line for i in range(len(evaluations)) for line in _lines(i, evaluations, view)]
        if lines:
            seconds = _seconds(evaluations, max(len(line.values) for line in lines))
            chart = line_chart(
                f'J against time, view {view}', lines, seconds, 'J of moving objects'
            )
            panels.append(element('figure', element('h3', f'View {view}'), chart))
    if not panels:
        return None
    return element(
        'section',
        element('h2', 'J against horizon'),
        element(
            'p',
            'Objects that really move. Bands: 95 % t intervals over episodes. Frames that fewer '
            'than a third of the rollouts reach are left out.',
            class_='faint',
        ),
        _key(evaluations),
        element('div', *panels, class_='panels'),
        _by_chunk(evaluations),
        id='horizon',
    )


def _by_chunk(evaluations: Sequence[Evaluated]) -> Markup | None:
    """How J falls from chunk to chunk; None where no rollout has two."""
    rows = []
    for index, found in enumerate(evaluations):
        for view, numbers in {**found.metrics['views'], 'all': found.metrics['overall']}.items():
            values = numbers.get('j_moving_by_chunk') or []
            cells = [
                stacked({'j': value, 'intervals': {'j': around}}, 'j')
                for value, around in zip(
                    values, numbers['j_moving_by_chunk_interval'] if values else [], strict=True
                )
            ]
            if cells:
                rows.append([letter(index) if len(evaluations) > 1 else '', view, *cells])
    if not rows:
        return None
    longest = max(map(len, rows))
    head = ['', 'View', *(f'Chunk {k + 1}' for k in range(longest - 2))]
    padded = [[*row, *['–'] * (longest - len(row))] for row in rows]
    return table(head, padded, num_labels=2, caption='J of objects that move, by chunk')


def _seconds(evaluations: Sequence[Evaluated], count: int) -> list[float]:
    """Times of the frames [s]; all evaluations on the first one's clock."""
    return [(k + 1) / evaluations[0].metrics['model']['fps'] for k in range(count)]


def _lines(index: int, evaluations: Sequence[Evaluated], view: str) -> list[Line]:
    found = evaluations[index]
    rows = [result.rows for result in found.results.values()]
    clock = evaluations[0].metrics['model']['fps'] / found.metrics['model']['fps']
    lines = []
    for field, word in _FIELDS.items():
        drawn = curve(rows, view, field)
        if not drawn.values:
            continue
        style = _style(index, evaluations, word)
        label = f'{letter(index)} {word or "imagined"}'
        values = _on_clock(drawn.values, clock)
        with_band = len(evaluations) == 1 or not word
        band = _on_clock(drawn.band, clock) if with_band else ()
        lines.append(Line(label=label, values=values, band=band, style=style))
    return lines


def _on_clock(values: Sequence[Any], clock: float) -> list[Any]:
    """Every frame's value at the frames of a clock that is `clock` times as fast."""
    count = max(int(len(values) * clock + 1e-6), 1)
    return [values[min(max(round((k + 1) / clock) - 1, 0), len(values) - 1)] for k in range(count)]


def _style(index: int, evaluations: Sequence[Evaluated], word: str) -> str:
    if word == 'held':
        return 'held'
    if word == 'shuffled':
        return 'alone shuffled' if len(evaluations) == 1 else f'{hue(index)} shuffled'
    return hue(index)


def _key(evaluations: Sequence[Evaluated]) -> Markup:
    """What the lines mean."""
    items = []
    for index in range(len(evaluations)):
        prefix = '' if len(evaluations) == 1 else f'{letter(index)} '
        for word in ('', 'held', 'shuffled'):
            stroke = element(
                'line', x1=1, y1=6, x2=25, y2=6, class_=f'line {_style(index, evaluations, word)}'
            )
            drawn = element('svg', stroke, viewBox='0 0 26 12', aria_hidden='true')
            items.append(element('li', drawn, f'{prefix}{word or "imagined"}'))
    return element('ul', *items, class_='key')
