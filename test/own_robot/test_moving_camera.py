"""A camera that no joint of the robot moves: its poses come from /tf or a data set, row by row."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.transforms import inverse
from mtv_world_ros.data.bag_mapping import load_source
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.observations import newest_observation
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.data.recordings import cached_recording, cut_clip
from mtv_world_ros.inspection.inspect import Inspector
from mtv_world_ros.inspection.motion_residual import ResidualSearch
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.shape import load_shape
from test.support.bags import bag_cameras, grey_frames, MAPPING, record
from test.support.crane import (
    FPS,
    JOINTS,
    make_cameras,
    make_positions,
    URDF,
    write_episode,
    write_robot,
)

NUM = 30
SEARCH = ResidualSearch(max_pairs=4, lags_s=(0.0,))
SPEC = WorldModelSpec(
    views=('door', 'palm'), fps=FPS, num_frames=4, width=80, height=60, robot='crane'
)
CEILING = np.diag([1.0, -1, -1, 1])
CEILING[:3, 3] = 0.4, 0.1, 2.0


def cart_poses():
    """(N, 4, 4) the ceiling frame, which goes 30 cm and turns by 20 degrees."""
    poses = np.repeat(CEILING[None], NUM, axis=0)
    for k, pose in enumerate(poses):
        angle = np.radians(20) * k / NUM
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, :3] = turn @ CEILING[:3, :3]
        pose[0, 3] += 0.3 * k / NUM
    return poses


def record_cart(path, robot, poses):
    positions, frames = make_positions(NUM / FPS)[:NUM], grey_frames(NUM)
    return record(path, robot, bag_cameras(), positions, frames=frames, cart=poses)


@pytest.fixture
def bag(robot, tmp_path):
    path = record_cart(tmp_path / 'wave', robot, cart_poses())
    (tmp_path / 'bag.yaml').write_text(yaml.safe_dump(MAPPING))
    return path


def truth():
    """(N, 4, 4) T_plinth_camera of the view `door`."""
    return cart_poses() @ inverse(CEILING) @ make_cameras()['door'].T_mount_camera


def imported(bag, *more):
    out = bag.parent / 'out'
    assert main(['import', 'bag', str(bag), '--topics', str(bag.parent / 'bag.yaml'), '--out',
                 str(out), *more]) == 0  # fmt: skip
    return out / 'wave'


def test_poses_of_each_image_go_through_the_episode(bag, robot, capsys):
    path = imported(bag)
    printed = capsys.readouterr().err
    assert "view 'door': its camera moves against every link of the robot" in printed
    assert 'palm' not in printed
    episode = read_episode(path)
    assert set(episode.camera_tracks) == {'door'}
    assert episode.cameras['door'].mount_link == 'plinth'
    assert episode.cameras['palm'].mount_link == 'hand'
    for k in (0, 7, NUM - 1):
        np.testing.assert_allclose(episode.camera('door', k).T_mount_camera, truth()[k], atol=1e-6)
    source = load_source(bag.parent / 'out' / 'mapping.yaml', None)
    direct = read_episode(bag, mapping=source.mapping, robot=robot)
    np.testing.assert_allclose(direct.camera_tracks['door'], truth(), atol=1e-6)


def test_clips_and_observations_have_the_camera_where_it_is(bag, robot, tmp_path):
    path = imported(bag)
    for recording in (
        load_recording(path, SPEC, robot),
        cached_recording(path, SPEC, robot, tmp_path / 'cache'),
        cached_recording(path, SPEC, robot, tmp_path / 'cache'),  # as it was kept
    ):
        for start in (0, 12):
            clip = cut_clip(recording, start, SPEC)
            door, palm = clip.cameras
            np.testing.assert_allclose(door.T_mount_camera, truth()[start], atol=1e-6)
            np.testing.assert_array_equal(palm.T_mount_camera, recording.cameras[1].T_mount_camera)
    episode = read_episode(path)

    stamp = int(episode.images['door'].stamps_ns[9])
    seen = newest_observation(episode, SPEC.views, robot, stamp)
    np.testing.assert_allclose(seen.cameras[0].T_mount_camera, truth()[9], atol=1e-6)


def test_the_doctor_says_that_it_is_not_checked(bag, robot):
    episode = read_episode(imported(bag), robot=robot)
    section = next(
        s
        for s in Inspector(robot, load_shape(robot), SEARCH).inspect(episode).views
        if s.name == 'door'
    )
    said = [finding.text for finding in section.findings]
    assert any('the camera moves by itself' in text for text in said)


def test_a_gap_in_tf_is_named(robot, tmp_path, bag, capsys):
    poses = cart_poses()
    poses[8:20, :3, :3] = np.nan  # no poses: twelve images at 10 Hz
    broken = record_cart(tmp_path / 'gap', robot, poses)
    command = ['import', 'bag', str(broken), '--topics', str(tmp_path / 'bag.yaml')]
    assert main([*command, '--out', str(tmp_path / 'out')]) == 1
    assert (
        "no transform from 'plinth' to 'ceiling' within 0.5 s before and after 12 of 30 images"
        in capsys.readouterr().err
    )


def test_a_camera_on_a_calibration_file_does_not_move(bag, robot):
    path = imported(bag)
    episode = read_episode(path, calibration=path / 'calibration.yaml')
    assert not episode.camera_tracks  # the user's own file goes before /tf
    np.testing.assert_allclose(episode.cameras['door'].T_mount_camera, truth()[0], atol=1e-6)
    assert episode.camera('door', 5) is episode.cameras['door']


def test_what_takes_one_pose_of_a_camera_refuses_it(bag, robot, capsys, tmp_path):
    path = imported(bag)
    out = str(tmp_path / 'cameras.yaml')
    command = ['fit', 'camera', str(path), '--view', 'door', '--robot', str(robot.file)]
    assert main([*command, '--out', out]) == 1
    assert "the camera of view 'door' moves by itself" in capsys.readouterr().err
    command = ['export', 'lerobot', str(path), '--robot', str(robot.file), '--fps', str(FPS)]
    assert main([*command, '--out', str(tmp_path / 'set')]) == 1
    assert "the camera of view 'door' moves by itself" in capsys.readouterr().err


@pytest.fixture
def panning(tmp_path):
    """The crane with a link `ceiling` on a joint `pan` that is not among its joints."""
    file = write_robot(tmp_path / 'panning')
    pan = (
        '<link name="ceiling"/><joint name="pan" type="revolute"><parent link="plinth"/>'
        '<child link="ceiling"/><origin xyz="0.4 0.1 2"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    file.with_suffix('.urdf').write_text(URDF.replace('</robot>', pan))
    file.write_text(f'{file.read_text()}joints: [{", ".join(JOINTS)}]\n')
    return load_robot(file)


def test_a_joint_that_the_robot_does_not_list_is_followed_by_tf(panning, bag):
    assert 'ceiling' in panning.link_names and 'ceiling' not in panning.posed_links
    assert {'plinth', 'hand', 'right', 'world'} <= set(panning.posed_links)
    episode = read_episode(imported(bag, '--robot', str(panning.file)))
    assert episode.cameras['door'].mount_link == 'plinth'
    np.testing.assert_allclose(episode.camera_tracks['door'], truth(), atol=1e-6)


def test_without_tf_the_joint_is_named(panning, tmp_path, capsys):
    """Taken as at rest, a view would be drawn at a pose that it does not have."""
    door = make_cameras()['door']
    on_ceiling = replace(door, mount_link='ceiling')
    path = write_episode(
        tmp_path / 'episode',
        panning,
        {'door': door},
        make_positions(1.0),
        recorded_as={'door': on_ceiling},
    )
    command = ['check', str(path), '--robot', str(panning.file), '--out', str(tmp_path / 'out')]
    assert main(command) == 1
    printed = capsys.readouterr().err
    assert "the camera of view 'door' is on link 'ceiling', which joint 'pan' moves" in printed
    assert "add it to 'joints' of the robot's YAML" in printed
