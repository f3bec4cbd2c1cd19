"""Intervals of the reports in 1,000 simulated sets: they hold the truth as often as they say."""

from __future__ import annotations

from pathlib import Path
import re

import numpy as np
import pytest

from test.support.scripts import imported_scripts

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope='module')
def benchmark(tmp_path_factory):
    """The benchmark's script, which imports its neighbour `page`."""

    with imported_scripts('interval_coverage') as (module,):
        yield module


@pytest.mark.parametrize('name', ['t, mean of J', 'Wilson, share of independent trials'])
def test_the_table_is_what_the_code_gives_and_93_to_97_percent_hold(benchmark, name):
    """Any change of an interval, or of the draws, changes it."""
    (page,) = (ROOT / 'experiments' / 'results').glob('interval_coverage_*.md')
    row = re.search(rf'^\| {name} \| mild \| (.+) \|$', page.read_text(), re.M)
    told = [float(cell.split()[0]) for cell in row[1].split(' | ')]
    found = [benchmark.coverage(name, num, 1000, 0)[0] for num in benchmark.SIZES]
    np.testing.assert_allclose(told, found, atol=6e-4)
    assert benchmark.SIZES == (4, 8, 20, 60)
    assert 0.93 <= min(found) <= max(found) <= 0.97


def test_the_percentile_bootstrap_did_not(benchmark):
    covered, _ = benchmark.coverage('before: percentile bootstrap, mean of J', 4, 300, 0)
    assert covered < 0.9


@pytest.mark.parametrize(
    'name', ['t, paired difference of two judges', 'jackknife by scene, AUROC']
)
@pytest.mark.parametrize('differs', [False, True])
def test_differences_and_areas_hold_the_truth_in_both_populations(benchmark, name, differs):
    covered = [benchmark.coverage(name, num, 250, 7, differs)[0] for num in benchmark.SIZES]
    assert 0.93 <= np.mean(covered) <= 0.98 and min(covered) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize('differs', [False, True])
def test_r_and_mmrv_hold_the_truth_in_both_populations(benchmark, differs):
    """93 to 97 % is the aim; the page says what is reached (r: 93 % at 4 scenes, 99 % if mild)."""
    found = [benchmark.ranking_scores(num, 40, 7, differs) for num in benchmark.SIZES]
    for name, least in (('pearson', -1.0), ('mmrv', 0.0)):
        scores = [one for by_size in found for one in by_size[name]]
        assert all(least <= s.interval[0] < s.interval[1] <= 1.0 for s, _ in scores)
        assert (0.9 if differs else 0.93) <= benchmark.held(scores) < 1.0
