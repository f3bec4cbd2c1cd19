"""Every scored episode as a card of the page: numbers, videos, and what it can be found by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

from markupsafe import Markup
import numpy as np

from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.lab.documents import number
from mtv_world_ros.lab.evaluation.metrics.scores import episode_means
from mtv_world_ros.lab.evaluation.report.filters import Filter, filters
from mtv_world_ros.lab.evaluation.report.headline import all_views, letter, mark
from mtv_world_ros.lab.evaluation.report.read_back import Evaluated, picks, ranked_by
from mtv_world_ros.lab.evaluation.report.rollout_clips import make_clip, RolloutClip
from mtv_world_ros.lab.evaluation.results import EpisodeResult
from mtv_world_ros.success.estimator import verdict
from mtv_world_ros.vision.jaccard import mean_of_known

#: of all embedded videos [bytes]; base64 adds a third
VIDEO_BUDGET = 24_000_000
#: of the best, the median and the worst episode alone
_PICKED_BUDGET = 6_000_000
#: widths up to which small frames are enlarged, of those and of the others [px]
_PICKED_TILE, _TILE = 320, 192
#: episodes with a contact sheet where none can be ranked
_NUM_UNRANKED = 3
_BINS = ('0 to .2', '.2 to .4', '.4 to .6', '.6 to .8', '.8 to 1')
_UNKNOWN = 'not scored'
_ESTIMATES = ('right', 'wrong', 'no verdict')


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """What the cards can be filtered by."""

    task: Filter
    outcome: Filter
    status: Filter
    estimate: Filter
    view: Filter
    score: Filter
    better: Filter


def episode_cards(evaluations: Sequence[Evaluated]) -> dict[str, Any]:
    """Returns the filters and the cards of all episodes, the worst first.

    Ranked by J of the objects that move, where any episode has it, else by J of all objects.
    """
    words, key, means = ranked_by(evaluations)
    titles = {pick.episode: pick.title for pick in picks(evaluations)}
    names = sorted({name for found in evaluations for name in found.results})
    names.sort(key=lambda name: means.get(name, 2.0))
    found = _filters(evaluations)
    num_clips = sum(name in one.results for one in evaluations for name in names)
    picked = set(titles) or set(names[:_NUM_UNRANKED])  # no object was named: no J to pick by
    num_picked = sum(name in one.results for one in evaluations for name in picked)
    budgets = (VIDEO_BUDGET // max(num_clips, 1), _PICKED_BUDGET // max(num_picked, 1))
    cards = []
    for name in names:
        title = titles.get(name, '')
        clips = [
            (mark(index, evaluations), _name(one, evaluations), *clip)
            for index, one in enumerate(evaluations)
            if (clip := _clip(name, one, name in picked, budgets[name in picked])) is not None
        ]
        cards.append(
            {
                'title': title,
                'name': name,
                'score': number(means.get(name)),
                'classes': _classes(name, evaluations, key, found),
                'about': _about(name, evaluations),
                'rows': _rows(name, evaluations, key),
                'clips': clips,
            }
        )
    shown = filters(*(getattr(found, name) for name in found.__slots__))
    return {'words': words, 'cards': cards, 'filters': shown, 'crop': _crop(found.view)}


def _filters(evaluations: Sequence[Evaluated]) -> _Found:
    results = [result for found in evaluations for result in found.results.values()]
    view = Filter(key='view', label='view', options=tuple(all_views(evaluations)))
    statuses = sorted({row.status for result in results for row in result.rows if row.name})
    letters = tuple(letter(index) for index in range(len(evaluations)))
    return _Found(
        task=Filter(key='task', label='task', options=_options(r.task for r in results)),
        outcome=Filter(
            key='outcome', label='recorded outcome', options=_options(r.outcome for r in results)
        ),
        status=Filter(key='status', label='status of an object', options=tuple(statuses)),
        estimate=Filter(key='estimate', label='success estimate', options=_ESTIMATES),
        view=view,
        score=Filter(key='score', label='J', options=(*_BINS, _UNKNOWN), within=view),
        better=Filter(key='better', label='highest J', options=letters),
    )


def _options(values: Any) -> tuple[str, ...]:
    return tuple(sorted({value for value in values if value}))


def _results(name: str, evaluations: Sequence[Evaluated]) -> list[EpisodeResult | None]:
    return [found.results.get(name) for found in evaluations]


def _classes(name: str, evaluations: Sequence[Evaluated], key: str, found: _Found) -> str:
    known = [result for result in _results(name, evaluations) if result is not None]
    statuses = {row.status for result in known for row in result.rows if row.name}
    views = sorted({row.view for result in known for row in result.rows})
    scored = {
        view: [
            np.nan if result is None else episode_means(result.rows, view or None)[key]
            for result in _results(name, evaluations)
        ]
        for view in ('', *found.view.options)
    }
    classes = [
        found.task.classes(known[0].task),
        found.outcome.classes(known[0].outcome),
        found.status.classes(*statuses),
        found.estimate.classes(*map(_estimate, known)),
        found.view.classes(*views),
        *(
            found.score.classes(_bin(float(mean_of_known(np.array(values)))), of=view)
            for view, values in scored.items()
        ),
    ]
    if np.isfinite(scored['']).any():
        classes.append(found.better.classes(letter(int(np.nanargmax(scored[''])))))
    return ' '.join(part for part in classes if part)


def _bin(score: float) -> str:
    return _BINS[min(int(score * len(_BINS)), len(_BINS) - 1)] if isfinite(score) else _UNKNOWN


def _estimate(result: EpisodeResult) -> str:
    """Whether the success estimate is right; empty where the outcome is not known."""
    said = verdict(result.probability)
    if not isfinite(said):
        return 'no verdict'
    if result.outcome not in ('success', 'failure'):
        return ''
    return 'right' if said == (result.outcome == 'success') else 'wrong'


def _about(name: str, evaluations: Sequence[Evaluated]) -> str:
    result = next(r for r in _results(name, evaluations) if r is not None)
    return ' · '.join(
        part for part in (result.task, f'recorded outcome: {result.outcome}') if part
    )


def _rows(name: str, evaluations: Sequence[Evaluated], key: str) -> list[dict[str, Any]]:
    """J by view, the success estimate and its reasons, by evaluation that scored the episode."""
    return [
        {
            'mark': mark(index, evaluations),
            'views': [
                f'{view} {number(episode_means(result.rows, view)[key])}'
                for view in evaluations[index].views
            ],
            'estimate': number(result.probability, 2)
            if isfinite(result.probability)
            else 'abstains',
            'reasons': '; '.join(result.reasons),
            'objects': '; '.join(
                f'{row.view} {row.name}: {row.status}'
                for row in result.rows
                if row.name and row.status != 'ok'
            ),
        }
        for index, result in enumerate(_results(name, evaluations))
        if result is not None
    ]


def _name(found: Evaluated, evaluations: Sequence[Evaluated]) -> str:
    return found.name if len(evaluations) > 1 else ''


def _clip(
    episode: str, found: Evaluated, is_picked: bool, budget: int
) -> tuple[RolloutClip | None, str] | None:
    """An episode's video, or why there is none; None = the evaluation has no such episode."""
    if episode not in found.results:
        return None
    try:
        rollout = found.rollout(episode)
    except EpisodeError as error:
        return None, str(error)
    if rollout is None:
        return None, ' its frames were not kept'
    tile = _PICKED_TILE if is_picked else _TILE
    return make_clip(rollout, max_bytes=budget, tile_width=tile, with_sheet=is_picked), ''


def _crop(view: Filter) -> Markup:
    """Style rules by which videos show the chosen view alone: a row of several."""
    num = len(view.options)
    return Markup(
        '\n'.join(
            f'main:has(#view option[value="{k}"]:checked) .card video {{ object-fit: cover; '
            f'object-position: 0 {100 * k / (num - 1):.0f}%; '
            f'aspect-ratio: calc(var(--ratio) * {num}); }}'
            for k in range(num)
            if num > 1
        )
    )
