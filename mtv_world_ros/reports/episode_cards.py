"""Every scored episode as a card of the page: numbers, videos, and what it can be found by."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any

from markupsafe import Markup
import numpy as np

from mtv_world_ros.core.documents import number
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.estimate_words import CANNOT_TELL, state_of
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary
from mtv_world_ros.evaluation.metrics.jaccard_scores import episode_means
from mtv_world_ros.evaluation.results import EpisodeResult
from mtv_world_ros.reports.filters import Filter, filters
from mtv_world_ros.reports.headline import letter, Marked, views_of
from mtv_world_ros.reports.read_back import picks, ranked_by
from mtv_world_ros.success.estimator import verdict
from mtv_world_ros.viewing.rollout_clips import make_clip, RolloutClip
from mtv_world_ros.vision.jaccard import mean_of_known

#: maximum size of all embedded videos [bytes]; base64 adds a third
VIDEO_BUDGET = 24_000_000
#: maximum size of the videos of the best, median and worst episode [bytes]
_PICKED_BUDGET = 6_000_000
#: width up to which small frames of the best, median and worst episode are enlarged [px]
_PICKED_TILE_PX = 320
#: width up to which small frames of other episodes are enlarged [px]
_TILE_PX = 192
#: number of episodes with a contact sheet if none can be ranked
_NUM_UNRANKED = 3
#: most points of time for which the share of futures is written
_MOST_SHARES = 12
_BINS = ('0 to .2', '.2 to .4', '.4 to .6', '.6 to .8', '.8 to 1')
_UNKNOWN = 'not scored'
_ESTIMATES = ('right', 'wrong', 'no verdict')
#: an evaluation and its result of an episode
_Scored = tuple[Marked, EpisodeResult]


def episode_cards(evaluations: Sequence[Marked]) -> dict[str, Any]:
    """Return the filters and the cards of all episodes, the worst first.

    Ranked by J of the objects that move, where any episode has it, else by J of all objects.
    """
    summaries = [one.found for one in evaluations]
    words, key, means = ranked_by(summaries)
    titles = picks(summaries)
    results = [(one, {r.episode: r for r in one.found.results}) for one in evaluations]
    by_name: dict[str, list[_Scored]] = {}
    for name in sorted({name for _, by_episode in results for name in by_episode}):
        by_name[name] = [(one, found[name]) for one, found in results if name in found]
    names = sorted(by_name, key=lambda name: means.get(name, 2.0))
    picked = set(titles) or set(names[:_NUM_UNRANKED])  # no object was named: no J to pick by
    num_clips = sum(map(len, by_name.values()))
    num_picked = sum(len(by_name[name]) for name in picked)
    budgets = (VIDEO_BUDGET // max(num_clips, 1), _PICKED_BUDGET // max(num_picked, 1))
    found = _filters(evaluations)
    cards = [
        {
            'title': titles.get(name, ''),
            'name': name,
            'score': number(means.get(name)),
            'classes': _classes(by_name[name], evaluations, key, found),
            'about': _about(by_name[name][0][1]),
            'rows': [_row(one, result, key) for one, result in by_name[name]],
            'clips': [
                (
                    one,
                    one.letter and one.found.title,
                    *_clip(name, one.found, name in picked, budgets[name in picked]),
                )
                for one, _ in by_name[name]
            ],
        }
        for name in names
    ]
    shown = filters(*found.values())
    return {'words': words, 'cards': cards, 'filters': shown, 'crop': _crop(found['view'])}


def _filters(evaluations: Sequence[Marked]) -> dict[str, Filter]:
    results = [result for one in evaluations for result in one.found.results]
    view = Filter(key='view', label='view', options=tuple(views_of(evaluations)))
    statuses = {row.status for result in results for row in result.rows if row.name}
    options = {
        'task': ('task', _options(r.task for r in results)),
        'outcome': ('recorded outcome', _options(r.outcome for r in results)),
        'status': ('status of an object', _options(statuses)),
        'estimate': ('success estimate', _ESTIMATES),
    }
    letters = tuple(letter(index) for index in range(len(evaluations)))
    return {
        **{key: Filter(key=key, label=label, options=o) for key, (label, o) in options.items()},
        'view': view,
        'score': Filter(key='score', label='J', options=(*_BINS, _UNKNOWN), within=view),
        'better': Filter(key='better', label='highest J', options=letters),
    }


def _options(values: Any) -> tuple[str, ...]:
    return tuple(sorted({value for value in values if value}))


def _classes(
    scored: Sequence[_Scored], evaluations: Sequence[Marked], key: str, found: dict[str, Filter]
) -> str:
    results = [result for _, result in scored]
    by_letter = {one.letter: result for one, result in scored}
    means = {
        view: [
            np.nan if result is None else episode_means(result.rows, view or None)[key]
            for result in (by_letter.get(one.letter) for one in evaluations)
        ]
        for view in ('', *found['view'].options)
    }
    classes = [
        found['task'].classes(results[0].task),
        found['outcome'].classes(results[0].outcome),
        found['status'].classes(*{row.status for r in results for row in r.rows if row.name}),
        found['estimate'].classes(*map(_estimate, results)),
        found['view'].classes(*sorted({row.view for r in results for row in r.rows})),
        *(
            found['score'].classes(_bin(float(mean_of_known(np.array(values)))), of=view)
            for view, values in means.items()
        ),
    ]
    if np.isfinite(means['']).any():
        classes.append(found['better'].classes(letter(int(np.nanargmax(means[''])))))
    return ' '.join(part for part in classes if part)


def _bin(score: float) -> str:
    return _BINS[min(int(score * len(_BINS)), len(_BINS) - 1)] if isfinite(score) else _UNKNOWN


def _estimate(result: EpisodeResult) -> str:
    """Return the verdict on the success estimate; empty if the outcome is not known."""
    judged = verdict(result.probability, result.interval)
    if not isfinite(judged):
        return 'no verdict'
    if result.outcome not in ('success', 'failure'):
        return ''
    return 'right' if judged == (result.outcome == 'success') else 'wrong'


def _about(result: EpisodeResult) -> str:
    return ' · '.join(filter(None, (result.task, f'recorded outcome: {result.outcome}')))


def _row(one: Marked, result: EpisodeResult, key: str) -> dict[str, Any]:
    """Return J by view, the success estimate and its reasons."""
    means = {view: episode_means(result.rows, view)[key] for view in one.found.spec.views}
    known, state = isfinite(result.probability), state_of(result.reasons)
    state = f' ({state})' if state else ''
    doubted = [row for row in result.rows if row.name and row.status != 'ok']
    return {
        'mark': one,
        'views': [f'{view} {number(mean)}' for view, mean in means.items()],
        'estimate': f'{number(result.probability, 2)}{state}' if known else CANNOT_TELL,
        'reasons': '; '.join(result.reasons),
        'shares': ', '.join(
            f'{time:.1f} s {number(share, 2)}' for time, share in _thinned(result.shares)
        ),
        'objects': '; '.join(f'{row.view} {row.name}: {row.status}' for row in doubted),
    }


def _thinned(shares: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return at most `_MOST_SHARES` of the shares over time, the last one among them."""
    step = -(-len(shares) // _MOST_SHARES) or 1
    return list(shares[::-1][::step][::-1])


def _clip(
    episode: str, found: EvaluationSummary, is_picked: bool, budget: int
) -> tuple[RolloutClip | None, str]:
    """Return an episode's video, or why there is none."""
    try:
        rollout = found.rollout(episode)
    except EpisodeError as error:
        return None, str(error)
    if rollout is None:
        return None, ' its frames were not kept'
    tile = _PICKED_TILE_PX if is_picked else _TILE_PX
    return make_clip(rollout, max_bytes=budget, tile_width=tile, with_sheet=is_picked), ''


def _crop(view: Filter) -> Markup:
    """Return style rules that crop videos to the row of the chosen view."""
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
