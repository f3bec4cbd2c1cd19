"""Episodes exported as a LeRobot dataset, and read back by `import-dataset`."""

import json

import cv2
import numpy as np
import pytest

pytest.importorskip('pyarrow', reason='pyarrow is not installed (pip install .[import])')

from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.importing.lerobot import LeRobotDataset

DEMO = share_path('resource', 'demo_episode')


@pytest.fixture(scope='module')
def exported(exported_demo):
    return exported_demo


def test_what_was_exported_is_imported_again(imported_demo):
    (path,) = imported_demo.glob('episode_*')
    before, after = read_episode(DEMO), read_episode(path)
    assert after.views == before.views
    assert after.info.outcome == before.info.outcome
    assert after.info.instruction == before.info.instruction
    first = before.images[before.views[0]].stamps_ns
    seconds = (first[-1] - first[0]) * 1e-9
    count = len(after.joint_states.positions)
    assert count == int(seconds * 5 + 1e-6) + 1
    for view in before.views:
        camera = before.cameras[view]
        np.testing.assert_allclose(after.cameras[view].K, camera.K, rtol=1e-5)
        np.testing.assert_allclose(
            after.cameras[view].T_mount_camera, camera.T_mount_camera, atol=1e-5
        )
        np.testing.assert_allclose(after.cameras[view].distortion, camera.distortion, atol=1e-5)
        for row in (0, count // 2, count - 1):
            nearest = np.argmin(abs(before.images[view].stamps_ns - first[0] - row * 2e8))
            a = np.asarray(before.images[view].frames[int(nearest)], float)
            b = np.asarray(after.images[view].frames[row], float)
            assert a.shape == b.shape and abs(a - b).mean() < 4
    states = before.joint_states
    order = [states.joint_names.index(name) for name in after.joint_states.joint_names]
    at = (states.stamps_ns - first[0]) * 1e-9
    wanted = [np.interp(np.arange(count) / 5, at, states.positions[:, k]) for k in order]
    np.testing.assert_allclose(after.joint_states.positions.T, wanted, atol=2e-2)


def test_metadata_and_statistics_are_of_the_rows(exported):
    dataset = LeRobotDataset(exported)
    assert dataset.version == 'v3.0' and dataset.fps == 5 and list(dataset.episodes) == [0]
    rows = dataset.rows(dataset.episodes[0], ['observation.state', 'action', 'frame_index'])
    statistics = json.loads((exported / 'meta/stats.json').read_text())
    for name in ('observation.state', 'action'):
        np.testing.assert_allclose(statistics[name]['mean'], rows[name].mean(0), atol=1e-5)
        np.testing.assert_allclose(statistics[name]['max'], rows[name].max(0), atol=1e-5)
    image = statistics['observation.images.low']
    assert np.shape(image['mean']) == (3, 1, 1) and 0 < np.max(image['mean']) < 1
    info = json.loads((exported / 'meta/info.json').read_text())
    assert info['total_frames'] == len(rows['action']) and info['splits'] == {'train': '0:1'}


def test_nothing_is_replaced_or_left_behind(exported, tmp_path, capsys):
    assert main(['export', 'lerobot', str(DEMO), '--out', str(exported)]) == 1
    assert main(['export', 'lerobot', str(tmp_path), '--out', str(tmp_path / 'new')]) == 1
    assert 'there is no episode to export' in capsys.readouterr().err
    assert (
        main(['export', 'lerobot', str(DEMO), '--out', str(tmp_path / 'new'), '--fps', '0']) == 1
    )
    assert not list(tmp_path.iterdir())


def test_an_episode_of_another_robot_is_named(tmp_path, capsys):
    command = ['export', 'lerobot', str(DEMO), '--robot', 'franka', '--out', str(tmp_path / 'out')]
    assert main(command) == 1
    assert f"mtv-world: episode '{DEMO}': joints ['panda_joint1', " in capsys.readouterr().err


def test_small_png_images_are_imported_again_without_loss(tmp_path):
    out = tmp_path / 'dataset'
    wanted = ['--fps', '5', '--size', '95x72', '--images']
    assert main(['export', 'lerobot', str(DEMO), '--out', str(out), *wanted]) == 0
    assert not (out / 'videos').exists()
    mapping = str(out / 'meta/mapping.yaml')
    again = tmp_path / 'again'
    assert main(['import', 'lerobot', str(out), '--mapping', mapping, '--out', str(again)]) == 0
    (path,) = again.glob('episode_*')
    before, after = read_episode(DEMO), read_episode(path)
    for view in before.views:
        camera = scaled(before.cameras[view], 95, 72)
        np.testing.assert_allclose(after.cameras[view].K, camera.K, rtol=1e-5)
        dataset = LeRobotDataset(out)
        key = f'observation.images.{view}'
        first = next(iter(dataset.frames(dataset.episodes[0], key, np.zeros(1))))
        real = before.images[view].frames[0]
        wanted_image = cv2.resize(real, (95, 72), interpolation=cv2.INTER_AREA)
        np.testing.assert_array_equal(first, wanted_image)


@pytest.mark.parametrize('size', ['96', '0x72', '96x', 'small'])
def test_a_wrong_size_is_refused(size, tmp_path, capsys):
    out = str(tmp_path / 'new')
    assert main(['export', 'lerobot', str(DEMO), '--out', out, '--size', size]) == 1
    assert f"--size is '{size}'; it must be WIDTHxHEIGHT" in capsys.readouterr().err


def test_several_paths_are_one_data_set(tmp_path, capsys):
    out = tmp_path / 'set'
    command = ['export', 'lerobot', str(DEMO), str(DEMO), '--out', str(out), '--fps', '2']
    assert main([*command, '--size', '64x48', '--images']) == 0
    assert '2 episodes' in capsys.readouterr().out
    assert len(LeRobotDataset(out).episodes) == 2
