"""metadata.yaml of a rosbag2 folder, version 9 (Jazzy), and the QoS profiles in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from mtv_world_ros.core.bounded_input import parse_yaml

VERSION = 9
_INFINITE = {'sec': 9223372036, 'nsec': 854775807}


@dataclass(frozen=True, slots=True, kw_only=True)
class Qos:
    """The profile a topic was offered with; `ros2 bag play` offers it again.

    Attributes:
        reliability: `reliable` or `best_effort`.
        durability: `volatile` or `transient_local` (latched).
        history: `keep_last` or `keep_all`.
        depth: messages kept for `keep_last`.
    """

    reliability: str = 'reliable'
    durability: str = 'volatile'
    history: str = 'keep_last'
    depth: int = 10


#: profile of latched topics: later subscribers get the last message
LATCHED = Qos(durability='transient_local', depth=1)


@dataclass(slots=True, kw_only=True)
class TopicRecord:
    """One topic of a bag: name, message type, type hash, profile, number of messages."""

    name: str
    msgtype: str
    type_hash: str
    qos: Qos
    message_count: int = 0


def dump_qos(qos: Qos) -> str:
    """Return the profile list as the MCAP channel's metadata holds it."""
    return dump([_qos_entry(qos)]).strip()


def parse_qos(text: str) -> Qos:
    """Return the first profile of a list in metadata.yaml, the default if it cannot be read."""
    try:
        entry = parse_yaml(text)[0]
        words = {key: entry[key] for key in ('reliability', 'durability', 'history')}
        if all(isinstance(word, str) for word in words.values()):
            return Qos(**words, depth=int(entry['depth']))
    except (yaml.YAMLError, LookupError, TypeError, ValueError):
        pass
    return Qos()


def bag_information(
    file_name: str,
    topics: Sequence[TopicRecord],
    first_ns: int,
    last_ns: int,
    custom_data: Mapping[str, str],
) -> dict[str, Any]:
    """Return the content of `rosbag2_bagfile_information` for a bag of one MCAP file."""
    count = sum(topic.message_count for topic in topics)
    span = {
        'starting_time': {'nanoseconds_since_epoch': first_ns},
        'duration': {'nanoseconds': last_ns - first_ns},
        'message_count': count,
    }
    return {
        'version': VERSION,
        'storage_identifier': 'mcap',
        **span,
        'topics_with_message_count': [_topic_entry(topic) for topic in topics],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file_name],
        'files': [{'path': file_name, **span}],
        'custom_data': dict(custom_data) or None,
        'ros_distro': 'jazzy',
    }


def _qos_entry(qos: Qos) -> dict[str, Any]:
    return {
        'history': qos.history,
        'depth': qos.depth,
        'reliability': qos.reliability,
        'durability': qos.durability,
        'deadline': dict(_INFINITE),
        'lifespan': dict(_INFINITE),
        'liveliness': 'automatic',
        'liveliness_lease_duration': dict(_INFINITE),
        'avoid_ros_namespace_conventions': False,
    }


def _topic_entry(topic: TopicRecord) -> dict[str, Any]:
    return {
        'topic_metadata': {
            'name': topic.name,
            'type': topic.msgtype,
            'serialization_format': 'cdr',
            'offered_qos_profiles': [_qos_entry(topic.qos)],
            'type_description_hash': topic.type_hash,
        },
        'message_count': topic.message_count,
    }


class _Dumper(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):  # type: ignore[misc]
    """YAML writer without anchors, which rosbag2's reader does not support."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def dump(content: Any) -> str:
    """Return the YAML text of metadata, without anchors."""
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1000)
