import argparse
from math import nan
import socket
import subprocess
import sys

import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.cli.rank import _recording_name
from mtv_world_ros.cli.shared_options import Watch, watch_arguments
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.reports.shown_rankings import rates_table
from mtv_world_ros.simulation.opengl import missing_opengl
from mtv_world_ros.viewing.viewer_process import PageAddress


@pytest.mark.parametrize(
    ('options', 'says'),
    [
        (['--policies', 'exprt'], "did you mean 'expert'?"),
        (['--policies', 'expert-noise-9'], "'noise' is 9.0; it must be 0 to 0.5"),
        (['--tasks', 'stack_block_two'], "did you mean 'stack_blocks_two'?"),
        (['--episodes', '0'], '--episodes is 0; it must be at least 1'),
        (['--true-episodes', '-1'], '--true-episodes is -1; it must be 0 or more'),
        (['--max-chunks', '0'], '--max-chunks'),
        (['--physics', 'bald'], "unknown physics 'bald' (did you mean 'bold'?)"),
        (['--hold', '-1'], '--hold is -1; it must be 0 or more'),
        (['--describer', 'nowhere.yaml'], "describer file 'nowhere.yaml'"),
    ],
)
def test_a_wrong_option_is_refused_before_anything_runs(options, says, tmp_path, capsys):
    assert main(['rank', '--out', str(tmp_path / 'out'), '--episodes', '1', *options]) == 1
    assert says in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_only_the_recording_of_a_ranking_that_goes_on_is_replaced(tmp_path):
    rerun_log = pytest.importorskip('mtv_world_ros.viewing.rerun_log')
    pytest.importorskip('rerun')
    file, out = tmp_path / 'live.rrd', tmp_path / 'out'

    def arguments(folder):
        watch = Watch(file=file)
        return argparse.Namespace(watch=watch, overwrite=False, out=folder)

    stream = rerun_log.recording(_recording_name(arguments(out)))
    rerun_log.open_viewer(stream, None, PageAddress(), file, False)
    rerun_log.flush(stream, file)
    assert watch_arguments(arguments(out), _recording_name(arguments(out)))
    other = arguments(tmp_path / 'other')
    with pytest.raises(ConfigError, match='live.rrd. exists; give another --watch FILE.rrd'):
        watch_arguments(other, _recording_name(other))
    with pytest.raises(ConfigError, match='exists'):
        watch_arguments(arguments(out))


@pytest.mark.slow
def test_a_ranking_is_watched_while_it_runs(tmp_path, capsys):
    """Rates so far and each rollout as it ends; those of an earlier run are there at once."""
    pytest.importorskip('rerun')
    if reason := missing_opengl():
        pytest.skip(reason)
    out = tmp_path / 'out'
    command = ['rank', '--policies', 'expert', '--tasks', 'stack_blocks_two', '--episodes', '1']
    command += ['--max-chunks', '1', '--segmenter', 'colour', '--out', str(out), '--watch']
    # the same command goes on, and its recording of the ranking is written again
    for file in (tmp_path / 'first.rrd', tmp_path / 'first.rrd', tmp_path / 'again.rrd'):
        assert main([*command, str(file)]) == 0
        assert f'written: {file}\n' in capsys.readouterr().out
        words = [sys.executable, '-m', 'rerun', 'rrd', 'print', '-vvv', str(file)]
        shown = subprocess.run(words, capture_output=True, text=True, check=True).stdout
        assert 'expert/stack_blocks_two_0/low/imagined' in shown
        assert 'rates\\ so\\ far' in shown
    assert main([*command, str(tmp_path / 'third.rrd'), '--no-video']) == 1
    assert '--watch shows what --no-video leaves out' in capsys.readouterr().err
    with pytest.raises(SystemExit, match='2'):
        main([*command, 'here'])
    assert "'here' does not end in a port" in capsys.readouterr().err


def test_rates_so_far_count_what_has_an_estimate(make_result):
    found = [make_result('a', 0, True, 0.9), make_result('b', 0, False, 0.25)]
    found += [make_result('a', 1, False, nan), make_result('a', 2, True, 0.5)]
    assert rates_table(found).splitlines()[2:] == [
        '| a | 3 | 0.67 | 0.70 | 1 |',
        '| b | 1 | 0.00 | 0.25 | 0 |',
    ]


def test_a_watched_port_that_is_taken_is_told_before_anything_runs(tmp_path, capsys):
    pytest.importorskip('rerun')
    with socket.socket() as taken:
        taken.bind(('127.0.0.1', 0))
        taken.listen()
        port = taken.getsockname()[1]
        command = ['rank', '--episodes', '1', '--out', str(tmp_path / 'out')]
        assert main([*command, '--watch', str(port)]) == 1
    said = capsys.readouterr().err
    assert f'port {port} cannot be used' in said and 'give another --watch PORT' in said
    assert not (tmp_path / 'out').exists()


@pytest.mark.slow
def test_a_rollout_that_fails_ends_with_1_and_its_reason_and_the_others_count(
    tmp_path, capsys, failing_policy
):
    if reason := missing_opengl():
        pytest.skip(reason)
    file = tmp_path / 'policies.yaml'
    file.write_text(
        'policies:\n- {name: expert, policy: expert}\n'
        f"- {{name: broken, policy: {{kind: python, factory: '{failing_policy}'}}}}\n"
    )
    command = ['rank', '--policies', str(file), '--tasks', 'stack_blocks_two', '--episodes', '1']
    command += ['--max-chunks', '1', '--segmenter', 'colour', '--no-video']
    assert main([*command, '--out', str(tmp_path / 'out')]) == 1
    said = capsys.readouterr()
    assert 'mtv-world: stack_blocks_two_00000_broken has no result: ' in said.err
    assert 'actions have shape (7,), expected (50, 14)' in said.err
    assert f'report: {tmp_path / "out" / "ranking.html"}' in said.out
