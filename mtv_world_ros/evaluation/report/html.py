"""Evaluations as one HTML file that needs nothing else: numbers, charts, videos, failures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mtv_world_ros.errors import ConfigError, EpisodeError
from mtv_world_ros.evaluation.report.clips import Clip, make_clip
from mtv_world_ros.evaluation.report.details import (
    episodes_section,
    provenance_section,
    status_section,
    success_section,
)
from mtv_world_ros.evaluation.report.headline import (
    badge,
    headline,
    horizon_section,
    number,
    with_interval,
)
from mtv_world_ros.evaluation.report.markup import data_uri, element, join, Markup
from mtv_world_ros.evaluation.report.read_back import Evaluated, Pick, picks, read_evaluations
from mtv_world_ros.evaluation.report.report_tables import paper_tables, task_section
from mtv_world_ros.files import share_path, write_whole

#: of all embedded videos [bytes]; base64 adds a third
VIDEO_BUDGET = 6_000_000
#: no request leaves the page, whatever a name in it says
_POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
_NAV = {
    'headline': 'Headline',
    'horizon': 'Horizon',
    'videos': 'Videos',
    'paper': "Paper's tables",
    'tasks': 'By task',
    'success': 'Success',
    'statuses': 'Statuses and failures',
    'episodes': 'All episodes',
    'made': 'How this was made',
}


def write_report(folders: Sequence[Path], path: Path) -> Path:
    """Writes the report of one or more evaluations beside its name and renames it.

    Args:
        folders: what `mtv-world evaluate --out` wrote; the first one sets the clock of the plots.
        path: of the HTML file.

    Returns:
        The path.

    Raises:
        ConfigError: none is given, or one holds no evaluation.
    """
    evaluations = [found for folder in folders for found in read_evaluations(folder)]
    if not evaluations:
        raise ConfigError('a report needs at least one evaluation; give the folders of them')
    write_whole(path, page(evaluations))
    return path


def page(evaluations: Sequence[Evaluated]) -> str:
    """Returns the whole page."""
    sections = {
        'headline': headline(evaluations),
        'horizon': horizon_section(evaluations),
        'videos': _videos(evaluations),
        'paper': paper_tables(evaluations),
        'tasks': task_section(evaluations),
        'success': success_section(evaluations),
        'statuses': status_section(evaluations),
        'episodes': episodes_section(evaluations),
        'made': provenance_section(evaluations),
    }
    links = [element('a', words, href=f'#{key}') for key, words in _NAV.items() if sections[key]]
    title = f'Evaluation of {", ".join(found.name for found in evaluations)}'
    parts = [_header(evaluations), element('nav', *links), *sections.values()]
    return document(title, join(parts))


def document(title: str, content: Markup) -> str:
    """Returns a whole page in the report's style, from which no request leaves."""
    style = share_path('resource', 'report', 'style.css').read_text(encoding='utf-8')
    head = element(
        'head',
        element('meta', charset='utf-8'),
        element('meta', name='viewport', content='width=device-width, initial-scale=1'),
        element('meta', http_equiv='Content-Security-Policy', content=_POLICY),
        element('title', title),
        element('style', Markup(style)),
    )
    body = element('body', element('main', content))
    return f'<!DOCTYPE html>\n{element("html", head, body, lang="en")}\n'


def _header(evaluations: Sequence[Evaluated]) -> Markup:
    blocks = []
    for index, found in enumerate(evaluations):
        date = found.metrics['provenance'].get('date', '')
        dataset = found.metrics['provenance'].get('dataset', '')
        about = ' · '.join(part for part in (dataset, date) if part)
        blocks.append(
            join(
                [
                    element('h3', badge(index, evaluations), found.name),
                    element('p', about, class_='faint') if about else None,
                    element('div', *_tiles(found), class_='tiles'),
                ]
            )
        )
    return join([element('h1', 'World model evaluation'), *blocks])


def _tiles(found: Evaluated) -> list[Markup]:
    overall, metrics = found.metrics['overall'], found.metrics
    tiles = [
        ('J, objects that move', number(overall.get('j_moving')), _bracket(overall, 'j_moving')),
        (
            'margin over first frame held',
            number(overall.get('margin_moving')),
            _bracket(overall, 'margin_moving'),
        ),
        (
            'margin over shuffled actions',
            number(overall.get('margin_over_shuffled')),
            _bracket(overall, 'margin_over_shuffled'),
        ),
        ('episodes scored', str(len(found.results)), f'{len(metrics["failed"])} failed'),
    ]
    factor = metrics.get('real_time_factor')
    if factor is not None:
        seconds = metrics.get('seconds_per_chunk')
        tiles.append(('real-time factor', number(factor, 1), f'{number(seconds, 2)} s a chunk'))
    return [
        element(
            'div',
            element('span', name),
            element('b', value),
            element('span', below),
            class_='tile',
        )
        for name, value, below in tiles
    ]


def _bracket(numbers: dict, key: str) -> str:
    text = with_interval(numbers, key)
    return text[text.index('[') :] if '[' in text else 'not measured' if text == '–' else ''


def _videos(evaluations: Sequence[Evaluated]) -> Markup:
    words, chosen = picks(evaluations)
    budget = VIDEO_BUDGET // max(len(chosen) * len(evaluations), 1)
    return element(
        'section',
        element('h2', 'Best, median and worst episode'),
        element(
            'p',
            f'By J of {words}. In each row: what was recorded, the trajectory video drawn '
            'from the commands, what was imagined. Outlines: the masks that were scored; white '
            'over imagined frames: where the recorded object is.',
            class_='faint',
        ),
        *(_episode(pick, evaluations, budget) for pick in chosen),
        id='videos',
    )


def _episode(pick: Pick, evaluations: Sequence[Evaluated], budget: int) -> Markup:
    figures = [
        _figure(pick.episode, index, evaluations, budget) for index in range(len(evaluations))
    ]
    result = next(f.results[pick.episode] for f in evaluations if pick.episode in f.results)
    about = ' · '.join(
        part for part in (result.task, f'recorded outcome: {result.outcome}') if part
    )
    style = 'clips single' if len(evaluations) == 1 else 'clips'
    return element(
        'div',
        element('h3', f'{pick.title}: {pick.episode} (J {pick.score:.3f})'),
        element('p', about, class_='faint'),
        element('div', *figures, class_=style),
        class_='episode',
    )


def _figure(
    episode: str, index: int, evaluations: Sequence[Evaluated], budget: int
) -> Markup | None:
    found = evaluations[index]
    if episode not in found.results:
        return None
    name = join([badge(index, evaluations), found.name if len(evaluations) > 1 else None])
    try:
        rollout = found.rollout(episode)
    except EpisodeError as error:
        return element('figure', element('figcaption', name, str(error)))
    if rollout is None:
        return element('figure', element('figcaption', name, ' its frames were not kept'))
    clip = make_clip(rollout, max_bytes=budget)
    return element(
        'figure',
        element('figcaption', name, *_legend(clip)),
        element(
            'video',
            src=data_uri(clip.video, 'video/mp4'),
            width=clip.width,
            height=clip.height,
            controls=True,
            loop=True,
            muted=True,
            autoplay=True,
            playsinline=True,
            preload='auto',
        ),
        element(
            'img',
            class_='sheet',
            src=data_uri(clip.sheet, 'image/webp'),
            alt=f'Frames of {episode}: recorded, trajectory video, imagined',
        ),
    )


def _legend(clip: Clip) -> list[Markup]:
    return [
        join([element('span', class_='swatch', style=f'border-color: rgb{colour}'), name])
        for name, colour in clip.outlines
    ]
