import csv
from dataclasses import replace
import json

import numpy as np
import pytest

from mtv_world_ros.evaluation.evaluate_episodes import evaluate
from mtv_world_ros.reports.comparison import (
    all_views,
    labels,
    lines,
    method_table,
    task_tables,
    write_comparison,
)
from test.support.small_episodes import PersistenceWorldModel

QUIET = {'show_progress': False}


@pytest.fixture
def summaries(make_pipeline, episodes, oracle, tmp_path):
    """A model that knows both views, and one that repeats the start of a single one."""
    both = make_pipeline(oracle)
    high = make_pipeline(PersistenceWorldModel(replace(both.spec, views=('high',))))
    mark = {episodes[0]: 'object'}
    return [
        evaluate(both, episodes, tmp_path / 'a', label='oracle', zero_shot=mark, **QUIET),
        evaluate(high, episodes, tmp_path / 'b', label='still', zero_shot=mark, **QUIET),
    ]


@pytest.fixture
def rows(summaries):
    return lines(summaries, labels(summaries))


def cells_of(table):
    text = table.text()
    found = [[cell.strip() for cell in row.strip('| ').split(' | ')] for row in text.splitlines()]
    return {row[0]: row[1:] for row in found}


@pytest.mark.slow
def test_each_zero_shot_set_is_a_row_of_its_own(summaries, rows):
    assert [line.label for line in rows] == [
        'oracle',
        'oracle, zero-shot object',
        'still',
        'still, zero-shot object',
        'First frame held',
        'First frame held, zero-shot object',
    ]
    metrics = summaries[0].metrics
    assert metrics['num_episodes'] == 3
    assert {k: v['num_episodes'] for k, v in metrics['zero_shot'].items()} == {
        'seen': 2,
        'object': 1,
    }


def test_table_1_has_a_dash_for_a_view_that_a_model_lacks(summaries, rows):
    cells = cells_of(method_table(rows, all_views(summaries)))
    # FID and FVD were measured for none
    assert cells['Method'] == ['low J ↑', 'low J moving ↑', 'high J ↑', 'high J moving ↑']
    assert cells['oracle'][0].startswith('1.000') and cells['oracle'][2].startswith('1.000')
    assert cells['still'][:2] == ['–'] * 2
    # the model that repeats the first frame scores what the first frame scores
    assert cells['still'][2:] == cells['First frame held'][2:]


@pytest.mark.slow
def test_table_3_has_a_column_per_task_and_view(summaries, rows):
    (table,) = task_tables(rows, all_views(summaries))
    cells = cells_of(table)
    assert cells['Method'] == ['place_block_a2b_left low', 'place_block_a2b_left high']
    assert cells['oracle, zero-shot object'][0].startswith('1.000')
    assert cells['still'][0] == '–' and cells['still'][1] != '–'


def test_files_compare_all_checkpoints(summaries, tmp_path):
    write_comparison(summaries, tmp_path)
    assert '| oracle, zero-shot object ' in (tmp_path / 'paper_tables.md').read_text()
    metrics = json.loads((tmp_path / 'metrics.json').read_text())
    assert metrics['num_episodes'] == {'oracle': 3, 'still': 3}
    assert metrics['methods']['oracle']['views']['low']['j_moving'] == 1.0
    rows = list(csv.DictReader((tmp_path / 'numbers.csv').open()))
    found = {
        (row['method'], row['zero_shot'], row['task'], row['view'], row['number']): row
        for row in rows
    }
    seen = found['oracle', 'seen', 'all', 'low', 'j_moving']
    assert seen['value'] == '1.0' and seen['num_episodes'] == '2'
    assert found['oracle', 'seen', 'all', 'low', 'psnr']['value'] == ''
    assert ('still', 'seen', 'all', 'low', 'j_moving') not in found


def test_one_checkpoint_keeps_its_own_metrics(summaries, tmp_path):
    write_comparison(summaries[:1], tmp_path)
    assert not (tmp_path / 'metrics.json').exists()
    assert np.isclose(summaries[0].estimates('low')['j_union'].value, 1.0)
