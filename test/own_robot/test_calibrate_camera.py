"""`mtv-world fit camera` against the pose that the pictures were drawn with."""

from dataclasses import replace
import shutil

import cv2
import numpy as np
import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cameras.silhouettes import draw_silhouettes
from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.inspection.camera_pose import difference, displaced_pose, jackknife_errors
from mtv_world_ros.inspection.cameras.fixed_camera import FixedCamera
from mtv_world_ros.inspection.cameras.scene_tracks import follow_scene
from mtv_world_ros.inspection.cameras.wrist_camera import WristCamera
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.shape import load_shape
from test.support.crane import load, make_cameras, make_positions, write_episode
from test.support.unknown_cameras import forget_poses


@pytest.mark.slow
def test_a_fixed_camera_is_found_from_a_guess_in_a_part_of_the_recording(tmp_path, capsys):
    robot = load(tmp_path)
    door = replace(make_cameras()['door'], mount_link='world')
    change = displaced_pose(
        np.eye(4), np.array([0.05, -0.04, 0.08, 0.04, 0.03, -0.05]), np.zeros(3)
    )
    guess = replace(door, T_mount_camera=door.T_mount_camera @ change)
    far_mm, far_deg = difference(door.T_mount_camera, guess.T_mount_camera)
    assert far_mm > 60 and far_deg > 5
    path = write_episode(
        tmp_path / 'episode', robot, {'door': door}, make_positions(5.0),
        recorded_as={'door': guess},
    )  # fmt: skip
    out = tmp_path / 'found.yaml'
    command = ['fit', 'camera', str(path), '--view', 'door', '--robot', str(robot.file)]
    assert main([*command, '--between', '0,4', '--out', str(out)]) == 0
    printed = capsys.readouterr().out
    assert 'standard error' in printed and 'the guess was' in printed
    found = load_calibration(out)['door']
    mm, degrees = difference(door.T_mount_camera, found.T_mount_camera)
    assert mm < 20 and degrees < 0.8, (mm, degrees)
    assert found.mount_link == 'world'
    assert out.with_suffix('.png').is_file()
    assert main([*command, '--out', str(out)]) == 1  # nothing that exists is overwritten
    capsys.readouterr()
    assert main([*command, '--between', '90,99', '--out', str(tmp_path / 'none.yaml')]) == 1
    assert 'no joint states between 90 and 99 s' in capsys.readouterr().err
    for wrong in ('4,0', '3', 'a,b'):
        with pytest.raises(SystemExit):
            main([*command, '--between', wrong])


def recorded_door(tmp_path):
    """Robot, true camera, images, joints and shapes of a recording in which all joints move."""
    robot = load(tmp_path)
    door = replace(make_cameras()['door'], mount_link='world')
    path = write_episode(tmp_path / 'episode', robot, {'door': door}, make_positions(5.0))
    episode = read_episode(path)
    joints, parts = JointTrack(episode.joint_states, robot), load_shape(robot).parts
    return robot, door, episode.images['door'], joints, parts


@pytest.mark.slow
def test_a_guess_from_round_the_corner_ends_where_the_camera_is(tmp_path):
    """Least squares alone, along poses that look alike, end 27 mm away here, the search 15."""
    robot, door, images, joints, parts = recorded_door(tmp_path)

    def estimator(camera):
        return FixedCamera(images, camera, robot, parts, joints)

    circled = np.array([0, 0.3, 0, 0, 0, 0])
    T = displaced_pose(door.T_mount_camera, circled, estimator(door).centre)
    assert difference(door.T_mount_camera, T)[0] > 400
    found = estimator(replace(door, T_mount_camera=T)).estimate()
    mm, degrees = difference(door.T_mount_camera, found.camera.T_mount_camera)
    assert mm < 20 and degrees < 0.5, (mm, degrees)
    assert mm < 2 * found.std_mm


@pytest.mark.slow
def test_shadows_on_the_table_do_not_move_the_camera(tmp_path):
    """Real arms cast soft shadows: here one lies beside the arm, a fifth darker than the rest."""
    robot, door, track, joints, parts = recorded_door(tmp_path)
    arm = draw_silhouettes(parts, door, robot, joints.at(track.stamps_ns))
    frames = np.asarray(track.frames).astype(np.float32)
    aside = np.roll(arm, (20, 40), axis=(1, 2))
    soft = np.stack([cv2.GaussianBlur(one.astype(np.float32), (0, 0), 6) for one in aside])
    frames *= 1 - 0.2 * np.where(arm, 0, soft)[..., None]
    shaded = track._replace(frames=frames.astype(np.uint8))
    change = displaced_pose(
        np.eye(4), np.array([0.05, -0.04, 0.08, 0.04, 0.03, -0.05]), np.zeros(3)
    )
    guess = replace(door, T_mount_camera=door.T_mount_camera @ change)
    found = FixedCamera(shaded, guess, robot, parts, joints).estimate()
    mm, degrees = difference(door.T_mount_camera, found.camera.T_mount_camera)
    assert mm < 25 and degrees < 1.0, (mm, degrees, found.match)
    assert found.match > 0.85


def test_an_arm_that_stands_still_calibrates_nothing(tmp_path):
    robot = load(tmp_path)
    positions = np.repeat(make_positions(2.0)[:1], 20, axis=0)
    path = write_episode(
        tmp_path / 'episode', robot, {'door': make_cameras()['door']}, positions
    )  # fmt: skip
    episode = read_episode(path)
    joints = JointTrack(episode.joint_states, robot)
    with pytest.raises(CalibrationError, match='the arm hardly moves'):
        FixedCamera(
            episode.images['door'], episode.cameras['door'], robot, load_shape(robot).parts, joints
        )


@pytest.fixture(scope='module')
def wrist(tmp_path_factory):
    """A recording of the camera on the hand whose calibration is 3 cm and 6 degrees wrong."""
    folder = tmp_path_factory.mktemp('wrist')
    robot = load(folder)
    palm = make_cameras()['palm']
    change = displaced_pose(
        np.eye(4), np.array([0.06, -0.05, 0.07, 0.02, 0.015, -0.02]), np.zeros(3)
    )
    guess = replace(palm, T_mount_camera=palm.T_mount_camera @ change)
    path = write_episode(
        folder / 'episode', robot, {'palm': palm}, make_positions(8.0, seed=2, speed=0.5),
        recorded_as={'palm': guess},
    )  # fmt: skip
    return robot, palm, path


@pytest.mark.slow
@pytest.mark.parametrize('options', [[], ['--no-guess'], ['--no-guess', '--mount-link', 'find']])
def test_a_camera_on_the_arm_is_found(wrist, tmp_path, capsys, options):
    robot, palm, path = wrist
    out = tmp_path / 'found.yaml'
    command = ['fit', 'camera', str(path), '--view', 'palm', '--robot', str(robot.file)]
    assert main([*command, *options, '--out', str(out)]) == 0
    assert 'points of the scene tracked' in capsys.readouterr().out
    found = load_calibration(out)['palm']
    assert found.mount_link == 'hand'
    mm, degrees = difference(palm.T_mount_camera, found.T_mount_camera)
    assert mm < 15 and degrees < 0.6, (mm, degrees)


@pytest.mark.slow
def test_a_camera_without_any_calibration_is_found(wrist, tmp_path):
    robot, palm, path = wrist
    bag = tmp_path / 'bag'
    shutil.copytree(path, bag)
    forget_poses(bag)
    out = tmp_path / 'found.yaml'
    command = ['fit', 'camera', str(bag), '--view', 'palm', '--robot', str(robot.file)]
    assert main([*command, '--out', str(out)]) == 1  # no guess in the recording
    assert main([*command, '--no-guess', '--mount-link', 'hand', '--out', str(out)]) == 0
    mm, degrees = difference(
        palm.T_mount_camera, load_calibration(out)['palm'].T_mount_camera
    )  # fmt: skip
    assert mm < 15 and degrees < 0.6, (mm, degrees)


@pytest.mark.parametrize('mount', [[], ['--mount-link', 'find']], ids=['fixed', 'on the arm'])
def test_one_recording_without_intrinsics_is_not_searched_with_made_up_ones(
    tmp_path, capsys, mount
):
    robot = load(tmp_path)
    path = tmp_path / 'episode'
    with EpisodeWriter(path, task='', instruction='move', robot=robot.name) as writer:
        for k, row in enumerate(make_positions(0.5)):
            writer.write_joint_states(10**9 + k * 10**8, robot.joint_names, row)
            writer.write_image('palm', 10**9 + k * 10**8, np.full((48, 64, 3), k, np.uint8))
    command = ['fit', 'camera', str(path), '--view', 'palm', '--robot', str(robot.file)]
    assert main([*command, '--no-guess', *mount, '--out', str(tmp_path / 'a.yaml')]) == 1
    said = capsys.readouterr().err
    assert "the intrinsics of view 'palm' are not known" in said and '--calibration' in said
    assert not (tmp_path / 'a.yaml').exists()


def test_a_guess_is_of_the_recorded_link(wrist, tmp_path, capsys):
    robot, _, path = wrist
    command = ['fit', 'camera', str(path), '--view', 'palm', '--robot', str(robot.file)]
    assert main([*command, '--mount-link', 'jib', '--out', str(tmp_path / 'a.yaml')]) == 1
    assert 'give --no-guess' in capsys.readouterr().err


@pytest.mark.slow
def test_a_wrist_that_turns_about_one_axis_determines_nothing(tmp_path):
    robot = load(tmp_path)
    positions = np.repeat(make_positions(3.0)[:1], 30, axis=0)
    positions[:, 0] += np.linspace(-0.5, 0.5, 30)
    palm = make_cameras()['palm']
    path = write_episode(tmp_path / 'episode', robot, {'palm': palm}, positions)
    episode = read_episode(path)
    joints = JointTrack(episode.joint_states, robot)
    tracks = follow_scene(episode.images['palm'], palm, robot, joints)
    with pytest.raises(CalibrationError, match='at least two axes'):
        WristCamera(tracks, palm, robot).estimate(guess=False)


def test_pictures_without_motion_calibrate_nothing(wrist):
    robot, palm, path = wrist
    episode = read_episode(path)
    frames = np.asarray(episode.images['palm'].frames)
    still = np.repeat(frames[:1], len(frames), axis=0)
    track = episode.images['palm']._replace(frames=still)
    with pytest.raises(CalibrationError, match='record a scene with texture'):
        follow_scene(track, palm, robot, JointTrack(episode.joint_states, robot))


def test_the_jackknife_has_the_textbook_value():
    changes = np.zeros((4, 6))
    changes[:, 3] = [0.0, 0.001, 0.002, 0.003]
    # sqrt(3/4 * ((1.5^2 + 0.5^2) * 2)) mm
    assert jackknife_errors(changes) == pytest.approx((np.sqrt(0.75 * 5.0), 0.0))
