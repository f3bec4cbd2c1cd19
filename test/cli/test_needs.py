"""Packages that a command needs are checked before any work, all in one line."""

import re

import pytest

from mtv_world_ros.cli import main, needs
from mtv_world_ros.core.extras import extra_of


@pytest.fixture
def bare(monkeypatch):
    """As after `make demo`, which installs no extra but ROS."""
    monkeypatch.setattr(needs, 'find_spec', lambda module: None)


@pytest.mark.parametrize(
    ('command', 'says'),
    [
        (['train', 'data', '--out', 'run'], "tensorboard is .*mtv_world_ros.train.'"),
        (
            ['evaluate', 'bundled', 'data', '--out', 'out', '--quality', 'psnr'],
            "matplotlib, torchmetrics are not installed: make in .*'mtv_world_ros.evaluate.'",
        ),
        (['rank', '--out', 'out'], "matplotlib is not installed"),
        (['view', 'data'], "rerun is not installed.*'mtv_world_ros.view.'"),
        (['import', 'lerobot', 'data', '--out', 'out'], "pyarrow is .*'mtv_world_ros.import.'"),
    ],
)  # fmt: skip
def test_a_command_names_all_that_is_missing_first(
    command, says, bare, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(command) == 1
    said = capsys.readouterr()
    assert len(said.err.splitlines()) == 1 and not said.out
    assert re.search(says, said.err), said.err


def test_what_an_option_leaves_out_is_not_needed(bare, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ['evaluate', 'bundled', 'data', '--out', 'out', '--no-report']
    assert main(command) == 1
    assert 'not installed' not in capsys.readouterr().err  # there is no folder 'data'


def test_every_package_that_is_checked_belongs_to_an_extra():
    lists = (*needs._ALWAYS.values(), *needs._WITH_OPTION.values())
    for name in {name for names in lists for name in names}:
        assert extra_of(name), name
