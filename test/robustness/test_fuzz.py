"""The short, repeatable part of `make fuzz`: nothing that is read ends in a traceback or hangs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
import os
from pathlib import Path
import resource
import tempfile
import tracemalloc

import numpy as np
import pytest

from mtv_world_ros.core.errors import MtvWorldError
from robustness import bad_input_table, fuzz, node_messages, parameter_calls
from robustness.accidents import ACCIDENTS
from robustness.file_kinds import Kind, KINDS
from test.support.tiers import rest_slow

SEED = 20261122
COUNT = 40
#: kinds whose cases compute: networks and simulations
SLOW_KINDS = ('plan, imagined', 'scene, foreseen', 'checkpoint', 'checkpoint, numbers')
FAST_KINDS = [kind for kind in KINDS if kind not in SLOW_KINDS]
#: more memory than an accident may take [MB]
MOST_MB = 300


@pytest.fixture(scope='module', autouse=True)
def nodes_end() -> Iterator[None]:
    """Those whose parameters were set are not there for the tests of another module."""
    yield
    parameter_calls.close()


@pytest.mark.parametrize('name', rest_slow(KINDS, FAST_KINDS))
def test_damaged_input_is_read_or_refused_with_a_reason(name, tmp_path) -> None:
    kind = KINDS[name]
    samples = kind.samples()
    fuzz.warm_up(kind, samples, tmp_path)
    outcomes = [fuzz.attempt(kind, sample, tmp_path)[0] for sample in samples[:3]]
    # what is not damaged is read
    assert set(outcomes) == {'survived'}
    for case in range(max(round(COUNT * min(kind.share, 2.0)), 2)):
        outcome, _ = fuzz.attempt(kind, fuzz.make_case(kind, samples, SEED, case), tmp_path)
        assert outcome in ('rejected', 'survived'), f'--seed {SEED} --case {case}: {outcome}'


@cache
def warm_up(kind: str) -> None:
    """Read a whole sample: what is imported and loaded for it is not what an accident takes."""
    with tempfile.TemporaryDirectory() as folder:
        fuzz.warm_up(KINDS[kind], KINDS[kind].samples(), Path(folder))


@pytest.mark.parametrize('name', ACCIDENTS)
def test_what_once_was_an_accident_is_refused_in_time(name, tmp_path) -> None:
    kind, make = ACCIDENTS[name]
    warm_up(kind)
    data = make()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    outcome, _ = fuzz.attempt(KINDS[kind], data, tmp_path)
    more_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    # the node limits an instruction's length; matching one takes as long as it is
    assert outcome == ('survived' if kind == 'instruction' else 'rejected')
    assert more_mb < MOST_MB
    # the page says what is answered: `python -m robustness.bad_input_table` writes it
    shown = bad_input_table.answer(KINDS[kind], make(), tmp_path)
    assert bad_input_table.row(name, shown) in bad_input_table.written_rows()


def test_an_error_that_is_not_ours_and_a_slow_case_are_failures(tmp_path) -> None:
    def crash(data, folder):
        raise KeyError('of somebody')

    kind = Kind(lambda: [b'x'], crash)
    assert 'KeyError' in fuzz.attempt(kind, b'x', tmp_path)[0]
    slow = Kind(lambda: [b'x'], lambda data, folder: sum(range(10**6)), most_s=0.0)
    assert 'took' in fuzz.attempt(slow, b'x', tmp_path)[0]


def test_a_list_that_is_made_longer_takes_no_more_than_is_kept_of_it() -> None:
    values = [0.0] * 30_000
    tracemalloc.start()
    try:
        lengths = [
            len(node_messages.changed_list(np.random.default_rng(seed), values, lambda: 1.0))
            for seed in range(40)
        ]
        peak_mb = tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()
    assert max(lengths) >= 30_000
    assert peak_mb < 5  # 300 copies before the cut: 69 MB


def test_processes_that_fuzz_leave_no_folder_behind(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    monkeypatch.setattr(tempfile, 'tempdir', None)
    row = fuzz.new_row('episode', SEED)
    assert Path(tempfile.gettempdir()) == tmp_path
    fuzz.fuzz(row, range(2))
    assert row['tried'] == 2 and not row['failures']
    assert list(tmp_path.iterdir()) == []


def _die(data, folder):
    os._exit(3)


def _refuse(data, folder):
    raise MtvWorldError('not this one')


@pytest.mark.parametrize(
    ('read', 'says'), [(_refuse, 'not this one'), (_die, 'the process hung or died')]
)
def test_a_kind_whose_whole_sample_is_not_read_fails_at_once(read, says, monkeypatch) -> None:
    kind = Kind(lambda: [b'x'], read)
    monkeypatch.setitem(fuzz.KINDS, 'broken', kind)
    # children that are forked know the kind
    monkeypatch.setattr(fuzz, 'START', 'fork')
    row = fuzz.new_row('broken', SEED)
    fuzz.fuzz(row, range(50))
    assert row['tried'] == 0
    (text,) = row['failures'].values()
    assert says in text
