"""`mtv-world calibrate-camera` against the pose that the pictures were drawn with."""

from dataclasses import replace

from crane import load, make_cameras, make_positions, write_episode
import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.errors import CalibrationError
from mtv_world_ros.geometry.calibration_file import load_calibration
from mtv_world_ros.geometry.robot_shape import load_shape
from mtv_world_ros.inspection.camera_pose import difference, moved, spread
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.inspection.fixed_camera import FixedCamera


def test_a_fixed_camera_is_found_from_a_guess(tmp_path, capsys):
    robot = load(tmp_path)
    door = replace(make_cameras()['door'], mount_link='world')
    change = moved(np.eye(4), np.array([0.05, -0.04, 0.08, 0.04, 0.03, -0.05]), np.zeros(3))
    guess = replace(door, T_mount_camera=door.T_mount_camera @ change)
    far_mm, far_deg = difference(door.T_mount_camera, guess.T_mount_camera)
    assert far_mm > 60 and far_deg > 5
    path = write_episode(
        tmp_path / 'episode', robot, {'door': door}, make_positions(5.0),
        recorded_as={'door': guess},
    )  # fmt: skip
    out = tmp_path / 'found.yaml'
    command = ['calibrate-camera', str(path), '--view', 'door', '--robot', str(robot.file)]
    assert main([*command, '--out', str(out)]) == 0
    printed = capsys.readouterr().out
    assert 'standard error' in printed and 'the guess was' in printed
    found = load_calibration(out)['door']
    mm, degrees = difference(door.T_mount_camera, found.T_mount_camera)
    assert mm < 20 and degrees < 0.8, (mm, degrees)
    assert found.mount_link == 'world'
    assert out.with_suffix('.png').is_file()
    assert main([*command, '--out', str(out)]) == 1  # nothing that exists is overwritten


def test_an_arm_that_stands_still_calibrates_nothing(tmp_path):
    robot = load(tmp_path)
    positions = np.repeat(make_positions(2.0)[:1], 20, axis=0)
    path = write_episode(
        tmp_path / 'episode', robot, {'door': make_cameras()['door']}, positions
    )  # fmt: skip
    from mtv_world_ros.data.episode_reader import read_episode

    episode = read_episode(path)
    joints = JointTrack(episode.joint_states, robot)
    with pytest.raises(CalibrationError, match='the arm hardly moves'):
        FixedCamera(
            episode.images['door'], episode.cameras['door'], robot, load_shape(robot).parts, joints
        )


def test_the_jackknife_has_the_textbook_value():
    places = np.array([[0.0, 0, 0], [0.001, 0, 0], [0.002, 0, 0], [0.003, 0, 0]])
    poses = []
    for place in places:
        T = np.eye(4)
        T[:3, 3] = place
        poses.append(T)
    # sqrt(3/4 * ((1.5^2 + 0.5^2) * 2)) mm
    assert spread(poses) == pytest.approx((np.sqrt(0.75 * 5.0), 0.0))
