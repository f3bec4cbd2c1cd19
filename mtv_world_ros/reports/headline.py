"""The page's headline and horizon: what is imagined against what knows nothing, as charts."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any, NamedTuple

from markupsafe import Markup
import numpy as np

from mtv_world_ros.core.documents import with_interval
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary, NOT_MEASURED
from mtv_world_ros.evaluation.metrics.horizon import horizon_curve
from mtv_world_ros.evaluation.metrics.statistics import Estimate, mean_interval, MIN_EPISODES
from mtv_world_ros.evaluation.tables import chunk_table
from mtv_world_ros.reports.charts import ChartLine, Dot, dot_chart, line_chart
from mtv_world_ros.reports.comparison import all_views
from mtv_world_ros.reports.read_back import ranked_by, scores

#: keys of J of the imagined, held and shuffled video: (moving objects, all objects)
_KEYS = (
    ('j_moving', 'j_copy_moving', 'j_shuffled_moving'),
    ('j_object_mean', 'j_copy_mean', 'j_shuffled_mean'),
)
#: additional rows, shown if they were measured
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


class Marked(NamedTuple):
    """An evaluation of a page, and how the page calls it.

    Attributes:
        found: the evaluation.
        letter: A, B, ... Z, A2, ...; empty where there is only one.
        colour: variable of the style sheet that holds its colour.
    """

    found: EvaluationSummary
    letter: str
    colour: str

    def name(self, words: str = '') -> str:
        """Return words, after the letter where there is one."""
        return f'{self.letter} {words}'.strip()

    @property
    def title(self) -> str:
        """The checkpoint, after the letter where there is one."""
        return ' · '.join(filter(None, (self.letter, self.found.title)))


def marked(evaluations: Sequence[EvaluationSummary]) -> list[Marked]:
    """Return evaluations with their letters and colours."""
    return [
        Marked(found, letter(index) if len(evaluations) > 1 else '', f'c{index % _NUM_HUES}')
        for index, found in enumerate(evaluations)
    ]


def letter(index: int) -> str:
    """Return the letter of an evaluation."""
    return chr(ord('A') + index % 26) + (str(index // 26 + 1) if index >= 26 else '')


def views_of(evaluations: Sequence[Marked]) -> list[str]:
    """Return the names of all views, in the order in which they come first."""
    return all_views([one.found for one in evaluations])


def headline(evaluations: Sequence[Marked]) -> dict[str, Any]:
    """Return J per view with intervals, and its margins over the baselines."""
    keys, words = _keys(evaluations)
    overall = [one.found.estimates(None) for one in evaluations]
    return {
        'words': words,
        'follows': [(one, one.found.following.line) for one in evaluations],
        'verdicts': [(one, _doubts(one.found), _few(one.found)) for one in evaluations],
        'meanings': [
            text
            for key, text in _MEANINGS.items()
            if any(isfinite(numbers[key].value) for numbers in overall)
        ],
        'panels': [(view, _dots(evaluations, view, keys)) for view in views_of(evaluations)],
    }


def compared(evaluations: Sequence[Marked]) -> list[tuple[Marked, str, bool]]:
    """Return how each further evaluation does against the first on the episodes of both.

    The evaluation, a sentence, and whether the interval of the difference leaves out 0.
    Differences are paired within the episodes.
    """
    key = ranked_by([one.found for one in evaluations])[1]
    words = 'J of ' + _keys(evaluations)[1]
    (base, first), *others = ((one, scores(one.found, key)) for one in evaluations)
    sentences = []
    for one, other in others:
        names = sorted(set(first) & set(other))
        gained = np.array([[other[name] - first[name]] for name in names]).reshape(-1, 1)
        mean, ends = mean_interval(gained, np.ones_like(gained), low=-1, high=1)
        low, high = float(ends[0, 0]), float(ends[1, 0])
        verdict = 'better' if low > 0 else 'worse' if high < 0 else ''
        ends_with = (
            f'{one.letter} is {verdict}.' if verdict else 'these episodes do not tell them apart.'
        )
        text = (
            f'{one.letter} - {base.letter}, {words}: {with_interval(mean[0], (low, high))} over '
            f'{len(names)} episodes of both; {ends_with}'
        )
        sentences.append((one, text, bool(verdict)))
    return sentences


def _keys(evaluations: Sequence[Marked]) -> tuple[tuple[str, str, str], str]:
    moving, every = _KEYS
    measured = any(isfinite(one.found.estimates(None)[moving[0]].value) for one in evaluations)
    return (moving, 'objects that really move') if measured else (every, 'objects')


def _doubts(found: EvaluationSummary) -> list[str]:
    """Return the reasons why margins are not shown in every view."""
    return [
        doubt
        for view in found.spec.views
        for numbers in [found.estimates(view)]
        for key, words in _MARGINS.items()
        if (doubt := _doubt(numbers[key], f'{view}: margin over {words}'))
    ]


def _few(found: EvaluationSummary) -> str:
    """Return the reason why episodes are too few for a verdict; empty if they suffice."""
    count = len(found.results)
    if count >= MIN_EPISODES:
        return ''
    return f'Cannot tell from {count} episode{"s" * (count > 1)}: give at least {MIN_EPISODES}.'


def _doubt(margin: Estimate, words: str) -> str:
    """Return the reason why a margin is not shown; empty if it is shown."""
    if not isfinite(margin.value):
        return f'{words} not measured'
    if margin.num_episodes < MIN_EPISODES:
        return f'{words} of too few episodes ({margin.num_episodes})'
    return '' if margin.interval[0] > 0 else f'{words} not above 0'


def _dots(evaluations: Sequence[Marked], view: str, keys: tuple[str, str, str]) -> Markup:
    """Return all evaluations' dots of one kind below each other, so that they are compared."""
    words = {**dict(zip(keys, ('', 'held', 'shuffled'), strict=True)), **_MORE}
    shown = [
        (one, one.found.estimates(view)) for one in evaluations if view in one.found.spec.views
    ]
    dots = [
        Dot(
            label=one.name(word or 'imagined'),
            value=numbers.get(key, NOT_MEASURED).value,
            interval=numbers.get(key, NOT_MEASURED).interval,
            colour='held' if key in _MORE else _colour(one, word),
            is_filled=word != 'shuffled',
        )
        for key, word in words.items()
        for one, numbers in shown
        if key not in _MORE or isfinite(numbers[key].value)
    ]
    return dot_chart(f'J in view {view}', dots)


def horizon(evaluations: Sequence[Marked]) -> dict[str, Any] | None:
    """Return J against how far ahead was imagined; None if no object moves anywhere."""
    fps = evaluations[0].found.spec.fps  # all evaluations are on the first one's clock
    panels = []
    for view in views_of(evaluations):
        lines = [line for one in evaluations for line in _lines(one, view, fps, len(evaluations))]
        if lines:
            seconds = [(k + 1) / fps for k in range(max(len(line.values) for line in lines))]
            title = f'J against time, view {view}'
            panels.append((view, line_chart(title, lines, seconds, 'J of moving objects')))
    if not panels:
        return None
    key = [
        (one.name(word or 'imagined'), _colour(one, word), dashes)
        for one in evaluations
        for word, (_, dashes) in _DASHES.items()
    ]
    chunks = [(one, table) for one in evaluations if (table := chunk_table(one.found))]
    return {'panels': panels, 'key': key, 'chunks': chunks}


def _lines(one: Marked, view: str, fps: float, count: int) -> list[ChartLine]:
    """Return the curves of an evaluation in a view, on a clock.

    All have bands where it is alone.
    """
    rows = [result.rows for result in one.found.results]
    clock = fps / one.found.spec.fps
    lines = []
    for field, word in _FIELDS.items():
        drawn = horizon_curve(rows, view, field)
        if not drawn.values:
            continue
        lines.append(
            ChartLine(
                label=one.name(word or 'imagined'),
                values=_on_clock(drawn.values, clock),
                band=_on_clock(drawn.band, clock) if count == 1 or not word else (),
                colour=_colour(one, word),
                dashes=_DASHES[word][0],
            )
        )
    return lines


def _on_clock(values: Sequence[Any], clock: float) -> list[Any]:
    """Return every frame's value at the frames of a clock that is `clock` times as fast."""
    count = max(int(len(values) * clock + 1e-6), 1)
    return [values[min(max(round((k + 1) / clock) - 1, 0), len(values) - 1)] for k in range(count)]


def _colour(one: Marked, word: str) -> str:
    if word == 'held' or (word == 'shuffled' and not one.letter):
        return word
    return one.colour
