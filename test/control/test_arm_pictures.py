"""The robot's links as the start frame shows them, where a pinhole camera has them later."""

import cv2
import numpy as np
import pytest

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.arm_pictures import arm_pictures
from mtv_world_ros.control.control import SeenFrame
from mtv_world_ros.control.trajectory_video import render_trajectory_video, TrajectoryVideoConfig
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.data.recordings import cut_clip
from mtv_world_ros.robot.shape import LinkShape, load_shape
from mtv_world_ros.training.training_config import load_training_config

WALL, PAINT = (90, 90, 90), np.array([200, 40, 60])
#: a thin plate across the optical axis, in the frame of the link that carries it [m]
PLATE = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.05, 0.05) for z in (-0.002, 0.002)])


def corners(camera, tool):
    """Pixels of the plate's outline by cv2, for a camera in the base's origin."""
    points = (PLATE[:, :2].min(0), PLATE[:, :2].max(0))
    flat = [[x, y, 0] for x, y in ((points[0][0], points[0][1]), (points[1][0], points[1][1]))]
    return cv2.projectPoints(np.array(flat) + tool, np.zeros(3), np.zeros(3), camera.K, None)[0]


def start_frame(camera, tool):
    """A frame (H, W, 3) with the painted plate; its right half is darker."""
    frame = np.full((camera.height, camera.width, 3), WALL, np.uint8)
    (left, top), (right, bottom) = np.rint(corners(camera, tool)[:, 0]).clip(0).astype(int)
    frame[top : bottom + 1, left : right + 1] = PAINT
    middle = round(float(corners(camera, tool)[:, 0, 0].mean()))
    frame[top : bottom + 1, max(middle, 0) : right + 1] = PAINT // 2
    return frame


def drawn(robot, camera, tools, frame, parts=None):
    """(T, H, W, 4) of one view, for tool points (T, 3)."""
    positions = np.column_stack([np.asarray(tools, float), np.ones(len(tools))])
    parts = parts or [LinkShape(link='hand0', points=PLATE)]
    return pictures_of(parts, robot, [camera], frame[None], positions)[0]


def pictures_of(parts, robot, cameras, frames, positions):
    links = {part.link for part in parts}
    return arm_pictures(parts, Motion.of(robot, cameras, positions, links), frames)


def test_a_link_goes_where_the_camera_will_see_it(one_arm, make_camera):
    camera = make_camera(192, 144)
    tools = [(-0.2, 0.0, 1.0), (0.2, 0.1, 1.0), (0.0, 0.0, 0.6)]
    pictures = drawn(one_arm, camera, tools, start_frame(camera, tools[0]))
    for picture, tool in zip(pictures, tools, strict=True):
        rows, columns = np.nonzero(picture[..., 3])
        found = [columns.min(), rows.min(), columns.max(), rows.max()]
        assert np.abs(corners(camera, np.array(tool)).ravel() - found).max() < 1.5
        middle = (int(rows.mean()), int(columns.mean()))
        wide = (columns.max() - columns.min()) // 4
        for at, colour in ((-wide, PAINT), (wide, PAINT // 2)):
            assert np.abs(picture[middle[0], middle[1] + at, :3].astype(int) - colour).max() < 12
    assert not pictures[..., :3][pictures[..., 3] == 0].any()


def test_what_the_start_frame_does_not_show_has_the_links_mean_colour(one_arm, make_camera):
    camera = make_camera(192, 144)
    tools = [(-0.48, 0.0, 1.0), (0.0, 0.0, 1.0)]  # three eighths outside at first
    frame = start_frame(camera, tools[0])
    first, later = drawn(one_arm, camera, tools, frame)
    row, (left, right) = 72, np.flatnonzero(later[72, :, 3])[[0, -1]]
    new, known = later[row, left + 4, :3], later[row, right - 4, :3].astype(int)
    assert np.abs(known - PAINT // 2).max() < 12
    mean = frame[first[..., 3] > 0].mean(axis=0)
    assert np.abs(PAINT - mean).max() > 20 and np.abs(new - mean).max() < 1
    # from behind the camera: nothing of it is known
    tools = [(0, 0, -1.0), (0, 0, 1.0)]
    unseen, grey = drawn(one_arm, camera, tools, start_frame(camera, tools[1]))
    assert not unseen.any() and (grey[grey[..., 3] > 0, :3] == 128).all() and grey.any()


def test_near_links_cover_far_ones(two_arms, make_camera):
    camera = make_camera(192, 144)
    parts = [LinkShape(link=f'hand{arm}', points=PLATE) for arm in (0, 1)]
    frame = start_frame(camera, (0.3, 0.0, 1.0))  # of the second arm alone
    near, far, side = (0.0, 0.0, 0.8), (0.0, 0.0, 1.0), (0.3, 0.0, 1.0)
    for first, covers in ((near, False), (far, True)):
        second = near if covers else far
        positions = np.array([[*first, 1, *side, 1], [*first, 1, *second, 1]], float)
        picture = pictures_of(parts, two_arms, [camera], frame[None], positions)[0, 1]
        seen = np.abs(picture[72, 90, :3].astype(int) - PAINT).max() < 12
        assert seen == covers


def test_drawn_arms_are_nearer_to_the_recorded_frame_than_held_ones(robot):
    """On the bundled episode, whose camera and robot are the simulator's."""
    spec = load_training_config('small', {'video.num_frames': 8}).spec
    recording = load_recording(share_path('resource', 'demo_episode'), spec, robot)
    errors = []
    for start in range(0, 40, 8):
        clip = cut_clip(recording, start, spec)
        pictures = pictures_of(
            load_shape(robot).parts, robot, clip.cameras, clip.frames[:, 0], clip.positions
        )
        moved = (pictures[:, -1, ..., 3] > 0) & (pictures[:, 0, ..., 3] == 0)
        true = clip.frames[:, -1][moved].astype(float)
        shown = (pictures[:, -1, ..., :3][moved], clip.frames[:, 0][moved])
        errors.append([np.abs(one - true).mean() for one in shown])
        assert moved.any()
    drawn_error, held_error = np.mean(errors, axis=0)
    assert drawn_error < 0.6 * held_error


def test_trails_lie_over_the_arms(one_arm, make_camera):
    camera = make_camera(192, 144)
    tools = np.array([(-0.2, 0.0, 1.0), (0.2, 0.0, 1.0)])
    positions = np.column_stack([tools, np.ones(2)])
    arms = drawn(one_arm, camera, tools, start_frame(camera, tools[0]))
    video = {
        name: render_trajectory_video(
            motion=Motion.of(one_arm, [camera], positions), times=np.arange(2) / 5,
            object_masks=None, config=TrajectoryVideoConfig(), arms=pictures,
        ).frames[0]
        for name, pictures in (('trails', None), ('arms', arms[None]))
    }  # fmt: skip
    free = video['trails'].max(axis=-1) == 0
    np.testing.assert_array_equal(video['arms'][free], arms[..., :3][free])
    bright = video['trails'].max(axis=-1) > 200
    assert bright.any() and (video['arms'][bright] >= video['trails'][bright] - 2).all()


def seen_frame(robot, camera, tool, frame):
    positions = np.array([[*tool, 1.0]])
    return SeenFrame(frames=frame[None], motion=Motion.of(robot, [camera], positions, ['hand0']))


@pytest.mark.parametrize(
    ('tool', 'is_sharp'), [((-0.2, 0.0, 1.0), True), ((5.0, 0.0, 1.0), False)]
)
def test_a_link_keeps_the_pixels_of_the_real_frame_that_shows_it(
    one_arm, make_camera, tool, is_sharp
):
    camera = make_camera(192, 144)
    start, goal = np.array([0.1, 0.0, 1.0]), np.array([0.2, 0.1, 1.0])
    # what an imagined frame has made of the plate: one smear
    smeared = np.full((camera.height, camera.width, 3), 110, np.uint8)
    real = seen_frame(one_arm, camera, tool, start_frame(camera, np.array(tool)))
    positions = np.array([[*start, 1.0], [*goal, 1.0]])
    motion = Motion.of(one_arm, [camera], positions, ['hand0'])
    parts = [LinkShape(link='hand0', points=PLATE)]
    (_, picture) = arm_pictures(parts, motion, smeared[None], real)[0]
    rows, columns = np.nonzero(picture[..., 3])
    middle, wide = (int(rows.mean()), int(columns.mean())), np.ptp(columns) // 4
    left, right = picture[middle[0], middle[1] - wide], picture[middle[0], middle[1] + wide]
    expected = (PAINT, PAINT // 2) if is_sharp else ((110,) * 3,) * 2
    for found, colour in zip((left, right), expected, strict=True):
        assert np.abs(found[:3].astype(int) - colour).max() < 12
