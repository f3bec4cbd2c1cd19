"""Advice for joints of a robot that the recorded joint states do not name."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from mtv_world_ros.data.bag_mapping import BagMapping, PREFIX
from mtv_world_ros.robot.model import RobotModel

#: prefixes that are proposed at most
_MAX_PREFIXES = 3


def common_prefixes(recorded: Collection[str], joints: Sequence[str]) -> list[str]:
    """Return the prefixes that turn all joint names into recorded names."""
    first, names = joints[0], set(recorded)
    found = [name.removesuffix(first) for name in recorded if name.endswith(first)]
    return [prefix for prefix in found if prefix and names.issuperset(prefix + j for j in joints)]


def missing_joints_text(
    robot: RobotModel,
    mapping: BagMapping,
    recorded: Sequence[str],
    missing: Sequence[str],
    others: Mapping[str, Sequence[str]],
) -> str:
    """Return which joints are not measured, and the mapping that gives them.

    Args:
        robot: robot whose joints are wanted.
        mapping: mapping that the recording was read with.
        recorded: joints in the joint states that were read.
        missing: joints of the robot that are not among them.
        others: joints in further topics of joint states, by topic.
    """
    begin = f"joints {list(missing)} of robot '{robot.name}' are not in the joint states, which"
    text = f'{begin} have {list(recorded)}'
    if prefixes := common_prefixes(recorded, robot.joint_names)[:_MAX_PREFIXES]:
        ways = ' or '.join(f"'joints: {{{PREFIX}: {prefix}}}'" for prefix in prefixes)
        return f"{text}; where they are this robot's, set {ways} in the mapping (--topics)"
    ways = []
    topics = [t for t, names in others.items() if not set(missing).isdisjoint(names)]
    if topics:
        listed = ', '.join([*mapping.state_topics, *topics])
        names = {name for topic in topics for name in others[topic]}
        measured = [joint for joint in missing if joint in names]
        ways.append(
            f"{', '.join(topics)} measures {', '.join(measured)}: 'joint_states: [{listed}]' "
            'reads it, too'
        )
        missing = [joint for joint in missing if joint not in names]
    if missing:
        constants = ', '.join(f'{joint}: 0.0' for joint in missing)
        ways.append(
            "rename recorded ones by 'joints', or give what is not measured: "
            f"'constants: {{{constants}}}'"
        )
    return f'{text}; in the mapping (--topics): {"; ".join(ways)}'
