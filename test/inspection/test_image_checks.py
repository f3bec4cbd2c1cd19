"""Pictures that stay the same while joints move: a camera that hangs, or only a slower one."""

import numpy as np
import pytest

from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode import JointStates, Track
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.inspection.image_checks import check_frozen
from mtv_world_ros.robot.file import load_robot

HZ, COUNT = 30, 90


@pytest.fixture(scope='module')
def moving():
    """Stamps [ns] and joint states of an arm that turns at 1 rad/s."""
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    stamps = 10**9 + np.round(np.arange(COUNT) * 1e9 / HZ).astype(np.int64)
    positions = np.tile(np.clip(0.0, robot.lower, robot.upper), (COUNT, 1))
    positions[:, 0] += np.arange(COUNT) / HZ
    states = JointStates(stamps_ns=stamps, joint_names=robot.joint_names, positions=positions)
    return stamps, JointTrack(states, robot)


def pictures(shown: np.ndarray) -> np.ndarray:
    """Return frames with the pictures of these numbers, each of its own."""
    known = np.random.default_rng(0).integers(0, 255, (COUNT, 16, 16, 3), dtype=np.uint8)
    return known[shown]


@pytest.mark.parametrize('every', [1, 2, 4])
def test_a_camera_that_is_slower_than_the_rows_does_not_hang(moving, every):
    stamps, joints = moving
    shown = np.arange(COUNT) // every * every
    measures, findings = check_frozen(Track(stamps, pictures(shown)), joints)
    assert findings == []
    assert measures['frames that do not change while joints move'] == '0%'
    repeated = float(measures['frames that repeat the one before while joints move'].rstrip('%'))
    assert repeated == pytest.approx(100 * (1 - 1 / every), abs=2)


@pytest.mark.parametrize(('length', 'verdict'), [(20, 'suspicious'), (75, 'broken')])
def test_a_picture_that_stays_while_joints_move_is_named(moving, length, verdict):
    stamps, joints = moving
    shown = np.arange(COUNT)
    shown[8 : 8 + length] = 8
    _, (finding,) = check_frozen(Track(stamps, pictures(shown)), joints)
    assert finding.verdict == verdict
    assert 'the same picture for more than 0.25 s: the camera hangs' in finding.text
