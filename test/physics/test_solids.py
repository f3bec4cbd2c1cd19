"""Boxes and cylinders that look like objects."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.physics.solids import find_solid, fit_solid


def looking_at(origin: np.ndarray, target: np.ndarray) -> tuple[CameraModel, np.ndarray]:
    forward = (target - origin) / np.linalg.norm(target - origin)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = origin
    camera = CameraModel(
        view='view',
        width=384,
        height=288,
        K=np.array([[672.0, 0, 191.5], [0, 672.0, 143.5], [0, 0, 1]]),
        distortion_model='none',
        distortion=np.zeros(0),
        mount_link='base',
        T_mount_camera=pose,
    )
    return camera, pose


TARGET = np.array([0.3, 0.05, 0.02])
CAMERAS, POSES = zip(
    *(looking_at(np.array(at), TARGET) for at in ([0.9, 0.6, 0.6], [0.9, -0.5, 0.9])),
    strict=True,
)


def masks_of(outline: np.ndarray, size: np.ndarray, centre: np.ndarray, yaw: float) -> np.ndarray:
    """(V, H, W) of an upright prism on the outline (N, 2) of size 1."""
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    flat = (outline * size[:2]) @ turn + centre[:2]
    corners = np.concatenate([np.c_[flat, np.full(len(flat), z)] for z in (0, size[2])])
    masks = []
    for camera, pose in zip(CAMERAS, POSES, strict=True):
        pixels = project(camera, pose, corners)[0]
        fine = np.zeros((16 * camera.height, 16 * camera.width), np.uint8)
        hull = cv2.convexHull((16 * (pixels + 0.5)).astype(np.int32))
        cv2.fillConvexPoly(fine, hull, 1)
        masks.append(fine[8::16, 8::16].astype(bool))
    return np.stack(masks)


SQUARE = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
ANGLES = np.linspace(0, 2 * np.pi, 60, endpoint=False)
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1) / 2


@pytest.mark.parametrize('yaw', [0.0, 0.5, 1.3])
def test_a_box_is_found_to_a_millimetre(yaw):
    size, centre = np.array([0.06, 0.04, 0.05]), np.array([0.31, 0.04, 0.025])
    solid = fit_solid(masks_of(SQUARE, size, centre, yaw), TARGET, CAMERAS, POSES)
    assert solid is not None and not solid.is_round and solid.error_px < 0.6
    np.testing.assert_allclose(solid.centre, centre, atol=0.001)
    # which side is the first depends on where the search began
    turned = round((solid.yaw - yaw) / (np.pi / 2)) % 2
    np.testing.assert_allclose(solid.size[[turned, 1 - turned, 2]], size, atol=0.0015)


def test_a_cylinder_is_found_to_be_round():
    size, centre = np.array([0.05, 0.05, 0.06]), np.array([0.29, 0.06, 0.03])
    solid = fit_solid(masks_of(CIRCLE, size, centre, 0.0), TARGET, CAMERAS, POSES)
    assert solid is not None and solid.is_round
    np.testing.assert_allclose(solid.size, size, atol=0.0015)
    np.testing.assert_allclose(solid.centre, centre, atol=0.0015)


def test_a_speck_that_looks_alike_is_not_part_of_an_object():
    size, centre = np.array([0.06, 0.04, 0.05]), np.array([0.31, 0.04, 0.025])
    masks = masks_of(SQUARE, size, centre, 0.5)
    whole = fit_solid(masks, TARGET, CAMERAS, POSES)
    masks[:, 20:24, 30:36] = True
    found = fit_solid(masks, TARGET, CAMERAS, POSES)
    assert found is not None and whole is not None
    np.testing.assert_array_equal(found.centre, whole.centre)
    masks = masks_of(SQUARE, size, centre, 0.5)
    for mask in masks:  # a finger before its middle
        middle = int(np.nonzero(mask)[1].mean())
        mask[:, middle - 3 : middle + 3] = False
    found = fit_solid(masks, TARGET, CAMERAS, POSES)
    assert found is not None
    np.testing.assert_allclose(found.centre, whole.centre, atol=0.001)


def test_one_view_does_not_tell():
    masks = masks_of(SQUARE, np.full(3, 0.05), np.array([0.3, 0.05, 0.025]), 0.0)
    masks[1] = False
    assert fit_solid(masks, TARGET, CAMERAS, POSES) is None
    masks = masks_of(SQUARE, np.full(3, 0.05), np.array([0.3, 0.05, 0.025]), 0.0)
    assert fit_solid(masks, np.full(3, np.nan), CAMERAS, POSES) is None


@pytest.mark.parametrize(('outline', 'yaw'), [(SQUARE, 0.4), (CIRCLE, 0.0)])
@pytest.mark.parametrize('turn', [0.0, 0.6])
def test_what_is_half_hidden_is_found_again_to_two_millimetres(outline, yaw, turn):
    size, centre = np.array([0.05, 0.05, 0.06]), np.array([0.31, 0.04, 0.03])
    whole = fit_solid(masks_of(outline, size, centre, yaw), TARGET, CAMERAS, POSES)
    assert whole is not None
    way = np.array([-0.05, 0.04, 0.0])
    masks = masks_of(outline, size, centre + way, yaw + turn)
    for mask in masks:
        rows, columns = np.nonzero(mask)
        mask[: int(np.quantile(rows, 0.4)), int(np.quantile(columns, 0.2)) :] = False
    found = find_solid(whole, masks, TARGET, CAMERAS, POSES)
    assert found is not None and found.is_hidden
    np.testing.assert_allclose(found.centre - whole.centre, way, atol=0.002)
    np.testing.assert_array_equal(found.size, whole.size)
    turned = turn if outline is SQUARE else 0.0
    x, y = whole.turn_to(found)[:2, 0]
    assert abs(np.sin(2 * (np.arctan2(y, x) - turned))) < 0.1
    anew = fit_solid(masks, TARGET, CAMERAS, POSES)
    assert anew is None or np.abs(anew.centre - whole.centre - way).max() > 0.003


@pytest.mark.parametrize(('outline', 'yaw'), [(SQUARE, 0.4), (CIRCLE, 0.0)])
def test_what_nothing_hides_is_not_hidden(outline, yaw):
    size, centre = np.array([0.05, 0.05, 0.06]), np.array([0.31, 0.04, 0.03])
    whole = fit_solid(masks_of(outline, size, centre, yaw), TARGET, CAMERAS, POSES)
    now = masks_of(outline, size, centre + [-0.06, 0.05, 0.0], yaw + 0.3)
    assert whole is not None
    found = find_solid(whole, now, TARGET, CAMERAS, POSES)
    assert found is not None and not found.is_hidden


def test_a_mug_whose_top_is_hidden_stands_on_the_table():
    size, centre = np.array([0.05, 0.05, 0.08]), np.array([0.31, 0.04, 0.04])
    handle = masks_of(SQUARE, np.array([0.05, 0.01, 0.05]), centre + [0.03, 0.0, 0.0], 0.0)
    masks = masks_of(CIRCLE, size, centre, 0.0) | handle
    whole = fit_solid(masks, TARGET, CAMERAS, POSES)
    assert whole is not None and whole.error_px > 1.0
    for mask in masks:
        mask[: int(np.quantile(np.nonzero(mask)[0], 0.25))] = False
    found = find_solid(whole, masks, TARGET, CAMERAS, POSES)
    assert found is not None and found.is_hidden
    assert abs(found.centre[2] - found.size[2] / 2) < 0.005


def test_what_one_view_shows_alone_is_hidden():
    size, centre = np.array([0.05, 0.05, 0.06]), np.array([0.31, 0.04, 0.03])
    masks = masks_of(SQUARE, size, centre, 0.4)
    whole = fit_solid(masks, TARGET, CAMERAS, POSES)
    assert whole is not None
    moved = masks_of(SQUARE, size, centre + [-0.08, 0.06, 0.0], 0.4)
    for now, way in ((masks, 0.0), (moved, np.array([-0.08, 0.06, 0.0]))):
        now[1] = False
        found = find_solid(whole, now, np.full(3, np.nan), CAMERAS, POSES)
        assert found is not None and found.is_hidden
        np.testing.assert_allclose(found.centre, whole.centre + way, atol=0.006)


def test_what_lies_on_its_side_is_another_solid():
    size = np.array([0.03, 0.03, 0.09])
    whole = fit_solid(masks_of(SQUARE, size, TARGET, 0.0), TARGET, CAMERAS, POSES)
    lying = masks_of(SQUARE, size[[2, 0, 1]], TARGET, 0.0)
    assert whole is not None and find_solid(whole, lying, TARGET, CAMERAS, POSES) is None
    assert find_solid(whole, np.zeros_like(lying), TARGET, CAMERAS, POSES) is None
