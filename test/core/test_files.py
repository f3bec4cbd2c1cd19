import fcntl
import os
import signal
import subprocess
import sys
import time

import pytest

from mtv_world_ros.core import files
from mtv_world_ros.core.files import (
    copy_folder,
    recover_folder,
    replace_folder,
    whole_folder,
    write_whole,
)

#: number of a process that never is: above the kernel's greatest (4194304)
NO_PROCESS = 9999999


def replace(folder, text):
    with whole_folder(folder) as partial:
        (partial / 'file').write_text(text)


@pytest.mark.parametrize(('content', 'data'), [('grün\n', 'grün\n'.encode()), (b'\0\1', b'\0\1')])
def test_file_has_the_content_and_nothing_lies_beside_it(tmp_path, content, data):
    path = tmp_path / 'new' / 'file'
    write_whole(path, content)
    write_whole(path, content)
    assert path.read_bytes() == data
    assert os.listdir(path.parent) == ['file']


@pytest.mark.parametrize(
    'error', [OSError(28, 'No space left on device'), KeyboardInterrupt()], ids=['full', 'Ctrl-C']
)
def test_what_was_there_stays_where_the_new_is_not_written(tmp_path, monkeypatch, error):
    path = tmp_path / 'file'
    write_whole(path, 'old')

    def half(self, data):
        with self.open('wb') as file:
            file.write(data[:2])
        raise error

    monkeypatch.setattr('pathlib.Path.write_bytes', half)
    with pytest.raises(type(error)):
        write_whole(path, 'new content')
    assert path.read_text() == 'old'
    assert os.listdir(tmp_path) == ['file']


def test_a_folder_in_place_of_the_file_is_named(tmp_path):
    (tmp_path / 'page.html').mkdir()
    with pytest.raises(IsADirectoryError, match=r"page\.html' is a folder; name a file"):
        write_whole(tmp_path / 'page.html', 'text')
    assert os.listdir(tmp_path) == ['page.html']


def names(folder):
    return sorted(os.listdir(folder))


def test_a_folder_is_replaced_whole_and_nothing_lies_beside_it(tmp_path):
    for text in ('first', 'second'):
        replace(tmp_path / 'new' / 'x', text)
        assert (tmp_path / 'new' / 'x' / 'file').read_text() == text
        assert names(tmp_path / 'new') == ['x']


def test_folders_of_the_user_with_similar_names_are_left_alone(tmp_path):
    theirs = ['x.old', 'x.partial', '.x.old', '.x.mtv-old', '.x.mtv-old-1x', 'y.old']
    for name in theirs:
        (tmp_path / name).mkdir()
        (tmp_path / name / 'mine').write_text(name)
    (tmp_path / 'x.old' / 'notes').write_text('what the other does not have')
    (tmp_path / f'.x.mtv-old-{NO_PROCESS}').write_text('a file, no folder')
    for _ in range(2):
        replace(tmp_path / 'x', 'new')
    assert names(tmp_path) == sorted([*theirs, 'x', f'.x.mtv-old-{NO_PROCESS}'])
    assert all((tmp_path / name / 'mine').read_text() == name for name in theirs)


@pytest.mark.parametrize('name', ['x.old', 'x.partial'])
def test_a_folder_that_the_user_moved_away_does_not_come_back(tmp_path, name):
    (tmp_path / name).mkdir()
    recover_folder(tmp_path / 'x')
    replace(tmp_path / 'x', 'new')
    assert names(tmp_path) == ['x', name] and not os.listdir(tmp_path / name)


def test_what_an_earlier_version_left_between_its_renames_is_renamed_back(tmp_path):
    for name in ('x.old', 'x.partial'):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'file').write_text(name)
    recover_folder(tmp_path / 'x')
    assert names(tmp_path) == ['x'] and (tmp_path / 'x' / 'file').read_text() == 'x.old'


def test_an_error_leaves_the_old_folder_and_nothing_else(tmp_path):
    replace(tmp_path / 'x', 'old')
    with pytest.raises(KeyboardInterrupt), whole_folder(tmp_path / 'x'):
        raise KeyboardInterrupt
    assert names(tmp_path) == ['x'] and (tmp_path / 'x' / 'file').read_text() == 'old'


def test_an_error_between_the_two_renames_brings_the_old_folder_back(tmp_path, monkeypatch):
    replace(tmp_path / 'x', 'old')
    rename = os.rename

    def stopped(source, target, **options):
        if 'mtv-new' in os.fspath(source):
            raise KeyboardInterrupt
        return rename(source, target, **options)

    monkeypatch.setattr(os, 'rename', stopped)
    with pytest.raises(KeyboardInterrupt):
        replace(tmp_path / 'x', 'new')
    assert names(tmp_path) == ['x'] and (tmp_path / 'x' / 'file').read_text() == 'old'


@pytest.mark.parametrize('word', ['mtv-new', 'mtv-old', 'mtv-waste'])
def test_leftovers_of_a_killed_process_go_where_the_folder_is_whole(tmp_path, word):
    replace(tmp_path / 'x', 'whole')
    (tmp_path / f'.x.{word}-{NO_PROCESS}').mkdir()
    recover_folder(tmp_path / 'x')
    assert names(tmp_path) == ['x'] and (tmp_path / 'x' / 'file').read_text() == 'whole'


def test_a_process_killed_between_the_two_renames_loses_nothing(tmp_path):
    """Killed by SIGKILL at every rename in turn: one of both contents is there, whole."""
    script = (
        'import os, signal, sys\n'
        'from pathlib import Path\n'
        'from mtv_world_ros.core.files import whole_folder\n'
        'number, rename = int(sys.argv[1]), os.rename\n'
        'def killed(*names, **options):\n'
        '    global number\n'
        '    number -= 1\n'
        '    if number < 0: os.kill(os.getpid(), signal.SIGKILL)\n'
        '    return rename(*names, **options)\n'
        'os.rename = killed\n'
        'with whole_folder(Path(sys.argv[2])) as partial:\n'
        '    (partial / "file").write_text("new")\n'
    )
    for number, expected in enumerate(('old', 'old', 'new', 'new')):
        replace(tmp_path / 'x', 'old')
        done = subprocess.run([sys.executable, '-c', script, str(number), str(tmp_path / 'x')])
        assert done.returncode == (0 if number == 3 else -signal.SIGKILL)
        recover_folder(tmp_path / 'x')
        assert names(tmp_path) == ['x'] and (tmp_path / 'x' / 'file').read_text() == expected


def test_what_a_living_process_writes_is_left_alone(tmp_path):
    script = (
        'import sys, time\n'
        'from pathlib import Path\n'
        'from mtv_world_ros.core.files import whole_folder\n'
        'with whole_folder(Path(sys.argv[1])):\n'
        '    print("ready", flush=True)\n'
        '    time.sleep(60)\n'
    )
    command = [sys.executable, '-c', script, str(tmp_path / 'x')]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        beside = f'.x.mtv-new-{other.pid}'
        replace(tmp_path / 'x', 'new')
        assert names(tmp_path) == [beside, 'x']
        other.kill()
        other.wait()
        end_s = time.monotonic() + 5
        while names(tmp_path) != ['x'] and time.monotonic() < end_s:
            recover_folder(tmp_path / 'x')
    assert names(tmp_path) == ['x']


def test_without_locks_the_number_says_whether_the_process_lives(tmp_path, monkeypatch):
    def unsupported(*_):
        raise OSError(95, 'Operation not supported')

    monkeypatch.setattr(fcntl, 'flock', unsupported)
    for pid in (NO_PROCESS, 1, os.getpid()):
        (tmp_path / f'.x.mtv-new-{pid}').mkdir()
    replace(tmp_path / 'x', 'new')
    assert names(tmp_path) == ['.x.mtv-new-1', 'x']


def test_a_link_to_a_folder_stays_a_link(tmp_path):
    (tmp_path / 'disk').mkdir()
    (tmp_path / 'x').symlink_to(tmp_path / 'disk')
    replace(tmp_path / 'x', 'new')
    assert (tmp_path / 'x').is_symlink() and (tmp_path / 'disk' / 'file').read_text() == 'new'
    assert names(tmp_path) == ['disk', 'x']


@pytest.mark.parametrize(('umask', 'mode'), [(0o077, 0o700), (0o027, 0o750), (0o022, 0o755)])
def test_who_may_read_is_what_the_umask_says(tmp_path, umask, mode):
    from mtv_world_ros.data.bag.writer import BagWriter

    before = os.umask(umask)
    try:
        replace(tmp_path / 'x', 'new')
        write_whole(tmp_path / 'file', 'new')
        with BagWriter(tmp_path / 'bag'):
            pass
    finally:
        os.umask(before)
    modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.rglob('*')}
    folders = {name: found for name, found in modes.items() if name in ('x', 'bag')}
    assert folders == {'x': mode, 'bag': mode}
    assert all(found == mode & 0o666 for name, found in modes.items() if name not in folders)


def test_copies_of_folders_hold_regular_files_alone(tmp_path):
    source = tmp_path / 'source'
    (source / 'inside').mkdir(parents=True)
    (tmp_path / 'blob').write_text('of a cache')
    (source / 'inside' / 'link').symlink_to(tmp_path / 'blob')
    copy_folder(source, tmp_path / 'copy')
    copied = tmp_path / 'copy' / 'inside' / 'link'
    assert copied.read_text() == 'of a cache' and not copied.is_symlink()
    for name, place in (('endless', '/dev/zero'), ('waits', None)):
        bad = tmp_path / name
        bad.mkdir()
        (bad / 'x').symlink_to(place) if place else os.mkfifo(bad / 'x')
        with pytest.raises(OSError, match='regular file|named pipe'):
            copy_folder(bad, tmp_path / f'{name}_copy')


def two_folders(tmp_path):
    for name in ('old', 'new'):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'file').write_text(name)
    return tmp_path / 'old', (tmp_path / 'new').rename(tmp_path / '.old.1234.tmp')


@pytest.mark.parametrize('exchanges', [True, False])
def test_a_folder_is_replaced_whether_or_not_names_can_be_exchanged(
    exchanges, tmp_path, monkeypatch
):
    if not exchanges:
        monkeypatch.setattr(files, '_exchange_names', lambda *_: False)
    folder, new = two_folders(tmp_path)
    link = tmp_path / 'link'
    link.symlink_to(folder)
    replace_folder(new, link)
    assert (folder / 'file').read_text() == 'new' and link.is_symlink()
    assert sorted(os.listdir(tmp_path)) == ['link', 'old']


def test_the_name_is_never_free_where_names_can_be_exchanged(tmp_path, monkeypatch):
    """A process that is killed at any call to the file system leaves one of the two."""
    folder, new = two_folders(tmp_path)
    monkeypatch.setattr('pathlib.Path.rename', lambda *_: pytest.fail('two steps'))
    monkeypatch.setattr(files.shutil, 'rmtree', lambda *_, **__: None)  # killed before
    replace_folder(new, folder)
    assert (folder / 'file').read_text() == 'new'
    assert (new / 'file').read_text() == 'old'


def test_a_folder_that_cannot_be_replaced_keeps_its_name(tmp_path, monkeypatch):
    monkeypatch.setattr(files, '_exchange_names', lambda *_: False)
    folder, new = two_folders(tmp_path)
    (new / 'file').unlink()
    new.rmdir()
    with pytest.raises(FileNotFoundError):
        replace_folder(new, folder)
    assert (folder / 'file').read_text() == 'old'
    assert os.listdir(tmp_path) == ['old']
