from dataclasses import replace
import json

import cv2
import numpy as np
import pytest

from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.trajectory_video import (
    arm_colour,
    object_colour,
    render_trajectory_video,
    TrajectoryVideoConfig,
)
from mtv_world_ros.core.errors import ConfigError, ObservationError, TrajectoryError
from mtv_world_ros.robot.model import RobotModel, Tool

OPEN, CLOSED = 1.0, 0.0
#: trails without the gripper's core: pure arm colours
PLAIN = TrajectoryVideoConfig(show_gripper=False)


def render(robot, cameras, points, times=None, *, grips=OPEN, masks=None, config=PLAIN):
    """Frames (V, T, H, W, 3) as float in 0 .. 1 of tool points (A, T, 3)."""
    points = np.asarray(points, float)
    num_arms, num_frames, _ = points.shape
    grips = np.broadcast_to(grips, (num_arms, num_frames))
    positions = np.concatenate([points, grips[..., None]], axis=2)
    cameras = [cameras] if not isinstance(cameras, list) else cameras
    rows = positions.transpose(1, 0, 2).reshape(num_frames, -1)
    video = render_trajectory_video(
        motion=Motion.of(robot, cameras, rows),
        times=np.arange(num_frames) / 5 if times is None else np.asarray(times, float),
        object_masks=masks,
        config=config,
    )
    assert video.frames.dtype == np.uint8
    return video.frames / 255


def still(point, num_frames=1):
    return [[point] * num_frames]


def centroid(image):
    light = image.sum(-1)
    rows, columns = np.indices(light.shape)
    return np.array([(light * columns).sum(), (light * rows).sum()]) / light.sum()


def spread(image):
    """Standard deviation [px], from the second moment about the centroid."""
    light = image.sum(-1)
    rows, columns = np.indices(light.shape)
    x, y = centroid(image)
    return np.sqrt((light * ((columns - x) ** 2 + (rows - y) ** 2)).sum() / light.sum() / 2)


def reference(robot, camera, points, times, config):
    """One arm, drawn plainly: every pixel, every point so far, from cv2's projection."""
    coefficients = camera.distortion.copy() if len(camera.distortion) else None
    frames, points, times = [], np.asarray(points)[0], np.asarray(times)
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1) / (config.max_gap_m or np.inf)
    fine = [0.0]
    for k, gap in enumerate(gaps):
        count = max(int(np.ceil(gap)), config.points_per_frame)
        fine += [k + (n + 1) / count for n in range(count)]
    dense = np.stack([np.interp(fine, range(len(times)), p) for p in points.T], axis=1)
    stamps = np.interp(fine, range(len(times)), times)
    pixels, _ = cv2.projectPoints(dense, np.zeros(3), np.zeros(3), camera.K.copy(), coefficients)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    colour = arm_colour(0, len(robot.tools))
    for now in times:
        glow = np.zeros((camera.height, camera.width))
        for point, (x, y), stamp in zip(dense, pixels[:, 0], stamps, strict=True):
            if stamp <= now + 1e-9:
                sigma = max(config.point_radius_m * camera.K[0, 0] / point[2],
                            config.min_radius_px)  # fmt: skip
                stain = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 2 / sigma**2)
                glow = np.maximum(glow, stain * 0.5 ** ((now - stamp) / config.half_life_s))
        frames.append(glow[..., None] * colour)
    return np.stack(frames)


@pytest.mark.parametrize('size', [(96, 72), (384, 288)])
@pytest.mark.parametrize('distortion', [(), (-0.3, 0.1, 0.002, -0.001)])
@pytest.mark.parametrize('max_gap_m', [None, 0.02])
def test_trails_equal_the_plain_drawing_of_every_point(
    one_arm, make_camera, size, distortion, max_gap_m
):
    model = 'plumb_bob' if distortion else 'none'
    camera = make_camera(*size, distortion=np.array(distortion), distortion_model=model)
    t = np.linspace(0, 1, 7)
    times = np.cumsum([0, 0.1, 0.3, 0.2, 0.05, 0.4, 0.2])
    points = [np.stack([0.6 * t - 0.2, 0.3 * np.sin(5 * t), 1 + 0.5 * t], axis=1)]
    config = PLAIN.replace(max_gap_m=max_gap_m)
    frames = render(one_arm, camera, points, times, config=config)[0]
    expected = reference(one_arm, camera, points, times, config)
    np.testing.assert_allclose(frames, expected, atol=2.1 / 255)


# The mistakes of other renderers, one test each.


@pytest.mark.parametrize(
    'point', [(0.05, 0.02, -1.0), (0.0, 0.0, 0.0), (5.0, 0, 1.0), (1e12, -1e12, 0.02)]
)
def test_a_point_behind_the_camera_or_far_outside_leaves_nothing(one_arm, make_camera, point):
    assert render(one_arm, make_camera(), still(point)).max() == 0


def test_an_arm_behind_the_camera_does_not_hide_one_in_front(two_arms, make_camera):
    both = render(two_arms, make_camera(), [[(0.05, 0.02, 1.0)], [(0.05, 0.02, -1.0)]])
    alone = render(two_arms, make_camera(), [[(0.05, 0.02, 1.0)], [(9, 9, 1.0)]])
    np.testing.assert_array_equal(both, alone)


@pytest.mark.parametrize('centre', [(-1.3, 30), (97.2, 30), (40, -2.5), (40, 73.8), (-0.6, -0.7)])
def test_a_glyph_whose_centre_left_the_image_keeps_the_part_inside(one_arm, make_camera, centre):
    """The same scene on a canvas with 20 px more on each side, cut to the image."""
    camera = make_camera()
    bigger = replace(camera, width=136, height=112, K=camera.K + [[0, 0, 20], [0, 0, 20], [0] * 3])
    ray = np.linalg.solve(camera.K, [*centre, 1.0])
    config = PLAIN.replace(point_radius_m=0.03)
    inside = render(one_arm, camera, still(0.9 * ray), config=config)
    whole = render(one_arm, bigger, still(0.9 * ray), config=config)
    assert inside.max() > 0.1
    np.testing.assert_array_equal(inside, whole[:, :, 20:-20, 20:-20])


def test_positions_are_sub_pixel_and_not_truncated(one_arm, make_camera):
    camera = make_camera()
    for x, y in np.random.default_rng(0).uniform((15, 15), (80, 57), (30, 2)):
        point = np.linalg.solve(camera.K, [x, y, 1.0])
        found = centroid(render(one_arm, camera, still(point))[0, 0])
        np.testing.assert_allclose(found, (x, y), atol=0.05)


def test_a_point_just_left_of_the_image_is_not_pulled_onto_its_edge(one_arm, make_camera):
    camera = make_camera()
    images = [
        render(one_arm, camera, still(np.linalg.solve(camera.K, [x, 30.0, 1.0])))[0, 0]
        for x in (-0.9, -0.4, 0.0)
    ]
    brightness = [image[30, 0].max() for image in images]
    assert brightness[0] < brightness[1] < brightness[2]


@pytest.mark.parametrize('depth', [0.3, 0.6, 0.9, 1.2, 2.0])
def test_size_is_metric_size_over_depth(one_arm, make_camera, depth):
    camera = make_camera(384, 288)
    image = render(one_arm, camera, still((0, 0, depth)))[0, 0]
    assert spread(image) == pytest.approx(0.012 * 384 / depth, rel=0.03)


@pytest.mark.parametrize('depth', [1.0, 3.0, 10.0, 40.0])
def test_far_points_never_vanish(one_arm, make_camera, depth):
    image = render(one_arm, make_camera(), still((0, 0, depth)))[0, 0]
    assert image.max() > 0.6
    assert spread(image) >= 0.75


def test_it_is_the_tool_point_that_is_drawn_not_the_flange(one_arm, make_camera):
    offset = np.eye(4)
    offset[:3, 3] = (0.0, 0.0, -0.15)
    offset[:3, :3] = cv2.Rodrigues(np.array([0, 0, 0.7]))[0]
    tool = Tool(arm='0', link='hand0', T_link_tool=offset)
    robot = RobotModel(
        name='r', model=one_arm.pinocchio_model, joint_names=one_arm.joint_names, tools=(tool,),
        base_link='base',
    )  # fmt: skip
    camera = make_camera()
    flange = np.array([0.1, 0.05, 0.8])
    found = centroid(render(robot, camera, still(flange))[0, 0])
    expected = camera.K @ (flange + (0, 0, -0.15))
    np.testing.assert_allclose(found, expected[:2] / expected[2], atol=0.05)


def test_intrinsics_follow_the_image_size(one_arm, make_camera):
    large = make_camera(384, 288)
    point = still((0.21, -0.13, 0.7))
    big = render(one_arm, large, point)[0, 0]
    small = render(one_arm, scaled(scaled(large, 96, 72), 96, 72), point)[0, 0]
    shrunk = cv2.resize(big, (96, 72), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(centroid(small), centroid(shrunk), atol=0.02)
    assert np.abs(small - shrunk).max() < 0.06


def test_frame_k_shows_the_state_after_command_k_and_frame_0_the_current_one(one_arm, make_camera):
    camera = make_camera()
    points = np.array([[(0.1 * k - 0.3, 0, 1.0) for k in range(7)]])
    frames = render(one_arm, camera, points, config=PLAIN.replace(half_life_s=1e-3))[0]
    for k, frame in enumerate(frames):
        x = 96 * points[0, k, 0] + camera.K[0, 2]
        np.testing.assert_allclose(centroid(frame), (x, camera.K[1, 2]), atol=0.05)


def test_a_command_does_not_show_before_its_frame(one_arm, make_camera):
    points = np.array([[(0.05 * k, 0, 1.0) for k in range(6)]])
    other = points.copy()
    other[0, 4] += 0.1
    first, second = (render(one_arm, make_camera(), p)[0] for p in (points, other))
    np.testing.assert_array_equal(first[:4], second[:4])
    assert np.abs(first[4] - second[4]).max() > 0.5


# What it must show.


def test_the_nearer_arm_covers_the_farther_one(two_arms, make_camera):
    camera = make_camera(384, 288)
    middle = (slice(142, 146), slice(190, 194))
    for nearer in (0, 1):
        depths = [1.5, 1.5]
        depths[nearer] = 1.0
        image = render(two_arms, camera, [[(0, 0, z)] for z in depths])[0, 0]
        colour = image[middle].mean((0, 1))
        ours, theirs = arm_colour(nearer, 2), arm_colour(1 - nearer, 2)
        assert np.abs(colour - ours).sum() < 0.35 * np.abs(colour - theirs).sum()


def test_brightness_halves_every_half_life_whatever_the_frame_rate(one_arm, make_camera):
    """The arm leaves a place at once; what stays there fades."""
    for fps in (4, 10, 30):
        times = np.arange(2 * fps + 1) / fps
        points = np.tile([(0.3, 0.2, 1.0)], (1, len(times), 1))
        points[0, 0] = (-0.3, -0.2, 1.0)
        config = PLAIN.replace(half_life_s=0.5, points_per_frame=1)
        frames = render(one_arm, make_camera(), points, times, config=config)[0]
        left = frames[:, 16, 19].max(-1) / frames[0, 16, 19].max()
        np.testing.assert_allclose(left, 0.5 ** (times / 0.5), atol=1.5 / 255)


def test_an_arm_at_rest_does_not_burn_in(one_arm, make_camera):
    frames = render(one_arm, make_camera(), still((0.1, 0, 1.0), 20))[0]
    np.testing.assert_array_equal(frames, np.repeat(frames[:1], 20, axis=0))


def test_a_fast_arm_leaves_a_trail_without_gaps(one_arm, make_camera):
    points = [[(-0.08, 0, 1.0), (0.08, 0, 1.0)]]
    config = PLAIN.replace(max_gap_m=0.012)
    frame = render(one_arm, make_camera(), points, [0.0, 0.2], config=config)[0, 1]
    assert frame[35, 41:55].max(axis=-1).min() > 0.5


@pytest.mark.parametrize('size', [(96, 72), (384, 288)])
def test_the_gripper_shows_at_both_sizes_and_the_arms_hue_stays(two_arms, make_camera, size):
    camera = make_camera(*size)
    points = [[(-0.2, 0.0, 1.0)], [(0.2, 0.0, 1.0)]]
    config = TrajectoryVideoConfig()
    images = {
        grip: render(two_arms, camera, points, grips=grip, config=config)[0, 0]
        for grip in (OPEN, 0.5, CLOSED)
    }
    row = slice(size[1] // 2 - 1, size[1] // 2 + 1)
    for arm, half in enumerate((slice(0, size[0] // 2), slice(size[0] // 2, None))):
        darkest = [images[grip][row, half].max((0, 1)).min() for grip in (OPEN, 0.5, CLOSED)]
        assert darkest[0] < 0.2 and 0.35 < darkest[1] < 0.7 and darkest[2] > 0.65
        halo = images[CLOSED][:, half]
        sigma = 0.012 * size[0]
        rows, columns = np.indices(halo.shape[:2])
        x = camera.K[0, 2] + (-0.2, 0.2)[arm] * size[0] - (half.start or 0)
        away = np.hypot(columns - x, rows - camera.K[1, 2]) / sigma
        ring = halo[(away > 1.5) & (away < 2.1)].mean(0)
        hue = ring / ring.max() - arm_colour(arm, 2)
        assert np.abs(hue).max() < 0.15


def test_the_gripper_can_be_left_out(one_arm, make_camera):
    drawn = [render(one_arm, make_camera(), still((0, 0, 1.0)), grips=g) for g in (OPEN, CLOSED)]
    np.testing.assert_array_equal(*drawn)


def test_a_centimetre_shows_at_the_small_size(one_arm, make_camera):
    config = TrajectoryVideoConfig()
    here, there = (
        render(one_arm, make_camera(), still((x, 0, 1.0)), config=config) for x in (0.0, 0.01)
    )
    assert np.abs(here - there).max() > 0.2


def test_objects_are_dim_fills_of_their_own_colours_held_over_all_frames(one_arm, make_camera):
    masks = np.zeros((1, 2, 72, 96), bool)
    masks[0, 0, 10:20, 10:20] = True
    masks[0, 1, 50:60, 70:90] = True
    frames = render(one_arm, make_camera(), still((0, 0, 1.0), 5), masks=masks)[0]
    for k in range(5):
        for index, mask in enumerate(masks[0]):
            colour = object_colour(index, PLAIN.object_fill)
            np.testing.assert_allclose(frames[k][mask], [colour] * mask.sum(), atol=0.5 / 255)
    assert 0 < object_colour(0, 0.35).max() < 0.4 and not np.allclose(
        object_colour(0, 0.35), object_colour(1, 0.35), atol=0.1
    )
    assert frames[0, 65, 5].max() == 0


def test_glow_lies_over_objects(one_arm, make_camera):
    masks = np.ones((1, 1, 288, 384), bool)
    image = render(one_arm, make_camera(384, 288), still((0, 0, 1.0)), masks=masks)[0, 0]
    np.testing.assert_allclose(image[143, 191], arm_colour(0, 1), atol=0.05)
    np.testing.assert_allclose(image[5, 5], object_colour(0, 0.35), atol=0.01)


def test_a_camera_that_hardly_moves_draws_what_one_at_rest_draws(two_arms, make_camera):
    """A camera on arm 1, which moves by a nanometre, against a fixed one at the same place."""
    t = np.linspace(0, 1, 12)
    points = np.stack(
        [np.stack([0.4 * t - 0.2, 0.2 * np.sin(6 * t), 1 + 0.3 * t], 1),
         np.stack([1e-9 * t, 0 * t, 0 * t + 1.2], 1)]
    )  # fmt: skip
    mount = np.eye(4)
    mount[2, 3] = -1.2
    moving = make_camera(mount_link='hand1', T_mount_camera=mount)
    frames = render(two_arms, [make_camera(), moving], points, grips=0.3,
                    config=TrajectoryVideoConfig())  # fmt: skip
    np.testing.assert_allclose(frames[0], frames[1], atol=1.1 / 255)


def test_a_wrist_camera_redraws_the_past_from_where_it_is_now(two_arms, make_camera):
    """Arm 0 rests; the camera on arm 1 shifts sideways: one glow, at the new place, no smear."""
    points = np.array([[(0.0, 0.0, 1.0)] * 5, [(0.05 * k, 0.0, 0.0) for k in range(5)]])
    camera = make_camera(mount_link='hand1')
    frames = render(two_arms, camera, points)[0]
    for k, frame in enumerate(frames):
        x, _ = centroid(frame)
        assert x == pytest.approx(camera.K[0, 2] - 0.05 * k * 96, abs=0.05)
        assert spread(frame) == pytest.approx(0.012 * 96, rel=0.05)


def test_views_times_and_frames_belong_together(two_arms, make_camera):
    cameras = [make_camera(), make_camera(view='side', T_mount_camera=np.diag([-1.0, 1, -1, 1]))]
    video = render_trajectory_video(
        motion=Motion.of(two_arms, cameras, np.zeros((3, 8))), times=np.array([0, 0.2, 0.4]),
        object_masks=None, config=TrajectoryVideoConfig(),
    )  # fmt: skip
    assert video.views == ('front', 'side')
    assert video.frames.shape == (2, 3, 72, 96, 3)
    np.testing.assert_array_equal(video.times, [0, 0.2, 0.4])


# Bad input.


@pytest.mark.parametrize(
    ('changes', 'error', 'says'),
    [
        ({'times': (0, 1)}, TrajectoryError, 'do not fit together'),
        ({'times': (0, 1, 1)}, TrajectoryError, 'do not increase'),
        ({'sizes': ((96, 72), (384, 288))}, ObservationError, 'sizes'),
        ({'masks': (1, 2, 36, 48)}, ObservationError, r'\(1, 2, 36, 48\).*\(1, 72, 96\)'),
    ],
)
def test_what_does_not_fit_together_is_refused(one_arm, make_camera, changes, error, says):
    given = {'sizes': ((96, 72),), 'times': (0, 1, 2), 'masks': None, **changes}
    cameras = [make_camera(*size) for size in given['sizes']]
    with pytest.raises(error, match=says):
        render_trajectory_video(
            motion=Motion.of(one_arm, cameras, np.zeros((3, 4))),
            times=np.array(given['times'], float),
            object_masks=given['masks'] and np.zeros(given['masks'], bool), config=PLAIN,
        )  # fmt: skip


@pytest.mark.parametrize(
    ('key', 'value'),
    [
        ('half_life_s', 0), ('point_radius_m', -1), ('min_radius_px', float('nan')),
        ('object_fill', 1.5), ('points_per_frame', 0), ('points_per_frame', 1.5),
        ('max_gap_m', 0.0), ('link_width_m', 0.0), ('link_width_m', float('inf')),
    ],
)  # fmt: skip
def test_wrong_settings_are_named(key, value):
    with pytest.raises(ConfigError, match=f'rendering.{key} is {value}'):
        TrajectoryVideoConfig(**{key: value})


def test_settings_survive_a_checkpoints_card():
    config = TrajectoryVideoConfig(half_life_s=0.3, show_gripper=False)
    assert TrajectoryVideoConfig(**json.loads(json.dumps(config.model_dump()))) == config
