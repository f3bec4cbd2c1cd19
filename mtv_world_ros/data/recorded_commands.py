"""Commands of a recorded episode: trajectories, leaders' joint states, tool poses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import FloatArray, JointTrajectory
from mtv_world_ros.core.errors import (
    EpisodeError,
)
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.command_messages import (
    command_topics,
    FLOAT_ARRAY,
    READ_AS,
)
from mtv_world_ros.data.bag_mapping import STATE, ToolTopic
from mtv_world_ros.data.episode import (
    JointStates,
)
from mtv_world_ros.data.episode_topics import listed
from mtv_world_ros.data.joint_plans import (
    complete_plans,
    hold_at_stops,
    join_streams,
    read_plan,
    trajectories_to,
)
from mtv_world_ros.data.measured_joints import merge_joint_states
from mtv_world_ros.data.recorded_streams import RecordedStreams, Stamped
from mtv_world_ros.data.tool_targets import joints_of_tools, ToolTrack
from mtv_world_ros.robot.model import RobotModel


class RecordedCommands:
    """Plans of a recording, with all joints of the robot.

    Args:
        streams: messages of the recording.
        robot: robot whose joints the plans are completed to; None = they stay as recorded.
        seen_ns: time from which all views have an image [ns].
    """

    def __init__(self, streams: RecordedStreams, robot: RobotModel | None, seen_ns: int) -> None:
        self.streams, self.robot, self.seen_ns = streams, robot, seen_ns
        self.path, self.mapping = streams.path, streams.mapping

    def trajectories(self, states: JointStates | None) -> Stamped:
        """Return the plans and their stamps [ns]; `states` fill in what they leave out."""
        others = self._joint_commands(states)
        if not self.mapping.tools or states is None or self.robot is None:
            return others
        targets = {
            arm: self._tool_poses(arm, tool, self.robot)
            for arm, tool in self.mapping.tools.items()
        }
        try:
            led, warnings = joints_of_tools(targets, self.robot, states, others)
        except ValueError as error:
            raise EpisodeError(f"'{self.path}': {error}") from error
        self.streams.warnings += warnings
        return trajectories_to(led, self.mapping.chunk_s, self.seen_ns)

    def _tool_poses(self, arm: str, tool: ToolTopic, robot: RobotModel) -> ToolTrack:
        topic = self.mapping.topic(tool.topic)
        ordered = self.streams.parsed(topic, messages.POSE_STAMPED, _framed_pose)
        if not ordered:
            raise EpisodeError(
                f"'{self.path}' has no poses of arm '{arm}' at '{topic}'; its topics of "
                f'PoseStamped are {listed(self.streams.topics_of(messages.POSE_STAMPED))}'
            )
        frames = {frame.lstrip('/').removeprefix(self.mapping.tf_prefix)
                  for _, (frame, _) in ordered}  # fmt: skip
        if not tool.frame and frames != {''}:
            unknown = sorted(frames - set(robot.link_names))
            if unknown or len(frames) > 1:
                raise EpisodeError(
                    f"'{self.path}': the poses at '{topic}' are in frame "
                    f"'{(unknown or sorted(frames))[0]}', which is no link of robot "
                    f"'{robot.name}' or not the only one; name the link in `tools: {arm}: frame`"
                )
            tool = tool.replace(frame=frames.pop())
        return ToolTrack(
            tool,
            np.array([stamp for stamp, _ in ordered], np.int64),
            np.stack([pose for _, (_, pose) in ordered]),
        )

    def _joint_commands(self, states: JointStates | None) -> Stamped:
        topics = self.streams.command_topics
        topic = ', '.join(topics)
        if self.mapping.action == STATE:
            return (
                []
                if states is None
                else trajectories_to(states, self.mapping.chunk_s, self.seen_ns)
            )
        kind = self.streams.types.get(topics[0], '')
        if READ_AS.get(kind, kind) == messages.JOINT_STATE:
            taken = [
                item for one in topics for item in self.streams.take(one, messages.JOINT_STATE)
            ]
            leader = merge_joint_states(
                topic, taken, self.streams.warnings, renamed=self.streams.renamed
            )
            if leader is None:
                return []
            led = trajectories_to(leader, self.mapping.chunk_s, self.seen_ns)
            return self._completed(topic, led, states)
        plan = self._plan if states is None else self._plan_or_stop
        plans = sorted(
            (
                item
                for one in topics
                for item in self.streams.parsed(one, messages.JOINT_TRAJECTORY, plan)
            ),
            key=lambda item: item[0],
        )
        if states is not None:
            plans, count = hold_at_stops(plans, states)
            if count:
                self.streams.warn_once(
                    f"'{topic}': {count} empty trajectories stop the plans before them; the "
                    'measured positions are held from then on, until the next plan'
                )
        if topics[0] not in self.streams.types:
            self._warn_of_other_commands(topic)
        return self._whole_plans(topic, plans, states)

    def _warn_of_other_commands(self, topic: str) -> None:
        """Name the topics that have commands where the one of the mapping has none."""
        others = self.streams.topics_of(messages.JOINT_TRAJECTORY) or list(
            command_topics(self.streams.types)
        )
        if others:
            self.streams.warn_once(
                f"no trajectories at '{topic}'; there are some at {listed(others)}"
            )
        if arrays := self.streams.topics_of(FLOAT_ARRAY):
            self.streams.warn_once(
                f"no trajectories at '{topic}'; {listed(arrays)} has values without names: with "
                f"'action: {arrays[0]}' in the mapping (--topics), 'action_joints' names them in "
                "the order of the controller's 'joints'"
            )

    def _plan_or_stop(self, message: Any) -> JointTrajectory | tuple[str, ...]:
        """Return a plan, or the joints that an empty trajectory stops; empty = all."""
        if not len(message.points):
            return self.streams.renamed(message.joint_names)
        return self._plan(message)

    def _plan(self, message: Any) -> JointTrajectory:
        plan = read_plan(message)
        return replace(plan, joint_names=self.streams.renamed(plan.joint_names))

    def _whole_plans(self, topic: str, plans: Stamped, states: JointStates | None) -> Stamped:
        """Return the plans of all joints of the robot; those of one point are joined."""
        chunk_s = self.mapping.chunk_s
        plans, count = join_streams(plans, chunk_s)
        if count:
            self.streams.warn_once(
                f"'{topic}': {count} trajectories of one point are a stream of commands and were "
                f'joined into plans of {chunk_s:g} s'
            )
        return self._completed(topic, plans, states)

    def _completed(self, topic: str, plans: Stamped, states: JointStates | None) -> Stamped:
        """Return the plans with the measured positions of joints that they leave out."""
        chunk_s = self.mapping.chunk_s
        if self.robot is None or self.mapping.tools:
            return plans
        whole, measured = complete_plans(plans, states, self.robot, chunk_s)
        if measured:
            self.streams.warn_once(
                f"'{topic}': trajectories leave out joints {', '.join(measured)}; their "
                'measured positions stand in for commands'
            )
        return whole


def _framed_pose(message: Any) -> tuple[str, FloatArray]:
    """Return the frame and (4, 4) pose of a PoseStamped."""
    return message.header.frame_id, messages.parse_pose(message.pose)
