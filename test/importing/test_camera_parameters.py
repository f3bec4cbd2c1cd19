"""Cameras from the dataset's own parameters: JSON files and features, in several conventions."""

from __future__ import annotations

import json
from pathlib import Path
import shutil

import numpy as np
import pytest

pytest.importorskip('pyarrow', reason='pyarrow is not installed (pip install .[import])')

from mtv_world_ros.core.config import validated
from mtv_world_ros.core.errors import CalibrationError, ConfigError
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.importing.camera_parameters import camera_track, CameraSource
from mtv_world_ros.importing.lerobot_episodes import import_dataset

#: looks down from 2 m: x right, y down, z ahead in the camera
POSE = np.array([[1.0, 0, 0, 0.5], [0, -1, 0, -0.25], [0, 0, -1, 2.0], [0, 0, 0, 1]])
K = [[70.0, 0, 31.5], [0, 71, 23.5], [0, 0, 1]]
BASE = {'file': 'camera_{episode_index:06d}.json', 'intrinsics': 'head.K',
        'extrinsics': 'head.T', 'mount_link': 'base'}  # fmt: skip


def source_of(row: dict, folder: Path) -> CameraSource:
    return validated(CameraSource, {'view': 'head', **row}, 'mapping', context={'folder': folder})


def model(folder: Path, document: object, size=(64, 48), **changes):
    row = {'feature': 'image', 'camera': {**BASE, **changes}}
    row['camera'] = {key: value for key, value in row['camera'].items() if value is not None}
    (folder / 'camera_000003.json').write_text(json.dumps(document))
    source = source_of(row, folder)
    return camera_track(source, folder, 3, {}, size).camera


def test_matrices_are_read_by_their_path(tmp_path):
    camera = model(tmp_path, {'head': {'K': K, 'T': POSE.tolist()}})
    assert pytest.approx(np.array(K)) == camera.K
    assert camera.T_mount_camera == pytest.approx(POSE)
    assert camera.mount_link == 'base'


@pytest.mark.parametrize(
    'intrinsics',
    [
        [70, 71, 31.5, 23.5],
        {'fx': 70, 'fy': 71, 'cx': 31.5, 'cy': 23.5},
        {'ppx': 31.5, 'ppy': 23.5, 'fx': 70, 'fy': 71, 'model': 'brown'},
        np.ravel(K).tolist(),
    ],
)
def test_intrinsics_come_in_several_forms(tmp_path, intrinsics):
    camera = model(tmp_path, {'head': {'K': intrinsics, 'T': POSE[:3].tolist()}})
    assert pytest.approx(np.array(K)) == camera.K
    assert camera.T_mount_camera == pytest.approx(POSE)


def test_poses_of_other_conventions_come_out_the_same(tmp_path):
    # by hand: the inverse of a half turn about x is itself, the translation turns with it
    inverted = np.array([[1.0, 0, 0, -0.5], [0, -1, 0, -0.25], [0, 0, -1, 2.0], [0, 0, 0, 1]])
    camera = model(tmp_path, {'head': {'K': K, 'T': inverted.tolist()}}, pose='mount_in_camera')
    assert camera.T_mount_camera == pytest.approx(POSE)
    # OpenGL's y points up and its z back: here the identity
    opengl = np.eye(4)
    opengl[:3, 3] = 500, -250, 2000
    camera = model(tmp_path, {'head': {'K': K, 'T': opengl.tolist()}}, axes='opengl', unit='mm')
    assert camera.T_mount_camera == pytest.approx(POSE)
    # a half turn about x as quaternion
    parts = {'q': [0, 1, 0, 0], 't': [[0.5], [-0.25], [2.0]]}
    camera = model(tmp_path, {'head': {'K': K}, 'pose': [parts]}, extrinsics=None,
                   rotation='pose.0.q', translation='pose.0.t', quaternion='wxyz')  # fmt: skip
    assert camera.T_mount_camera == pytest.approx(POSE)


def test_k_is_for_another_size_than_the_video(tmp_path):
    document = {'head': {'K': K, 'T': POSE.tolist(), 'd': [-0.1, 0.01, 0, 0, 0]}}
    row = {**BASE, 'distortion': 'head.d', 'size': [64, 48]}
    (tmp_path / 'camera_000003.json').write_text(json.dumps(document))
    source = source_of({'feature': 'x', 'camera': row}, tmp_path)
    camera = camera_track(source, tmp_path, 3, {}, (128, 96)).camera
    assert (camera.width, camera.K[0, 0], camera.K[0, 2]) == (128, 140, 63.5)
    assert camera.distortion_model == 'plumb_bob'
    assert camera.distortion == pytest.approx([-0.1, 0.01, 0, 0, 0])


@pytest.mark.parametrize(
    ('document', 'changes', 'message'),
    [
        ({'head': {'k': K}}, {}, "has no 'head.K': 'K' is not there"),
        ({'heads': {}}, {}, "'head' is not there (did you mean 'heads'?)"),
        ({'head': {'K': [1, 2], 'T': POSE.tolist()}}, {}, "'intrinsics' is [1, 2]"),
        ({'head': {'K': K, 'T': POSE.T.tolist()}}, {}, 'stored transposed'),
        ({'head': {'K': K, 'T': 'none'}}, {}, "'extrinsics' is 'none', must be numbers"),
        ({}, {'file': 'nothing.json'}, 'nothing.json'),
        ({}, {'file': 'x_{episode}.json'}, 'it may hold {episode_index}'),
    ],
)
def test_wrong_parameters_are_errors_that_help(tmp_path, document, changes, message):
    with pytest.raises((CalibrationError, ConfigError)) as caught:
        model(tmp_path, document, **changes)
    assert message in str(caught.value)


def test_unknown_words_name_the_nearest(tmp_path):
    with pytest.raises(ConfigError, match="'pose' is 'camera_to_mount' .did you mean"):
        model(tmp_path, {}, pose='camera_to_mount')
    with pytest.raises(ConfigError, match="unknown key 'extrinsic' .did you mean 'extrinsics'"):
        model(tmp_path, {}, extrinsics=None, extrinsic='head.T')


def test_single_view_data_with_parameters_in_features(datasets, make_mapping, tmp_path):
    camera = '{intrinsics: sensors.top.K, extrinsics: sensors.top.pose, mount_link: base}'
    front = 'front: {feature: observation.images.front, calibration: calibration.yaml}'
    mapping = make_mapping((front, f'top: {{feature: observation.images.top, camera: {camera}}}'))
    assert import_dataset(datasets('v3.0'), mapping, tmp_path / 'out').failed == {}
    poses = [read_episode(tmp_path / f'out/episode_00000{n}').cameras['top'] for n in (0, 1)]
    assert [camera.T_mount_camera[0, 3] for camera in poses] == pytest.approx([0.0, 0.1])
    assert poses[0].K[0, 0] == 70


def test_a_pose_that_changes_within_the_episode_is_refused(tmp_path):
    row = {'feature': 'x', 'camera': {'intrinsics': 'K', 'extrinsics': 'T', 'mount_link': 'base'}}
    source = source_of(row, tmp_path)
    poses = np.repeat(POSE[None], 4, axis=0)
    poses[2, 0, 3] += 0.1
    values = {'K': np.repeat(np.array(K)[None], 4, axis=0), 'T': poses}
    with pytest.raises(CalibrationError, match="'T' changes at frame 2; a camera that moves"):
        camera_track(source, tmp_path, 0, values, (64, 48))


def test_a_camera_that_moves_has_a_pose_a_row(tmp_path):
    poses = np.repeat(POSE[None], 4, axis=0)
    poses[:, 0, 3] += np.arange(4)
    row = {**BASE, 'file': None, 'intrinsics': 'K', 'extrinsics': 'T', 'moves': True}
    row = {key: value for key, value in row.items() if value is not None}
    values = {'K': np.repeat(np.array(K)[None], 4, axis=0), 'T': poses}
    source = source_of({'feature': 'image', 'camera': row}, tmp_path)
    camera, track, _ = camera_track(source, tmp_path, 0, values, (64, 48))
    assert camera.T_mount_camera == pytest.approx(poses[0]) and track == pytest.approx(poses)
    poses[2, :3, :3] *= 2
    with pytest.raises(CalibrationError, match='not a rotation'):
        camera_track(source, tmp_path, 0, values, (64, 48))
    with pytest.raises(ConfigError, match="'moves' needs poses that are features"):
        source_of({'feature': 'image', 'camera': {**BASE, 'moves': True}}, tmp_path)


def test_the_poses_of_a_camera_that_moves_are_stored_with_the_episode(
    datasets, make_mapping, tmp_path
):
    from pyarrow import array, parquet

    root = tmp_path / 'moving'
    shutil.copytree(datasets('v2.1'), root)
    file = root / 'data/chunk-000/episode_000000.parquet'
    table = parquet.read_table(file)
    poses = np.repeat(POSE[None], len(table), axis=0)
    poses[:, 0, 3] += 0.05 * np.arange(len(table))
    at = table.column_names.index('sensors.top.pose')
    parquet.write_table(table.set_column(at, 'sensors.top.pose', array(poses.tolist())), file)
    camera = (
        'camera: {intrinsics: sensors.top.K, extrinsics: sensors.top.pose, moves: true, '
        'mount_link: base}'
    )
    mapping = make_mapping(('calibration: calibration.yaml', camera))
    summary = import_dataset(root, mapping, tmp_path / 'out', episodes=[0])
    assert summary.made == [0], summary.failed
    episode = read_episode(tmp_path / 'out' / 'episode_000000')
    np.testing.assert_allclose(episode.camera_tracks['front'], poses, atol=1e-9)
    np.testing.assert_allclose(episode.camera('front', 3).T_mount_camera, poses[3], atol=1e-9)
