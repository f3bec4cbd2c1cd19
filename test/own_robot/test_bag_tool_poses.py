"""`mtv-world import bag` of recordings whose commands are poses of the tool."""

import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.transforms import quaternion
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.episode_reader import read_episode
from test.support.bags import Bag, bag_cameras, grey_frames, MAPPING, record
from test.support.crane import FPS, make_positions, START_NS

NUM = 20


@pytest.fixture(scope='module')
def positions():
    return make_positions(NUM / FPS)[:NUM]


def stamp_of(k):
    return START_NS + round(k * 1e9 / FPS)


def poses_of(poses, frame='plinth'):
    """Write geometry_msgs/PoseStamped of (N, 4, 4)."""
    kind = messages.POSE_STAMPED

    def write(bag: Bag) -> None:
        for k, T in enumerate(poses):
            x, y, z, w = (float(v) for v in quaternion(T[:3, :3]))
            place = dict(zip('xyz', T[:3, 3].tolist(), strict=True))
            pose = messages.make(
                'geometry_msgs/msg/Pose',
                position=messages.make('geometry_msgs/msg/Point', **place),
                orientation=messages.make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
            )
            header = messages.make_header(stamp_of(k), frame)
            message = messages.make(kind, header=header, pose=pose)
            bag.write('/cell/target', kind, stamp_of(k), message)

    return write


def run(folder, robot, positions, more, **tool):
    frames = grey_frames(NUM)
    bag = record(folder / 'wave', robot, bag_cameras(), positions, frames=frames, more=more)
    mapping = {**MAPPING, 'tools': {'arm': {'topic': 'target', **tool}}}
    (folder / 'bag.yaml').write_text(yaml.safe_dump(mapping))
    command = ['import', 'bag', str(bag), '--topics', str(folder / 'bag.yaml')]
    status = main([*command, '--robot', str(robot.file), '--out', str(folder / 'out')])
    return status, folder / 'out' / 'wave'


def commands(path, robot):
    """(N,) stamps and (N, 4, 4) tool poses that the episode commands, and the jaw's commands."""
    stamps, rows = [], []
    for start, trajectory in read_episode(path).trajectories:
        assert trajectory.joint_names == robot.joint_names
        stamps += (start + (trajectory.times * 1e9).round().astype(int)).tolist()
        rows += trajectory.positions.tolist()
    rows = np.array(rows)
    return np.array(stamps), robot.tool_poses(rows)[0], rows[:, -1]


def test_poses_of_the_tool_become_joints_reached_at_their_stamps(
    robot, positions, tmp_path, capsys
):
    wanted = robot.tool_poses(positions)[0]
    ahead = np.roll(wanted, -1, axis=0)  # where it is one step later
    status, path = run(tmp_path, robot, positions, poses_of(ahead[: NUM - 1]))
    assert status == 0, capsys.readouterr().err
    stamps, poses, jaw = commands(path, robot)
    np.testing.assert_array_equal(stamps, [stamp_of(k) for k in range(1, NUM - 1)])
    np.testing.assert_allclose(poses, ahead[1 : NUM - 1], atol=3e-3)
    np.testing.assert_allclose(jaw, positions[1 : NUM - 1, -1], atol=1e-6)


@pytest.mark.parametrize('axes', ['fixed', 'tool'])
def test_differences_are_added_to_what_is_measured_and_reached_at_the_next_stamp(
    robot, positions, tmp_path, capsys, axes
):
    now = robot.tool_poses(positions)[0]
    after = np.roll(now, -1, axis=0)
    change = np.linalg.inv(now) @ after
    if axes == 'fixed':
        change[:, :3, :3] = after[:, :3, :3] @ now[:, :3, :3].transpose(0, 2, 1)
        change[:, :3, 3] = after[:, :3, 3] - now[:, :3, 3]
    change = change[: NUM - 1]
    change[:, :3, 3] /= 0.05
    status, path = run(
        tmp_path, robot, positions, poses_of(change, ''), difference=axes, scale=[0.05, 1.0]
    )
    assert status == 0, capsys.readouterr().err
    stamps, poses, _ = commands(path, robot)
    expected = [now[round((s - START_NS) * FPS / 1e9)] for s in stamps]
    np.testing.assert_allclose(poses, expected, atol=3e-3)


def test_what_is_out_of_reach_is_counted_and_named(robot, positions, tmp_path, capsys):
    wanted = robot.tool_poses(positions)[0]
    wanted[4, :3, 3] += 5
    status, path = run(tmp_path, robot, positions, poses_of(wanted))
    printed = capsys.readouterr()
    assert status == 0 and "arm 'arm': 1 of 20 poses are out of reach" in printed.err
    _, poses, _ = commands(path, robot)
    np.testing.assert_allclose(poses[5:], wanted[6:], atol=3e-3)


@pytest.mark.parametrize(
    ('frame', 'tool', 'message'),
    [
        ('map', {}, "the poses at '/cell/target' are in frame 'map', which is no link"),
        ('plinth', {'topic': 'goal'}, 'its topics of PoseStamped are /cell/target'),
        ('plinth', {'link': 'hnad'}, "no link 'hnad' (did you mean 'hand'?)"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_the_poses_is_named(
    robot, positions, tmp_path, capsys, frame, tool, message
):
    wanted = robot.tool_poses(positions)[0]
    status, _ = run(tmp_path, robot, positions, poses_of(wanted, frame), **tool)
    assert status == 1 and message in capsys.readouterr().err
