"""Finds the bags of an import in files and folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import re

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.bag.reader import is_storage, ROS1_SUFFIX
from mtv_world_ros.data.episode_reader import list_episodes
from mtv_world_ros.data.other_formats import conversion_hint

#: number that rosbag2 adds to the files of a bag that it splits
_PART = re.compile(r'_\d+$')


def find_bags(paths: Sequence[Path]) -> list[Path]:
    """Return bags: files as they are, folders that are bags, and the bags in other folders.

    A folder without metadata.yaml is a bag where its files are named like the parts of one; else
    each of them is.

    Raises:
        EpisodeError: a path is not there, or there is no bag.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise EpisodeError(f"there is no bag '{path}'")
        if path.is_file() and not is_storage(path) and (hint := conversion_hint(path)):
            raise EpisodeError(f"'{path}' is no bag{hint}")
        inside = [path] if path.is_file() else list_episodes(path)
        found += [bag for folder in inside for bag in _apart(folder)]
    if not found:
        hints = ''.join(dict.fromkeys(map(conversion_hint, paths)))
        raise EpisodeError(f'there is no bag in {", ".join(map(str, paths))}{hints}')
    return found


def _apart(folder: Path) -> list[Path]:
    """Return a folder that is one bag, or else the bags that its files are."""
    if folder.is_file() or (folder / 'metadata.yaml').is_file():
        return [folder]
    files = [file for file in sorted(folder.iterdir()) if is_storage(file) and file.is_file()]
    if any(ROS1_SUFFIX in file.suffixes for file in files):  # each is a recording of its own
        return files
    stems = {_PART.sub('', file.name.split('.')[0]) for file in files}
    return [folder] if len(stems) == 1 else files
