import cv2
import numpy as np
import pytest

from mtv_world_ros.cameras.camera import (
    camera_poses,
    project,
    scaled,
    triangulate,
    unproject,
    with_camera_info,
)
from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.core.errors import CalibrationError

PLUMB_BOB = (-0.28, 0.09, 0.0008, -0.0006, -0.013)
RATIONAL = (1.9, 0.7, 0.0005, -0.0003, 0.05, 2.2, 1.3, 0.2)
THIN_PRISM = (*RATIONAL, 0.001, -0.0005, 0.0007, 0.0002)
TILTED = (*THIN_PRISM, 0.01, -0.02)
MODELS = {
    'none': ('none', ()),
    'plumb_bob4': ('plumb_bob', PLUMB_BOB[:4]),
    'plumb_bob5': ('plumb_bob', PLUMB_BOB),
    'rational8': ('rational_polynomial', RATIONAL),
    'rational12': ('rational_polynomial', THIN_PRISM),
    'rational14': ('rational_polynomial', TILTED),
}


def rigid(generator: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(generator.uniform(-2, 2, 3))[0]
    T[:3, 3] = generator.uniform(-1, 1, 3)
    return T


def make_camera(model: str = 'none', **changes) -> CameraModel:
    name, distortion = MODELS[model]
    values = {
        'view': 'low',
        'width': 384,
        'height': 288,
        'K': np.array([[410.0, 0, 188.3], [0, 402.0, 147.1], [0, 0, 1]]),
        'distortion_model': name,
        'distortion': np.array(distortion),
        'mount_link': 'base',
        'T_mount_camera': np.eye(4),
    }
    return CameraModel(**(values | changes))


def in_front(generator: np.random.Generator, count: int) -> np.ndarray:
    """Points of the optical frame up to 35 degrees off the axis."""
    depth = generator.uniform(0.2, 3, count)
    angle, radius = generator.uniform(0, 2 * np.pi, count), generator.uniform(0, 0.7, count)
    return (
        np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(count)], 1)
        * (depth[:, None])
    )


@pytest.mark.parametrize('model', MODELS)
def test_projection_equals_opencv(model):
    generator = np.random.default_rng(3)
    for _ in range(10):
        camera = make_camera(
            model, K=np.array([[generator.uniform(200, 900), 0, generator.uniform(100, 300)],
                               [0, generator.uniform(200, 900), generator.uniform(100, 200)],
                               [0, 0, 1]])
        )  # fmt: skip
        T = rigid(generator)
        local = in_front(generator, 100)
        points = local @ T[:3, :3].T + T[:3, 3]
        pixels, depth = project(camera, T, points)
        T_camera_base = np.linalg.inv(T)
        coefficients = camera.distortion.copy() if len(camera.distortion) else None
        expected, _ = cv2.projectPoints(
            points, cv2.Rodrigues(T_camera_base[:3, :3])[0], T_camera_base[:3, 3], camera.K.copy(),
            coefficients,
        )  # fmt: skip
        np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-6)
        np.testing.assert_allclose(depth, local[:, 2], atol=1e-9)


FISHEYE = (-0.02, 0.01, -0.004, 0.001)


@pytest.mark.parametrize('coefficients', [FISHEYE, (0.0, 0.0, 0.0, 0.0)])
def test_equidistant_projection_equals_opencv_and_can_be_undone(coefficients):
    camera = make_camera(distortion_model='equidistant', distortion=np.array(coefficients))
    generator = np.random.default_rng(4)
    angle, turn = generator.uniform(0, 1.4, 300), generator.uniform(0, 2 * np.pi, 300)
    points = np.stack(
        [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], 1
    )
    pixels, _ = project(camera, np.eye(4), points)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.K.copy(), np.array(coefficients)
    )
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-6)
    np.testing.assert_allclose(unproject(camera, pixels), points, atol=1e-7)


def test_a_fisheye_of_camera_info_stays_one_without_coefficients():
    info = {'width': 384, 'height': 288, 'K': make_camera().K, 'distortion': [0.0] * 4}
    for name in ('equidistant', 'fisheye'):
        camera = with_camera_info(make_camera(), distortion_model=name, **info)
        assert camera.distortion_model == 'equidistant'


def test_points_behind_the_camera_have_no_pixel_but_a_depth():
    points = np.array([[0.1, 0.1, 1], [0.1, 0.1, -1], [0.1, 0.1, 0.0], [0, 0, 0.001]])
    pixels, depth = project(make_camera(), np.eye(4), points)
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:]).all()
    np.testing.assert_array_equal(depth, points[:, 2])


@pytest.mark.parametrize('coefficients', [(-0.3, 0.05, 0, 0), (-0.01, 0, 0, 0)])
def test_points_far_off_the_axis_do_not_fold_back_into_the_image(coefficients):
    camera = make_camera('plumb_bob4', distortion=np.array(coefficients))
    radii = np.linspace(0, 12, 2000)
    points = np.stack([radii, 0 * radii, np.ones_like(radii)], axis=1)
    pixels, _ = project(camera, np.eye(4), points)
    seen = np.isfinite(pixels[:, 0])
    assert (np.diff(pixels[seen, 0]) > 0).all()
    assert not seen[radii > 4].any()
    assert seen[radii < 0.9].all()


def test_projection_broadcasts_over_poses_and_arms():
    generator = np.random.default_rng(0)
    poses = np.stack([rigid(generator) for _ in range(5)])
    points = generator.uniform(-1, 1, (2, 5, 3))
    pixels, depth = project(make_camera('plumb_bob5'), poses, points)
    assert pixels.shape == (2, 5, 2) and depth.shape == (2, 5)
    for arm in range(2):
        for k in range(5):
            one, _ = project(make_camera('plumb_bob5'), poses[k], points[arm, k])
            np.testing.assert_array_equal(pixels[arm, k], one)


@pytest.mark.parametrize('model', MODELS)
def test_unprojected_rays_project_to_their_pixels(model):
    camera = make_camera(model)
    pixels = np.random.default_rng(5).uniform((0, 0), (384, 288), (1000, 2))
    rays = unproject(camera, pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-12)
    again, _ = project(camera, np.eye(4), 0.7 * rays)
    np.testing.assert_allclose(again, pixels, atol=1e-6)


def test_a_pixel_that_no_point_reaches_has_no_ray():
    camera = make_camera('plumb_bob4', distortion=np.array([-0.3, 0, 0, 0]))
    assert np.isnan(unproject(camera, np.array([5000.0, 147.0]))).all()


def test_a_fixed_camera_stays_and_a_wrist_camera_moves_with_its_link(yam):
    positions = np.random.default_rng(2).uniform(yam.lower, yam.upper, (6, 14))
    offset = rigid(np.random.default_rng(8))
    fixed = make_camera(T_mount_camera=offset)
    np.testing.assert_array_equal(camera_poses(fixed, yam, positions), [offset] * 6)
    wrist = make_camera(mount_link='right_link_6', T_mount_camera=offset)
    links = yam.forward_kinematics(positions)['right_link_6']
    np.testing.assert_allclose(camera_poses(wrist, yam, positions), links @ offset, atol=1e-12)


def test_what_a_wrist_camera_sees_of_its_own_tool_does_not_move(yam):
    positions = np.random.default_rng(2).uniform(yam.lower, yam.upper, (20, 14))
    mount = np.eye(4)
    mount[:3, 3] = (0.0, 0.08, -0.05)
    camera = make_camera(mount_link='left_link_6', T_mount_camera=mount)
    poses = camera_poses(camera, yam, positions)
    own, _ = project(camera, poses, yam.tool_poses(positions)[0, :, :3, 3])
    assert np.ptp(own, axis=0).max() < 1e-9


def test_a_camera_on_an_unknown_link_is_refused(yam):
    with pytest.raises(Exception, match="'left_link6'.*did you mean 'left_link_6'"):
        camera_poses(make_camera(mount_link='left_link6'), yam, np.zeros((1, 14)))


@pytest.mark.parametrize('size', [(96, 72), (192, 288), (768, 576), (100, 37)])
def test_a_scaled_camera_finds_a_dot_where_the_resized_image_has_it(size):
    camera = make_camera('plumb_bob5')
    point = np.array([0.13, -0.08, 0.9])
    (x, y), _ = project(camera, np.eye(4), point)
    rows, columns = np.mgrid[:288, :384]
    image = np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / 8.0**2)
    shrinks = size[0] <= 384 and size[1] <= 288
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    weights = small / small.sum()
    centre = [(weights.sum(0) * np.arange(size[0])).sum(),
              (weights.sum(1) * np.arange(size[1])).sum()]  # fmt: skip
    found, _ = project(scaled(camera, *size), np.eye(4), point)
    np.testing.assert_allclose(found, centre, atol=0.02)


def test_scaling_to_the_same_size_changes_nothing_and_twice_equals_once():
    camera = make_camera()
    assert scaled(camera, 384, 288) is camera
    once = scaled(camera, 96, 72)
    assert scaled(once, 96, 72) is once
    via = scaled(scaled(camera, 192, 100), 96, 72)
    np.testing.assert_allclose(via.K, once.K, atol=1e-12)
    np.testing.assert_array_equal(camera.K, make_camera().K)


@pytest.mark.parametrize('model', ['none', 'plumb_bob5', 'rational14'])
@pytest.mark.parametrize('num_views', [2, 3])
def test_triangulation_finds_the_point(model, num_views):
    generator = np.random.default_rng(num_views)
    for _ in range(30):
        point = generator.uniform(-0.2, 0.2, 3)
        cameras, poses, pixels = [], [], []
        for _ in range(num_views):
            T = rigid(generator)
            T[:3, 3] = point - T[:3, :3] @ (generator.uniform(0.5, 1.5) * np.array([0.1, 0.05, 1]))
            cameras.append(make_camera(model))
            poses.append(T)
            pixels.append(project(cameras[-1], T, point)[0])
        found, residual = triangulate(cameras, poses, np.array(pixels))
        np.testing.assert_allclose(found, point, atol=1e-6)
        assert residual < 1e-4


def test_triangulation_says_how_badly_the_views_agree():
    poses = [np.eye(4), np.eye(4)]
    poses[1] = np.array([[0, 0, -1, 1], [0, 1, 0, 0], [1, 0, 0, 1], [0, 0, 0, 1.0]])
    cameras = [make_camera(), make_camera()]
    point = np.array([0, 0, 1.0])
    pixels = np.array([project(c, T, point)[0] for c, T in zip(cameras, poses, strict=True)])
    pixels[0, 1] += 4
    pixels[1, 1] -= 4
    found, residual = triangulate(cameras, poses, pixels)
    np.testing.assert_allclose(found, point, atol=1e-3)
    assert 3.9 < residual < 4.1


def test_triangulation_of_parallel_rays_or_behind_the_cameras_is_nan():
    aside = np.eye(4)
    aside[0, 3] = 0.1
    cameras = [make_camera(), make_camera()]
    same = np.array([[188.3, 147.1]] * 2)
    apart = np.array([[188.3, 147.1], [288.3, 147.1]])
    for pixels in (same, apart):
        point, residual = triangulate(cameras, [np.eye(4), aside], pixels)
        assert np.isnan(point).all() and np.isnan(residual)
    with pytest.raises(CalibrationError, match='two views'):
        triangulate(cameras[:1], [np.eye(4)], same[:1])


def info(camera: CameraModel, **changes) -> dict:
    values = {
        'width': camera.width,
        'height': camera.height,
        'K': camera.K,
        'distortion_model': camera.distortion_model,
        'distortion': camera.distortion.tolist(),
    }
    return values | changes


def test_intrinsics_come_from_camera_info_and_the_pose_from_the_calibration():
    calibrated = make_camera('plumb_bob5', T_mount_camera=rigid(np.random.default_rng(0)))
    other = scaled(make_camera('rational8', K=calibrated.K * [[1.01], [0.99], [1]]), 640, 480)
    informed = with_camera_info(calibrated, **info(other))
    assert (informed.width, informed.height) == (640, 480)
    np.testing.assert_array_equal(informed.K, other.K)
    np.testing.assert_array_equal(informed.distortion, RATIONAL)
    np.testing.assert_array_equal(informed.T_mount_camera, calibrated.T_mount_camera)


def test_camera_info_without_distortion_may_name_any_model():
    informed = with_camera_info(
        make_camera(), **info(make_camera(), distortion_model='', distortion=[0.0] * 5)
    )
    assert informed.distortion_model == 'none'


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'K': np.zeros((3, 3))}, 'not calibrated'),
        ({'distortion_model': 'ftheta', 'distortion': [0.1] * 4}, "'ftheta'; known are"),
        ({'distortion': [0.1] * 3, 'distortion_model': 'plumb_bob'}, '3 coefficients'),
        ({'K': make_camera().K * [[2], [2], [1]]}, 'contradicts itself'),
        ({'width': 96, 'height': 72}, 'contradicts itself'),
    ],
)
def test_camera_info_that_cannot_be_right_is_refused(changes, message):
    with pytest.raises(CalibrationError, match=message):
        with_camera_info(make_camera(), **info(make_camera(), **changes))
