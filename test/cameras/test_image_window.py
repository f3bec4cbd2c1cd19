"""Intrinsics of the images that a driver sends, by the words of sensor_msgs/CameraInfo."""

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.cameras.image_window import ImageWindow, WHOLE, windowed_camera
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import CalibrationError

#: 640x480, f 300, principal point off the middle so that a shift shows
CAMERA = CameraModel(
    view='low',
    width=640,
    height=480,
    K=np.array([[300.0, 0, 359.5], [0, 300, 269.5], [0, 0, 1]]),
    mount_link='base',
    T_mount_camera=np.eye(4),
)
ROI = ImageWindow(x=200, y=150, width=320, height=240)
#: (window, size of the images) -> fx, fy, cx, cy, by hand from sensor_msgs' definitions
EXPLAINED = {
    'the whole image': (WHOLE, (640, 480), (300, 300, 359.5, 269.5)),
    'a region': (ROI, (320, 240), (300, 300, 159.5, 119.5)),
    'binned': (ImageWindow(binning_x=2, binning_y=2), (320, 240), (150, 150, 179.5, 134.5)),
    'binned unevenly': (ImageWindow(binning_x=4, binning_y=2), (160, 240), (75, 150, 89.5, 134.5)),
    'a region, binned': (
        replace(ROI, binning_x=2, binning_y=2), (160, 120), (150, 150, 79.5, 59.5),
    ),
    'binned by 3, floor': (
        ImageWindow(binning_x=3, binning_y=3), (213, 160), (100, 100, 119.5, 89.5),
    ),
    'a region of odd size, binned, floor': (
        ImageWindow(x=200, y=150, width=321, height=241, binning_x=2, binning_y=2),
        (160, 120), (150, 150, 79.5, 59.5),
    ),
    'a region that is everything': (
        ImageWindow(width=640, height=480), (640, 480), (300, 300, 359.5, 269.5),
    ),
}  # fmt: skip
#: not explained, but with one reading that changes nothing but the scale: said
NAMED = {
    'resized': (WHOLE, (320, 240), (150, 150, 179.5, 134.5), 'taken as resized'),
    'a region, resized': (ROI, (160, 120), (150, 150, 79.5, 59.5), 'taken as resized'),
    'binning that was not done': (
        ImageWindow(binning_x=2, binning_y=2), (640, 480), (300, 300, 359.5, 269.5),
        'the whole size: taken as whole images',
    ),
    'a region that was not cut': (
        ROI, (640, 480), (300, 300, 359.5, 269.5), 'the whole size: taken as whole images',
    ),
}  # fmt: skip
REFUSED = {
    'another aspect': (CAMERA, WHOLE, (320, 180), 'no resizing keeps that aspect'),
    'a region beyond the image': (
        CAMERA, replace(ROI, x=400), (320, 240), r'roi 320x240 at \(400, 150\)',
    ),
    'a region without height': (CAMERA, replace(ROI, height=0), (320, 240), 'contradicts itself'),
    'another size than region and whole': (CAMERA, ROI, (320, 180), 'keeps that aspect'),
    'K of the binned images already': (
        replace(CAMERA, K=np.array([[150.0, 0, 159.5], [0, 150, 119.5], [0, 0, 1]])),
        ImageWindow(binning_x=2, binning_y=2), (320, 240), 'seems to be theirs already',
    ),
    'K of the region already': (
        replace(CAMERA, K=np.array([[300.0, 0, 161.5], [0, 300, 118.0], [0, 0, 1]])),
        ROI, (320, 240), 'seems to be theirs already',
    ),
}  # fmt: skip


def numbers(camera):
    """fx, fy, cx, cy."""
    return camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]


@pytest.mark.parametrize('case', EXPLAINED)
def test_what_camera_info_explains_is_followed_to_the_letter(case):
    window, size, wanted = EXPLAINED[case]
    camera, note = windowed_camera(CAMERA, *size, window)
    assert numbers(camera) == pytest.approx(wanted) and not note
    assert (camera.width, camera.height) == size


@pytest.mark.parametrize('case', NAMED)
def test_what_it_leaves_open_is_taken_one_way_and_said(case):
    window, size, wanted, said = NAMED[case]
    camera, note = windowed_camera(CAMERA, *size, window)
    assert numbers(camera) == pytest.approx(wanted)
    assert said in note and "view 'low'" in note


@pytest.mark.parametrize('case', REFUSED)
def test_what_contradicts_it_is_refused(case):
    camera, window, size, said = REFUSED[case]
    with pytest.raises(CalibrationError, match=said):
        windowed_camera(camera, *size, window)
