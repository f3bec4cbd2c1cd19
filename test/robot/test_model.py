from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest

from mtv_world_ros.core.errors import RobotError, TrajectoryError
from mtv_world_ros.robot.model import check_positions, RobotModel, Tool

# The maker's figures: position [m] and quaternion wxyz (not normalised) of each link in its
# parent; every joint turns about its own z.
LINKS = (
    ((0, 0, 0.0631), (1, 0, 0, 1)),
    ((0.000025, -0.02, 0.0409), (1, 1, 1, 1)),
    ((0.264, 0, 0), (0, 1, 0, 0)),
    ((-0.245, -0.06, 0), (1, 0, 0, 0)),
    ((-0.074, -0.0395, 0.000025), (1, -1, 1, 1)),
    ((0, 0.0353, 0.0395), (1, -1, 0, 0)),
)
GRASP = ((0, 0, 0.1347), (1, 0, 0, -1))
LEFT_FINGER = ((-0.037, 0.0392, 0.0605), (1, 0, 1, 0))
RIGHT_FINGER = ((0.037, -0.0392, 0.0605), (1, 0, 1, 0))
BASES = (((-0.28, 0, 0), (1, 0, 0, 1)), ((0.28, 0, 0), (1, 0, 0, 1)))


@cache
def published(frame) -> np.ndarray:
    """(4, 4) by rotating the axes with quaternion products, not by the matrix formula."""
    position, quaternion = frame
    q = np.array(quaternion, float) / np.linalg.norm(quaternion)

    def times(a, b):
        real = a[0] * b[0] - a[1:] @ b[1:]
        return np.array([real, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])

    T = np.eye(4)
    for axis in range(3):
        pure = np.zeros(4)
        pure[1 + axis] = 1
        T[:3, axis] = times(times(q, pure), q * (1, -1, -1, -1))[1:]
    T[:3, 3] = position
    return T


def turned(angle: float) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return T


def slid(distance: float) -> np.ndarray:
    T = np.eye(4)
    T[2, 3] = distance
    return T


def wrist(arm: int, joints: np.ndarray) -> np.ndarray:
    T = published(BASES[arm])
    for frame, angle in zip(LINKS, joints[:6], strict=True):
        T = T @ published(frame) @ turned(angle)
    return T


def random_positions(robot: RobotModel, count: int) -> np.ndarray:
    return np.random.default_rng(7).uniform(robot.lower, robot.upper, (count, 14))


def test_tool_poses_equal_the_product_of_the_published_frames(yam):
    positions = random_positions(yam, 1000)
    poses = yam.tool_poses(positions)
    for arm in range(2):
        joints = positions[:, 7 * arm : 7 * arm + 7]
        expected = np.stack([wrist(arm, row) @ published(GRASP) for row in joints])
        np.testing.assert_allclose(poses[arm], expected, atol=1e-6)


def test_every_link_and_the_mirrored_finger_equal_the_published_frames(yam):
    positions = random_positions(yam, 50)
    links = yam.forward_kinematics(positions)
    for arm, side in enumerate(('left', 'right')):
        joints = positions[:, 7 * arm : 7 * arm + 7]
        hands = np.stack([wrist(arm, row) for row in joints])
        lefts = np.stack([published(LEFT_FINGER) @ slid(row[6]) for row in joints])
        rights = np.stack([published(RIGHT_FINGER) @ slid(-row[6]) for row in joints])
        np.testing.assert_allclose(links[f'{side}_link_6'], hands, atol=1e-6)
        np.testing.assert_allclose(links[f'{side}_left_finger'], hands @ lefts, atol=1e-6)
        np.testing.assert_allclose(links[f'{side}_right_finger'], hands @ rights, atol=1e-6)
    np.testing.assert_array_equal(links['base'], np.repeat(np.eye(4)[None], 50, axis=0))


def test_the_tool_is_the_grasp_point_not_the_flange(yam):
    positions = random_positions(yam, 3)
    flange = yam.link_poses('left_link_6', positions)[:, :3, 3]
    tool = yam.tool_poses(positions)[0, :, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(tool - flange, axis=1), 0.1347, atol=1e-9)


def test_the_points_along_an_arm_are_those_of_its_links_and_its_tool(yam):
    positions = np.linspace(yam.lower, yam.upper, 5) * 0.7
    links, tools = yam.forward_kinematics(positions), yam.tool_poses(positions)
    origins = np.stack([poses[:, :3, 3] for poses in links.values()])
    arms = yam.kinematics(positions).arm_points
    assert len(arms) == len(yam.tools)
    for points, tool in zip(arms, tools, strict=True):
        assert points.shape[1:] == (5, 3) and len(points) >= 7
        np.testing.assert_allclose(points[-1], tool[:, :3, 3], atol=1e-12)
        for joint in points[:-1]:  # each joint's origin is that of the link it carries
            assert np.abs(origins - joint).max(axis=(1, 2)).min() < 1e-12
    # the two arms have no joint in common
    assert np.abs(arms[0][:-1, None] - arms[1][None, :-1]).max(axis=(2, 3)).min() > 0.01


def test_limits_and_joint_order_are_the_published_ones(yam):
    assert len(yam.joint_names) == 14
    assert yam.joint_names[6] == 'left_gripper' and yam.joint_names[13] == 'right_gripper'
    lower = [-2.61799, 0, 0, -1.5708, -1.5708, -2.0944, -0.00205]
    upper = [3.05433, 3.66519, 3.66519, 1.5708, 1.5708, 2.0944, 0.037524]
    np.testing.assert_allclose(yam.lower, lower * 2)
    np.testing.assert_allclose(yam.upper, upper * 2)


def test_gripper_openings_run_from_closed_to_open_and_are_clipped(yam):
    positions = np.zeros((4, 14))
    positions[:, 6] = (-0.00205, 0.0, 0.018762, 0.037524)
    positions[:, 13] = (0.037524, 0.05, 0.0, 0.0)
    expected = [[0, 0, 0.5, 1], [1, 1, 0, 0]]
    np.testing.assert_allclose(yam.gripper_openings(positions), expected, atol=1e-12)


def test_results_do_not_change_when_more_are_computed(yam):
    positions = random_positions(yam, 2)
    first = yam.tool_poses(positions)
    kept = first.copy()
    yam.tool_poses(positions[::-1])
    np.testing.assert_array_equal(first, kept)


def test_threads_may_share_a_robot(yam):
    batches = np.split(random_positions(yam, 400), 8)
    expected = [yam.tool_poses(batch) for batch in batches]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(yam.tool_poses, batches))
    np.testing.assert_array_equal(found, expected)


def test_positions_of_another_width_are_refused(yam):
    with pytest.raises(RobotError, match=r'shape \(3, 13\).*\(T, 14\)'):
        yam.tool_poses(np.zeros((3, 13)))


def test_check_positions_names_joint_value_and_limits(yam):
    positions = np.zeros((3, 14))
    check_positions(yam, positions)
    positions[2, 3] = 2.0
    with pytest.raises(
        TrajectoryError, match="'left_joint4' is 2 at point 2, its limits are -1.5708"
    ):
        check_positions(yam, positions)


def test_check_positions_accepts_an_overshoot_within_the_tolerance(yam):
    positions = np.zeros((1, 14))
    positions[0, 1] = -0.0009
    check_positions(yam, positions)
    with pytest.raises(TrajectoryError, match='left_joint2'):
        check_positions(yam, positions, tolerance=1e-4)


@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_check_positions_refuses_what_is_not_finite(yam, value):
    positions = np.zeros((1, 14))
    positions[0, 0] = value
    with pytest.raises(TrajectoryError, match='left_joint1'):
        check_positions(yam, positions)


def test_an_unknown_joint_or_link_names_the_nearest(yam):
    def build(joints=('left_joint1',), link='left_link_6', base='base', gripper=None):
        tool = Tool(arm='left', link=link, T_link_tool=np.eye(4), gripper_joint=gripper)
        return RobotModel(
            name='r', model=yam.pinocchio_model, joint_names=joints, tools=(tool,), base_link=base
        )

    with pytest.raises(RobotError, match="'left_joint_1'.*did you mean 'left_joint1'"):
        build(joints=('left_joint_1',))
    with pytest.raises(RobotError, match="'left_link6'.*did you mean 'left_link_6'"):
        build(link='left_link6')
    with pytest.raises(RobotError, match="no link 'world'"):
        build(base='world')
    with pytest.raises(RobotError, match="opens by 'left_gripper'"):
        build(gripper='left_gripper')
    with pytest.raises(RobotError, match='more than once'):
        build(joints=('left_joint1', 'left_joint1'))


def test_poses_are_given_in_the_base_link(yam):
    positions = random_positions(yam, 5)
    robot = RobotModel(
        name='r', model=yam.pinocchio_model, joint_names=yam.joint_names, tools=yam.tools,
        base_link='left_link_3',
    )  # fmt: skip
    base = yam.link_poses('left_link_3', positions)
    np.testing.assert_allclose(base @ robot.tool_poses(positions)[0],
                               yam.tool_poses(positions)[0], atol=1e-12)  # fmt: skip


def test_a_tool_that_is_no_rigid_pose_is_refused():
    with pytest.raises(RobotError, match="arm 'left'.*not a rigid tool pose"):
        Tool(arm='left', link='l', T_link_tool=np.diag([1, 1, -1, 1]))
    with pytest.raises(RobotError, match='both 0.02'):
        Tool(arm='left', link='l', T_link_tool=np.eye(4), gripper_open=0.02, gripper_closed=0.02)
