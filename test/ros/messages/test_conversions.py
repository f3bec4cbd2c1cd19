"""Messages to arrays and back, against values worked out by hand or by OpenCV."""

import cv2
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from mtv_world_ros.ros.messages.conversions import (
    has_header,
    make_header,
    NANO,
    read_stamp,
    to_joint_state,
    to_multi_array,
    to_ns,
    to_positions,
    to_stamp,
    to_status,
    to_trajectory,
    values_of,
    with_stamp,
)
from mtv_world_ros.ros.messages.image_messages import (
    scale_camera_info,
    to_compressed,
    to_image,
    to_rgb,
)
from mtv_world_ros.ros.messages.rejection import Rejection

RGB = np.array([[[1, 2, 3], [4, 5, 6]], [[7, 8, 9], [250, 251, 252]]], np.uint8)


@pytest.mark.parametrize(
    ('encoding', 'pixels'),
    [
        ('rgb8', RGB),
        ('bgr8', RGB[..., ::-1]),
        ('rgba8', np.dstack([RGB, np.full((2, 2), 255, np.uint8)])),
        ('bgra8', np.dstack([RGB[..., ::-1], np.zeros((2, 2), np.uint8)])),
    ],
)
@pytest.mark.parametrize('padding', [0, 5])
def test_encodings_become_rgb_without_the_rows_padding(encoding, pixels, padding):
    rows = np.ascontiguousarray(pixels).reshape(2, -1)
    rows = np.hstack([rows, np.full((2, padding), 99, np.uint8)])
    message = Image(width=2, height=2, step=rows.shape[1], encoding=encoding, data=rows.tobytes())
    np.testing.assert_array_equal(to_rgb(message), RGB)


def test_grey_becomes_three_equal_channels():
    message = Image(width=3, height=1, step=3, encoding='mono8', data=b'\x00\x07\xff')
    np.testing.assert_array_equal(to_rgb(message), [[[0] * 3, [7] * 3, [255] * 3]])


def test_images_survive_the_way_over_the_wire():
    sent = to_image(RGB, make_header(1_500_000_002, 'low_optical_frame'))
    got = deserialize_message(serialize_message(sent), Image)
    assert (got.encoding, got.step, got.header.frame_id) == ('rgb8', 6, 'low_optical_frame')
    assert to_ns(got.header.stamp) == 1_500_000_002
    np.testing.assert_array_equal(to_rgb(got), RGB)


def test_labels_are_sent_as_they_are():
    labels = np.array([[0, 1, 2], [0, 0, 2]], np.uint8)
    message = to_image(labels, make_header(0))
    assert (message.encoding, message.step, bytes(message.data)) == ('mono8', 3, labels.tobytes())


def test_a_view_into_a_video_is_sent_whole():
    video = np.arange(2 * 3 * 4 * 6 * 3, dtype=np.uint8).reshape(2, 3, 4, 6, 3)
    np.testing.assert_array_equal(
        to_rgb(to_image(video[1, 2, ::2], make_header(0))), video[1, 2, ::2]
    )


def test_compressed_images_are_rgb_for_others_too():
    red = np.zeros((32, 32, 3), np.uint8)
    red[..., 0] = 200
    message = to_compressed(red, make_header(0), 95)
    assert message.format == 'rgb8; jpeg compressed bgr8'
    bgr = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
    assert bgr[..., 2].min() > 190 and bgr[..., 0].max() < 10
    assert np.abs(to_rgb(message).astype(int) - red).max() < 10


def test_png_is_read_without_loss():
    data = cv2.imencode('.png', RGB[..., ::-1])[1].tobytes()
    np.testing.assert_array_equal(to_rgb(CompressedImage(format='png', data=data)), RGB)


def test_camera_info_scales_as_a_resized_image_projects():
    info = CameraInfo(width=640, height=480, distortion_model='plumb_bob', d=[0.1, 0, 0, 0, 0])
    info.k = [600.0, 0, 320.0, 0, 610.0, 240.0, 0, 0, 1]
    info.p = [590.0, 0, 318.0, -59.0, 0, 605.0, 242.0, 0, 0, 0, 1, 0]
    info.roi.x_offset, info.roi.width = 64, 320
    small = scale_camera_info(info, 96, 72, make_header(5))
    point = np.array([0.2, -0.1, 1.0])
    x, y, _ = info.k.reshape(3, 3) @ point
    sx, sy, _ = small.k.reshape(3, 3) @ point
    # pixel centres at integers: the left edge of the image is at -0.5 before and after
    assert sx + 0.5 == pytest.approx((x + 0.5) * 96 / 640)
    assert sy + 0.5 == pytest.approx((y + 0.5) * 72 / 480)
    assert small.p[3] == pytest.approx(-59.0 * 96 / 640)  # the stereo baseline
    assert (small.roi.x_offset, small.roi.width) == (10, 48)
    assert list(small.d) == [0.1, 0, 0, 0, 0]


def trajectory(*rows, velocities=None):
    message = JointTrajectory(joint_names=['a', 'b'])
    for index, row in enumerate(rows):
        point = JointTrajectoryPoint(positions=row)
        point.time_from_start.sec, point.time_from_start.nanosec = 1, (index + 1) * 250_000_000
        if velocities is not None:
            point.velocities = velocities[index]
        message.points.append(point)
    return message


def test_trajectory_keeps_velocities_only_if_every_point_has_them():
    rows = ([0.0, 1.0], [0.5, 1.5])
    both = to_trajectory(trajectory(*rows, velocities=([1.0, 2.0], [3.0, 4.0])))
    np.testing.assert_array_equal(both.times, [1.25, 1.5])
    np.testing.assert_array_equal(both.positions, rows)
    np.testing.assert_array_equal(both.velocities, [[1.0, 2.0], [3.0, 4.0]])
    assert to_trajectory(trajectory(*rows, velocities=([1.0, 2.0], []))).velocities is None
    assert to_trajectory(trajectory(*rows)).velocities is None


def test_trajectory_with_infinite_velocity_is_refused():
    with pytest.raises(Rejection, match="joint 'b' has velocities inf at point 0"):
        to_trajectory(trajectory([0.0, 1.0], velocities=([0.0, float('inf')],)))


def test_joint_states_go_both_ways():
    message = to_joint_state(('a', 'b'), np.array([0.25, -1.0]), make_header(3))
    got = deserialize_message(serialize_message(message), JointState)
    assert to_positions(got) == {'a': 0.25, 'b': -1.0}


def test_arrays_name_their_dimensions():
    message = to_multi_array(np.array([[1.0, 2.0, 3.0], [4.0, np.nan, 6.0]]), ('view', 'object'))
    assert [(d.label, d.size, d.stride) for d in message.layout.dim] == [
        ('view', 2, 6),
        ('object', 3, 3),
    ]
    np.testing.assert_array_equal(message.data, [1, 2, 3, 4, np.nan, 6])
    empty = to_multi_array(np.zeros((2, 0)), ('view', 'object'))
    assert [d.size for d in empty.layout.dim] == [2, 0] and not empty.data


def test_diagnostic_values_are_short_text():
    values = {'rate': 1 / 3, 'busy': True, 'views': ('low', 'high'), 'n': 7, 'none': float('nan')}
    status = to_status('node', 'arm', DiagnosticStatus.OK, 'ready', values)
    assert values_of(status) == {
        'rate': '0.333333',
        'busy': 'true',
        'views': 'low, high',
        'n': '7',
        'none': 'nan',
    }


@pytest.mark.parametrize('stamp_ns', [0, 1, NANO - 1, NANO, 1_795_000_000_123_456_789])
def test_stamps_keep_every_nanosecond(stamp_ns):
    assert to_ns(to_stamp(stamp_ns)) == stamp_ns


def test_stamps_are_replaced_in_serialised_messages():
    data = serialize_message(to_image(RGB, make_header(7, 'camera')))
    assert read_stamp(data) == 7
    moved = deserialize_message(with_stamp(data, 12 * NANO + 34), Image)
    assert to_ns(moved.header.stamp) == 12 * NANO + 34
    assert moved.header.frame_id == 'camera'
    np.testing.assert_array_equal(to_rgb(moved), RGB)
    assert has_header('sensor_msgs/msg/Image') and not has_header('std_msgs/msg/String')
