"""Leans and extents of objects from their masks."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mtv_world_ros.cameras.camera import project, scaled, with_camera_info
from mtv_world_ros.cameras.mask_geometry import axis_lean, locate, upright_extents
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.transforms import looking_along

PLACE = np.array([0.05, 0.35, 0.1])


def make_camera(position, distortion=(0.1, -0.05)):
    """A camera at a position that looks at `PLACE`, and its pose."""
    K = np.array([[150.0, 0, 64], [0, 150.0, 48], [0, 0, 1]])
    camera = CameraModel(
        view='low', width=128, height=96, K=K, distortion_model='plumb_bob',
        distortion=np.array([*distortion, 0, 0, 0]), mount_link='base_link',
        T_mount_camera=np.eye(4),
    )  # fmt: skip
    pose = np.eye(4)
    pose[:3, :3] = looking_along(PLACE - position)
    pose[:3, 3] = position
    return camera, pose


def make_mask(camera, pose, axis):
    """The mask of a rod of 12 cm."""
    ends = PLACE + 0.06 * np.outer([-1, 1], axis / np.linalg.norm(axis))
    (a, b), _ = project(camera, pose, ends)
    mask = np.zeros((camera.height, camera.width), np.uint8)
    cv2.line(mask, np.round(16 * a).astype(int), np.round(16 * b).astype(int), 1, 7, shift=4)
    return mask.astype(bool)


def seen_lean(axis, *positions):
    cameras, poses = zip(*[make_camera(np.array(p)) for p in positions], strict=True)
    masks = [make_mask(c, pose, axis) for c, pose in zip(cameras, poses, strict=True)]
    return axis_lean(cameras, poses, masks)


LOW, SIDE, ABOVE = (0.0, -0.4, 0.3), (0.9, 0.3, 0.4), (0.1, 0.1, 0.9)


@pytest.mark.parametrize(('x', 'y'), [(0, 0), (0.3, 0), (-0.4, 0), (0, 0.35), (0.3, -0.3)])
def test_two_views_tell_a_lean_in_any_direction(x, y):
    axis = np.array([x, y, np.sqrt(1 - x**2 - y**2)])
    assert seen_lean(axis, LOW, SIDE) == pytest.approx([x, y], abs=0.04)
    assert seen_lean(-axis, LOW, SIDE) == pytest.approx([x, y], abs=0.04)


@pytest.mark.parametrize('x', [-0.5, -0.2, 0.0, 0.2, 0.5])
def test_views_from_one_side_tell_a_lean_across_their_line_of_sight(x):
    axis = np.array([x, 0, np.sqrt(1 - x**2)])
    low, high = (0.05, -0.4, 0.2), (0.05, -0.2, 0.8)
    assert seen_lean(axis, low) == pytest.approx([x, 0], abs=0.05)
    assert seen_lean(axis, low, high) == pytest.approx([x, 0], abs=0.05)


def test_a_lean_along_the_line_of_sight_is_not_made_up():
    along = seen_lean(np.array([0, 0.4, np.sqrt(1 - 0.16)]), (0.05, -0.4, 0.2))
    assert np.linalg.norm(along) < 0.05


def test_a_round_mask_tells_nothing():
    camera, pose = make_camera(np.array(ABOVE))
    mask = np.zeros((96, 128), np.uint8)
    cv2.circle(mask, (60, 50), 9, 1, -1)
    assert np.abs(axis_lean([camera], [pose], [mask.astype(bool)])).max() < 0.02


def drawn_box(camera, pose, size, yaw):
    """The mask of an upright box at `PLACE`, by its projected corners."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    pixels, _ = project(camera, pose, (signs * size) @ turn.T + PLACE)
    mask = np.zeros((camera.height, camera.width), np.uint8)
    hull = cv2.convexHull(np.round(16 * pixels).astype(np.int32))
    cv2.fillConvexPoly(mask, hull, 1, shift=4)
    return mask.astype(bool)


@pytest.mark.parametrize('size', [(0.2, 0.2, 0.02), (0.05, 0.05, 0.05), (0.06, 0.06, 0.1)])
def test_extents_of_plates_blocks_and_bottles_are_those_that_were_drawn(size):
    places = np.array([LOW, SIDE, ABOVE])
    cameras, poses = zip(*[make_camera(p, (0, 0)) for p in places], strict=True)
    found = []
    for yaw in (0.0, 0.4, 0.8, 1.2):
        masks = np.stack(
            [drawn_box(c, pose, size, yaw) for c, pose in zip(cameras, poses, strict=True)]
        )
        found.append(upright_extents(cameras, poses, masks, PLACE))
    # the mean width of a box over its turns is 4 / pi of its side; a mask is a pixel of 4 mm wider
    width = 4 / np.pi * size[0]
    assert np.mean(found, axis=0)[0] == pytest.approx(width + 0.004, rel=0.1)
    assert np.mean(found, axis=0)[1] == pytest.approx(size[2], abs=0.015)


def test_extents_count_the_largest_part_and_the_views_that_see_it():
    camera, pose = make_camera(np.array(LOW), (0, 0))
    mask = drawn_box(camera, pose, (0.06, 0.06, 0.06), 0.0)
    alone = upright_extents([camera], [pose], mask[None], PLACE)
    spotted = mask.copy()
    spotted[:3, :3] = True
    empty = np.zeros_like(mask)
    both = upright_extents([camera, camera], [pose, pose], np.stack([spotted, empty]), PLACE)
    assert both == pytest.approx(alone)
    assert np.isnan(upright_extents([camera], [pose], empty[None], PLACE)).all()


#: standard error of where points are drawn with cameras that are turned a little [px]
TURN_ERROR_PX = 1.2


@pytest.mark.parametrize('states_error', [True, False])
def test_the_stated_error_of_a_position_covers_that_of_the_cameras(states_error):
    """Cameras that were turned since: rays may meet, and still pass beside the object."""
    generator, inside, count = np.random.default_rng(5), 0, 300
    true = [make_camera((0.6, y, 0.5), (0.0, 0.0)) for y in (-0.1, 0.9)]
    stated = [replace(one, error_px=TURN_ERROR_PX if states_error else None) for one, _ in true]
    for _ in range(count):
        point = PLACE + generator.uniform(-0.1, 0.1, 3)
        pixels, poses = [], []
        for camera, pose in true:
            pixels.append(project(camera, pose, point)[0])
            turn, _ = cv2.Rodrigues(generator.normal(0, TURN_ERROR_PX / camera.K[0, 0], 3))
            poses.append(pose @ np.block([[turn, np.zeros((3, 1))], [np.zeros((1, 3)), 1.0]]))
        found = locate(stated, poses, np.array(pixels))
        # across the line of sight an error of s in x and in y is within 2.45 s 19 times of 20
        inside += np.linalg.norm(found.point - point) < 2.45 * found.sigma_m
        assert found.sigma_m >= 0.9 * found.pixel_m * (TURN_ERROR_PX if states_error else 0.3)
    assert (inside / count > 0.9) == states_error


def test_the_stated_error_of_a_camera_grows_with_its_picture():
    camera, pose = make_camera((0.6, 0.3, 0.5))
    stated = replace(camera, error_px=0.9)
    double = scaled(stated, 2 * camera.width, 2 * camera.height)
    assert double.error_px == pytest.approx(1.8)
    assert scaled(camera, 2 * camera.width, 2 * camera.height).error_px is None
    informed = with_camera_info(
        stated, width=double.width, height=double.height, K=double.K,
        distortion_model='none', distortion=(),
    )  # fmt: skip
    assert informed.error_px == pytest.approx(1.8)
