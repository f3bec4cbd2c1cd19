"""Whatever a user can set or import has a row in `surface.json` that says who sets it."""

from __future__ import annotations

import re

import pytest

from test.support.pages import generator
from test.support.surface import live, ROOT, written

#: most keys of the basic tier of configuration files, and most basic parameters of the node
MOST_BASIC_KEYS, MOST_BASIC_PARAMETERS = 40, 15
_RECORD = "'python test/record_surface.py' writes the rows of test/surface.json"
_FILE = re.compile(r'[\w./-]*\w\.(?:md|py|yaml|json)|Makefile')
#: pages that list everything, and so say nothing about who sets it
_LISTS = {'docs/commands.md', 'docs/configuration.md', 'docs/parameters.md', 'test/surface.json'}


@pytest.fixture(scope='module')
def surface():
    return live()


@pytest.mark.parametrize('kind', list(written()))
def test_the_file_has_a_row_for_all_that_can_be_set_and_for_nothing_else(kind, surface):
    rows, names = written()[kind], set(surface[kind])
    new, gone = sorted(names - set(rows)), sorted(set(rows) - names)
    assert not new, (
        f'{kind} {new} have no row. Every one is kept working for years: answer the six '
        f'questions of CONTRIBUTING.md first. Then {_RECORD}; write into each who sets it'
    )
    assert not gone, (
        f'{kind} {gone} are gone, but have rows. If somebody may miss one, add it to '
        f'REMOVED_OPTIONS of cli/commands.py, REMOVED of ros/parameters.py, REPLACED of its '
        f'launch file or `removed` of its '
        f'schema, with what to use now; then {_RECORD}'
    )


def test_the_file_has_all_kinds(surface):
    assert list(written()) == list(surface), _RECORD


@pytest.mark.parametrize('kind', list(written()))
def test_every_row_names_a_file_that_sets_or_explains_it(kind):
    for name, who in written()[kind].items():
        assert who, f'{kind} {name}: the row is empty; write who sets it, with a file that does'
        files = [file for file in _FILE.findall(who) if file not in _LISTS]
        assert files, f'{kind} {name}: {who!r} names no page, example, preset or test'
        word = re.split(r'[ .]', name)[-1]
        for file in files:
            path = ROOT / file
            assert path.is_file(), f'{kind} {name}: there is no {file}; write who sets it now'
            if kind != 'options' or word.startswith('-'):  # arguments by place have no name
                assert word in path.read_text(), (
                    f"{kind} {name}: {file} has no '{word}' any more; write who sets it now, or "
                    'remove it where nobody does'
                )


def test_the_basic_tier_is_small_and_has_known_keys():
    page = generator('configuration_page')
    shown = {kind for file, parts in page.sections() for kind in (file.schema, *parts)}
    basic = {kind: getattr(kind, 'basic', ()) for kind in shown}
    for kind, names in basic.items():
        assert not set(names) - set(page.keys(kind)), kind.__name__
    assert 20 <= sum(map(len, basic.values())) <= MOST_BASIC_KEYS
    parameters = generator('parameter_tables').NODES['world_model']
    assert set(parameters.basic) < set(parameters.model_fields)
    assert len(parameters.basic) <= MOST_BASIC_PARAMETERS
