"""`mtv-world imagine` says whether the policy succeeded, and why an episode failed."""

from dataclasses import replace
import json
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration, save_calibration
from mtv_world_ros.cli import main
from mtv_world_ros.cli.imagine import episode_table
from mtv_world_ros.core.estimate_words import NOT_FITTED_HERE
from mtv_world_ros.core.files import share_path
from mtv_world_ros.rollout import imagined_episodes
from mtv_world_ros.viewing.streams import read_streams

DEMO = share_path('resource', 'demo_episode')
HOLDING = """
import numpy as np
from mtv_world_ros import JointTrajectory
from mtv_world_ros.robot.file import load_robot, robot_path


class Holding:
    name = 'holding'

    def reset(self, *, seed):
        self.names = load_robot(robot_path('yam_bimanual')).joint_names

    def act(self, observation, instruction):
        times = np.array([1.0, 4.0])
        rows = np.repeat(observation.positions[None], 2, axis=0)
        return JointTrajectory(joint_names=self.names, times=times, positions=rows)
"""


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
def test_an_episode_ends_after_its_longest_time_and_keeps_its_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr(imagined_episodes, 'LONGEST_EPISODE_S', 0.001)
    assert run(tmp_path, 'recorded', '--steps', '1', '--no-video') == 0
    (episode,) = json.loads((tmp_path / 'episodes.json').read_text())
    assert episode['how'] == 'max_seconds' and (tmp_path / 'episode_00000').is_dir()


@pytest.mark.slow
def test_an_episode_in_another_robot_cell_is_judged_by_the_wide_prior(tmp_path):
    """`--place` takes the place of what the recording states."""
    words = ('--steps', '1', '--max-chunks', '1', '--no-video')
    reasons = []
    for folder, place in (('stated', ()), ('named', ('--place', 'cell 3'))):
        assert run(tmp_path / folder, 'recorded', *words, *place) == 0
        (episode,) = json.loads((tmp_path / folder / 'episodes.json').read_text())
        reasons.append(NOT_FITTED_HERE in episode['reasons'])
    assert reasons == [False, True]


@pytest.mark.slow
def test_live_episodes_start_from_what_a_bag_shows(tmp_path, capsys, monkeypatch):
    """The two commands of docs/policies.md."""
    pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')
    from test.support import ros_nodes

    player = [sys.executable, '-m', 'mtv_world_ros.cli', 'replay', str(DEMO), '--no-wait']
    playing = ros_nodes.NodeProcess([*player, '--loop'], tmp_path / 'player.log')
    (tmp_path / 'holding_policy.py').write_text(HOLDING)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / 'holding.yaml').write_text('kind: python\nfactory: holding_policy:Holding\n')
    words = ['--live', '--policy', str(tmp_path / 'holding.yaml'), '--count', '2']
    words += ['--max-chunks', '1', '--steps', '1', '--out', str(tmp_path / 'out'), '--no-video']
    words += ['--place', 'simulator/nominal']
    words += ['--ros-args', '-p', f'calibration_file:={DEMO / "calibration.yaml"}']
    try:
        assert main(['imagine', *words]) == 0, playing.output()
    finally:
        playing.stop(signal.SIGINT)
    said = capsys.readouterr().out
    assert said.count('observed /low/image_raw/compressed, /high/image_raw/compressed') == 2
    results = json.loads((tmp_path / 'out' / 'episodes.json').read_text())
    assert [(r['start'], r['how'], r['num_chunks']) for r in results] == [
        ('live', 'max_chunks', 1)
    ] * 2
    assert not any(NOT_FITTED_HERE in r['reasons'] for r in results)
    # the bag says what the robot is to do
    streams = read_streams([tmp_path / 'out' / 'episode_00000'])
    assert 'purple block' in ' '.join(text for _, text in streams.words)
    assert ('real', 'low') in streams.images and ('imagined', 'high') in streams.images


def test_ros_arguments_belong_to_live_episodes(capsys, tmp_path):
    with pytest.raises(SystemExit):
        run(tmp_path, 'expert', '--ros-args', '-r', 'low:=camera')
    assert 'unrecognized arguments: --ros-args' in capsys.readouterr().err


def test_a_policy_that_repeats_a_recording_needs_one(capsys, tmp_path):
    assert main(['imagine', '--live', '--policy', 'recorded', '--out', str(tmp_path)]) == 1
    assert 'give --episodes' in capsys.readouterr().err
