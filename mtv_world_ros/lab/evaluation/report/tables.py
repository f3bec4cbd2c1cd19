"""Evaluation results as files: metrics.json, a CSV of rows, Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import csv
import io
from math import nan
from typing import Any

from mtv_world_ros.lab.documents import DASH, Table, with_interval
from mtv_world_ros.lab.evaluation.metrics.scores import FRAME_FIELDS, ScoreRow
from mtv_world_ros.lab.evaluation.metrics.statistics import Estimate

#: columns of the Markdown tables: key -> heading
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
NOT_MEASURED = Estimate(value=nan, interval=(nan, nan), num_episodes=0)
QUALITY = {'fid': 'FID', 'fvd': 'FVD', 'psnr': 'PSNR [dB]', 'ssim': 'SSIM', 'lpips': 'LPIPS'}


def estimates_json(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """Returns the values by name, and `intervals` and `num_episodes_with` beside them.

    `fid` and `fvd` are null where no weights of feature networks were named.
    """
    found = {**dict.fromkeys(('fid', 'fvd'), NOT_MEASURED), **estimates}
    return {
        **{name: estimate.value for name, estimate in found.items()},
        'intervals': {name: estimate.interval for name, estimate in found.items()},
        'num_episodes_with': {name: e.num_episodes for name, e in found.items()},
    }


def rows_csv(rows: Iterable[tuple[str, str, ScoreRow]]) -> str:
    """Returns a CSV of (episode, task, row): one line per stretch, view and object."""
    stream = io.StringIO()
    writer: csv.DictWriter[str] | None = None
    for episode, task, row in rows:
        values = {'episode': episode, 'task': task, **row.as_json()}
        for field in FRAME_FIELDS:
            values.pop(field)
        values['name'] = row.name or '(union)'
        if writer is None:
            writer = csv.DictWriter(stream, list(values), lineterminator='\n')
            writer.writeheader()
        writer.writerow(values)
    return stream.getvalue()


def markdown_table(lines: Sequence[tuple[str, Mapping[str, Estimate]]], first: str) -> str:
    """Returns a table of (label, estimates) with 95 % intervals in brackets."""
    rows = [[label, *(cell(found.get(key)) for key in COLUMNS)] for label, found in lines]
    return Table(head=[first, *COLUMNS.values()], rows=rows).text()


def controls_table(lines: Sequence[tuple[str, Mapping[str, Estimate]]]) -> str:
    """Returns J of moving objects by what was shown and view, as far as measured."""
    head = ['J of objects that move', *(view for view, _ in lines)]
    body = [
        [words, *(cell(found.get(key)) for _, found in lines)] for key, words in CONTROLS.items()
    ]
    rows = [row for row in body if set(row[1:]) != {DASH}]
    return Table(head=head, rows=rows).text()


def quality_table(lines: Sequence[tuple[str, Mapping[str, Estimate]]]) -> str:
    """Returns a table of pictures' quality by view; empty where nothing was measured."""
    measured = [k for k in QUALITY if any(cell(found.get(k)) != DASH for _, found in lines)]
    if not measured:
        return ''
    body = [[view, *(cell(found.get(key)) for key in measured)] for view, found in lines]
    return Table(head=['view', *(QUALITY[key] for key in measured)], rows=body).text()


def status_table(views: Mapping[str, Mapping[str, int]]) -> str:
    """Returns how often each status of an object in a stretch was met, by view."""
    words = sorted({word for counts in views.values() for word in counts})
    body = [[word, *(str(counts.get(word, 0)) for counts in views.values())] for word in words]
    return Table(head=['objects by status', *views], rows=body).text()


def point(values: Sequence[float], band: Sequence[tuple[float, float]], index: int) -> str:
    """Returns a value of a curve with its interval; a dash where the curve does not reach."""
    if index >= len(values):
        return DASH
    return cell(Estimate(value=values[index], interval=band[index], num_episodes=0))


def cell(estimate: Estimate | None, digits: int = 3) -> str:
    """Returns a number with its interval; a dash where it was not measured."""
    if estimate is None:
        return DASH
    return with_interval(estimate.value, estimate.interval, digits)
