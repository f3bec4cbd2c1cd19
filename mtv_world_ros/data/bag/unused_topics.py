"""Topics of a recording that an episode has no use for, and why."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.command_messages import READ_AS
from mtv_world_ros.data.bag_mapping import BagMapping, STATE

#: words in the names of image topics that are not colour images of the scene
_NO_COLOURS = ('depth', 'infra', 'mask', 'confidence', 'disparity')
_COMMANDS = "commands; --action, or 'action' in the mapping, names the topic that is read"
#: key of the mapping, or option, that takes messages of a type
_TAKEN_BY = {
    messages.CAMERA_INFO: 'camera info of no view',
    messages.JOINT_STATE: "joint states; 'joint_states' in the mapping names the topics that are "
    'read',
    messages.JOINT_TRAJECTORY: _COMMANDS,
    **dict.fromkeys(READ_AS, _COMMANDS),
    messages.POSE_STAMPED: "poses; 'tools' in the mapping takes commanded ones",
    messages.STRING: "text; 'instruction_topic' in the mapping names the topic that is read",
    messages.TF_MESSAGE: 'poses of cameras; those of the calibration file are used',
}


def plain_topic(topic: str) -> str:
    """Return the name of an image topic without the suffix of its transport."""
    return topic.removesuffix('/compressed').removesuffix('/ffmpeg')


def has_no_colours(topic: str) -> bool:
    """Return True if a topic's name says that its images are no colour images of the scene."""
    return any(word in topic.lower() for word in _NO_COLOURS)


def unused_topics(
    types: Mapping[str, str], used: Collection[str], images: Collection[str], mapping: BagMapping
) -> dict[str, str]:
    """Return why topics of a recording are not used, by topic.

    Args:
        types: message type of each topic.
        used: topics that the episode was made of.
        images: image topics among them.
        mapping: names and kinds of the topics.
    """
    return {
        topic: _why(topic, kind, images, mapping)
        for topic, kind in types.items()
        if topic not in used
    }


def _why(topic: str, kind: str, images: Collection[str], mapping: BagMapping) -> str:
    if kind in messages.IMAGE_TYPES:
        return _why_no_view(topic, images)
    if kind in (messages.JOINT_TRAJECTORY, *READ_AS) and mapping.action == STATE:
        return "commands; 'action: state' takes the measured positions that follow"
    if kind == messages.STRING and topic == mapping.topic(mapping.instruction_topic):
        return "text; the mapping's 'instruction' is used"
    if kind == messages.STRING and topic.endswith('robot_description'):
        return 'description of the robot; --robot, or the mapping, names another one'
    return _TAKEN_BY.get(kind, f'{kind} is not read')


def _why_no_view(topic: str, images: Collection[str]) -> str:
    place = plain_topic(topic).rpartition('/')[0]
    same = [name for name in images if plain_topic(name).rpartition('/')[0] == place]
    if has_no_colours(topic):
        return 'no colour images, by its name'
    if same:
        return f"images of the camera of '{same[0]}', which is read; 'views' in the mapping"
    return "images of no view; 'views' in the mapping names it"


def unused_line(unused: Mapping[str, str]) -> str:
    """Return the line that names all topics that are not used, grouped by reason; empty = none."""
    reasons: dict[str, list[str]] = {}
    for topic, why in unused.items():
        reasons.setdefault(why, []).append(topic)
    parts = [f'{", ".join(sorted(topics))} ({why})' for why, topics in reasons.items()]
    return f'not used: {"; ".join(parts)}' if parts else ''
