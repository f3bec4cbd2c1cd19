"""Several checkpoints in one set of tables, in the form of the paper's tables 1 and 3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import csv
import io
from pathlib import Path
from typing import NamedTuple

from mtv_world_ros.core.documents import Table
from mtv_world_ros.core.files import plain, write_json, write_whole
from mtv_world_ros.evaluation import tables
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary, Group, SEEN
from mtv_world_ros.evaluation.metrics.statistics import Estimate, METHOD

#: maximum number of tasks in the columns of a table
TASKS_PER_TABLE = 3
_COPY = 'First frame held'
_ABOUT = (
    'J: of the union of all objects, mean over frames and episodes (the paper prints it times '
    f'100). J moving: of the objects that really move. Brackets: {METHOD}; of '
    'FID and FVD jackknife. A dash is not measured, or a view that the model does not have.'
)


class Line(NamedTuple):
    """A row of the tables: a checkpoint on a set of episodes."""

    label: str
    summary: EvaluationSummary
    zero_shot: str | None
    held: bool = False

    def numbers(self, view: str, task: str | None = None) -> Mapping[str, Estimate]:
        """Return the numbers of a view and task; none for a view that the model lacks."""
        group = Group(task=task, zero_shot=self.zero_shot)
        if view not in self.summary.spec.views or not self.summary.chosen(group):
            return {}
        found = self.summary.estimates(view, group)
        if not self.held:
            return found
        return {'j_union': found['j_copy_union'], 'j_moving': found['j_copy_moving']}


def labels(summaries: Sequence[EvaluationSummary]) -> list[str]:
    """Return the names of the rows of checkpoints."""
    return [summary.label or summary.name for summary in summaries]


def lines(summaries: Sequence[EvaluationSummary], names: Sequence[str]) -> list[Line]:
    """Return a row per checkpoint, or per zero-shot set of each; the held first frame below.

    Where a data set has zero-shot episodes, the row with the plain name is that of the others.
    """
    found, held = [], {}
    for summary, called in zip(summaries, names, strict=True):
        for name in summary.zero_shot_sets or [None]:
            suffix = '' if name in (None, SEEN) else f', zero-shot {name}'
            found.append(Line(f'{called}{suffix}', summary, name))
            held.setdefault(name, Line(f'{_COPY}{suffix}', summary, name, held=True))
    return [*found, *held.values()]


def all_views(summaries: Sequence[EvaluationSummary]) -> list[str]:
    """Return the names of all views, in the order in which they come first."""
    return list(dict.fromkeys(view for summary in summaries for view in summary.spec.views))


def method_table(rows: Sequence[Line], views: Sequence[str]) -> Table:
    """Return the table of methods by view: FID, FVD, J (the paper's table 1), J of moving ones."""
    columns = ('FID ↓', 'FVD ↓', 'J ↑', 'J moving ↑')
    head = ['Method', *(f'{view} {what}' for view in views for what in columns)]
    body = []
    for line in rows:
        cells = [line.label]
        for view in views:
            found = line.numbers(view)
            cells += [tables.cell(found.get(name), 1) for name in ('fid', 'fvd')]
            cells += [tables.cell(found.get(name)) for name in ('j_union', 'j_moving')]
        body.append(cells)
    return Table(head=head, rows=body)


def task_tables(rows: Sequence[Line], views: Sequence[str]) -> list[Table]:
    """Return method by task and view: J (the paper's table 3), a few tasks at a time."""
    tasks = sorted({task for row in rows for task in row.summary.tasks})
    parts = []
    for first in range(0, len(tasks), TASKS_PER_TABLE):
        columns = [
            (task, view) for task in tasks[first : first + TASKS_PER_TABLE] for view in views
        ]
        head = ['Method', *(f'{task or "no task"} {view}' for task, view in columns)]
        body = [
            [row.label, *(tables.cell(row.numbers(v, t).get('j_union')) for t, v in columns)]
            for row in rows
        ]
        parts.append(Table(head=head, rows=body))
    return parts


def markdown(summaries: Sequence[EvaluationSummary]) -> str:
    """Return both tables and their explanation in Markdown."""
    names, views = labels(summaries), all_views(summaries)
    rows = lines(summaries, names)
    numbers = ', '.join(
        f'{name}: {len(summary.results)} episodes'
        for name, summary in zip(names, summaries, strict=True)
    )
    by_task = '\n\n'.join(table.text() for table in task_tables(rows, views))
    failed = sum(len(summary.failed) for summary in summaries)
    note = f' {failed} could not be scored, see the tables of each.' if failed else ''
    return (
        f'# Methods\n\n{numbers}.{note}\n\n{_ABOUT}\n\n{method_table(rows, views).text()}\n\n'
        f'J by task and view:\n\n{by_task}\n'
    )


def as_csv(summaries: Sequence[EvaluationSummary]) -> str:
    """Return every number with its interval: a line per method, set, task, view and number."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator='\n')
    writer.writerow(
        ['method', 'zero_shot', 'task', 'view', 'number', 'value', 'low', 'high', 'num_episodes']
    )
    for line in (line for line in lines(summaries, labels(summaries)) if not line.held):
        for view in line.summary.spec.views:
            for task in (None, *line.summary.tasks):
                for name, found in line.numbers(view, task).items():
                    where = [line.summary.label or line.summary.name, line.zero_shot or 'all']
                    values = [_text(value) for value in (found.value, *found.interval)]
                    writer.writerow(
                        [*where, task or 'all', view, name, *values, found.num_episodes]
                    )
    return stream.getvalue()


def _text(value: float) -> str:
    found = plain(float(value))
    return '' if found is None else str(found)


def write_comparison(summaries: Sequence[EvaluationSummary], out: Path) -> None:
    """Write `paper_tables.md` and `numbers.csv`; for several checkpoints `metrics.json` too."""
    write_whole(out / 'paper_tables.md', markdown(summaries))
    write_whole(out / 'numbers.csv', as_csv(summaries))
    if len(summaries) > 1:
        methods = dict(zip(labels(summaries), (s.metrics for s in summaries), strict=True))
        counts = {name: found['num_episodes'] for name, found in methods.items()}
        write_json(out / 'metrics.json', {'num_episodes': counts, 'methods': methods})
