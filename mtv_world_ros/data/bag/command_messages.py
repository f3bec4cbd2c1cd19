"""Joint commands in messages of controllers and actions, as JointState or JointTrajectory.

Definitions are those of https://github.com/ros-controls/control_msgs as far as they are read. What
follows them differs between releases, and is not needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag import messages

CONTROLLER_STATE = 'control_msgs/msg/JointTrajectoryControllerState'
FEEDBACK = 'control_msgs/action/FollowJointTrajectory_FeedbackMessage'
#: goals of an action whose service events are recorded
SENT_GOAL = 'control_msgs/action/FollowJointTrajectory_SendGoal_Event'
#: goals of actions of ROS 1
ACTION_GOAL = 'control_msgs/msg/FollowJointTrajectoryActionGoal'
#: positions without names, for forward_command_controller
FLOAT_ARRAY = 'std_msgs/msg/Float64MultiArray'

#: kinds that name their joints, the one that follows a motion most closely first
NAMED_KINDS = (CONTROLLER_STATE, SENT_GOAL, ACTION_GOAL, FEEDBACK)
#: kinds that commands are read from, and the type that each is read as
READ_AS: Mapping[str, str] = {
    CONTROLLER_STATE: messages.JOINT_STATE,
    FEEDBACK: messages.JOINT_STATE,
    FLOAT_ARRAY: messages.JOINT_STATE,
    SENT_GOAL: messages.JOINT_TRAJECTORY,
    ACTION_GOAL: messages.JOINT_TRAJECTORY,
}
#: set point of the controller: `reference`, before Humble `desired`, at the same place
_STATE = """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
"""
_DEFINITIONS = {
    CONTROLLER_STATE: _STATE,
    FEEDBACK: f'uint8[16] goal_id\n{_STATE}',
    SENT_GOAL: """service_msgs/ServiceEventInfo info
mtv_world/SentGoal[] request
""",
    ACTION_GOAL: """std_msgs/Header header
builtin_interfaces/Time goal_stamp
string goal_id
trajectory_msgs/JointTrajectory trajectory
""",
}
_SENT_GOAL = 'uint8[16] goal_id\ntrajectory_msgs/JointTrajectory trajectory\n'


def own_name(msgtype: str) -> str:
    """Return the name that the beginning of a message has in the store of beginnings."""
    return f'mtv_world/msg/{msgtype.rpartition("/")[2].replace("_", "")}'


@cache
def command_store() -> Typestore:
    """Definitions of the part of each message that is read."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(_SENT_GOAL, 'mtv_world/msg/SentGoal'))
    for msgtype, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, own_name(msgtype)))
    return store


class CommandReader:
    """Reader of the commands of one topic.

    Args:
        joints: names of the values of a Float64MultiArray.
    """

    def __init__(self, joints: Sequence[str] = ()) -> None:
        self._joints = joints
        self._goals: set[bytes] = set()

    def read(self, msgtype: str, data: bytes) -> Any:
        """Return a JointState or JointTrajectory, see `READ_AS`; None = it holds no new command.

        Raises:
            EpisodeError: the bytes do not hold such a message, or its values have no names.
        """
        if msgtype == FLOAT_ARRAY:
            return self._named(messages.deserialize(msgtype, data).data)
        found = messages.deserialize_as(command_store(), own_name(msgtype), msgtype, data)
        if msgtype == SENT_GOAL:  # client and server each record a goal
            new = [goal for goal in found.request if bytes(goal.goal_id) not in self._goals]
            self._goals |= {bytes(goal.goal_id) for goal in new}
            return new[0].trajectory if new else None
        if msgtype == ACTION_GOAL:
            return found.trajectory
        stamp = messages.header_stamp(found)
        return messages.make_joint_state(stamp, found.joint_names, found.reference.positions)

    def _named(self, values: Sequence[float]) -> Any:
        if len(values) != len(self._joints):
            names = ', '.join(self._joints) or 'none'
            raise EpisodeError(
                f"its messages have {len(values)} values; 'action_joints' in the mapping must "
                f"name as many, in the order of the controller's 'joints', and has: {names}"
            )
        return messages.make_joint_state(0, self._joints, values)


def command_topics(types: Mapping[str, str]) -> tuple[str, ...]:
    """Return the topics whose commands name their joints, of the kind that is preferred."""
    for kind in NAMED_KINDS:
        if topics := tuple(topic for topic, found in types.items() if found == kind):
            return topics
    return ()
