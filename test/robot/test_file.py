from pathlib import Path

import numpy as np
import pytest
import yaml

from mtv_world_ros.cli.robot import describe
from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import ConfigError, RobotError, TrajectoryError
from mtv_world_ros.importing.convert import joints_too_fast
from mtv_world_ros.robot.file import described_robot, load_robot, robot_path, save_robot
from mtv_world_ros.robot.plan_limits import check_speeds

PLANAR = """<robot name="two">
  <link name="root"/><link name="upper"/><link name="lower"/><link name="finger"/>
  <joint name="shoulder" type="continuous"><parent link="root"/><child link="upper"/>
    <origin xyz="0 0 1"/><axis xyz="0 0 1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
    <origin xyz="2 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" effort="1" velocity="3"/></joint>
  <joint name="follower" type="prismatic"><parent link="lower"/><child link="finger"/>
    <axis xyz="0 0 1"/><mimic joint="elbow" multiplier="-0.5" offset="0.1"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
</robot>"""


def write(folder: Path, values: dict, urdf: str = PLANAR) -> Path:
    (folder / 'two.urdf').write_text(urdf)
    path = folder / 'robot.yaml'
    path.write_text(yaml.safe_dump(values))
    return path


def planar(**changes) -> dict:
    tool = {'arm': 'only', 'link': 'lower', 'position': [1.0, 0.0, 0.0]}
    return {'name': 'two', 'urdf': 'two.urdf', 'tools': [tool]} | changes


def dh_arm(rows, **changes) -> dict:
    keys = ('joint', 'a', 'alpha', 'd', 'theta', 'type', 'lower', 'upper')
    return {'arm': 'only', 'joints': [dict(zip(keys, row, strict=True)) for row in rows]} | changes


def dh_robot(arm: dict, link: str) -> dict:
    return {'name': 'dh', 'dh': [arm], 'tools': [{'arm': 'only', 'link': link}]}


def rx(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def rz(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def shift(x, z):
    T = np.eye(4)
    T[0, 3], T[2, 3] = x, z
    return T


@pytest.mark.parametrize('convention', ['standard', 'modified'])
def test_a_dh_table_gives_the_product_of_its_matrices(tmp_path, convention):
    generator = np.random.default_rng(1)
    for _ in range(10):
        rows = [
            (f'j{i}', *map(float, generator.uniform(-1, 1, 4)),
             'prismatic' if generator.random() < 0.3 else 'revolute', -3.0, 3.0)
            for i in range(6)
        ]  # fmt: skip
        arm = dh_arm(rows, convention=convention, position=[0.1, 0.2, 0.3],
                     quaternion_xyzw=[0, 0, 1, 1])  # fmt: skip
        robot = load_robot(write(tmp_path, dh_robot(arm, 'j5_link')))
        positions = generator.uniform(-3, 3, (100, 6))
        poses = robot.tool_poses(positions)[0]
        for pose, values in zip(poses, positions, strict=True):
            expected = rz(np.pi / 2)
            expected[:3, 3] = 0.1, 0.2, 0.3
            for (_, a, alpha, d, theta, kind, *_), value in zip(rows, values, strict=True):
                theta, d = (theta, d + value) if kind == 'prismatic' else (theta + value, d)
                if convention == 'standard':
                    expected = expected @ rz(theta) @ shift(0, d) @ shift(a, 0) @ rx(alpha)
                else:
                    expected = expected @ rx(alpha) @ shift(a, 0) @ rz(theta) @ shift(0, d)
            np.testing.assert_allclose(pose, expected, atol=1e-6)


def test_two_dh_arms_with_grippers_make_one_model(tmp_path):
    def arm(side, x):
        row = {'joint': f'{side}_1', 'a': 0.5, 'alpha': 0, 'd': 0.1, 'lower': -3, 'upper': 3}
        grip = {'joint': f'{side}_grip', 'lower': 0.0, 'upper': 0.04}
        return {'arm': side, 'position': [x, 0, 0], 'joints': [row], 'gripper': grip}

    tools = [
        {'arm': side, 'link': f'{side}_1_link', 'gripper_joint': f'{side}_grip',
         'gripper_open': 0.04} for side in ('a', 'b')
    ]  # fmt: skip
    values = {'name': 'dh', 'dh': [arm('a', -1.0), arm('b', 1.0)], 'tools': tools}
    robot = load_robot(write(tmp_path, values))
    assert robot.joint_names == ('a_1', 'a_grip', 'b_1', 'b_grip')
    positions = np.array([[0.0, 0.01, np.pi / 2, 0.04]])
    points = robot.tool_poses(positions)[:, 0, :3, 3]
    np.testing.assert_allclose(points, [[-0.5, 0, 0.1], [1, 0.5, 0.1]], atol=1e-12)
    np.testing.assert_allclose(robot.gripper_openings(positions), [[0.25], [1.0]])


def test_a_urdf_with_continuous_and_mimic_joints(tmp_path):
    robot = load_robot(write(tmp_path, planar()))
    assert robot.base_link == 'root'
    assert robot.joint_names == ('shoulder', 'elbow')
    np.testing.assert_array_equal(robot.lower, [-np.inf, -1])
    np.testing.assert_array_equal(robot.upper, [np.inf, 2])
    positions = np.array([[7.5, 0.4]])
    elbow = np.array([2 * np.cos(7.5), 2 * np.sin(7.5), 1])
    ahead = np.array([np.cos(7.5) * np.cos(0.4), np.sin(7.5) * np.cos(0.4), -np.sin(0.4)])
    np.testing.assert_allclose(robot.tool_poses(positions)[0, 0, :3, 3], elbow + ahead, atol=1e-9)
    lower, finger = (robot.link_poses(link, positions)[0] for link in ('lower', 'finger'))
    np.testing.assert_allclose(finger[:3, 3], lower[:3, 3] - 0.1 * lower[:3, 2], atol=1e-9)


def test_a_speed_limit_of_zero_is_none_everywhere(tmp_path):
    urdf = PLANAR.replace('effort="1" velocity="3"', 'effort="1" velocity="0"')
    given = load_robot(write(tmp_path, planar()))
    robot = load_robot(write(tmp_path, planar(), urdf))
    assert given.velocity_limits[1] == 3.0 and robot.velocity_limits[1] == np.inf
    live, _ = described_robot(given, urdf)  # as from /robot_description
    assert live.velocity_limits[1] == np.inf
    assert 'joint elbow: -1 .. 2, no speed limit given' in describe(robot)
    # 2 rad/s in the elbow
    plan = JointTrajectory(
        joint_names=robot.joint_names,
        times=np.array([0.1, 0.2, 0.3]),
        positions=np.array([[0, 0.2], [0, 0.4], [0, 0.6]]),
    )
    check_speeds(robot, plan, np.zeros(2))
    assert joints_too_fast([plan], robot) == []
    fast = JointTrajectory(
        joint_names=robot.joint_names,
        times=np.array([0.1, 0.12]),
        positions=np.array([[0, 0.2], [0, 0.9]]),
    )
    with pytest.raises(TrajectoryError, match='elbow'):
        check_speeds(robot, fast, np.zeros(2))
    (said,) = joints_too_fast([fast], robot)
    assert said.startswith("commands of joint 'elbow' jump 1 times (over 2 times 10 a second")


def test_speed_limits_of_the_robot_file_stand_in_for_those_of_the_description(tmp_path):
    robot = load_robot(write(tmp_path, planar(speed_limits={'elbow': 7.5})))
    np.testing.assert_array_equal(robot.velocity_limits, [np.inf, 7.5])
    live, _ = described_robot(robot, PLANAR)  # as from /robot_description
    assert live.velocity_limits[1] == 7.5
    saved = save_robot(robot.file, tmp_path / 'copy')
    assert load_robot(saved.file).velocity_limits[1] == 7.5
    with pytest.raises(RobotError, match="names 'elbo', which is .*did you mean 'elbow'"):
        load_robot(write(tmp_path, planar(speed_limits={'elbo': 7.5})))
    with pytest.raises(ConfigError, match='speed_limits'):
        load_robot(write(tmp_path, planar(speed_limits={'elbow': 0})))


def test_joints_take_the_order_of_the_file(tmp_path):
    robot = load_robot(write(tmp_path, planar(joints=['elbow', 'shoulder'])))
    swapped = load_robot(write(tmp_path, planar()))
    np.testing.assert_array_equal(
        robot.tool_poses(np.array([[0.3, 1.2]])), swapped.tool_poses(np.array([[1.2, 0.3]]))
    )


def test_mimics_may_stand_in_the_robot_file(tmp_path):
    urdf = PLANAR.replace('<mimic joint="elbow" multiplier="-0.5" offset="0.1"/>', '')
    mimic = {'joint': 'follower', 'source': 'elbow', 'multiplier': -0.5, 'offset': 0.1}
    robot = load_robot(write(tmp_path, planar(mimic=[mimic]), urdf))
    here = robot.link_poses('finger', np.array([[1.0, 0.6]]))
    there = load_robot(write(tmp_path, planar())).link_poses('finger', np.array([[1.0, 0.6]]))
    np.testing.assert_array_equal(here, there)


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'tool': []}, "unknown key 'tool'.*did you mean 'tools'"),
        ({'dh': []}, "either 'urdf' or 'dh'"),
        ({'urdf': 'none.urdf'}, "none.urdf' does not exist; 'urdf' is relative"),
        ({'tools': {'arm': 'only'}}, "'tools' must be a list"),
        ({'tools': [{'arm': 'only'}]}, "'link' is missing"),
        (
            {'tools': [{'arm': 'only', 'link': 'lower', 'position': [1]}]},
            'no position',
        ),
        ({'tools': [{'arm': 'a', 'link': 'lower', 'quaternion_xyzw': [0] * 4}]}, 'no quaternion'),
        ({'tools': [{'arm': 'a', 'link': 'lower', 'gripper_open': 'wide'}]}, "'gripper_open' is"),
    ],
)
def test_wrong_values_are_config_errors(tmp_path, changes, message):
    with pytest.raises(ConfigError, match=message):
        load_robot(write(tmp_path, planar(**changes)))


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'joints': ['sholder', 'elbow']}, "no joint 'sholder'.*did you mean 'shoulder'"),
        ({'base_link': 'world'}, "no link 'world'"),
        ({'joints': ['shoulder', 'elbow', 'follower']}, "'follower'.*follows 'elbow'"),
        ({'joints': ['shoulder']}, "'elbow', which is not among the joints"),
    ],
)
def test_what_does_not_fit_the_urdf_is_a_robot_error(tmp_path, changes, message):
    with pytest.raises(RobotError, match=message):
        load_robot(write(tmp_path, planar(**changes)))


def test_broken_files_are_named(tmp_path):
    with pytest.raises(RobotError, match=r"two.urdf' cannot be used"):
        load_robot(write(tmp_path, planar(), '<robot name="two"><link'))
    with pytest.raises(ConfigError, match='does not exist'):
        load_robot(tmp_path / 'other.yaml')
    path = tmp_path / 'robot.yaml'
    path.write_text('name: [')
    with pytest.raises(ConfigError, match='not valid YAML'):
        load_robot(path)


@pytest.mark.parametrize(
    ('row', 'message'),
    [
        ({'type': 'screw'}, "'type' is 'screw'; valid are revolute, prismatic"),
        ({'lower': 4}, 'lower 4.0 is not below 3.0'),
        ({'alfa': 1}, "unknown key 'alfa'.*did you mean 'alpha'"),
        ({'a': float('nan')}, "'a' is nan"),
    ],
)
def test_wrong_dh_rows_are_named(tmp_path, row, message):
    arm = dh_arm([('j0', 0.1, 0.0, 0.0, 0.0, 'revolute', -3, 3)])
    arm['joints'][0].update(row)
    with pytest.raises(ConfigError, match=message):
        load_robot(write(tmp_path, dh_robot(arm, 'j0_link')))


def test_a_name_that_no_file_system_takes_is_no_robot():
    with pytest.raises(ConfigError, match='is not in config/robots'):
        robot_path('x' * 300)
    with pytest.raises(ConfigError, match='does not exist'):
        robot_path('x' * 300 + '.yaml')
