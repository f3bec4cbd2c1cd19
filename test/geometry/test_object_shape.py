"""What a mask tells of an object's size."""

from __future__ import annotations

import numpy as np

from mtv_world_ros.data_types import CameraModel
from mtv_world_ros.geometry.camera import project
from mtv_world_ros.geometry.object_shape import NUM_FEATURES, object_shapes


def looking_down(height: float) -> tuple[CameraModel, np.ndarray]:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = height
    camera = CameraModel(
        view='top',
        width=200,
        height=200,
        K=np.array([[400.0, 0, 99.5], [0, 400.0, 99.5], [0, 0, 1]]),
        distortion_model='none',
        distortion=np.zeros(0),
        mount_link='base',
        T_mount_camera=pose,
    )
    return camera, pose


def mask_of_a_rectangle(camera, pose, centre, x: float, y: float) -> np.ndarray:
    corners = centre + np.array([[-x, -y, 0], [x, y, 0]]) / 2
    (a, b), (c, d) = project(camera, pose, corners)[0]
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return (
        (columns >= min(a, c)) & (columns <= max(a, c)) & (rows >= min(b, d)) & (rows <= max(b, d))
    )


def test_widths_are_those_of_the_footprint():
    camera, pose = looking_down(1.0)
    centre = np.array([0.02, -0.03, 0.1])
    mask = mask_of_a_rectangle(camera, pose, centre, 0.08, 0.04)
    shapes = object_shapes(mask[None, None], centre[None], [camera], [pose])
    widths = shapes[0, 0, :4]
    np.testing.assert_allclose(widths[[0, 2]], [0.92 * 0.08, 0.92 * 0.04], atol=0.004)
    assert widths[2] < widths[1] <= 0.12 / np.sqrt(2)
    np.testing.assert_allclose(widths[1], widths[3], atol=0.003)
    np.testing.assert_allclose(shapes[0, 0, 6:], [-0.0222, 0.0333, 0.9992], atol=1e-3)


def test_what_is_not_known_has_no_features():
    camera, pose = looking_down(1.0)
    masks = np.zeros((1, 2, 200, 200), bool)
    masks[0, 1, 90:110, 90:110] = True
    points = np.array([[0.0, 0.0, 0.0], [np.nan] * 3])
    shapes = object_shapes(masks, points, [camera], [pose])
    assert shapes.shape == (2, 1, NUM_FEATURES) and not shapes.any()
