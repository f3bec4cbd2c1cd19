"""`mtv-world imagine` says whether the policy succeeded, and why an episode failed."""

from dataclasses import replace
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration, save_calibration
from mtv_world_ros.cli import main
from mtv_world_ros.cli.imagine import episode_table
from mtv_world_ros.core.files import share_path
from mtv_world_ros.viewing.streams import read_streams

DEMO = share_path('resource', 'demo_episode')


def run(out, policy, *more):
    command = ['imagine', '--policy', str(policy), '--episodes', str(DEMO), '--out', str(out)]
    return main([*command, *more])


@pytest.mark.slow
def test_the_expert_succeeds_as_the_page_says(tmp_path, capsys):
    """The command of docs/watch_it.md."""
    pytest.importorskip('rerun')
    live, watch = tmp_path / 'live.rrd', ('--watch', str(tmp_path / 'live.rrd'), '--count', '2')
    assert run(tmp_path, 'expert', '--max-chunks', '5', *watch) == 0
    said = capsys.readouterr().out
    assert said.startswith(f'written: {live}\n')
    assert 'success rate: 2 of 2 = 1.00' in said and f'mtv-world view {tmp_path}' in said
    command = [sys.executable, '-m', 'rerun', 'rrd', 'print', str(live)]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for number in (0, 1):  # a tab each
        for path in ('low/real', 'high/imagined', 'low/trajectory', 'success', 'words'):
            assert f'/episode_{number}/{path} ' in shown
    assert '/episode_2' not in shown
    episode, _ = json.loads((tmp_path / 'episodes.json').read_text())
    assert episode['verdict'] == 'success' and episode['success'] >= 0.75
    assert episode['success_low'] <= episode['success'] <= episode['success_high']
    assert 'foreseen motions succeed' in episode['reasons']
    assert (tmp_path / 'episode_00000' / 'comparison.mp4').stat().st_size > 1000
    assert main(['view', str(tmp_path), '--save', str(tmp_path / 'all.rrd')]) == 0


@pytest.mark.slow
def test_a_policy_that_fails_ends_with_1_and_its_reason_on_the_screen(
    tmp_path, capsys, failing_policy
):
    (tmp_path / 'failing.yaml').write_text(f'kind: python\nfactory: {failing_policy}\n')
    assert run(tmp_path / 'out', tmp_path / 'failing.yaml') == 1
    printed = capsys.readouterr()
    assert 'episode 0 failed: policy_failed: ' in printed.err
    assert 'actions have shape (7,), expected (50, 14)' in printed.err
    assert 'success rate: no verdict in 1 episodes' in printed.out


@pytest.mark.slow
def test_a_policy_server_that_is_down_is_named(tmp_path, capsys):
    text = share_path('config', 'policies', 'openpi.yaml').read_text()
    text = text.replace('localhost:8000', 'localhost:1').replace('timeout_s: 60.0', 'timeout_s: 1')
    (tmp_path / 'down.yaml').write_text(text)
    assert run(tmp_path / 'out', tmp_path / 'down.yaml') == 1
    assert 'localhost:1' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('verdicts', 'said'),
    [
        # Wilson's intervals of 7 of 10 and 0 of 5, from R's binom.confint(method = 'wilson')
        (['success'] * 7 + ['failure'] * 3, '7 of 10 = 0.70 [0.40 0.89]'),
        (['failure'] * 5, '0 of 5 = 0.00 [0.00 0.43]'),
        (['success', 'open', 'abstains'], '1 of 1 = 1.00 [0.21 1.00]; 2 without a verdict'),
        (['abstains'], 'no verdict in 1 episodes'),
    ],
)
def test_the_success_rate_has_wilsons_interval(verdicts, said):
    row = {'episode': 0, 'how': 'done', 'num_chunks': 1, 'episode_s': 1.0, 'bag': 'b'}
    row |= {'success': None, 'success_low': None, 'success_high': None, 'reasons': 'a; b'}
    lines = episode_table([{**row, 'verdict': verdict} for verdict in verdicts])
    assert said in lines[-1]
    assert lines[2].strip() == 'a' and lines[3].strip() == 'b'


@pytest.mark.slow
def test_each_episode_has_cameras_of_its_own(tmp_path):
    """The same recording, once with a camera that stands 20 mm elsewhere: its trails differ."""
    paths = [shutil.copytree(DEMO, tmp_path / name) for name in ('a', 'b')]
    known = load_calibration(DEMO / 'calibration.yaml')
    T = known['low'].T_mount_camera.copy()
    T[0, 3] += 0.02
    moved = {**known, 'low': replace(known['low'], T_mount_camera=T)}
    (paths[1] / 'calibration.yaml').unlink()
    save_calibration(paths[1] / 'calibration.yaml', moved)
    out, words = tmp_path / 'out', ('--steps', '1', '--max-chunks', '1', '--no-video')
    episodes = ['--episodes', *map(str, paths), '--policy', 'recorded', '--out', str(out)]
    assert main(['imagine', *episodes, *words]) == 0
    first, second = (read_streams([out / f'episode_{k:05d}']).images for k in range(2))
    differs = [
        not np.array_equal(first['trajectory', view][4][1], second['trajectory', view][4][1])
        for view in ('low', 'high')
    ]
    assert differs == [True, False]


@pytest.mark.slow
def test_an_episode_ends_after_its_longest_time_and_keeps_its_chunks(tmp_path):
    assert run(tmp_path, 'recorded', '--steps', '1', '--max-seconds', '0.001', '--no-video') == 0
    (episode,) = json.loads((tmp_path / 'episodes.json').read_text())
    assert episode['how'] == 'max_seconds' and (tmp_path / 'episode_00000').is_dir()
