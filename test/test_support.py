"""What tests share does what they take for granted."""

from types import SimpleNamespace

import pytest

from test.conftest import FILE_SECONDS, pytest_collection_modifyitems
from test.support.tables import table
from test.support.tiers import FAST_LIMIT_S, file_seconds, rest_slow, tier_lines


def test_a_table_tries_all_rows_and_names_those_that_fail(tmp_path):
    tried = []

    @table('a, b', [(1, 1), (2, 3), (4, 4), (5, 6)])
    def equal(a, b, folder):
        assert folder == tmp_path
        tried.append(a)
        assert a == b

    with pytest.raises(AssertionError) as error:
        equal(folder=tmp_path)
    assert tried == [1, 2, 4, 5]
    said = str(error.value)
    assert said.startswith('2 of 4 rows: (2, 3):') and '(5, 6):' in said and '(4, 4)' not in said


def test_a_table_without_rows_is_refused():
    with pytest.raises(AssertionError, match='no rows of a'):
        table('a', [])


def report(name, seconds, when='call', **keywords):
    return pytest.TestReport(
        name, ('', 0, ''), keywords, 'passed', None, when, duration=seconds
    )  # fmt: skip


def test_items_that_outgrew_the_fast_tier_are_named_and_those_that_shrank():
    reports = [
        report('a.py::test_grown', FAST_LIMIT_S - 1, 'setup'),
        report('a.py::test_grown', 1.5),
        report('a.py::test_quick', 0.1),
        report('a.py::test_slow', 30.0, slow=1),
        report('a.py::test_shrunk[1]', 0.1, slow=1),
        report('a.py::test_shrunk[2]', 0.2, slow=1),
    ]
    first, second, third = tier_lines(reports)
    assert first.startswith('1 tests took 3 s or more and are not marked slow')
    assert second == f'{FAST_LIMIT_S + 0.5:.1f} s: a.py::test_grown'
    assert third == 'below 1 s and marked slow: a.py::test_shrunk'
    assert tier_lines(reports, most=5) == [first, second]
    assert tier_lines(reports[2:4]) == []


def test_files_are_ordered_by_the_longest_of_their_runs():
    reports = [report('a.py::test_b', 1.0, 'setup'), report('a.py::test_b[1]', 2.0)]
    found = file_seconds([*reports, report('c.py::test_d', 0.5)], {'a.py': 2.5, 'c.py': 4.0})
    assert found == {'a.py': 3.0, 'c.py': 4.0}
    assert file_seconds([], found) == found


def test_files_that_took_longest_go_first():
    items = [
        SimpleNamespace(nodeid=name, get_closest_marker=lambda marker: None)
        for name in ('quick.py::a', 'new.py::a', 'long.py::a', 'long.py::b')
    ]
    seconds = {'quick.py': 1.0, 'long.py': 9.0}
    cache = SimpleNamespace(get=lambda key, default: seconds if key == FILE_SECONDS else default)
    pytest_collection_modifyitems(SimpleNamespace(cache=cache), items)
    names = [item.nodeid for item in items]
    assert names == ['long.py::a', 'long.py::b', 'quick.py::a', 'new.py::a']


def test_parameters_that_stand_for_the_others_are_fast():
    marked = rest_slow(['a', 'b', ('c', 1)], ['b'])
    assert marked[1] == 'b'
    assert [row.values for row in (marked[0], marked[2])] == [('a',), ('c', 1)]
    assert all(row.marks[0].name == 'slow' for row in (marked[0], marked[2]))
    with pytest.raises(AssertionError, match='no parameters'):
        rest_slow(['a'], ['z'])
