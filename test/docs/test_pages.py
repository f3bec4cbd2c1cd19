"""The README is a door, and the pages build into a site without a warning."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
import re
import subprocess
import sys

import pytest

from mtv_world_ros.sim.expert.faults import FAULTS

ROOT = Path(__file__).resolve().parents[2]
MOST_WORDS = 1200


def test_the_readme_is_short():
    assert len((ROOT / 'README.md').read_text().split()) <= MOST_WORDS


def test_the_readme_and_the_results_page_have_the_same_table():
    marked = re.compile(r'<!-- unseen-faults: begin -->(.*)<!-- unseen-faults: end -->', re.S)
    tables = [marked.search((ROOT / n).read_text()) for n in ('README.md', 'docs/results.md')]
    assert tables[0] is not None
    assert tables[1] is not None
    assert tables[0][1] == tables[1][1]


def test_every_page_is_linked_from_the_readme():
    readme = (ROOT / 'README.md').read_text()
    for page in (ROOT / 'docs').glob('*.md'):
        assert f'(docs/{page.name})' in readme, page.name


def test_the_index_of_benchmarks_has_every_page():
    index = (ROOT / 'docs' / 'benchmarks.md').read_text()
    for page in (ROOT / 'benchmark' / 'results').glob('*.md'):
        assert f'(../benchmark/results/{page.name})' in index, page.name


def test_every_example_is_run():
    page = (ROOT / 'docs' / 'python_api.md').read_text()
    for script in (ROOT / 'examples').glob('*.py'):
        assert f'\npython examples/{script.name}' in page, script.name


def test_the_fault_catalogue_has_a_row_for_every_kind():
    page = (ROOT / 'docs' / 'ranking.md').read_text()
    rows = re.findall(r'^\| `(\w+)` \| (\w+) \| (\w+) \|', page, re.M)
    assert rows == [(name, kind.family, kind.split) for name, kind in FAULTS.items()]


@pytest.mark.skipif(
    importlib.util.find_spec('material') is None, reason='mkdocs-material is not installed'
)
def test_the_site_builds_without_a_warning(tmp_path):
    done = subprocess.run(
        [sys.executable, '-m', 'mkdocs', 'build', '--strict', '--site-dir', str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, 'NO_MKDOCS_2_WARNING': '1'},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / 'training.html').is_file()
    assert (tmp_path / 'repository' / 'config' / 'node.yaml').is_file()
    # nothing is loaded from elsewhere
    assert 'src="http' not in (tmp_path / 'index.html').read_text()
