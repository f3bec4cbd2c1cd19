"""The page's headline and horizon: what is imagined against what knows nothing, as charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan
from typing import Any, NamedTuple

from markupsafe import Markup
import numpy as np

from mtv_world_ros.lab.documents import DASH, number, Table, with_interval
from mtv_world_ros.lab.evaluation.metrics.horizon import curve
from mtv_world_ros.lab.evaluation.metrics.picture_scores import Following
from mtv_world_ros.lab.evaluation.metrics.statistics import mean_interval, MIN_EPISODES
from mtv_world_ros.lab.evaluation.report.charts import ChartLine, Dot, dot_chart, line_chart
from mtv_world_ros.lab.evaluation.report.read_back import Evaluated, ranked_by, scores

#: what is imagined, held and shuffled: (of objects that move, of all objects)
_KEYS = (
    ('j_moving', 'j_copy_moving', 'j_shuffled_moving'),
    ('j_object_mean', 'j_copy_mean', 'j_shuffled_mean'),
)
#: shown where they were measured
_MORE = {
    'j_zero_moving': 'joints held',
    'j_ceiling_moving': 'round trip',
    'j_self_moving': 'recorded',
}
_MEANINGS = {
    'j_zero_moving': 'Joints held: imagined with joints that stay where they are.',
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
#: line styles: of matplotlib, and of the key's SVG
_DASHES = {'': ('-', 'none'), 'held': (':', '2 4'), 'shuffled': ('--', '6 4')}


class Mark(NamedTuple):
    """How the page calls one of several evaluations: A, B, ... Z, A2, ..., in its colour."""

    letter: str
    colour: str


def mark(index: int, evaluations: Sequence[Evaluated]) -> Mark | None:
    """Returns an evaluation's letter and colour; None where there is only one."""
    return None if len(evaluations) == 1 else Mark(letter(index), hue(index))


def letter(index: int) -> str:
    """Returns the letter of an evaluation."""
    return chr(ord('A') + index % 26) + (str(index // 26 + 1) if index >= 26 else '')


def hue(index: int) -> str:
    """Returns the variable of the style sheet that holds an evaluation's colour."""
    return f'c{index % _NUM_HUES}'


def cell(numbers: Mapping[str, Any], key: str) -> str:
    """Returns a number of metrics.json with its interval."""
    return with_interval(numbers.get(key), interval(numbers, key))


def interval(numbers: Mapping[str, Any], key: str) -> tuple[float, float]:
    """Returns the interval of a number of metrics.json, NaN where there is none."""
    low, high = numbers.get('intervals', {}).get(key) or (None, None)
    return (nan, nan) if low is None or high is None else (low, high)


def all_views(evaluations: Sequence[Evaluated]) -> list[str]:
    """Returns the names of all views, in the order in which they come first."""
    return list(dict.fromkeys(view for found in evaluations for view in found.views))


def headline(evaluations: Sequence[Evaluated]) -> dict[str, Any]:
    """Returns J per view with intervals, and whether it beats what knows nothing."""
    keys, words = _keys(evaluations)
    overall = [found.metrics['overall'] for found in evaluations]
    return {
        'words': words,
        'follows': [
            (mark(index, evaluations), Following(**found.metrics['follows_commands']).line)
            for index, found in enumerate(evaluations)
            if 'follows_commands' in found.metrics
        ],
        'verdicts': [
            (mark(index, evaluations), _doubts(found), _few(found))
            for index, found in enumerate(evaluations)
        ],
        'meanings': [
            text
            for key, text in _MEANINGS.items()
            if any(numbers.get(key) is not None for numbers in overall)
        ],
        'panels': [(v, _dots(evaluations, v, keys)) for v in all_views(evaluations)],
    }


def compared(evaluations: Sequence[Evaluated]) -> list[tuple[Mark | None, str, bool]]:
    """Returns how each further evaluation does against the first on the episodes of both.

    Mark, sentence, and whether the interval of the difference leaves out 0. Differences are
    paired within the episodes.
    """
    _, key, _ = ranked_by(evaluations)
    words = 'J of ' + _keys(evaluations)[1]
    first, *others = (scores(found, key) for found in evaluations)
    sentences = []
    for index, other in enumerate(others, start=1):
        names = sorted(set(first) & set(other))
        gained = np.array([[other[name] - first[name]] for name in names]).reshape(-1, 1)
        mean, ends = mean_interval(gained, np.ones_like(gained), low=-1, high=1)
        low, high = float(ends[0, 0]), float(ends[1, 0])
        text = (
            f'{letter(index)} - {letter(0)}, {words}: {with_interval(mean[0], (low, high))} over '
            f'{len(names)} episodes of both; '
        )
        verdict = 'better' if low > 0 else 'worse' if high < 0 else ''
        text += (
            f'{letter(index)} is {verdict}.'
            if verdict
            else 'these episodes do not tell them apart.'
        )
        sentences.append((mark(index, evaluations), text, bool(verdict)))
    return sentences


def _keys(evaluations: Sequence[Evaluated]) -> tuple[tuple[str, str, str], str]:
    moving, every = _KEYS
    measured = any(found.metrics['overall'].get(moving[0]) is not None for found in evaluations)
    return (moving, 'objects that really move') if measured else (every, 'objects')


def _doubts(found: Evaluated) -> list[str]:
    """What keeps the margins from being shown in every view."""
    return [
        doubt
        for view, numbers in found.metrics['views'].items()
        for key, words in _MARGINS.items()
        if (doubt := _doubt(numbers, key, f'{view}: margin over {words}'))
    ]


def _few(found: Evaluated) -> str:
    """Why nothing can be told at all, in words; empty = it can."""
    count = int(found.metrics['num_episodes'])
    if count >= MIN_EPISODES:
        return ''
    return f'Cannot tell from {count} episode{"s" * (count > 1)}: give at least {MIN_EPISODES}.'


def _doubt(numbers: Mapping[str, Any], key: str, words: str) -> str:
    """What keeps a margin from being shown; empty = nothing."""
    if number(numbers.get(key)) == DASH:
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
        colour='held' if key in _MORE else _colour(index, evaluations, word),
        is_filled=word != 'shuffled',
    )


def horizon(evaluations: Sequence[Evaluated]) -> dict[str, Any] | None:
    """Returns J against how far ahead was imagined; None if no object moves anywhere."""
    panels = []
    for view in all_views(evaluations):
        lines = [line for i in range(len(evaluations)) for line in _lines(i, evaluations, view)]
        if lines:
            seconds = _seconds(evaluations, max(len(line.values) for line in lines))
            title = f'J against time, view {view}'
            panels.append((view, line_chart(title, lines, seconds, 'J of moving objects')))
    if not panels:
        return None
    return {'panels': panels, 'key': _key(evaluations), 'chunks': _by_chunk(evaluations)}


def _key(evaluations: Sequence[Evaluated]) -> list[tuple[str, str, str]]:
    """What the lines mean: words, colour, dashes."""
    return [
        (_line_name(index, evaluations, word), _colour(index, evaluations, word), dashes)
        for index in range(len(evaluations))
        for word, (_, dashes) in _DASHES.items()
    ]


def _line_name(index: int, evaluations: Sequence[Evaluated], word: str) -> str:
    prefix = '' if len(evaluations) == 1 else f'{letter(index)} '
    return f'{prefix}{word or "imagined"}'


def _by_chunk(evaluations: Sequence[Evaluated]) -> Table | None:
    """How J falls from chunk to chunk; None where no rollout has two."""
    rows = []
    for index, found in enumerate(evaluations):
        for view, numbers in {**found.metrics['views'], 'all': found.metrics['overall']}.items():
            values = numbers.get('j_moving_by_chunk') or []
            around = numbers['j_moving_by_chunk_interval'] if values else []
            cells = list(map(with_interval, values, around))
            if cells:
                rows.append([letter(index) if len(evaluations) > 1 else '', view, *cells])
    if not rows:
        return None
    longest = max(map(len, rows))
    head = ['', 'View', *(f'Chunk {k + 1}' for k in range(longest - 2))]
    padded = [[*row, *[DASH] * (longest - len(row))] for row in rows]
    return Table(head=head, rows=padded, num_labels=2, caption='J of objects that move, by chunk')


def _seconds(evaluations: Sequence[Evaluated], count: int) -> list[float]:
    """Times of the frames [s]; all evaluations on the first one's clock."""
    return [(k + 1) / evaluations[0].metrics['model']['fps'] for k in range(count)]


def _lines(index: int, evaluations: Sequence[Evaluated], view: str) -> list[ChartLine]:
    found = evaluations[index]
    rows = [result.rows for result in found.results.values()]
    clock = evaluations[0].metrics['model']['fps'] / found.metrics['model']['fps']
    lines = []
    for field, word in _FIELDS.items():
        drawn = curve(rows, view, field)
        if not drawn.values:
            continue
        label = _line_name(index, evaluations, word)
        values = _on_clock(drawn.values, clock)
        with_band = len(evaluations) == 1 or not word
        band = _on_clock(drawn.band, clock) if with_band else ()
        lines.append(
            ChartLine(
                label=label,
                values=values,
                band=band,
                colour=_colour(index, evaluations, word),
                dashes=_DASHES[word][0],
            )
        )
    return lines


def _on_clock(values: Sequence[Any], clock: float) -> list[Any]:
    """Every frame's value at the frames of a clock that is `clock` times as fast."""
    count = max(int(len(values) * clock + 1e-6), 1)
    return [values[min(max(round((k + 1) / clock) - 1, 0), len(values) - 1)] for k in range(count)]


def _colour(index: int, evaluations: Sequence[Evaluated], word: str) -> str:
    if word == 'held' or (word == 'shuffled' and len(evaluations) == 1):
        return word
    return hue(index)
