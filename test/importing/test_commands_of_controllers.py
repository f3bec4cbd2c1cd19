"""Commands in states of controllers, goals and feedback of actions, and numbers without names.

Bags are written by rosbags with the whole definitions of control_msgs, of several releases.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
import yaml

from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.episode_reader import read_episode
from test.support.robot_recordings import events, JOINTS, ns, plan, positions, RATE, SECONDS

POINT = 'trajectory_msgs/JointTrajectoryPoint'
MULTI = 'trajectory_msgs/MultiDOFJointTrajectoryPoint'
STATE = 'control_msgs/msg/JointTrajectoryControllerState'
FEEDBACK = 'control_msgs/action/FollowJointTrajectory_FeedbackMessage'
EVENT = 'control_msgs/action/FollowJointTrajectory_SendGoal_Event'
ARRAY = 'std_msgs/msg/Float64MultiArray'
#: before Humble, and today
OLD_STATE = (
    f'std_msgs/Header header\nstring[] joint_names\n{POINT} desired\n{POINT} actual\n'
    f'{POINT} error\n'
)
NEW_STATE = (
    f'std_msgs/Header header\nstring[] joint_names\n{POINT} reference\n{POINT} feedback\n'
    f'{POINT} error\n{POINT} output\nstring[] multi_dof_joint_names\n{MULTI} multi_dof_reference\n'
    f'{MULTI} multi_dof_feedback\n{MULTI} multi_dof_error\n{MULTI} multi_dof_output\n'
    'float64 speed_scaling_factor\n'
)
#: joints are commanded this long before they are there [s]
AHEAD = 0.1


def store() -> Any:
    made = get_typestore(Stores.ROS2_JAZZY)
    made.register(get_types_from_msg('uint8[16] uuid\n', 'unique_identifier_msgs/msg/UUID'))
    return made


def numbers(values: Any = ()) -> np.ndarray:
    return np.array(values, np.float64)


def point(types: Any, values: Any = (), seconds: float = 0.0) -> Any:
    duration = types['builtin_interfaces/msg/Duration'](
        sec=int(seconds), nanosec=round(seconds % 1 * 1e9)
    )
    return types['trajectory_msgs/msg/JointTrajectoryPoint'](
        positions=numbers(values), velocities=numbers(), accelerations=numbers(),
        effort=numbers(), time_from_start=duration,
    )  # fmt: skip


def multi(types: Any) -> Any:
    duration = types['builtin_interfaces/msg/Duration'](sec=0, nanosec=0)
    return types['trajectory_msgs/msg/MultiDOFJointTrajectoryPoint'](
        transforms=[], velocities=[], accelerations=[], time_from_start=duration
    )


Make = Callable[[Any], list[tuple[float, str, str, Any]]]


def write(path: Path, definitions: dict[str, str], make: Make) -> Path:
    """A recording of `robot_recordings` whose commands are the messages that `make` returns."""
    types = store()
    for name, text in definitions.items():
        types.register(get_types_from_msg(text, name))
    told = [
        (t, topic, kind, messages.serialize(kind, message))
        for t, topic, kind, message in events()
        if topic != '/joint_trajectory'
    ]
    told += [
        (t, topic, kind, bytes(types.serialize_cdr(message, kind)))
        for t, topic, kind, message in make(types.types)
    ]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics: dict[str, Any] = {}
        for t, topic, kind, data in sorted(told, key=lambda each: each[0]):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=types)
            writer.write(topics[topic], ns(t), data)
    return path


def times() -> list[float]:
    return [k / RATE + 0.001 for k in range(round(SECONDS * RATE))]


def states(text: str, parts: dict[str, list[int]], kind: str = STATE) -> Make:
    """States of controllers, by namespace with the joints that each commands."""
    first = 'reference' if 'reference' in text else 'desired'

    def make(types: Any) -> list[tuple[float, str, str, Any]]:
        def message(t: float, at: list[int]) -> Any:
            values: dict[str, Any] = {
                'header': types['std_msgs/msg/Header'](
                    stamp=types['builtin_interfaces/msg/Time'](
                        sec=ns(t) // 10**9, nanosec=ns(t) % 10**9
                    ),
                    frame_id='',
                ),
                'joint_names': [JOINTS[k] for k in at],
            }
            for line in text.splitlines()[2:]:
                field, name = line.split()
                values[name] = (
                    point(types, positions(t + AHEAD)[at]) if name == first
                    else point(types) if field == POINT
                    else multi(types) if field == MULTI
                    else [] if field == 'string[]' else 1.0
                )  # fmt: skip
            return types[kind](**values)

        return [(t, topic, kind, message(t, at)) for t in times() for topic, at in parts.items()]

    return make


def led(bag: Path, **mapping: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the commanded and the right positions of an imported recording, over time."""
    episode = read_episode(bag)
    found, right = [], []
    for start, trajectory in episode.trajectories:
        names = list(trajectory.joint_names)
        for seconds, row in zip(trajectory.times, trajectory.positions, strict=True):
            t = (start - ns(0.0)) / 1e9 + float(seconds)
            found.append([row[names.index(name)] for name in JOINTS])
            right.append(positions(t + AHEAD))
    return np.array(found), np.array(right)


ALL = list(range(8))


@pytest.mark.parametrize('text', [OLD_STATE, NEW_STATE], ids=['before Humble', 'today'])
def test_reference_of_a_controller_is_the_command(tmp_path, run, text):
    bag = write(tmp_path / 'bag', {STATE: text}, states(text, {'/arm/controller_state': ALL}))
    status, said = run(bag)
    assert status == 0, said
    assert "there is no '/joint_trajectory': commands are those of /arm/controller_state" in said
    found, right = led(tmp_path / 'out/bag')
    assert len(found) > 150
    np.testing.assert_allclose(found, right, atol=1e-6)


def test_arm_and_gripper_of_two_controllers_are_both_commanded(tmp_path, run):
    parts = {'/arm/controller_state': ALL[:7], '/hand/controller_state': [7]}
    bag = write(tmp_path / 'bag', {STATE: NEW_STATE}, states(NEW_STATE, parts))
    assert run(bag)[0] == 0
    found, right = led(tmp_path / 'out/bag')
    np.testing.assert_allclose(found, right, atol=0.02)  # the hand's row holds the arm's last one


def test_joints_that_a_controller_leaves_out_have_their_measured_positions(tmp_path, run):
    bag = write(tmp_path / 'bag', {STATE: NEW_STATE}, states(NEW_STATE, {'/arm/state': ALL[:7]}))
    status, said = run(bag, action='/arm/state')
    assert status == 0
    assert 'trajectories leave out joints panda_finger_joint1' in said
    found, right = led(tmp_path / 'out/bag')
    np.testing.assert_allclose(found[:, :7], right[:, :7], atol=2e-3)  # interpolated


def test_feedback_of_the_action_is_read_where_there_is_nothing_better(tmp_path, run):
    text = f'uint8[16] goal_id\n{OLD_STATE}'

    def make(types: Any) -> list[tuple[float, str, str, Any]]:
        plain = states(OLD_STATE, {'/c/follow_joint_trajectory/_action/feedback': ALL})(types)
        return [
            (t, topic, FEEDBACK, types[FEEDBACK](
                goal_id=np.ones(16, np.uint8),
                **{name: getattr(message, name) for name in
                   ('header', 'joint_names', 'desired', 'actual', 'error')},
            ))
            for t, topic, _, message in plain
        ]  # fmt: skip

    bag = write(tmp_path / 'bag', {STATE: OLD_STATE, FEEDBACK: text}, make)
    assert run(bag)[0] == 0
    found, right = led(tmp_path / 'out/bag')
    np.testing.assert_allclose(found, right, atol=1e-6)


def test_recorded_goals_of_the_action_are_plans_each_once(tmp_path, run):
    definitions = {
        'control_msgs/msg/Goal': 'trajectory_msgs/JointTrajectory trajectory\n'
        'float64[] path_tolerance\nbuiltin_interfaces/Duration goal_time_tolerance\n',
        'control_msgs/msg/Request': 'unique_identifier_msgs/UUID goal_id\n'
        'control_msgs/Goal goal\n',
        'control_msgs/msg/Response': 'bool accepted\nbuiltin_interfaces/Time stamp\n',
        EVENT: 'service_msgs/ServiceEventInfo info\ncontrol_msgs/Request[] request\n'
        'control_msgs/Response[] response\n',
    }

    def make(types: Any) -> list[tuple[float, str, str, Any]]:
        found = []
        for k in range(round(SECONDS)):
            told = plan(k + 0.004)
            trajectory = types['trajectory_msgs/msg/JointTrajectory'](
                header=types['std_msgs/msg/Header'](
                    stamp=types['builtin_interfaces/msg/Time'](sec=0, nanosec=0), frame_id=''
                ),
                joint_names=list(told.joint_names),
                points=[
                    point(types, each.positions, (j + 1) / 10)
                    for j, each in enumerate(told.points)
                ],
            )
            goal = types['control_msgs/msg/Goal'](
                trajectory=trajectory, path_tolerance=numbers(),
                goal_time_tolerance=types['builtin_interfaces/msg/Duration'](sec=0, nanosec=0),
            )  # fmt: skip
            uuid = types['unique_identifier_msgs/msg/UUID'](uuid=np.full(16, k, np.uint8))
            request = types['control_msgs/msg/Request'](goal_id=uuid, goal=goal)
            time = types['builtin_interfaces/msg/Time'](sec=ns(k) // 10**9, nanosec=0)
            for event, requests in ((0, [request]), (1, [request]), (2, []), (3, [])):
                information = types['service_msgs/msg/ServiceEventInfo'](
                    event_type=event, stamp=time, client_gid=np.zeros(16, np.uint8),
                    sequence_number=k,
                )  # fmt: skip
                message = types[EVENT](info=information, request=requests, response=[])
                topic = '/c/follow_joint_trajectory/_action/send_goal/_service_event'
                found.append((k + 0.004 + event * 1e-3, topic, EVENT, message))
        return found

    bag = write(tmp_path / 'bag', definitions, make)
    status, said = run(bag)
    assert status == 0, said
    plans = read_episode(tmp_path / 'out/bag').trajectories
    assert [stamp for stamp, _ in plans] == [ns(k + 0.004) for k in range(4)]
    np.testing.assert_allclose(plans[1][1].positions[4], positions(1.504), atol=1e-6)


def arrays(types: Any) -> list[tuple[float, str, str, Any]]:
    layout = types['std_msgs/msg/MultiArrayLayout'](dim=[], data_offset=0)
    backwards = ALL[::-1]
    return [
        (t, '/forward/commands', ARRAY,
         types[ARRAY](layout=layout, data=positions(t + AHEAD)[backwards]))
        for t in times()
    ]  # fmt: skip


def test_numbers_without_names_are_refused_and_the_advice_works(tmp_path, run):
    bag = write(tmp_path / 'bag', {}, arrays)
    status, said = run(bag)
    assert status == 1
    assert "'action: /forward/commands' in the mapping (--topics), 'action_joints' names" in said
    status, said = run(bag, action='/forward/commands')
    assert status == 1
    assert "have 8 values; 'action_joints' in the mapping must name as many" in said
    status, said = run(bag, action='/forward/commands', action_joints=JOINTS[::-1])
    assert status == 0, said
    found, right = led(tmp_path / 'out/bag')
    np.testing.assert_allclose(found, right, atol=2e-3)  # stamped when they are received


def test_commands_that_are_not_taken_are_named(tmp_path, run):
    bag = write(tmp_path / 'bag', {}, arrays)
    status, said = run(bag, action='state')
    assert status == 0
    assert "/forward/commands (commands; 'action: state' takes the measured" in said
    saved = yaml.safe_load((tmp_path / 'out/mapping.yaml').read_text())
    assert saved['action'] == 'state'
