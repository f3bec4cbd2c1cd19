"""Refusal of recordings before they are read: views, robot and rate, from their first messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag_mapping import BagMapping
from mtv_world_ros.data.episode_topics import asked_topics, EpisodeTopics, find_topics
from mtv_world_ros.robot.model import RobotModel

#: images from which the rate is estimated
_NUM_IMAGES = 20
#: minimum rate of the images, as a fraction of the model's rate
MIN_RATE_RATIO = 0.7
#: number of episodes that are named with a reason
NUM_NAMED = 3


def refuse_unusable(
    paths: Sequence[Path],
    views: Sequence[str],
    robot: RobotModel,
    *,
    fps: float = 0.0,
    mapping: BagMapping | None = None,
    remedy: str = '--robot FILE (of imported episodes: robot/robot.yaml beside them)',
) -> None:
    """Refuse recordings none of which can be used; the first that can be used ends the search.

    A recording without `metadata.yaml` counts as usable, because its topics are known only after
    it was read.

    Args:
        paths: folders of the recordings.
        views: views that each has to have.
        robot: robot that each has to be of.
        fps: rate of the model's frames [Hz]; 0 = any rate will do.
        mapping: topics of the recordings; None = the default names.
        remedy: thing to give for recordings of another robot, for the error text.

    Raises:
        EpisodeError: none can be used; the text has the reasons, the frequent ones first.
    """
    reasons: dict[str, str] = {}
    for path in paths:
        try:
            bag = BagReader(path)
            if bag.listed_topics:
                topics = find_topics(path, bag.listed_topics, views, asked_topics(mapping, views))
                if mapping is None:
                    _check_robot(bag, topics, robot, remedy)
                _check_rate(bag, topics.views[views[0]].image, fps)
            return
        except EpisodeError as error:
            reasons[str(path)] = str(error)
    lines = reason_lines(reasons) if len(paths) > 1 else list(reasons.values())
    raise EpisodeError(f'no usable episode: {"; ".join(lines)}')


def slow_text(path: Path, rate: float, fps: float) -> str:
    """Return the error text for a recording with too few frames a second.

    Args:
        path: folder of the recording.
        rate: rate of its frames [Hz].
        fps: rate of the model's frames [Hz].
    """
    return (
        f"episode '{path}' has {rate:.3g} frames a second, fewer than the model's {fps:g}: set "
        f'video.fps to {rate:.3g} or less'
    )


def reason_lines(skipped: Mapping[str, str]) -> list[str]:
    """Return a line for each reason with the names of its first episodes, the frequent first.

    Args:
        skipped: reasons by the episode's path.
    """
    episodes: dict[str, list[str]] = {}
    for path, reason in skipped.items():
        name = Path(path).name
        said = reason.replace(path, '...').replace(f"'{name}'", "'...'")
        episodes.setdefault(said, []).append(name)
    frequent = sorted(episodes.items(), key=lambda item: -len(item[1]))
    named = {
        reason: ', '.join([*names[:NUM_NAMED], *(['...'] if len(names) > NUM_NAMED else [])])
        for reason, names in frequent
    }
    return [f'{len(episodes[reason])} x {reason} ({text})' for reason, text in named.items()]


def _check_robot(bag: BagReader, topics: EpisodeTopics, robot: RobotModel, remedy: str) -> None:
    """Refuse a recording that names another robot and has no joint of this one."""
    recorded = bag.custom_data.get('robot', '')
    if recorded in ('', robot.name):
        return
    for message in islice(bag.messages({topics.joint_states}), 1):
        names = messages.deserialize(messages.JOINT_STATE, message.data).name
        if set(robot.joint_names).isdisjoint(names):
            raise EpisodeError(
                f"'{bag.path}' is of robot '{recorded}' and has no joint of '{robot.name}': give "
                f'{remedy}'
            )


def _check_rate(bag: BagReader, topic: str, fps: float) -> None:
    """Refuse a recording whose first images come at a lower rate than the model's."""
    if not fps:
        return
    stamps = [message.stamp_ns for message in islice(bag.messages({topic}), _NUM_IMAGES)]
    period_s = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else 0.0
    if period_s > 0 and 1 / period_s < MIN_RATE_RATIO * fps:
        raise EpisodeError(slow_text(bag.path, 1 / period_s, fps))
