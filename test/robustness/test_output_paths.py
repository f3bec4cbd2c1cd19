"""Paths that cannot be written are told at once, by every command, as they were given."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import socket
import subprocess
import sys
import time

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import check_output, write_whole
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.episode_reader import list_episodes
from test.robustness.test_commands import AT, COMMANDS, DEMO, OUT

#: longest time until it is said, once a process runs [s]
MOST_S = 1.0
#: commands of every output, with what makes the input right; the path stands for a folder or file
WRITING = {
    **{name: words for name, words in COMMANDS.items() if OUT in words},
    'demo': 'demo --out %',
    'collect': 'collect --episodes 1 --out %',
    'foresee --picture': f'foresee {DEMO} --picture %',
    'robot --picture': 'robot yam_bimanual --picture %',
    'replay': f'replay {DEMO} --offline --out %',
    'imagine --watch': f'imagine --episodes {DEMO} --watch %.rrd',
    'rank --watch': 'rank --policies expert --out {free} --watch %.rrd',
}


def _loop(folder: Path) -> Path:
    (folder / 'loop').symlink_to(folder / 'loop')
    return folder / 'loop'


def _circle(folder: Path) -> Path:
    (folder / 'a').symlink_to(folder / 'b')
    (folder / 'b').symlink_to(folder / 'a')
    return folder / 'a' / 'out'


def _dangling(folder: Path) -> Path:
    (folder / 'link').symlink_to(folder / 'nowhere')
    return folder / 'link'


def _below_dangling(folder: Path) -> Path:
    return _dangling(folder) / 'out'


def _below_file(folder: Path) -> Path:
    (folder / 'file').write_text('mine')
    return folder / 'file' / 'out'


def _pipe(folder: Path) -> Path:
    os.mkfifo(folder / 'pipe')
    return folder / 'pipe'


def _socket(folder: Path) -> Path:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.path.relpath(folder / 'socket'))
    return folder / 'socket'


PLACES: dict[str, tuple[Callable[[Path], Path], str]] = {
    'loop': (_loop, 'a link that leads to itself'),
    'circle': (_circle, 'a link that leads to itself'),
    'dangling link': (_dangling, "a link to '.*nowhere', which is missing"),
    'below a dangling link': (_below_dangling, "a link to '.*nowhere', which is missing"),
    'below a file': (_below_file, "'.*file' is a file"),
    'device': (lambda _: Path('/dev/null'), 'a device'),
    'pipe': (_pipe, 'a device, a pipe or a socket'),
    'socket': (_socket, 'a device, a pipe or a socket'),
    'long name': (lambda folder: folder / ('a' * 300), 'ame.* too long|more than 231 bytes'),
    'name that leaves no room': (lambda folder: folder / ('a' * 250), 'more than 231 bytes'),
    'kernel': (lambda _: Path('/proc/out'), 'No such file|Read-only|not permitted|denied'),
    'read-only': (lambda _: Path('/sys/out'), 'No such file|Read-only|not permitted|denied'),
}  # fmt: skip


@pytest.mark.parametrize('place', PLACES)
def test_what_cannot_be_written_is_said_with_path_reason_and_option(place, tmp_path):
    make, reason = PLACES[place]
    path = make(tmp_path)
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(ConfigError, match=reason) as error:
        check_output(path, '--somewhere')
    assert str(error.value).startswith(f"'{path}' cannot be written: ")
    assert str(error.value).endswith('; give another --somewhere')
    assert sorted(os.listdir(tmp_path)) == before


def test_what_can_be_written_leaves_no_trace(tmp_path):
    (tmp_path / 'file').write_text('mine')
    (tmp_path / 'disk').mkdir()
    (tmp_path / 'link').symlink_to(tmp_path / 'disk')
    before = sorted(os.listdir(tmp_path))
    for name in ('file', 'disk', 'link', 'link/new', 'new', 'new/and/new', 'a' * 200):
        check_output(tmp_path / name)
    check_output(Path(os.path.relpath(tmp_path / 'new')))
    assert sorted(os.listdir(tmp_path)) == before and not os.listdir(tmp_path / 'disk')


@pytest.mark.skipif(os.geteuid() == 0, reason='root may write everywhere')
def test_a_folder_without_permission_is_said(tmp_path):
    (tmp_path / 'closed').mkdir(mode=0o500)
    with pytest.raises(ConfigError, match='Permission denied'):
        check_output(tmp_path / 'closed' / 'out')


@pytest.mark.parametrize('command', WRITING)
@pytest.mark.parametrize('place', ['loop', 'dangling link', 'below a file', 'pipe', 'kernel'])
def test_every_command_says_it_before_any_work(command, place, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = PLACES[place][0](tmp_path)
    before = sorted(os.listdir(tmp_path))
    words = WRITING[command].replace(AT, str(DEMO)).replace('{free}', str(tmp_path / 'free'))
    words = words.replace(OUT, f'{path}/x' if command.endswith('--watch') else str(path))
    begin_s = time.process_time()
    assert main(words.split()) == 1
    assert time.process_time() - begin_s < MOST_S
    said = capsys.readouterr().err
    assert 'cannot be written: ' in said and str(path) in said and '.mtv-' not in said
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize(
    'words',
    [f'check {DEMO}', 'robot yam_bimanual', f'fit camera {DEMO} --view low',
     f'replay {DEMO} --offline', 'demo', f'imagine --episodes {DEMO}'],
)  # fmt: skip
def test_where_results_go_by_default_is_looked_at_as_well(words, monkeypatch, capsys):
    monkeypatch.chdir('/proc')
    assert main(words.split()) == 1
    assert "'out" in (said := capsys.readouterr().err) and 'cannot be written' in said


@pytest.mark.parametrize('kind', ['empty folder', 'link to an empty folder', 'nothing'])
def test_a_bag_is_written_into_an_empty_folder_and_through_a_link(kind, tmp_path):
    (tmp_path / 'disk').mkdir()
    path = tmp_path / 'bag'
    if kind == 'empty folder':
        path.mkdir()
    elif kind != 'nothing':
        path.symlink_to(tmp_path / 'disk')
    for overwrite in (False, True):
        with BagWriter(path, overwrite=overwrite):
            pass
        assert sorted(file.name for file in path.iterdir()) == ['bag_0.mcap', 'metadata.yaml']
    assert path.is_symlink() == (kind == 'link to an empty folder')
    assert sorted(os.listdir(tmp_path)) == ['bag', 'disk']


#: of a process whose file names are ASCII
ASCII = {'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'}


def test_ascii_terminals_get_every_text(tmp_path):
    code = (
        'import sys\n'
        'from mtv_world_ros.cli import main\n'
        'assert sys.stdout.encoding == "ascii", sys.stdout.encoding\n'
        'status = main(sys.argv[1:])\n'
        'print("\\u2026 \\udcff")\n'
        'sys.exit(status)\n'
    )
    command = [sys.executable, '-c', code, 'robot', 'yam_bimanual', '--picture', 'a.png']
    environment = {**os.environ, **ASCII}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, timeout=60)
    assert done.returncode == 0 and b'Traceback' not in done.stderr, done.stderr
    assert done.stdout.endswith(b'\\u2026 \\udcff\n')


@pytest.mark.parametrize(
    ('locale', 'name', 'said'),
    [(ASCII, 'ü'.encode(), b"'\\xfc' cannot be used in a locale of ASCII names; set LC_ALL="),
     ({'PYTHONUTF8': '1'}, b'\xfc', b"'\\udcfc' holds bytes that are no UTF-8"),
     (ASCII, b'\xfc', b"'\\udcfc' holds bytes that are no UTF-8")],
)  # fmt: skip
@pytest.mark.parametrize('words', [['collect', '--out'], ['evaluate', '--out', 'x'], ['check']])
def test_names_that_cannot_be_written_into_files_are_told_before_any_work(
    locale, name, said, words, tmp_path
):
    command = [sys.executable, '-m', 'mtv_world_ros.cli', *words, name]
    environment = {**os.environ, **locale}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, timeout=60)
    assert done.returncode == 1 and said in done.stderr, done.stderr
    lines = [line for line in done.stderr.splitlines() if not line.endswith(b': loading')]
    assert len(lines) == 1 and os.listdir(tmp_path) == []


def test_a_present_folder_whose_name_is_no_utf8_is_told_before_any_work(tmp_path):
    folder = os.fsencode(tmp_path) + b'/\xff'
    os.mkdir(folder)
    command = [sys.executable, '-m', 'mtv_world_ros.cli', 'robot', 'panda', '--picture', 'x']
    done = subprocess.run(command, cwd=folder, capture_output=True, timeout=60)
    assert done.returncode == 1 and b'holds bytes that are no UTF-8' in done.stderr


def test_an_episode_whose_name_is_no_utf8_is_told_when_a_folder_is_listed(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b'/\xff'))
    folder.mkdir()
    (folder / 'metadata.yaml').write_text('')
    with pytest.raises(ConfigError, match='holds bytes that are no UTF-8'):
        list_episodes(tmp_path)


def test_texts_with_names_that_are_no_utf8_are_written(tmp_path):
    write_whole(tmp_path / 'page', 'über \udcff')
    assert (tmp_path / 'page').read_text('utf-8') == 'über \\udcff'
    write_whole(tmp_path / 'page', os.fsdecode('ü'.encode()) + ' \udcc3\udcbc')
    assert (tmp_path / 'page').read_text('utf-8') == 'ü ü'
