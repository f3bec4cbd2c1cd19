"""The least-squares problem of cameras, against points that OpenCV projects."""

import cv2
import numpy as np
import pytest

from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.transforms import looking_along
from mtv_world_ros.inspection.camera_pose import difference, displaced_pose
from mtv_world_ros.inspection.cameras.lens import with_lens
from mtv_world_ros.inspection.cameras.seen_points import points_residual, SeenPoint
from mtv_world_ros.inspection.cameras.solver import CameraState, Residual, solve, Unknowns

CENTRE = np.array([0.4, 0.0, 0.3])
K = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
WRONG = np.array([0.08, -0.06, 0.1, 0.05, -0.04, 0.08])  # 8 degrees and 10 cm


def pose(eye):
    T = np.eye(4)
    T[:3, :3] = looking_along(CENTRE - np.array(eye))
    T[:3, 3] = eye
    return T


def camera(scale=1.0):
    matrix = K.copy()
    matrix[:2, :2] *= scale
    return CameraModel(view='door', width=320, height=240, K=matrix, mount_link='base',
                       T_mount_camera=np.eye(4))  # fmt: skip


def seen(T, count, noise=0.0, distortion=(0.0,) * 5):
    """Points around the centre, and where OpenCV projects them."""
    generator = np.random.default_rng(4)
    points = CENTRE + generator.uniform(-0.3, 0.3, (count, 3))
    inverse = np.linalg.inv(T)
    pixels = cv2.projectPoints(points, cv2.Rodrigues(inverse[:3, :3])[0], inverse[:3, 3], K,
                               np.array(distortion))[0][:, 0]  # fmt: skip
    pixels = pixels + generator.normal(0, noise, pixels.shape)
    return [
        SeenPoint(recording=0, seconds=0.0, position=point, pixel=pixel)
        for point, pixel in zip(points, pixels, strict=True)
    ]


def moved(T):
    return displaced_pose(T, WRONG, CENTRE)


@pytest.mark.parametrize('whiten', [False, True])
def test_a_pose_and_a_lens_are_found_though_a_fifth_of_the_points_are_wrong(whiten):
    T = pose((1.4, 0.6, 0.9))
    points = seen(T, 60, noise=0.3, distortion=(-0.1, 0, 0, 0, 0))
    for point in points[::5]:
        point.pixel[:] += (40.0, -25.0)
    residual = points_residual(0, points, camera(1.15), std_px=1.0, outlier=3.0)
    unknowns = Unknowns(
        centre=CENTRE, free_lens=(0, 1, 2), lens_std=np.full(3, 0.3), stiffness=1.0
    )
    state, _ = solve(
        [residual], unknowns, CameraState(poses={0: moved(T)}), evaluations=200, tolerance=1e-9,
        whiten=whiten,
    )  # fmt: skip
    mm, degrees = difference(T, state.poses[0])
    assert mm < 15 and degrees < 0.4, (mm, degrees)
    found = with_lens(camera(1.15), state.lens)
    assert found.K[0, 0] == pytest.approx(300, rel=0.01)
    assert found.K[1, 1] == pytest.approx(300, rel=0.01)
    assert found.distortion[0] == pytest.approx(-0.1, abs=0.03)


def test_a_lens_that_is_given_is_held():
    T = pose((1.4, 0.6, 0.9))
    residual = points_residual(0, seen(T, 20), camera(), std_px=1.0, outlier=3.0)
    state, cost = solve(
        [residual], Unknowns(centre=CENTRE), CameraState(poses={0: moved(T)}), evaluations=100,
        tolerance=1e-12,
    )  # fmt: skip
    assert not state.lens.any() and cost < 1e-6
    assert np.allclose(difference(T, state.poses[0]), 0, atol=0.01)


def places(stiffness, apart):
    """Solve two places of one view, the second of which is seen in a single point."""
    first = pose((1.4, 0.6, 0.9))
    second = displaced_pose(first, apart, first[:3, 3])
    start = {0: moved(first), 1: displaced_pose(moved(first), apart, moved(first)[:3, 3])}
    residuals = [
        points_residual(0, seen(first, 20), camera(), std_px=1.0, outlier=3.0),
        points_residual(1, seen(second, 20)[:1], camera(), std_px=1.0, outlier=3.0),
    ]
    unknowns = Unknowns(centre=CENTRE, view_of={0: 0, 1: 0}, stiffness=stiffness)
    state, _ = solve(
        residuals, unknowns, CameraState(poses=start), evaluations=300, tolerance=1e-12
    )
    assert difference(first, state.poses[0])[0] < 10
    return difference(second, state.poses[1])


def test_places_of_a_view_are_moved_together_as_their_backgrounds_say():
    turned = np.array([0.0, 0.06, 0.0, 0.0, 0.0, 0.0])
    mm, degrees = places(1.0, turned)
    assert mm < 30 and degrees < 1.5, (mm, degrees)
    assert places(1e-9, turned)[0] > 2 * mm


def test_places_of_other_views_do_not_pull_on_each_other():
    a, b = pose((1.4, 0.6, 0.9)), pose((1.2, -0.9, 0.7))
    residuals = [
        points_residual(n, seen(T, 20), camera(), std_px=1.0, outlier=3.0)
        for n, T in enumerate((a, b))
    ]
    unknowns = Unknowns(centre=CENTRE, view_of={0: 0, 1: 1}, stiffness=1e6)
    state, _ = solve(
        residuals, unknowns, CameraState(poses={0: moved(a), 1: b}), evaluations=100,
        tolerance=1e-12,
    )  # fmt: skip
    assert difference(a, state.poses[0])[0] < 1 and difference(b, state.poses[1])[0] < 1


def test_large_steps_along_a_flat_valley_pass_its_ripples():
    """Errors that hardly change along one direction, with ripples as those of drawn pixels."""
    T = pose((1.4, 0.6, 0.9))
    direction = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])

    def errors(found, lens):
        step = np.linalg.inv(T) @ found
        turns = cv2.Rodrigues(step[:3, :3])[0].ravel()
        along = float(turns @ direction[:3]) / 0.01
        across = np.concatenate([turns, step[:3, 3]]) * (1 - direction) / 0.01
        ripples = 0.004 * np.sin(9 * along)
        return np.concatenate([5 * across, [0.02 * along + ripples, 0.02 * along - ripples]])

    residual = Residual(place=0, errors=errors, outlier=10.0)
    start = displaced_pose(T, 0.2 * direction, T[:3, 3])
    state, _ = solve(
        [residual], Unknowns(), CameraState(poses={0: start}), evaluations=60, whiten=True,
        tolerance=1e-9,
    )  # fmt: skip
    assert difference(T, state.poses[0])[1] < 2.0 < difference(T, start)[1]
