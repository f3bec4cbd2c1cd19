"""The command line: quick help, clear errors, and the demo from end to end."""

from __future__ import annotations

from dataclasses import dataclass
import json
import os
from pathlib import Path
import subprocess
import sys
import time
from types import ModuleType

import cv2
import numpy as np
import pytest

from mtv_world_ros.cli import _num_progresses, imagine, main
from mtv_world_ros.cli.commands import REMOVED_OPTIONS
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.rollout import offline
from mtv_world_ros.rollout.offline import ReplaySummary
from mtv_world_ros.viewing import sheets

DEMO = str(share_path('resource', 'demo_episode'))


def run(*arguments: str, cwd: Path, timeout: float = 300) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, '-m', 'mtv_world_ros.cli', *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


def test_help_does_not_load_the_model(tmp_path):
    code = (
        'import sys\nfrom mtv_world_ros.cli import main\n'
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "sys.exit(any(m in sys.modules for m in ('torch', 'diffusers', 'mujoco', 'rclpy')))"
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, cwd=tmp_path)
    assert done.returncode == 0
    for command in ('demo', 'replay', 'collect', 'train', 'evaluate'):
        assert command in done.stdout.decode()


def test_numpy_starts_no_threads_and_cycles_are_searched_for_seldom():
    """Threads of NumPy's matrix products spin while they wait; ours are small."""
    code = (
        'from mtv_world_ros.core.processes import prepare_process\nprepare_process()\n'
        'import gc, numpy, os\nprint(len(os.listdir("/proc/self/task")), gc.get_threshold()[0])'
    )
    kept = {name: text for name, text in os.environ.items() if 'NUM_THREADS' not in name}
    assert subprocess.check_output([sys.executable, '-c', code], env=kept) == b'1 5000\n'


def test_a_command_that_left_says_where_it_is(capsys):
    with pytest.raises(SystemExit) as end:
        main(['distill', 'bundled', 'data/sim', '--out', 'x'])
    said = capsys.readouterr().err
    assert end.value.code == 2
    assert "'distill' is no longer a command" in said and 'version 0.1.0 has it' in said


def test_an_option_that_left_says_what_to_use_now(capsys):
    required = {
        'fit success': ['bundled', 'data', '--out', 'x'],
        'import wan': ['x', '--out', 'y'],
    }
    for name, now in REMOVED_OPTIONS.items():
        command, _, option = name.rpartition(' ')
        for words in ([option, '1'], [f'{option}=1']):
            with pytest.raises(SystemExit) as end:
                main([*command.split(), *required.get(command, []), *words])
            said = ' '.join(capsys.readouterr().err.split())
            assert end.value.code == 2
            assert f"'{option}' is no longer an option of '{command}': {now}" in said


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['train', 'nowhere', '--out', 'run'], 'holds no episodes'),
        (['train', '.', '--out', 'run', '--preset', 'smal'], "did you mean 'small'"),
        (['train', '.', '--out', 'run', '--set', 'optimizer.step=3'], "did you mean 'steps'"),
        (['train', DEMO, '--out', 'run', '--dtype', 'int8'], "dtype 'int8' is not one of"),
        (['evaluate', 'nowhere', '.', '--out', 'x'], 'is not a checkpoint'),
        (['replay', 'nowhere', '--offline'], 'nowhere'),
        (['collect', '--task', 'stack_blocks', '--episodes', '1', '--out', 'x'],
         'stack_blocks_two'),
    ],
)  # fmt: skip
def test_errors_are_one_line_and_say_what_to_do(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.startswith('mtv-world: ')
    assert 'Traceback' not in said


needs_checkpoint = pytest.mark.skipif(
    not (Path(__file__).parents[2] / 'resource' / 'checkpoint' / 'world_model.json').is_file(),
    reason='the bundled checkpoint is not in resource/checkpoint',
)


@needs_checkpoint
@pytest.mark.parametrize(
    ('package', 'extra'), [('tensorboard', 'train'), ('torchmetrics.image', 'evaluate')]
)
def test_a_package_of_an_extra_that_is_missing_is_named(package, extra, capsys, monkeypatch):
    """As after `make demo`, which installs what the demo needs."""

    def handler(arguments):
        raise ModuleNotFoundError(f"No module named '{package}'", name=package)

    monkeypatch.setattr('mtv_world_ros.cli.train._train', handler)
    assert main(['train', 'data', '--out', 'runs']) == 1
    said = capsys.readouterr().err
    assert f'{package.partition(".")[0]} is not installed: make in the folder of' in said
    assert f"pip install 'mtv_world_ros[{extra}]'" in said


def test_a_module_that_no_extra_asks_for_is_no_error_of_the_user(monkeypatch):
    def handler(arguments):
        raise ModuleNotFoundError("No module named 'nowhere'", name='nowhere')

    monkeypatch.setattr('mtv_world_ros.cli.train._train', handler)
    with pytest.raises(ModuleNotFoundError):
        main(['train', 'data', '--out', 'runs'])


@pytest.mark.slow
def test_the_demo_runs_over_the_middleware_and_beats_the_held_frame(tmp_path):
    done = run('demo', '--out', 'out', '--threads', '1', cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert report['chunks'] == 3
    assert report['frames_received'] == report['frames_published'] == 3 * 16 * 2
    assert report['camera_infos_received'] == report['frames_received']
    assert report['outcome'] == 'success' and report['success'] > 0.5
    for view in ('low', 'high'):
        assert report['views'][view]['j_moving'] > report['views'][view]['j_copy_moving']
    sheet = cv2.imread(str(tmp_path / 'out' / 'contact_sheet.png'))
    assert sheet is not None
    assert sheet.shape[1] > 800
    assert (tmp_path / 'out' / 'comparison.mp4').stat().st_size > 10_000
    assert (tmp_path / 'out' / 'predictions' / 'metadata.yaml').is_file()
    assert 'success after each chunk (recorded outcome: success)' in done.stdout
    assert 'plan/s' not in done.stderr  # a bar is drawn on a terminal only
    # which counts these
    log = (tmp_path / 'out' / 'logs' / 'player.log').read_text()
    assert log.count('trajectory is answered: done') == 3


@pytest.mark.slow
@needs_checkpoint
def test_replays_offline_to_a_bag_with_all_frames(tmp_path):
    from mtv_world_ros.data.bag.reader import BagReader

    episode = share_path('resource', 'demo_episode')
    out = tmp_path / 'imagined'
    words = ['--offline', '--out', str(out), '--steps', '1', '--threads', '1']
    assert main(['replay', str(episode), *words]) == 0
    counts: dict[str, int] = {}
    for message in BagReader(out).messages():
        counts[message.topic] = counts.get(message.topic, 0) + 1
    infos = [n for topic, n in counts.items() if topic.endswith('predicted/camera_info')]
    assert len(infos) == 2
    assert infos[0] == infos[1] == 48


@pytest.mark.slow
@needs_checkpoint
def test_evaluates_the_bundled_model(tmp_path):
    words = ['--out', str(tmp_path / 'scores'), '--steps', '1', '--threads', '1']
    assert main(['evaluate', 'bundled', str(share_path('resource', 'demo_episode')), *words]) == 0
    metrics = json.loads((tmp_path / 'scores' / 'metrics.json').read_text())
    assert metrics['num_episodes'] == 1
    for view in ('low', 'high'):
        scores = metrics['views'][view]
        value = scores['j_moving']
        value = value['value'] if isinstance(value, dict) else value
        assert 0 < value < 1
        assert scores['fid'] is None
    assert np.isfinite(metrics['num_episodes'])


def test_the_shell_completes_commands_and_options():
    pytest.importorskip('argcomplete', reason='argcomplete is not installed')
    for line, wanted in (('mtv-world imag', 'imagine'), ('mtv-world imagine --pol', '--policy')):
        words = {'_ARGCOMPLETE': '1', 'COMP_LINE': line, 'COMP_POINT': str(len(line))}
        words |= {'_ARGCOMPLETE_IFS': ' ', '_ARGCOMPLETE_STDOUT_FILENAME': '/dev/stdout'}
        done = subprocess.run(
            [sys.executable, '-m', 'mtv_world_ros.cli'],
            env={**os.environ, **words}, capture_output=True, text=True, timeout=180,
        )  # fmt: skip
        assert wanted in done.stdout.split(), done


@pytest.mark.parametrize('error', [MemoryError(), MemoryError('Unable to allocate 8.7 GiB')])
def test_memory_that_does_not_suffice_is_told_in_a_line(monkeypatch, capsys, error):
    def fail(*_):
        raise error

    monkeypatch.setattr('mtv_world_ros.cli.view._view', fail)
    assert main(['view', 'x']) == 1
    said = capsys.readouterr().err
    assert said.startswith(f'mtv-world: {error}') and 'the memory does not suffice' in said


@pytest.mark.parametrize('num_rejected', [0, 2])
def test_an_offline_replay_fails_if_plans_were_rejected_and_says_the_first(
    num_rejected, tmp_path, monkeypatch, capsys
):
    """The predictions of the others are written all the same."""

    @dataclass(frozen=True)
    class AnyPipeline:
        describer: object = None

    rejected = [(10**9 * k, f'joints would jump at {k} s') for k in range(num_rejected)]
    summary = ReplaySummary(out=tmp_path, num_trajectories=4, rejected=rejected)
    monkeypatch.setattr(imagine, 'open_checkpoints', lambda *_: (None,))
    monkeypatch.setattr(imagine, 'refuse_for', lambda *_: None)
    monkeypatch.setattr(imagine, 'pipeline_of', lambda _: AnyPipeline())
    monkeypatch.setattr(offline, 'replay_offline', lambda *_, **__: summary)
    monkeypatch.setattr(sheets, 'write_pictures', lambda *_: ())
    out = str(tmp_path / 'out')
    status = main(['replay', str(tmp_path), '--offline', '--out', out])
    said = capsys.readouterr()
    assert status == int(num_rejected > 0)
    assert '4 trajectories' in said.out
    if num_rejected:
        first = '2 of 6 plans were not imagined, the first: joints would jump at 0 s'
        assert said.err.endswith(f'mtv-world: {first}\n')


def test_a_command_that_takes_seconds_says_that_it_is_loading(tmp_path):
    code = 'import sys, time, mtv_world_ros.cli.imagine as i; i._replay = lambda _: time.sleep(3);'
    code += 'from mtv_world_ros.cli import main; main(sys.argv[1:])'
    words = [sys.executable, '-c', code, 'replay', str(tmp_path), '--offline']
    run = subprocess.run([*words, '--out', str(tmp_path / 'out')], capture_output=True, text=True)
    assert run.stderr == 'mtv-world: replay: loading\n'


def test_a_command_that_still_loads_says_so_until_it_shows_its_progress(capsys, monkeypatch):
    monkeypatch.setattr('mtv_world_ros.cli._FIRST_LINE_S', 0.05)
    monkeypatch.setattr('mtv_world_ros.cli._NEXT_LINE_S', 0.06)

    def work(_):
        said, end_s = '', time.monotonic() + 60.0
        while said.count('\n') < 2 and time.monotonic() < end_s:
            time.sleep(0.05)
            said += capsys.readouterr().err
        with Progress(total=1):
            time.sleep(0.5)  # a line may be on its way
            told.append(said + capsys.readouterr().err)
            time.sleep(0.3)
        return 0

    told = []
    monkeypatch.setattr('mtv_world_ros.cli.imagine._replay', work)
    assert main(['replay', 'x', '--offline', '--out', 'y']) == 0
    first, second, *_ = told[0].splitlines()
    assert first == 'mtv-world: replay: loading'
    assert second.startswith('mtv-world: replay: loading, ') and second.endswith(' s so far')
    assert capsys.readouterr().err == ''


def test_a_module_that_another_thread_still_imports_shows_no_progress(monkeypatch):
    assert _num_progresses() == Progress.num_shown
    half = ModuleType('mtv_world_ros.core.progress')  # without the class, as while it is imported
    monkeypatch.setitem(sys.modules, half.__name__, half)
    assert _num_progresses() == 0


def test_a_player_does_not_load_while_it_plays(capsys, monkeypatch):
    monkeypatch.setattr('mtv_world_ros.cli._FIRST_LINE_S', 0.05)
    monkeypatch.setattr('mtv_world_ros.cli._NEXT_LINE_S', 0.06)
    monkeypatch.setattr('runpy.run_module', lambda *_, **__: time.sleep(0.5))
    assert main(['replay', 'x']) == 0
    assert capsys.readouterr().err.splitlines() in ([], ['mtv-world: replay: loading'])
