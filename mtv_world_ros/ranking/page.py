"""A ranking as one HTML file, and all its files."""

from __future__ import annotations

from pathlib import Path

from mtv_world_ros.evaluation.report.charts import Point, scatter_chart
from mtv_world_ros.evaluation.report.html import document
from mtv_world_ros.evaluation.report.markup import element, join, Markup, table
from mtv_world_ros.files import write_json, write_whole
from mtv_world_ros.ranking.report import grids, markdown, remarks, TITLE
from mtv_world_ros.ranking.summary import ALL_TASKS, JUDGES, Summary

#: hues of the report's style sheet
_NUM_HUES = 6


def write_ranking(summary: Summary, out: Path) -> Path:
    """Writes `ranking.json`, `ranking.md` and `ranking.html`; returns the last one's path."""
    write_json(out / 'ranking.json', summary.as_json())
    write_whole(out / 'ranking.md', markdown(summary))
    path = out / 'ranking.html'
    write_whole(path, document(TITLE, join([element('h1', TITLE), *_sections(summary)])))
    return path


def _sections(summary: Summary) -> list[Markup]:
    charts = [
        _figure(summary, judge, task)
        for task in (None, *summary.tasks)
        for judge in JUDGES
        if any(summary.judged_rate(p, task, judge).count for p in summary.policies)
    ]
    made = [[heading, value] for heading, value in summary.provenance.items()]
    return [
        element('section', *(element('p', remark) for remark in remarks(summary))),
        element(
            'section',
            element('h2', 'Imagined against true success'),
            _key(summary),
            element('div', *charts, class_='panels'),
        ),
        *(
            element('section', element('h2', found.caption), table(found.head, found.rows))
            for found in grids(summary)
        ),
        element(
            'section',
            element('h2', 'How this was made'),
            table(['', ''], made, num_labels=2) if made else None,
        ),
    ]


def _figure(summary: Summary, judge: str, task: str | None) -> Markup:
    points = []
    for number, policy in enumerate(summary.policies, 1):
        true = summary.true_rate(policy, task)
        judged = summary.judged_rate(policy, task, judge)
        points.append(
            Point(
                label=str(number),
                title=policy,
                x=true.value,
                y=judged.value,
                x_interval=true.interval,
                y_interval=judged.interval,
                style=f'c{(number - 1) % _NUM_HUES}',
            )
        )
    title = f'{task or ALL_TASKS}: {JUDGES[judge]}'
    chart = scatter_chart(title, points, 'success rate in the simulator', 'judged success rate')
    return element('figure', element('h3', title), chart)


def _key(summary: Summary) -> Markup:
    items = [
        element(
            'li',
            element('span', str(number), class_=f'badge c{(number - 1) % _NUM_HUES}'),
            policy,
        )
        for number, policy in enumerate(summary.policies, 1)
    ]
    return element('ul', *items, class_='key')
