"""Scores of several rankings together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import json
from math import isfinite, isnan, nan
from pathlib import Path
from types import ModuleType

import pytest

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.ranking.jobs import Result, StoredEstimate
from test.support.scripts import imported_scripts

UNKNOWN = StoredEstimate.stated(nan, 'abstains')


@pytest.fixture(scope='module')
def pooled() -> Iterator[ModuleType]:
    """The experiment as a module."""
    with imported_scripts('pooled_rankings') as (script,):
        yield script


def result(task: str, final: bool, pictures: float, rule: float = 0.5) -> Result:
    said = StoredEstimate.stated(pictures, 'pictures') if pictures == pictures else UNKNOWN
    return Result(
        policy=f'expert-late-{1 if final else 2}',
        task=task,
        index=0,
        seed=1,
        ever=final,
        final=final,
        imagined=said,
        pictures=said,
        seen=StoredEstimate.stated(float(final), 'frames'),
        no_picture=StoredEstimate.stated(rule, 'rule'),
        num_chunks=1,
        num_imagined=1,
        is_over=True,
        seconds={},
    )


def write(folder: Path, results: list[Result], checkpoint: str = 'paper (1)') -> Path:
    """Write what `mtv-world rank` leaves of its rollouts."""
    (folder / 'rollouts').mkdir(parents=True)
    for number, one in enumerate(results):
        stored = {'settings': {'checkpoint': checkpoint}, 'result': one.as_json()}
        text = json.dumps(stored).replace('NaN', 'null')
        (folder / 'rollouts' / f'{number}.json').write_text(text)
    (folder / 'ranking.json').write_text('{}')
    return folder


def test_scenes_of_two_rankings_are_two_clusters(pooled: ModuleType):
    rankings = [[result('stack', True, 0.9), result('stack', False, 0.1)]] * 3
    together = pooled.pooled(rankings)
    assert len({(r.task, r.index) for r in together}) == 3
    interval = pooled.scores(together, together, 'pictures')['abstention'].interval
    assert isfinite(interval[0]) and isfinite(interval[1])
    # as rollouts of one scene they would say nothing about another scene
    shared = [replace(one, index=0) for one in together]
    interval = pooled.scores(shared, shared, 'pictures')['abstention'].interval
    assert isnan(interval[0]) and isnan(interval[1])


def test_the_table_has_each_ranking_and_all_together(pooled, tmp_path, capsys):
    # by hand: 3 of 4 pairs of a success and a failure are in order, 1 of 2 failures is called one
    first = write(tmp_path / 'a', [result('stack', True, 0.95), result('stack', False, 0.01)])
    second = write(
        tmp_path / 'b',
        [result('cup', True, 0.9), result('cup', False, 0.92), result('cup', True, nan)],
    )
    pooled.main([str(first), str(second)])
    shown = capsys.readouterr().out
    assert '0.60 of 5 rollouts really succeed' in shown
    lines = {
        tuple(cells[:2]): cells[2:]
        for cells in (
            [cell.strip() for cell in line.strip('|').split('|')]
            for line in shown.splitlines()
            if line.startswith('|')
        )
    }
    whole = lines['all', 'pictures alone']
    assert whole[0] == '5' and whole[1].startswith('0.75') and whole[1].endswith('of 4')
    assert whole[2].startswith('0.50') and whole[2].endswith('of 2')
    assert whole[3].startswith('0.20') and whole[3].endswith('of 5')
    assert lines['b', 'pictures alone'][1].startswith('0.00')
    assert ('all', 'both') not in lines  # nothing was foreseen


@pytest.mark.parametrize(
    ('spoil', 'words'),
    [
        (lambda folder: (folder / 'ranking.json').unlink(), 'no finished ranking'),
        (lambda folder: _rename(folder, 'another (2)'), 'one is needed'),
    ],
)
def test_rankings_that_cannot_be_pooled_are_named(pooled, tmp_path, spoil, words):
    folder = write(tmp_path / 'a', [result('cup', True, 0.9), result('cup', False, 0.2)])
    spoil(folder)
    with pytest.raises(ConfigError, match=words):
        pooled.main([str(folder)])


def test_rankings_of_two_checkpoints_are_refused(pooled, tmp_path):
    results = [result('cup', True, 0.9), result('cup', False, 0.2)]
    folders = [write(tmp_path / name, results, name) for name in 'ab']
    with pytest.raises(ConfigError, match='cannot be pooled'):
        pooled.main(list(map(str, folders)))


def _rename(folder: Path, checkpoint: str) -> None:
    file = folder / 'rollouts' / '0.json'
    stored = json.loads(file.read_text())
    stored['settings']['checkpoint'] = checkpoint
    file.write_text(json.dumps(stored))
