"""The tables of an evaluation say why a number is not there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary
from mtv_world_ros.evaluation.metrics.jaccard_scores import ScoreRow
from mtv_world_ros.evaluation.results import EpisodeResult
from mtv_world_ros.evaluation.tables import markdown

NAN = float('nan')
ROW = ScoreRow(
    stretch=0, num_frames=2, view='low', name='red block', status='ok', moving=True, j=0.7,
    j_copy=0.5, j_shuffled=0.4, j_ceiling=0.9, j_self=1.0,
)  # fmt: skip
NOT_SCORED = replace(
    ROW, status='absent', moving=False, j=NAN, j_copy=NAN, j_shuffled=NAN, j_ceiling=NAN,
    j_self=NAN,
)  # fmt: skip


def tables_of(*rows: ScoreRow) -> str:
    result = EpisodeResult(
        episode='a', task='', zero_shot='', outcome='unknown', rows=rows, quality={},
        probability=NAN, reasons=(), notes=(), seconds_per_chunk=1.0, seconds={}, has_ids=False,
    )  # fmt: skip
    spec = WorldModelSpec(
        views=('low',), fps=5.0, num_frames=2, width=96, height=72, robot='crane'
    )
    return markdown(
        EvaluationSummary(
            folder=Path(), name='x', spec=spec, settings={}, results=[result], failed={}
        )
    )


@pytest.mark.parametrize(
    ('rows', 'why'),
    [
        ((NOT_SCORED,), 'no named object could be scored in any stretch (1 absent)'),
        ((replace(ROW, moving=False),), 'no object that was scored really moves'),
        (
            (replace(ROW, j_shuffled=NAN),),
            "Dashes of shuffled actions: no rollout was imagined with another episode's actions",
        ),
        ((replace(ROW, j_ceiling=NAN),), 'Dashes of ceiling: no recorded frame went'),
    ],
)
def test_a_dash_has_its_reason(rows, why):
    assert why in tables_of(*rows)


def test_without_named_objects_there_are_no_tables_of_them():
    said = tables_of()
    assert 'No object is named in any episode' in said and '--describer' in said
    assert '|' not in said and 'Dashes' not in said
