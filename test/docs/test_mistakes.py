"""docs/mistakes.md: every mistake in it is made here, and answered as the page says."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatchcase
import json
from pathlib import Path
import re
import shlex
import shutil
import socket

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / 'docs' / 'mistakes.md'


def sessions() -> list[tuple[str, str]]:
    """Commands and answers of the page."""
    blocks = re.findall(r'```text\n(.*?)```', PAGE.read_text(), re.S)
    found = [part for block in blocks for part in re.split(r'^\$ ', block, flags=re.M)[1:]]
    return [(one.partition('\n')[0], one.partition('\n')[2].strip()) for one in found]


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    """What the page's commands find: half an evaluation, predictions, a report, a checkpoint."""
    out = tmp_path_factory.mktemp('mistakes')
    shutil.copytree(share_path('resource', 'demo_episode'), out / 'data' / 'demo_episode')
    half = out / 'out' / 'half' / 'episodes'
    half.mkdir(parents=True)
    (half / 'one.json').write_text('{}')
    old = out / 'out' / 'old'
    old.mkdir()
    (old / 'metrics.json').write_text(json.dumps({'episodes': [], 'name': 'an old one'}))
    for name in ('imagined/episode_00000', 'predictions'):
        (out / 'out' / name).mkdir(parents=True)
        (out / 'out' / name / 'metadata.yaml').write_text('')
    mine = out / 'runs' / 'mine' / 'checkpoint'
    mine.mkdir(parents=True)
    for name in ('world_model.json', 'success_calibration.json'):
        shutil.copy(share_path('resource', 'checkpoint') / name, mine)
    return out


@pytest.fixture
def port(folder) -> Iterator[None]:
    """The viewer's port is in use."""
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            taken.bind(('127.0.0.1', 9090))
            taken.listen()
        except OSError:
            pass  # somebody else has it
        yield


@pytest.mark.parametrize(('command', 'answer'), sessions())
def test_a_mistake_is_answered_as_the_page_says(
    command, answer, folder, port, monkeypatch, capsys
):
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob('*') if path.is_file()}
    words = shlex.split(command)
    assert words[0] == 'mtv-world'
    if '9090' in answer:
        pytest.importorskip('rerun')
    if 'cuda' in command:
        torch = pytest.importorskip('torch')
        if torch.cuda.is_available():
            pytest.skip('there is a GPU')
    try:
        status = main(words[1:])
    except SystemExit as end:
        status = end.code
    said = capsys.readouterr()
    # a slow machine says first that the command is loading
    told = re.sub(r'mtv-world: [\w ]+: loading\n', '', said.out + said.err).strip()
    wanted = answer.replace('[', '[[]').replace('...', '*')
    assert fnmatchcase(told, wanted), f'{told}\n\nis not\n\n{answer}'
    if '--version' not in words:
        assert status not in (0, None)
    after = {path: path.stat().st_mtime_ns for path in folder.rglob('*') if path.is_file()}
    assert {p: after.get(p) for p in before} == before


def test_the_tests_that_the_page_names_are_there():
    named = set(re.findall(r'`(test_\w+)`', PAGE.read_text()))
    written = '\n'.join(path.read_text() for path in (ROOT / 'test').rglob('test_*.py'))
    assert len(named) > 8
    assert not {name for name in named if f'def {name}(' not in written}
