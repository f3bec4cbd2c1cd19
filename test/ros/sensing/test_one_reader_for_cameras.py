"""Importer and live node take the same intrinsics from the same CameraInfo and images."""

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo

from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.data_types import CameraModel
from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.ros.messages.image_messages import windowed_camera_info
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


def imported(folder, roi, binning, size):
    """The camera of a bag, and the warnings."""
    with EpisodeWriter(folder, task='', instruction='', robot='any', cameras=[CAMERA]) as writer:
        for k in range(2):
            stamp = 1_000_000_000 + k * 100_000_000
            info = make_info(stamp, roi, binning)
            writer.write_message('/low/camera_info', messages.CAMERA_INFO, stamp, info)
            writer.write_image('low', stamp, np.zeros((size[1], size[0], 3), np.uint8))
            writer.write_joint_states(stamp, ['a'], [0.0])
    episode = read_episode(folder)
    return episode.cameras['low'], ' '.join(episode.warnings)


def live(roi, binning, size):
    """The camera of the node, and its notes."""
    intrinsics = Intrinsics([CAMERA])
    data = messages.serialize(messages.CAMERA_INFO, make_info(0, roi, binning))
    info = deserialize_message(data, CameraInfo)
    intrinsics.add('low', info)
    camera = intrinsics.camera('low', width=size[0], height=size[1])
    shown = windowed_camera_info(info, camera)
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
        outcome(imported, tmp_path / 'bag', roi, binning, size),
        outcome(live, roi, binning, size),
    ):
        assert found == (wanted if wanted is None else pytest.approx(wanted)), text
        assert said in text if said else not text
