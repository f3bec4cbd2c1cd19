"""Tables of an evaluation: of `tables.md`, of the page and, a line a row, of `rows.csv`."""

from __future__ import annotations

from collections.abc import Iterable
import csv
import io

from mtv_world_ros.core.documents import DASH, Table, with_interval
from mtv_world_ros.core.files import write_json, write_whole
from mtv_world_ros.core.shown_text import markdown_cell
from mtv_world_ros.evaluation.evaluation_summary import (
    ALL,
    EvaluationSummary,
    Group,
    NOT_MEASURED,
    TRAINING,
)
from mtv_world_ros.evaluation.metrics.grasp_outcomes import GRASP_RULE
from mtv_world_ros.evaluation.metrics.jaccard_scores import FRAME_FIELDS
from mtv_world_ros.evaluation.metrics.picture_scores import KINDS, MARGIN_KINDS, MEASURES
from mtv_world_ros.evaluation.metrics.statistics import Estimate, METHOD

BRACKETS = (
    f'Brackets: {METHOD}. J moving, persistence and shuffled actions: of the '
    'objects that really move.'
)
_NO_OBJECTS = (
    'No object is named in any episode, so that none is scored: pictures are compared instead. '
    'Name objects with `--describer`, or in the episodes.'
)
#: why a column is empty although objects that move were scored
_NOT_MADE = {
    'j_shuffled_moving': "no rollout was imagined with another episode's actions (`--actions`, "
    'or there is no other episode)',
    'j_ceiling_moving': 'no recorded frame went through an autoencoder (`--no-ceiling`, or the '
    'model has none)',
    'j_self_moving': 'recorded frames were not scored themselves (`--no-ceiling`)',
}
#: columns of the tables of J: key -> heading
COLUMNS = {
    'j_object_mean': 'J objects',
    'j_union': 'J union',
    'j_moving': 'J moving',
    'j_moving_either': 'J moving in truth or imagination',
    'jf_moving': 'J&F moving',
    'j_copy_moving': 'persistence',
    'j_shuffled_moving': 'shuffled actions',
    'margin_moving': 'margin over persistence',
    'skill': 'skill',
    'j_self_moving': 'segmenter alone',
    'j_ceiling_moving': 'ceiling',
}
#: rows of the table that shows whether the model obeys, and what could be reached at all
CONTROLS = {
    'j_self_moving': 'recorded frames: what the segmenter leaves',
    'jf_self_moving': 'the same, J&F',
    'j_ceiling_moving': 'recorded frames through the autoencoder',
    'j_moving': 'imagined, true actions',
    'jf_moving': 'the same, J&F',
    'j_shuffled_moving': "imagined, another episode's actions",
    'j_zero_moving': 'imagined, joints held',
    'j_copy_moving': 'first frame held (persistence)',
    'jf_copy_moving': 'the same, J&F',
    'margin_of_shuffled': 'shuffled actions - persistence',
}
QUALITY = {'fid': 'FID', 'fvd': 'FVD', 'psnr': 'PSNR [dB]', 'ssim': 'SSIM', 'lpips': 'LPIPS'}


def cell(estimate: Estimate | None, digits: int = 3) -> str:
    """Return a number with its interval; a dash where it was not measured."""
    found = estimate or NOT_MEASURED
    return with_interval(found.value, found.interval, digits)


def write_summary(summary: EvaluationSummary) -> None:
    """Write metrics.json, rows.csv and tables.md into the folder of the evaluation."""
    write_json(summary.folder / 'metrics.json', summary.metrics)
    write_whole(summary.folder / 'rows.csv', rows_csv(summary))
    write_whole(summary.folder / 'tables.md', markdown(summary))


def rows_csv(summary: EvaluationSummary) -> str:
    """Return a CSV with a line per episode, stretch, view and object."""
    stream = io.StringIO()
    writer: csv.DictWriter[str] | None = None
    for result in summary.results:
        for row in result.rows:
            values = {'episode': result.episode, 'task': result.task, **row.as_json()}
            for field in FRAME_FIELDS:
                values.pop(field)
            values['name'] = row.name or '(union)'
            if writer is None:
                writer = csv.DictWriter(stream, list(values), lineterminator='\n')
                writer.writeheader()
            writer.writerow(values)
    return stream.getvalue()


def markdown(summary: EvaluationSummary) -> str:
    """Return tables.md: scores by view, by task and view, statuses, failures."""
    counts = ', '.join(
        f'{len(summary.chosen(Group(task=t)))} of {markdown_cell(t or "no task")}'
        for t in summary.tasks
    )
    training = summary.provenance.get(TRAINING, '')
    of_objects = [
        _truth(summary),
        BRACKETS,
        view_table(summary),
        _why_dashes(summary),
        dreams_table(summary),
        *group_tables(summary),
        controls_table(summary),
        chunk_table(summary),
    ]
    parts = [
        summary.following.line,
        f'# {markdown_cell(summary.name) or "Evaluation"}\n\n'
        f'{len(summary.results)} episodes: {counts}.'
        + (f' The checkpoint: {training}.' if training else ''),
        *(of_objects if summary.has_objects else [_NO_OBJECTS, BRACKETS]),
        quality_table(summary),
        pictures_table(summary),
        compared_line(summary),
        status_table(summary) if summary.has_objects else None,
        '\n'.join(
            f'- not scored: {markdown_cell(str(path))}: {markdown_cell(str(why))}'
            for path, why in summary.failed.items()
        ),
        '\n'.join(
            f'- {markdown_cell(r.episode)}: {markdown_cell(note)}'
            for r in summary.results
            for note in r.notes
        ),
    ]
    texts = [part.text() if isinstance(part, Table) else part for part in parts]
    return '\n\n'.join(text for text in texts if text) + '\n'


def view_table(summary: EvaluationSummary) -> Table:
    """Return `COLUMNS` by view."""
    return _numbers('view', [(view, view, ALL) for view in (*summary.spec.views, None)], summary)


def group_tables(summary: EvaluationSummary) -> list[Table]:
    """Return `COLUMNS` by zero-shot set and view, where there are sets, and by task and view."""
    views = summary.spec.views
    groups = {
        'zero-shot set': {name: Group(zero_shot=name) for name in summary.zero_shot_sets},
        'task': {task: Group(task=task) for task in summary.tasks},
    }
    found = []
    for kind, named in groups.items():
        rows = [(f'{name} · {v}', v, group) for name, group in named.items() for v in views]
        found += [_numbers(f'{kind} · view', rows, summary)] if rows else []
    return found


def _numbers(
    head: str, rows: Iterable[tuple[str | None, str | None, Group]], summary: EvaluationSummary
) -> Table:
    """Return a row for each label, view and group."""
    lines = []
    for label, view, group in rows:
        found = summary.estimates(view, group)
        lines.append([label or 'all views', *(cell(found.get(key)) for key in COLUMNS)])
    return Table(head=[head, *COLUMNS.values()], rows=lines)


def controls_table(summary: EvaluationSummary) -> Table:
    """Return the table of J of moving objects, by baseline and view; only measured rows."""
    views = {view: summary.estimates(view) for view in summary.spec.views}
    rows = [
        [words, *(cell(found.get(key)) for found in views.values())]
        for key, words in CONTROLS.items()
    ]
    rows = [row for row in rows if set(row[1:]) != {DASH}]
    return Table(head=['J of objects that move', *views], rows=rows)


def dreams_table(summary: EvaluationSummary) -> Table:
    """Return the table of disagreement on moving objects and grasps, see `Dreams`."""
    found = summary.dreams
    rows = {
        'missed grasps that are dreamt as grasps': found.dreamt,
        'grasps that are imagined as missed': found.missed,
        'objects that move in imagination and in truth, of those in imagination': found.precision,
        'objects that move in imagination and in truth, of those in truth': found.recall,
    }
    return Table(
        head=['motion of objects', 'cases (share, 95 % Wilson interval)'],
        rows=[[words, share.text] for words, share in rows.items()],
        caption=f'Grasps and motion of objects: {GRASP_RULE}; {summary.moving_rule}',
    )


def chunk_table(summary: EvaluationSummary) -> Table | None:
    """Return the table of J by chunk; None where no rollout has two chunks."""
    if summary.num_chunks < 2:
        return None
    curves = {view: summary.chunk_curve(view) for view in (*summary.spec.views, None)}
    rows = [
        [str(k + 1), *(with_interval(*c.at(k)) for c in curves.values())]
        for k in range(summary.num_chunks)
    ]
    head = ['J of objects that move, chunk', *(view or 'all views' for view in curves)]
    return Table(head=head, rows=rows)


def quality_table(summary: EvaluationSummary) -> Table | None:
    """Return the pictures' quality by view; None where nothing was measured."""
    views = {view: summary.estimates(view) for view in summary.spec.views}
    measured = [k for k in QUALITY if any(cell(v.get(k)) != DASH for v in views.values())]
    rows = [[view, *(cell(found.get(key)) for key in measured)] for view, found in views.items()]
    return Table(head=['view', *(QUALITY[k] for k in measured)], rows=rows) if measured else None


def pictures_table(summary: EvaluationSummary) -> Table | None:
    """Return the table of picture scores, their baselines and margins; None without scores."""
    if not any(result.pictures for result in summary.results):
        return None
    rows = [
        [f'{view or "all views"} · {words}', *(cell(found.get(f'{k}{suffix}')) for k in MEASURES)]
        for view, found in summary.pictures.items()
        for suffix, words in {**KINDS, **MARGIN_KINDS}.items()
        if any(f'{name}{suffix}' in found for name in MEASURES)
    ]
    return Table(head=['pictures', *MEASURES.values()], rows=rows)


def compared_line(summary: EvaluationSummary) -> str:
    """Return the line with the numbers of chunks and episodes behind the margins; may be empty."""
    counts, margin = summary.num_compared, summary.pictures[None].get('margin_over_held')
    if counts is None or margin is None:
        return ''
    num_compared, num_chunks = counts
    if not num_compared:
        return (
            f'Margins are over the held frame alone ({num_chunks} chunks): none was imagined with '
            'other commands.'
        )
    return (
        f'Margins are over the same chunks in all columns: {num_compared} of {num_chunks} were '
        f'imagined with other commands, in {margin.num_episodes} of {len(summary.results)} '
        'episodes. Rows that are no margins are over all the chunks they have.'
    )


def status_table(summary: EvaluationSummary) -> Table:
    """Return the counts of each status of an object in a stretch, by view."""
    views = {view: summary.statuses(view) for view in summary.spec.views}
    words = sorted({word for counts in views.values() for word in counts})
    rows = [[word, *(str(counts.get(word, 0)) for counts in views.values())] for word in words]
    return Table(head=['objects by status', *views], rows=rows)


def _why_dashes(summary: EvaluationSummary) -> str:
    """Return the reasons why object scores are missing, one per line; empty if none is."""
    overall = summary.estimates(None)
    missing = [key for key in COLUMNS if cell(overall.get(key)) == DASH]
    if not missing:
        return ''
    if 'j_object_mean' in missing:
        counts = ', '.join(f'{n} {word}' for word, n in summary.statuses(None).items())
        return f'Dashes: no named object could be scored in any stretch ({counts}).'
    if 'j_moving' in missing:
        return 'Dashes: no object that was scored really moves.'
    return '\n'.join(
        f'Dashes of {COLUMNS[key]}: {_NOT_MADE[key]}.' for key in missing if key in _NOT_MADE
    )


def _truth(summary: EvaluationSummary) -> str:
    """Return the sentence that names the ground truth of the scores."""
    count = len(summary.results)
    others = count - summary.num_true
    if not others:
        return (
            "Ground truth: the simulator's masks. 'Segmenter alone' is the segmenter's own J "
            'on the recorded frames; no prediction can be expected to exceed it.'
        )
    where = f' in {others} of {count} episodes' if summary.num_true else ''
    return (
        f"Ground truth: the segmenter's own masks of the recorded frames{where}. Its errors "
        'there do not show in the numbers, and a ceiling of 1 says nothing.'
    )
