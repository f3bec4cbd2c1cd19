"""Cost of camera poses that are not known or were doubted: the episodes that training lacks."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
import os
from pathlib import Path
import shlex

from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.data.episode import UNKNOWN_CAMERAS
from mtv_world_ros.data.episode_reader import read_info


def unknown_camera_lines(skipped: Iterable[str], num_all: int) -> list[str]:
    """Return how many episodes are left out for unknown poses of cameras, and the remedy.

    Args:
        skipped: paths of the episodes that were left out.
        num_all: number of all episodes.
    """
    views: dict[str, None] = {}
    episodes = []
    for path in skipped:
        with suppress(MtvWorldError):
            marked = read_info(path).metadata.get(UNKNOWN_CAMERAS, '')
            views |= dict.fromkeys(name for name in marked.split(', ') if name)
            episodes += [path] if marked else []
    if not episodes:
        return []
    folders = [str(Path(path).parent) for path in episodes]
    folder = os.path.commonpath(folders)
    line = (
        f'{len(episodes)} of {num_all} episodes ({len(episodes) / num_all:.0%}) are left out as '
        f'the pose of a camera is not known or was doubted ({", ".join(views)}): look at the '
        f'pictures of mtv-world fit camera {shlex.quote(folder)} --view {",".join(views)} '
        '--apply, and where they fit add --apply-doubted'
    )
    return [line]
