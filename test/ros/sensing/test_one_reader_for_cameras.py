"""Importer and live node take the same intrinsics from the same CameraInfo and images."""

from functools import partial
import re

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo

from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.ros.messages.image_messages import windowed_camera_info
from mtv_world_ros.ros.messages.rejection import Rejection
from mtv_world_ros.ros.sensing.observations import Intrinsics

CAMERA = CameraModel(
    view='low', width=640, height=480, mount_link='base', T_mount_camera=np.eye(4),
    K=np.array([[300.0, 0, 359.5], [0, 300, 269.5], [0, 0, 1]]),
)  # fmt: skip
ROI = (200, 150, 320, 240)
#: roi, binning, size of the images -> fx, fy, cx, cy; what is said of it
CASES = {
    'whole': (None, 0, (640, 480), (300, 300, 359.5, 269.5), ''),
    'a region': (ROI, 0, (320, 240), (300, 300, 159.5, 119.5), ''),
    'binned': (None, 2, (320, 240), (150, 150, 179.5, 134.5), ''),
    'a region, binned': (ROI, 2, (160, 120), (150, 150, 79.5, 59.5), ''),
    'resized': (None, 0, (320, 240), (150, 150, 179.5, 134.5), 'taken as resized'),
    'a region that was not cut': (ROI, 0, (640, 480), (300, 300, 359.5, 269.5), 'whole images'),
    'another aspect': (None, 0, (320, 180), None, 'no resizing keeps that aspect'),
    'a region beyond the image': ((400, 150, 320, 240), 0, (320, 240), None, 'contradicts'),
}  # fmt: skip


def make_info(stamp_ns, roi, binning):
    message = messages.make_camera_info(stamp_ns, CAMERA, 'low_optical_frame')
    message.binning_x = message.binning_y = binning
    if roi:
        region = message.roi
        region.x_offset, region.y_offset, region.width, region.height = roi
    return message


def imported(folder, make, size, calibration=None):
    """The camera of a bag, and the warnings."""
    with EpisodeWriter(folder, task='', instruction='', robot='any', cameras=[CAMERA]) as writer:
        for k in range(2):
            stamp = 1_000_000_000 + k * 100_000_000
            writer.write_message('/low/camera_info', messages.CAMERA_INFO, stamp, make(stamp))
            writer.write_image('low', stamp, np.zeros((size[1], size[0], 3), np.uint8))
            writer.write_joint_states(stamp, ['a'], [0.0])
    episode = read_episode(folder, calibration=calibration)
    return episode.cameras['low'], ' '.join(episode.warnings)


def live(make, size, is_given=False):
    """The camera of the node, and its notes."""
    intrinsics = Intrinsics([CAMERA], lambda: is_given)
    info = deserialize_message(messages.serialize(messages.CAMERA_INFO, make(0)), CameraInfo)
    intrinsics.add('low', info)
    camera = intrinsics.camera('low', width=size[0], height=size[1])
    shown = windowed_camera_info(intrinsics.info('low', ''), camera)
    np.testing.assert_allclose(np.reshape(shown.k, (3, 3)), camera.K)
    np.testing.assert_allclose(np.reshape(shown.p, (3, 4))[:, :3], camera.K)
    assert (shown.width, shown.height, shown.roi.width, shown.binning_x) == (*size, 0, 0)
    return camera, intrinsics.notes['low']


def outcome(ask, *arguments):
    try:
        camera, said = ask(*arguments)
    except MtvWorldError as error:
        return None, str(error)
    return (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]), said


@pytest.mark.parametrize('name', CASES)
def test_importer_and_node_agree(name, tmp_path):
    roi, binning, size, wanted, said = CASES[name]
    for found, text in (
        outcome(imported, tmp_path / 'bag', partial(make_info, roi=roi, binning=binning), size),
        outcome(live, partial(make_info, roi=roi, binning=binning), size),
    ):
        assert found == (wanted if wanted is None else pytest.approx(wanted)), text
        assert said in text if said else not text


def changed(stamp_ns, **fields):
    """A CameraInfo with other values of some fields."""
    info = make_info(stamp_ns, None, 0)
    for name, value in fields.items():
        setattr(info, name, np.array(value, float) if isinstance(value, list) else value)
    return info


SMALL = (640, 480)
#: what CameraInfo says -> fx, fy, cx, cy, or None where it is refused; what is said of it
INFOS = {
    'no size': ({'width': 0, 'height': 0}, (300, 300, 359.5, 269.5), 'has no size'),
    'half a size': ({'width': 640, 'height': 0}, (300, 300, 359.5, 269.5), 'has no size'),
    'another width alone': ({'width': 320, 'height': 0}, None, 'publish both or none'),
    'NaN': (
        {'k': [np.nan, 0, 359.5, 0, 300, 269.5, 0, 0, 1]}, None, "view 'low': K[0] is nan",
    ),
    'NaN in D': ({'d': [0, 0, np.nan, 0, 0]}, None, "view 'low': D[2] is nan"),
    'zeros behind': ({'d': [0.1, -0.1, 0, 0, 0, 0, 0, 0]}, (300, 300, 359.5, 269.5), ''),
    'eight that count': ({'d': [0.1, -0.1, 0, 0, 0, 0.1, 0, 0]}, None, '8 coefficients'),
}  # fmt: skip


@pytest.mark.parametrize('name', INFOS)
def test_importer_and_node_read_a_camera_info_as_it_is_defined(name, tmp_path):
    fields, wanted, said = INFOS[name]
    make = partial(changed, **fields)
    found, text = outcome(live, make, SMALL)
    assert found == (wanted if wanted is None else pytest.approx(wanted)), text
    assert said in text if said else not text
    bag = tmp_path / 'bag'
    found, text = outcome(imported, bag, make, SMALL)
    assert said in text if said else not text
    if wanted is None:  # the episode has a calibration file
        assert "the calibration file's intrinsics are used" in text
        (bag / 'calibration.yaml').unlink()
        with pytest.raises(MtvWorldError, match=re.escape(said)):
            read_episode(bag, unknown_mount='base')
    assert found == pytest.approx(wanted or (300, 300, 359.5, 269.5)), text


ZEROS = {'k': [0.0] * 9, 'p': [0.0] * 12}


@pytest.mark.parametrize('fields', [ZEROS, {**ZEROS, 'width': 0, 'height': 0, 'd': []}])
def test_a_camera_info_of_zeros_is_the_same_as_none(fields, tmp_path):
    make = partial(changed, **fields)
    camera, said = imported(tmp_path / 'bag', make, SMALL)
    np.testing.assert_array_equal(camera.K, CAMERA.K)  # calibration.yaml of the episode
    assert "'/low/camera_info' is not calibrated (K[0] = 0)" in said
    camera, said = live(make, SMALL, is_given=True)
    np.testing.assert_array_equal(camera.K, CAMERA.K)
    assert "the intrinsics of 'calibration_file' are used" in said
    refused, said = outcome(live, make, SMALL)
    assert refused is None
    assert "camera_info of view 'low' is not calibrated (K[0] = 0)" in said


def test_a_camera_that_is_calibrated_later_is_taken_then():
    intrinsics = Intrinsics([CAMERA])

    def received(info):
        return deserialize_message(messages.serialize(messages.CAMERA_INFO, info), CameraInfo)

    with pytest.raises(Rejection, match='not calibrated'):
        intrinsics.add('low', received(changed(0, **ZEROS)))
    intrinsics.add('low', received(changed(1, **ZEROS)))  # said once
    assert intrinsics.missing('low')
    intrinsics.add('low', received(changed(2)))
    intrinsics.add('low', received(changed(3, **ZEROS)))  # what is known holds
    assert intrinsics.missing('low') == []
    assert intrinsics.camera('low', width=640, height=480).K[0, 0] == 300


def test_rectified_images_have_the_intrinsics_of_p_live_too():
    info = changed(
        0, d=[0.1, -0.1, 0, 0, 0], p=[280, 0, 350, 0, 0, 281, 260, 0, 0, 0, 1, 0],
        distortion_model='equidistant',
    )  # fmt: skip
    info = deserialize_message(messages.serialize(messages.CAMERA_INFO, info), CameraInfo)
    intrinsics = Intrinsics([CAMERA])
    intrinsics.add('low', info, is_rectified=True)
    camera = intrinsics.camera('low', width=640, height=480)
    np.testing.assert_array_equal(camera.K, [[280, 0, 350], [0, 281, 260], [0, 0, 1]])
    assert camera.distortion_model == 'none'
