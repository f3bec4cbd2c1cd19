"""Situations that users of other projects reported, each as small valid input.

The table in docs/importing_cases.md names the reports; its rows have tests of their numbers here.
"""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import PlanError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.image_decoding import compressed_to_rgb, raw_to_rgb
from mtv_world_ros.data.episode import JointStates
from mtv_world_ros.data.joint_plans import complete_plans, join_streams, read_plan
from mtv_world_ros.robot.resample import resample

SECOND = 1_000_000_000


def plan(names, rows, times, velocities=None):
    """trajectory_msgs/JointTrajectory of rosbags' class."""
    make = messages.make
    points = [
        make(
            'trajectory_msgs/msg/JointTrajectoryPoint',
            positions=np.array(row, float),
            velocities=np.array([] if velocities is None else velocities[k], float),
            accelerations=np.empty(0),
            effort=np.empty(0),
            time_from_start=make(
                'builtin_interfaces/msg/Duration', sec=int(t), nanosec=round(t % 1 * SECOND)
            ),
        )
        for k, (row, t) in enumerate(zip(rows, times, strict=True))
    ]
    header = messages.make_header(0, '')
    return make(messages.JOINT_TRAJECTORY, header=header, joint_names=list(names), points=points)


def test_1_an_empty_second_point_of_servo_is_refused_and_named():
    with pytest.raises(PlanError, match='point 1 has no positions'):
        read_plan(plan('ab', [[0.0, 0.1], []], [0.02, 0.02]))


def test_2_a_first_point_at_time_zero_is_where_the_plan_starts():
    """Not dropped: the motion begins at its position, not at the measured one."""
    found = read_plan(plan('a', [[0.0], [1.0]], [0.0, 2.0]))
    assert found.times.tolist() == [0.0, 2.0]
    half = resample(found, np.array([0.3]), np.array([0.0, 1.0]))
    np.testing.assert_allclose(half[:, 0], [0.0, 0.5])


def test_3_servos_points_without_a_time_are_joined_by_their_stamps():
    one = [(k * SECOND // 50, read_plan(plan('a', [[0.01 * k]], [0.0]))) for k in range(100)]
    joined, count = join_streams(one, 1.0)
    assert count == 100 and [stamp / SECOND for stamp, _ in joined] == pytest.approx([0.0, 1.0])
    at = np.concatenate([stamp / SECOND + t.times for stamp, t in joined])
    np.testing.assert_allclose(at, np.arange(1, 100) / 50)
    np.testing.assert_allclose(
        np.concatenate([t.positions[:, 0] for _, t in joined]), 0.01 * np.arange(1, 100)
    )


class TwoJoints:
    """As much of a robot as plans need."""

    joint_names = ('arm', 'gripper')
    is_endless = np.array([False, False])


def test_4_joints_that_a_plan_leaves_out_go_where_they_were_measured():
    stamps = np.arange(0, 2 * SECOND, SECOND // 10)
    measured = np.stack([np.zeros(20), np.linspace(0.0, 0.019, 20)], axis=1)
    states = JointStates(stamps_ns=stamps, joint_names=TwoJoints.joint_names, positions=measured)
    arm = JointTrajectory(joint_names=('arm',), times=np.array([1.0]), positions=np.array([[0.5]]))
    plans, measured = complete_plans([(0, arm)], states, TwoJoints, 3.2)
    assert measured == ('gripper',)
    _, whole = plans[0]
    np.testing.assert_allclose(whole.positions[-1], [0.5, 0.01])
    np.testing.assert_allclose(whole.positions[:, 1], 0.01 * whole.times)
    assert plans[1][1].positions[-1].tolist() == pytest.approx([0.5, 0.019])


def test_5_a_plan_that_ends_with_a_speed_holds_after_its_end():
    found = read_plan(plan('a', [[0.0], [1.0]], [0.5, 1.0], velocities=[[2.0], [5e-5]]))
    after = resample(found, np.array([0.0]), np.array([1.0, 1.5, 3.0]))
    np.testing.assert_allclose(after[:, 0], 1.0)


@pytest.mark.parametrize(
    'layout', ['jpeg', 'rgb8; jpeg compressed bgr8', 'bgra8; jpeg compressed bgr8', 'jpg', 'png']
)
def test_6_whatever_the_format_says_of_its_order_the_picture_is_rgb(layout):
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 2] = 200  # OpenCV's order
    data = cv2.imencode('.png' if layout == 'png' else '.jpg', red)[1].ravel()
    found = compressed_to_rgb(layout, data)[8, 8]
    assert found[0] > 190 and found[2] < 20


@pytest.mark.parametrize(('encoding', 'first'), [('rgb8', 200), ('bgr8', 10)])
def test_7_raw_images_keep_red_where_the_encoding_has_it(encoding, first):
    data = np.tile(np.array([200, 50, 10], np.uint8), 4)
    fields = {'height': 2, 'width': 2, 'step': 6, 'is_bigendian': 0}
    found = raw_to_rgb(SimpleNamespace(data=data, encoding=encoding, **fields))
    assert found[0, 0].tolist() == [first, 50, 210 - first]


@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
@pytest.mark.parametrize('suffix', ['.jpg', '.png'])
def test_8_a_compressed_mosaic_has_its_colours(pattern, suffix):
    """A red picture: only the red places of the mosaic are bright."""
    mosaic = np.zeros((32, 32), np.uint8)
    row, column = divmod(pattern.index('r'), 2)
    mosaic[row::2, column::2] = 200
    data = cv2.imencode(suffix, mosaic, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].ravel()
    kind = 'jpeg' if suffix == '.jpg' else 'png'
    found = compressed_to_rgb(f'bayer_{pattern}8; {kind} compressed ', data)[8:24, 8:24]
    red, green, blue = found.reshape(-1, 3).mean(axis=0)
    assert red > 180 and green < 30 and blue < 30


def test_8_a_colour_picture_that_was_a_mosaic_stays_as_it_is():
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 2] = 200
    data = cv2.imencode('.jpg', red)[1].ravel()
    found = compressed_to_rgb('bayer_rggb8; jpeg compressed bgr8', data)[8, 8]
    assert found[0] > 190 and found[2] < 20
