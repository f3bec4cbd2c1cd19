"""Which scripted policy acted in recorded episodes, and which of them must not be learned from."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mtv_world_ros.data.episode_reader import read_info
from mtv_world_ros.entry_points import policy_kind
from mtv_world_ros.errors import PolicyError

#: keys of an episode's metadata: what acted, and the splits of its fault kinds
POLICY, FAULT_SPLIT = 'policy', 'fault_split'
#: kind of policies, and what their names begin with
_SCRIPTED, _EXPERT = 'scripted', 'expert'
#: fault kinds of this split are for rankings alone
_TEST = 'test'


def recorded_policy(path: Path) -> str:
    """Returns the scripted policy of an episode; empty = another one, or not recorded.

    Raises:
        EpisodeError: the episode's metadata cannot be used.
    """
    name = read_info(path).metadata.get(POLICY, '')
    return name if name.split('-')[0] == _EXPERT else ''


def recorded_kinds(paths: Iterable[Path]) -> dict[Path, tuple[str, ...]]:
    """Returns the fault kinds of episodes of scripted policies.

    Raises:
        ConfigError: the simulator, which knows scripted policies, is not installed.
        EpisodeError: the metadata of an episode cannot be used.
        PolicyError: a policy has an unknown fault.
    """
    named = {Path(path): recorded_policy(path) for path in paths}
    scripted = {path: policy for path, policy in named.items() if policy}
    if not scripted:
        return {}
    kind = policy_kind(_SCRIPTED)
    return {path: kind.fault_kinds(policy) for path, policy in scripted.items()}


def refuse_test_kinds(paths: Iterable[Path], what: str) -> None:
    """Refuses episodes of policies with faults of the split `test`.

    Args:
        paths: folders of episodes.
        what: purpose that such episodes are refused for, e.g. `training`.

    Raises:
        ConfigError: an earlier episode names a policy alone, and the simulator, which knows its
            faults, is not installed.
        EpisodeError: the metadata of an episode cannot be used.
        PolicyError: names the policies and their kinds.
    """
    read = [read_info(path).metadata for path in paths]
    of_test = {m.get(POLICY, '') for m in read if _TEST in m.get(FAULT_SPLIT, '').split(',')}
    if of_test:
        raise PolicyError(
            f'fault kinds of the split {_TEST} are not for {what}: policies of these episodes '
            f'have some: {", ".join(sorted(of_test))}; leave the episodes out'
        )
    # earlier episodes do not say it: the name does
    names = {m.get(POLICY, '') for m in read if FAULT_SPLIT not in m}
    scripted = sorted(name for name in names if name.split('-')[0] == _EXPERT)
    if scripted:
        policy_kind(_SCRIPTED).refuse_test_kinds(scripted, what)
