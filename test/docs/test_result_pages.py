"""Every page of results says what it was made with; those that are older than that are named."""

from __future__ import annotations

import importlib.util
from pathlib import Path
import subprocess
import warnings

import pytest

from mtv_world_ros.core.files import content_digest
from mtv_world_ros.model.checkpoint import checkpoint_folder

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / 'experiments' / 'results').glob('*.md'))


@pytest.fixture(scope='module')
def page():
    spec = importlib.util.spec_from_file_location('page', ROOT / 'experiments' / 'page.py')
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_page_names_its_commit_and_checkpoint(page):
    bundled = content_digest(checkpoint_folder('bundled'))[:8]
    stale = {path.name: why for path in PAGES if (why := page.why_stale(path, bundled=bundled))}
    told = ''.join(f'\n  {name}: {"; ".join(why)}' for name, why in stale.items())
    if stale:
        warnings.warn(
            f'{len(stale)} of {len(PAGES)} pages of results are old:{told}', stacklevel=1
        )


def test_what_is_compared_takes_turns_and_first_place_changes(page):
    order, clock = [], iter(range(1000))
    works = {name: (lambda name=name: order.append(name)) for name in 'ab'}
    spent = page.in_turns(works, 3, clock=lambda: next(clock))
    assert ''.join(order) == 'abbaabba' and spent == {'a': [1, 1, 1], 'b': [1, 1, 1]}
    # the machine gets slower: the ratio of the same turns does not notice
    assert page.ratio([2.0, 4.0, 40.0], [1.0, 2.0, 20.0]) == 2.0


def test_a_page_older_than_what_it_describes_is_found(page, tmp_path):
    def git(*words):
        identity = ['-c', 'user.name=a', '-c', 'user.email=a@example.org']
        done = subprocess.run(
            ['git', *identity, *words], cwd=tmp_path, check=True, capture_output=True, text=True
        )
        return done.stdout.strip()

    def commit(name, text):
        (tmp_path / name).write_text(text)
        git('add', '.')
        git('commit', '-qm', name)
        return git('rev-parse', '--short', 'HEAD')

    git('init', '-q')
    first = commit('code.py', '1')
    about = tmp_path / 'page.md'
    about.write_text(
        f'# Title\n\nMade at commit `{first}`, bundled checkpoint `abcd0123`. Describes: '
        '`code.py`.\n'
    )
    assert page.why_stale(about, tmp_path, 'abcd0123') == []
    commit('other.py', '1')
    assert page.why_stale(about, tmp_path, 'abcd0123') == []
    commit('code.py', '2')
    assert page.why_stale(about, tmp_path, 'ffff0123') == [
        'of checkpoint abcd0123, the bundled one is ffff0123',
        f'1 commits changed code.py after {first}',
    ]
    about.write_text('# Title\n')
    with pytest.raises(ValueError, match='has no line'):
        page.why_stale(about, tmp_path)


def test_a_new_page_gets_the_line(page, tmp_path):
    line = page.made_line('wan_1_3b')
    assert 'Describes: `mtv_world_ros/model`.' in line and 'no checkpoint' in line
    (tmp_path / 'page.md').write_text(f'# Title\n\n{page.made_line("serving_cpu2")}\n')
    bundled = content_digest(checkpoint_folder('bundled'))[:8]
    assert page.why_stale(tmp_path / 'page.md', bundled=bundled) == []
