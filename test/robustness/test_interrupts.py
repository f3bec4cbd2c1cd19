"""The short part of `make attacks`: commands that are interrupted, and run again."""

from __future__ import annotations

from pathlib import Path
import shutil
import signal

import pytest

from mtv_world_ros.core.files import share_path
from robustness.interrupts import Attack, halves, WAYS


@pytest.fixture(scope='module')
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled episode as a data set."""
    folder = tmp_path_factory.mktemp('given')
    shutil.copytree(share_path('resource', 'demo_episode'), folder / 'set' / 'stack_blocks_00001')
    return folder


@pytest.fixture(autouse=True)
def heed_sigint():
    """A shell starts background jobs deaf to SIGINT, and they start theirs so."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.slow
@pytest.mark.parametrize('name', ['import-bag', 'export-dataset'])
def test_an_interrupted_command_leaves_nothing_half_and_a_second_run_makes_it_whole(
    name: str, given: Path, tmp_path: Path
) -> None:
    one = Attack(name, given, tmp_path)
    assert one.expected
    for way, share in zip(WAYS, (0.5, 0.7, 0.9), strict=True):
        end, _, wrong = one.attempt(way, share * one.whole_s)
        assert not wrong, f'{way} after {share:g} of {one.whole_s:.1f} s, {end}: {wrong}'


def test_what_is_cut_off_is_found(tmp_path: Path) -> None:
    (tmp_path / 'a.json').write_text('{"a": ')
    (tmp_path / 'b.json').write_text('{}')
    (tmp_path / '.c.json.12.part').write_text('{')
    expected = {'a.json': 9, 'b.json': 2}
    (wrong,) = halves(tmp_path, expected, {'b.json': None})
    assert wrong.startswith('a.json: JSONDecodeError')
    assert halves(tmp_path, {'b.json': 2}, {'b.json': 7}) == ['b.json: None, whole 7']
