"""Data sets whose actions are tool poses or differences become joint commands."""

import cv2
import numpy as np
import pytest

from mtv_world_ros.core.config import validated
from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.transforms import quaternion
from mtv_world_ros.importing.lerobot_episodes import import_dataset
from mtv_world_ros.importing.mapping import ActionStream
from mtv_world_ros.robot.file import load_robot

NAMES = ('x', 'y', 'z', 'a', 'b', 'c', 'd', 'grip')
POSITION, ROTATION = ['x', 'y', 'z'], ['a', 'b', 'c']
GRIPPER = {'panda_finger_joint1': {'column': 'grip', 'closed': 0, 'open': 1}}


@pytest.fixture(scope='module')
def robot():
    return load_robot(share_path('config', 'robots', 'franka', 'robot.yaml'))


@pytest.fixture(scope='module')
def positions():
    """(T, J) a smooth motion of a Franka; the gripper closes."""
    t = np.linspace(0, 1, 12)[:, None]
    start = np.array([0.0, 0.3, 0.0, -2.0, 0.1, 2.3, 0.8, 0.04])
    end = np.array([0.4, 0.5, -0.2, -1.7, 0.0, 2.1, 0.5, 0.0])
    return start + (end - start) * t


def stream(robot, **poses):
    values = {'feature': 'action', 'joints': GRIPPER, 'tools': {'panda': poses}}
    return validated(ActionStream, values, 'mapping', context={'robot': robot})


def table(place, rotations, gripper):
    """(T, 8) columns as `NAMES`; rotations of three or four numbers."""
    wide = np.zeros((len(place), 8))
    wide[:, :3], wide[:, 3 : 3 + rotations.shape[1]], wide[:, 7] = place, rotations, gripper
    return wide


def reached(robot, positions):
    return robot.tool_poses(positions)[0]


def vectors(turns):
    return np.stack([cv2.Rodrigues(R)[0].ravel() for R in turns])


FORMS = {
    'rotation_vector': (ROTATION, lambda R: vectors(R)),
    'rpy': (ROTATION, lambda R: np.stack([_rpy(one) for one in R])),
    'quaternion_xyzw': (['a', 'b', 'c', 'd'], lambda R: np.stack([quaternion(r) for r in R])),
    'quaternion_wxyz': (
        ['a', 'b', 'c', 'd'],
        lambda R: np.stack([np.roll(quaternion(r), 1) for r in R]),
    ),
}


def _rpy(R):
    """Roll, pitch, yaw about fixed axes."""
    return np.array(
        [np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])]
    )


@pytest.mark.parametrize('form', FORMS)
def test_absolute_poses_give_joints_that_bring_the_tool_there(robot, positions, form):
    columns, write = FORMS[form]
    wanted = reached(robot, positions)
    values = table(1000 * wanted[:, :3, 3], write(wanted[:, :3, :3]), positions[:, -1] / 0.04)
    action = stream(robot, position=POSITION, rotation=columns, rotation_is=form, unit='mm')
    found, odd = action.commanded(values, NAMES, np.roll(positions, 1, axis=0), robot)
    assert odd == ()
    np.testing.assert_allclose(reached(robot, found), wanted, atol=3e-3)
    np.testing.assert_allclose(found[:, -1], positions[:, -1], atol=1e-9)
    # the arm has a joint more than needed: of all solutions the one nearest to the measured
    assert np.abs(found[2:, :7] - positions[2:, :7]).max() < 0.1


@pytest.mark.parametrize('axes', ['fixed', 'tool'])
def test_differences_are_added_to_the_measured_pose(robot, positions, axes):
    now, wanted = (reached(robot, rows) for rows in (positions[:-1], positions[1:]))
    if axes == 'fixed':
        place = wanted[:, :3, 3] - now[:, :3, 3]
        turns = wanted[:, :3, :3] @ now[:, :3, :3].transpose(0, 2, 1)
    else:
        change = np.linalg.inv(now) @ wanted
        place, turns = change[:, :3, 3], change[:, :3, :3]
    values = table(place / 0.05, vectors(turns) / 0.5, 1.0)
    action = stream(
        robot, position=POSITION, rotation=ROTATION, difference=axes, scale=[0.05, 0.5]
    )
    found, odd = action.commanded(values, NAMES, positions[:-1], robot)
    assert odd == ()
    np.testing.assert_allclose(reached(robot, found), wanted, atol=3e-3)


def test_poses_of_another_link_in_another_frame(robot, positions):
    frame, link = robot.link_poses('panda_link0', positions), robot.link_poses(
        'panda_link7', positions)  # fmt: skip
    wanted = np.linalg.inv(frame) @ link
    values = table(wanted[:, :3, 3], vectors(wanted[:, :3, :3]), 1.0)
    action = stream(
        robot, position=POSITION, rotation=ROTATION, frame='panda_link0', link='panda_link7'
    )
    found, _ = action.commanded(values, NAMES, positions, robot)
    np.testing.assert_allclose(robot.link_poses('panda_link7', found), link, atol=3e-3)


def test_poses_out_of_reach_are_counted_and_the_rest_is_kept(robot, positions):
    wanted = reached(robot, positions)
    place = wanted[:, :3, 3].copy()
    place[3] += 5
    values = table(place, vectors(wanted[:, :3, :3]), 1.0)
    action = stream(robot, position=POSITION, rotation=ROTATION)
    found, odd = action.commanded(values, NAMES, positions, robot)
    assert "arm 'panda': 1 of 12 poses are out of reach" in odd[0]
    np.testing.assert_allclose(found[3, :7], positions[4, :7])
    np.testing.assert_allclose(reached(robot, found)[4:], wanted[4:], atol=3e-3)
    with pytest.raises(EpisodeError, match='12 of 12 poses are out of reach: are frame, link'):
        action.commanded(values * 100, NAMES, positions, robot)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'tools': {'pandas': {'position': POSITION}}}, "no arm 'pandas' (did you mean 'panda'?)"),
        ({'tools': {'panda': {'position': ['x', 'y']}}}, "'position' has 2 columns"),
        ({'tools': {'panda': {'position': POSITION, 'rotation': ['a']}}}, "'rotation' has 1"),
        ({'tools': {'panda': {'position': POSITION, 'link': 'panda_link77'}}},
         "no link 'panda_link77' (did you mean"),
        ({'joints': {**GRIPPER, 'panda_joint1': 0}}, 'follow from the poses'),
        ({'joints': {}}, "joints ['panda_finger_joint1'] of robot 'franka' are missing"),
        ({'differences': ['panda_joint1']}, "'panda_joint1' is not among"),
    ],
)  # fmt: skip
def test_a_wrong_action_is_an_error_that_helps(robot, change, message):
    values = {'feature': 'action', 'joints': GRIPPER, 'tools': {'panda': {'position': POSITION}}}
    with pytest.raises(ConfigError) as caught:
        validated(ActionStream, values | change, 'mapping', context={'robot': robot})
    assert message in str(caught.value)


def test_joint_differences_of_a_data_set_and_jumps_are_named(datasets, make_mapping, tmp_path):
    """The data set's action of row k is its state of row k + 1, read here as a difference."""
    mapping = make_mapping(('feature: action\n', 'feature: action\n  differences: [shoulder]\n'))
    summary = import_dataset(datasets('v2.1'), mapping, tmp_path / 'out', episodes=[1])
    from mtv_world_ros.data.episode_reader import read_episode

    episode = read_episode(tmp_path / 'out' / 'episode_000001')
    assert summary.failed == {}
    commanded = np.concatenate([t.positions for _, t in episode.trajectories])[:, 0]
    rows = np.arange(9)
    measured, difference = np.radians(3.0 * rows + 1), np.radians(3.0 * (rows + 1) + 1)
    np.testing.assert_allclose(commanded, measured + difference, atol=1e-6)
