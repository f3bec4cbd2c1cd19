"""One process at a time writes an output path; the second one is told who does."""

from __future__ import annotations

from contextlib import suppress
import os
import signal
import socket
import subprocess
import sys
import time

import pytest

from mtv_world_ros.core import files
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.writer_lock import LOCK_NAME, only_writer
from test.robustness.test_commands import AT, DEMO, OUT
from test.robustness.test_output_paths import WRITING

_HOLDER = (
    'import os, sys, time\n'
    'from pathlib import Path\n'
    'from mtv_world_ros.core.writer_lock import only_writer\n'
    'with only_writer(Path(sys.argv[1])):\n'
    '    if "fork" in sys.argv and os.fork() == 0: time.sleep(60)\n'
    '    print("held", flush=True)\n'
    '    sys.stdin.read()\n'
)


@pytest.fixture
def holder():
    """Return a function that starts a process that holds the lock of a path."""
    started = []

    def start(path, *words):
        process = subprocess.Popen(
            [sys.executable, '-c', _HOLDER, str(path), *words],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        started.append(process)
        assert process.stdout.readline() == 'held\n'
        return process

    yield start
    for process in started:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def test_the_second_writer_is_told_process_and_host_of_the_first(tmp_path, holder):
    process = holder(tmp_path / 'run')
    expected = f"run' is being written by process {process.pid} on host '{socket.gethostname()}'"
    with pytest.raises(ConfigError, match=expected), only_writer(tmp_path / 'run'):
        pass
    with only_writer(tmp_path / 'other'):
        pass


@pytest.mark.parametrize('words', [(), ('fork',)], ids=['alone', 'with a forked worker'])
def test_a_killed_writer_releases_it_at_once(words, tmp_path, holder):
    process = holder(tmp_path / 'run', *words)
    process.kill()
    process.wait()
    with only_writer(tmp_path / 'run'):
        pass
    assert os.listdir(tmp_path) == []


def test_it_leaves_no_file_and_no_folder_behind(tmp_path):
    with only_writer(tmp_path / 'new' / 'deep' / 'run'):
        assert os.listdir(tmp_path / 'new' / 'deep') == [f'.run{LOCK_NAME}']
    assert os.listdir(tmp_path) == []


def test_a_process_may_take_it_again_and_a_link_stands_for_its_target(tmp_path, holder):
    (tmp_path / 'link').symlink_to(tmp_path / 'run')
    with only_writer(tmp_path / 'run'):
        with only_writer(tmp_path / 'link'):
            pass
        assert f'.run{LOCK_NAME}' in os.listdir(tmp_path)
    holder(tmp_path / 'link')
    with pytest.raises(ConfigError, match='is being written'), only_writer(tmp_path / 'run'):
        pass


def test_a_mounted_folder_has_its_lock_inside_and_counts_as_empty(tmp_path, monkeypatch, holder):
    (tmp_path / 'mounted').mkdir()
    before = files.content_digest(tmp_path / 'mounted')
    real = os.access
    monkeypatch.setattr(os, 'access', lambda path, how: path != tmp_path and real(path, how))
    with only_writer(tmp_path / 'mounted'):
        assert os.listdir(tmp_path / 'mounted') == [LOCK_NAME]
        files.check_free(tmp_path / 'mounted', overwrite=False)
        assert files.content_digest(tmp_path / 'mounted') == before
    assert os.listdir(tmp_path / 'mounted') == []


def test_a_file_system_without_locks_holds_nothing(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(95, 'Operation not supported')

    monkeypatch.setattr('fcntl.flock', refuse)
    with only_writer(tmp_path / 'run'), only_writer(tmp_path / 'run'):
        pass


@pytest.mark.parametrize('command', [name for name in WRITING if name != 'robot'])
def test_every_command_that_writes_is_told_at_once(command, tmp_path, holder, monkeypatch, capsys):
    from mtv_world_ros.cli import main

    monkeypatch.chdir(tmp_path)
    words = WRITING[command].replace(AT, str(DEMO)).replace('{free}', str(tmp_path / 'free'))
    words = words.replace(OUT, str(tmp_path / 'out'))
    path = next(word for word in words.split() if word.startswith(f'{tmp_path}/out'))
    holder(path)
    before = sorted(os.listdir(tmp_path))
    begin_s = time.process_time()
    assert main(words.split()) == 1
    assert time.process_time() - begin_s < 1.0
    assert f"'{path}' is being written by process" in capsys.readouterr().err
    assert sorted(os.listdir(tmp_path)) == before


def test_the_recorder_is_told_as_well(tmp_path, holder):
    holder(tmp_path / 'bag')
    command = [sys.executable, '-m', 'mtv_world_ros.ros.bags.recorder', tmp_path / 'bag', '/x']
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and 'is being written by process' in done.stderr


def test_the_other_processes_of_one_training_take_no_lock(monkeypatch):
    from mtv_world_ros.core.processes import is_helper_rank

    assert not is_helper_rank()
    monkeypatch.setenv('WORLD_SIZE', '2')
    for rank, is_helper in (('0', False), ('1', True)):
        monkeypatch.setenv('RANK', rank)
        assert is_helper_rank() == is_helper
