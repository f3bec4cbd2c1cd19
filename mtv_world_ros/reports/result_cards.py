"""Every result as a card of the ranking's page: both worlds, when they part, who was right."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isfinite
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import escape, Markup

from mtv_world_ros.core.documents import number
from mtv_world_ros.core.estimate_words import CANNOT_TELL, state_of
from mtv_world_ros.ranking.both_worlds import SHEET, VIDEO
from mtv_world_ros.ranking.jobs import Result, StoredEstimate, WorldComparison
from mtv_world_ros.ranking.run_jobs import FOLDER
from mtv_world_ros.reports.filters import Filter, filters

_VERDICTS = ('false success', 'false failure', 'right', 'no verdict')
_PARTS = ('commands', 'objects', 'nothing')
#: width of a plot of curves [px]
_PLOT_WIDTH_PX = 320
#: height of a plot of curves [px]
_PLOT_HEIGHT_PX = 64


def result_cards(results: Sequence[Result], out: Path) -> dict[str, Any]:
    """Return the filters and the cards of all results; see `worst_first`.

    Args:
        results: results of a ranking, a policy on an episode each.
        out: folder of its page; the videos lie below it.
    """
    policy = Filter(key='policy', label='policy', options=_options(r.policy for r in results))
    task = Filter(key='task', label='task', options=_options(r.task for r in results))
    outcome = Filter(key='outcome', label='in the simulator', options=('success', 'failure'))
    verdicts = Filter(key='verdict', label='imagined verdict', options=_VERDICTS)
    parts = Filter(key='parts', label='what parts first', options=_PARTS)
    cards = []
    for result in worst_first(results):
        classes = [
            policy.classes(result.policy),
            task.classes(result.task),
            outcome.classes(_word(result.final)),
            verdicts.classes(verdict(result)),
            parts.classes(_first_to_part(result.course)),
        ]
        cards.append(
            {
                'title': f'{result.policy} · {result.task} {result.index}',
                'verdict': f'{_word(result.final)} in the simulator; imagined '
                f'{estimate_text(result.imagined)}: {verdict(result)}',
                'parts': [
                    f'{what} at {time:.1f} s'
                    for time, what in (when_they_part(result.course) if result.course else ())
                ],
                'judged': [
                    (
                        'imagined',
                        estimate_text(result.imagined),
                        '; '.join(result.imagined.reasons),
                    ),
                    (
                        "on the simulator's frames",
                        estimate_text(result.seen),
                        '; '.join(result.seen.reasons),
                    ),
                    ('no-picture rule', estimate_text(result.no_picture), ''),
                ],
                'ends': [
                    f'{where}: {end}'
                    for where, end in (
                        ('in the simulator', result.end),
                        ('in imagination', result.imagined_end),
                    )
                    if end
                ],
                'curves': curves(result.course) if result.course else '',
                'video': _address(out, result, VIDEO),
                'sheet': _address(out, result, SHEET),
                'classes': ' '.join(found for found in classes if found),
            }
        )
    return {'cards': cards, 'filters': filters(policy, task, outcome, verdicts, parts)}


def worst_first(results: Sequence[Result]) -> list[Result]:
    """Return the rollouts, sorted by the error of the imagined estimate, largest first.

    Of equal ones, those whose worlds part first.
    """
    return sorted(results, key=_rank)


def _options(values: Iterable[str]) -> tuple[str, ...]:
    return tuple(sorted(set(values)))


def _rank(result: Result) -> tuple[float, float, str]:
    said = result.imagined.probability
    off = abs(said - result.final) if isfinite(said) else 0.5
    part = result.course.part_s if result.course else float('nan')
    return -off, part if isfinite(part) else float('inf'), result.name


def _word(final: bool) -> str:
    return 'success' if final else 'failure'


def verdict(result: Result) -> str:
    """Return the outcome of the imagined verdict: right, false success, false failure, none."""
    said = result.imagined.success
    if not isfinite(said):
        return 'no verdict'
    return 'right' if said == result.final else f'false {_word(bool(said))}'


def estimate_text(judged: StoredEstimate) -> str:
    """Return an estimate with its state of trust, e.g. `0.98 (fitted here)`."""
    if not isfinite(judged.probability):
        return CANNOT_TELL
    state = state_of(judged.reasons)
    return number(judged.probability, 2) + (f' ({state})' if state else '')


def _first_to_part(course: WorldComparison | None) -> str:
    """Return the entry of `_PARTS` that differs first between the worlds; empty = not known."""
    if course is None:
        return ''
    if not isfinite(course.part_s):
        return 'nothing'
    return 'commands' if course.commands_part_s == course.part_s else 'objects'


def when_they_part(course: WorldComparison) -> list[tuple[float, str]]:
    """Return when [s] what parts in the two worlds, the first one first."""
    whats = {
        'commands': course.commands_part_s,
        f'objects ({course.parted_object})': course.objects_part_s,
        'estimates': course.verdicts_part_s,
    }
    return sorted((time, what) for what, time in whats.items() if isfinite(time))


def result_file(out: Path, result: Result, suffix: str) -> Path:
    """Return where a file of a rollout lies in a ranking's folder."""
    return out / FOLDER / f'{result.name}{suffix}'


def _address(out: Path, result: Result, suffix: str) -> str:
    """Return the address of a rollout's file from the page; empty = there is none."""
    path = result_file(out, result, suffix)
    return f'{FOLDER}/{quote(path.name)}' if path.is_file() else ''


def curves(course: WorldComparison) -> Markup:
    """Return estimates in both worlds and the overlap of the objects over time, as SVG."""
    last = max([*course.times, *course.ends], default=0.0) or 1.0
    lines = {
        'held': ("estimate on the simulator's frames", course.ends, course.seen, True),
        'c0': ('imagined estimate', course.ends, course.imagined, True),
        'c2': ('least overlap of an object', course.times, course.overlaps, False),
    }
    drawn = [
        f'<path d="{_path(times, values, last, is_step)}" fill="none" stroke="var(--{colour})" '
        f'stroke-width="1.6"><title>{escape(words)}</title></path>'
        for colour, (words, times, values, is_step) in lines.items()
    ]
    if isfinite(course.part_s):
        x = course.part_s / last * _PLOT_WIDTH_PX
        drawn.append(
            f'<path d="M {x:.1f} 0 V {_PLOT_HEIGHT_PX}" stroke="var(--bad)"><title>they part at '
            f'{course.part_s:.1f} s</title></path>'
        )
    return Markup(
        f'<svg viewBox="-2 -2 {_PLOT_WIDTH_PX + 4} {_PLOT_HEIGHT_PX + 4}" role="img" '
        'class="curves"><title>'
        f'Estimates and overlap over {last:.1f} s, from 0 to 1</title>{"".join(drawn)}</svg>'
    )


def _path(times: Sequence[float], values: Sequence[float], last: float, is_step: bool) -> str:
    """Return the drawing commands of values in [0, 1]; a gap where one is not known.

    A step holds its value from the moment before up to its own.
    """
    parts, before = [], 0.0
    for time, value in zip(times, values, strict=True):
        x, y = time / last * _PLOT_WIDTH_PX, (1 - value) * _PLOT_HEIGHT_PX
        if not isfinite(value):
            parts.append('')
        elif is_step:
            parts.append(f'M {before / last * _PLOT_WIDTH_PX:.1f} {y:.1f} H {x:.1f}')
        else:
            parts.append(f'{"L" if parts and parts[-1] else "M"} {x:.1f} {y:.1f}')
        before = time
    return ' '.join(part for part in parts if part)
