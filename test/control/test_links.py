"""The lines along the arms, on gantries whose slides carry the tool from the base's origin."""

import cv2
import numpy as np
import pytest

from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.trajectory_video import (
    arm_colour,
    render_trajectory_video,
    TrajectoryVideoConfig,
)

PLAIN = TrajectoryVideoConfig(show_gripper=False)
LINKS = PLAIN.replace(link_width_m=0.02)
#: the arm's slides stand in the base, so the camera looks at it from outside
BACK = np.eye(4) + np.pad(np.array([[0.2], [0.1], [-1.0]]), ((0, 1), (3, 0)))


def render(robot, camera, tools, config=LINKS):
    """(T, H, W, 3) frames of one view, for tool points (T, A, 3)."""
    tools = np.asarray(tools, float)
    positions = np.concatenate([tools, np.ones((*tools.shape[:2], 1))], axis=2)
    return render_trajectory_video(
        motion=Motion.of(robot, [camera], positions.reshape(len(tools), -1)),
        times=np.arange(len(tools)) / 5,
        object_masks=None,
        config=config,
    ).frames[0]


def seen_at(camera, points):
    """Pixels by cv2, of points in the base frame."""
    T = np.linalg.inv(camera.T_mount_camera)
    lens = camera.distortion.copy() if len(camera.distortion) else None
    local = (points @ T[:3, :3].T + T[:3, 3]).reshape(-1, 1, 3)
    return cv2.projectPoints(local, np.zeros(3), np.zeros(3), camera.K.copy(), lens)[0][:, 0]


@pytest.mark.parametrize('lens', [(), (-0.4, 0.1, 0.01, 0.0, 0.0)])
def test_lines_run_through_the_joints_to_the_tool(one_arm, make_camera, lens):
    kind = 'plumb_bob' if lens else 'none'
    camera = make_camera(
        384, 288, T_mount_camera=BACK, distortion=np.array(lens), distortion_model=kind
    )
    tool = np.array([0.5, -0.2, 0.4])
    frame = render(one_arm, camera, [[tool]])[0].astype(int)
    # x, y and z slide from the base's origin: what they carry stands at its partial sums
    joints = np.tril(np.ones((3, 3))) * tool
    lit = frame.max(axis=-1) > 60
    for start, end in zip(joints[:-1], joints[1:], strict=True):
        shares = np.linspace(0, 1, 9)[:, None]
        for x, y in np.rint(seen_at(camera, start + shares * (end - start))).astype(int):
            assert lit[y, x]
    dark = np.ones(lit.shape, np.uint8)
    for start, end in zip(joints[:-1], joints[1:], strict=True):
        shares = np.linspace(0, 1, 200)[:, None]
        for x, y in np.rint(seen_at(camera, start + shares * (end - start))).astype(int):
            cv2.circle(dark, (int(x), int(y)), 16, 0, -1)
    assert not frame[dark > 0].any()


def test_a_line_is_as_wide_as_its_depth_says(one_arm, make_camera):
    for depth, width in ((0.8, 19), (1.6, 10)):
        pose = np.eye(4)
        pose[2, 3] = -depth
        camera = make_camera(384, 288, T_mount_camera=pose)
        # along y, from (0.1, 0, 0) to (0.1, 0.3, 0)
        config = PLAIN.replace(link_width_m=0.04)
        lit = render(one_arm, camera, [[(0.1, 0.3, 0)]], config)[0].max(axis=-1) > 60
        row = lit[144 + int(384 * 0.1 / depth)]
        assert abs(int(row.sum()) - width) <= 3


def test_what_is_behind_the_camera_is_left_out(one_arm, make_camera):
    pose = np.eye(4)
    pose[2, 3] = 0.5  # the base is behind it, the tool in front
    camera = make_camera(T_mount_camera=pose)
    lit = render(one_arm, camera, [[(0.2, 0.0, 1.5)]])[0].max(axis=-1) > 60
    ys, xs = np.nonzero(lit)
    assert len(xs) and xs.min() > 48  # the tool stands to the right; mirrored it were left
    behind = render(one_arm, camera, [[(0.2, 0.1, -0.5)]])
    assert not behind.any()


def test_trails_lie_over_lines_and_nearer_arms_over_farther_ones(two_arms, make_camera):
    pose = np.eye(4)
    pose[2, 3] = -1.0
    camera = make_camera(T_mount_camera=pose)
    near, far = (0.0, 0.3, -0.3), (0.0, 0.3, 0.3)
    for first, second, nearer in ((near, far, 0), (far, near, 1)):
        frame = render(two_arms, camera, [[first, second]])[0]
        # both arms' y slides lie on the same line
        shown = frame[45, 48] / 255
        assert np.abs(shown - arm_colour(nearer, 2) / 2).max() < 0.02
    trails = render(two_arms, camera, [[near, far]], config=PLAIN)[0].astype(int)
    both = render(two_arms, camera, [[near, far]])[0].astype(int)
    assert trails.any() and (both >= trails - 2).all()


def test_lines_follow_the_state_of_each_frame(one_arm, make_camera):
    camera = make_camera(T_mount_camera=BACK)
    tools = [[(0.1, 0.2, 0.0)], [(0.5, -0.3, 0.0)], [(0.3, 0.3, 0.1)]]
    frames = render(one_arm, camera, tools)
    trails = render(one_arm, camera, tools, config=PLAIN)
    assert (frames != trails).any(axis=(1, 2, 3)).all()
    # lines do not fade: those of a frame are those of its state alone
    for number, tool in enumerate(tools):
        alone = render(one_arm, camera, [tool])[0]
        free = (trails[number].max(axis=-1) == 0) & (trails[0].max(axis=-1) == 0)
        free &= render(one_arm, camera, [tool], config=PLAIN)[0].max(axis=-1) == 0
        np.testing.assert_array_equal(frames[number][free], alone[free])


def test_without_a_width_there_are_no_lines(one_arm, make_camera):
    camera = make_camera(T_mount_camera=BACK)
    assert TrajectoryVideoConfig().link_width_m is None
    tool = (0.3, 0.2, 0.1)
    x, y = np.rint(seen_at(camera, np.array([[0.3, 0.1, 0.0]])))[0].astype(int)
    assert not render(one_arm, camera, [[tool]], config=PLAIN)[0, y, x].any()
    assert render(one_arm, camera, [[tool]])[0, y, x].any()
