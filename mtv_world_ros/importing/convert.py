"""The loop over recordings that become episodes, and what its results hold."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
import shlex
from typing import Generic, TypeVar

import numpy as np

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.data.episode_reader import read_info
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan_limits import joint_speeds

#: datasets have no date: episodes start at this stamp (0 would mean "not stamped") [ns]
START_NS = 1_000_000_000
#: key of an episode's metadata: digest of the mapping that it was imported with
MAPPING_KEY = 'import_mapping'

Item = TypeVar('Item')


@dataclass(slots=True)
class ImportSummary(Generic[Item]):
    """Outcome of an import, by the number of the episode or by bag.

    Attributes:
        made: episodes that were converted now.
        kept: episodes of an earlier run.
        failed: reasons of the episodes that could not be converted.
        warnings: problems and how they were handled.
        robot_notes: problems of the robot's description.
        notes: problems that concern no single recording.
    """

    made: list[Item] = field(default_factory=list)
    kept: list[Item] = field(default_factory=list)
    failed: dict[Item, str] = field(default_factory=dict)
    warnings: dict[Item, tuple[str, ...]] = field(default_factory=dict)
    robot_notes: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def import_each(
    items: Iterable[Item],
    key: str,
    place: Callable[[Item], Path],
    convert: Callable[[Item, Path], tuple[str, ...]],
) -> ImportSummary[Item]:
    """Convert the episodes that do not exist yet.

    Args:
        items: keys of the episodes, e.g. their numbers in a data set.
        key: digest of mapping, robot and calibration; an episode made with others is an error.
        place: function that returns the folder of an item's episode.
        convert: writes the folder, unless it divides the item into further ones of `items`;
            returns what was odd and how it was handled.
    """
    summary = ImportSummary[Item]()
    for item in items:
        path = place(item)
        try:
            if not path.exists():
                summary.warnings[item] = convert(item, path)
                if path.exists():  # else it was divided
                    summary.made.append(item)
            elif read_info(path).metadata.get(MAPPING_KEY, '') == key:
                summary.kept.append(item)
            else:
                raise EpisodeError(
                    f"'{path}' was imported with another mapping, calibration, robot, describer "
                    'or segmenter; remove it or choose another --out'
                )
        except MtvWorldError as error:
            summary.failed[item] = str(error)
    return summary


def episode_name(number: int) -> str:
    """Return the name of an imported episode."""
    return f'episode_{number:06d}'


def unknown_camera_note(folder: Path, view: str, what: str, why: str = '') -> str:
    """Describe the unknown parameters of a view's camera, with the command that estimates them.

    Args:
        folder: folder of the episodes.
        view: name of the view.
        what: parameters that are not known.
        why: the reason; empty = nothing is recorded of them.
    """
    because, quoted = f' ({why})' if why else '', shlex.quote(str(folder))
    return (
        f"view '{view}': {what} not known{because}: mtv-world fit camera {quoted} --view {view} "
        '--click points.html'
    )


#: speed of a command that counts as a jump [joint speed limits]
_JUMP = 2.0


def joints_too_fast(commands: Iterable[JointTrajectory], robot: RobotModel) -> list[str]:
    """Return joints whose commands are faster than they can move, and how often."""
    counts, limits = np.zeros(len(robot.joint_names), int), joint_speeds(robot)
    for trajectory in commands:
        if len(trajectory.times) > 1:
            speeds = np.diff(trajectory.positions, axis=0) / np.diff(trajectory.times)[:, None]
            counts += (np.abs(speeds) > _JUMP * limits).sum(axis=0)
    given = np.isfinite(robot.velocity_limits)
    rows = zip(robot.joint_names, counts, given, limits, strict=True)
    return [
        f"commands of joint '{name}' jump {count} times (over {_JUMP:g} times "
        f'{"its speed limit" if is_given else f"{limit:g} a second, as no speed limit is given"})'
        for name, count, is_given, limit in rows
        if count
    ]
