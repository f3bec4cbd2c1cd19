"""A signal ends a command or a node with one line and the signal's status, at any moment."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.processes import ended_by_signals, Stopped, stopped_by_sigterm

ROOT = Path(__file__).parents[1]
SLOW = "import time\nprint('importing', flush=True)\ntime.sleep(60)\n"
EPISODE = ROOT / 'resource' / 'demo_episode'


@pytest.fixture(autouse=True)
def heed_sigint():
    """A shell starts background jobs deaf to SIGINT, and they start theirs so."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def stopped(tmp_path: Path, slow: str, number: int, *words: str) -> tuple[int, list[str]]:
    """Status and stderr of a process that gets a signal while it imports the module `slow`."""
    (tmp_path / f'{slow}.py').write_text(SLOW)
    process = subprocess.Popen(
        [sys.executable, '-m', *words],
        env={**os.environ, 'PYTHONPATH': f'{tmp_path}{os.pathsep}{ROOT}'},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == 'importing\n'
        process.send_signal(number)
        _, said = process.communicate(timeout=120)
    finally:
        process.kill()
    return process.returncode, said.splitlines()


def test_ctrl_c_while_python_starts_ends_without_a_traceback(tmp_path: Path) -> None:
    status, said = stopped(tmp_path, 'argparse', signal.SIGINT, 'mtv_world_ros.cli', 'replay', 'x')
    assert (status, said) == (-signal.SIGINT, [])
    handler = 'signal.getsignal(signal.SIGINT) is signal.default_int_handler'
    code = f'import signal, mtv_world_ros.cli; raise SystemExit(0 if {handler} else 3)'
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    assert subprocess.run([sys.executable, '-c', code], env=environment).returncode == 0


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_still_imports_ends_with_one_line(number, tmp_path):
    status, said = stopped(tmp_path, 'platform', number, 'mtv_world_ros.cli', 'replay', 'x')
    assert status == 128 + number
    assert said == [f'mtv-world: stopped while starting ({signal.Signals(number).name})']


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_runs_ends_with_one_line(number, tmp_path):
    words = ('mtv_world_ros.cli', 'replay', str(EPISODE), '--offline', '--out', 'out')
    status, said = stopped(tmp_path, 'torch', number, *words)
    assert status == 128 + number
    assert said == [
        'mtv-world: replay: loading',
        f'mtv-world: stopped ({signal.Signals(number).name})',
    ]
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('node', ['world_model.node', 'policy.node', 'bags.recorder'])
def test_a_node_that_still_imports_ends_with_one_line(node, number, tmp_path):
    pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')
    slow = 'yaml' if node == 'bags.recorder' else 'pydantic'
    status, said = stopped(tmp_path, slow, number, f'mtv_world_ros.ros.{node}')
    assert status == 128 + number
    assert said == [f'mtv_world_ros: stopped while starting ({signal.Signals(number).name})']


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_node_that_loads_its_model_ends_with_one_line(number, tmp_path):
    pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')
    status, said = stopped(tmp_path, 'torch', number, 'mtv_world_ros.ros.world_model.node')
    assert status == 128 + number
    assert said == [f'mtv_world_ros: stopped while starting ({signal.Signals(number).name})']


@pytest.mark.parametrize('home', ['/proc/nowhere', 'file'])
def test_a_node_whose_home_cannot_be_written_says_so_and_starts(home, tmp_path, monkeypatch):
    pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')
    (tmp_path / 'file').write_text('a file where a folder should be')
    monkeypatch.setenv('HOME', str(tmp_path / home))
    for variable in ('ROS_LOG_DIR', 'ROS_HOME'):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    status, said = stopped(tmp_path, 'torch', signal.SIGTERM, 'mtv_world_ros.ros.world_model.node')
    assert status == 128 + signal.SIGTERM
    assert len(said) == 2 and 'cannot be written' in said[0] and 'ROS logs into' in said[0]


def test_sigterm_lets_a_block_tidy_up_and_handlers_come_back(tmp_path):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    tidied = []
    with pytest.raises(Stopped) as stop, stopped_by_sigterm():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            tidied.append(True)
    assert tidied and stop.value.signum == signal.SIGTERM
    with ended_by_signals('test'):
        assert signal.getsignal(signal.SIGINT) is not before[0]
    assert main(['replay', 'nowhere', '--offline']) == 1
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
