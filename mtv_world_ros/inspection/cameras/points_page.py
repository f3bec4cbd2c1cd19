"""A page of frames on which somebody clicks where the finger tips are seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.documents import clicked_frame, render
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.model import RobotModel

#: frames of each recording and view
_NUM_FRAMES = 4


def points_page(
    episodes: Sequence[Episode], views: Sequence[str], robot: RobotModel, tips: Sequence[int]
) -> str:
    """Return the HTML page on which a user clicks the tool in frames of recordings.

    The page shows the frames of each recording whose tool positions are farthest apart, of each
    arm that moves.

    Args:
        episodes: recordings with joint states.
        views: names of the views whose frames are shown.
        robot: robot of the recordings.
        tips: number of finger tips that are clicked per frame, by arm; their middle is saved.

    Raises:
        EpisodeError: a recording has no frame within its joint states.
    """
    shown = {
        view: [frame for episode in episodes for frame in _frames(episode, view, robot, tips)]
        for view in views
    }
    used = sorted({frame['tips'] for frames in shown.values() for frame in frames})
    what = 'is the tool point' if used == [1] else 'are the finger tips'
    title = f'Where {what}? {", ".join(views)}'
    return render('points.html.j2', title=title, file='points.yaml', views=shown, tips=used)


def _frames(
    episode: Episode, view: str, robot: RobotModel, tips: Sequence[int]
) -> list[dict[str, Any]]:
    track, name = episode.images[view], episode.info.path.name
    if episode.joint_states is None:
        raise EpisodeError(f"'{episode.info.path}' has no joint_states")
    joints = JointTrack(episode.joint_states, robot)
    covered = np.flatnonzero(joints.covers(track.stamps_ns))
    if not len(covered):
        raise EpisodeError(f"'{episode.info.path}', view '{view}': no frame has joint states")
    found = []
    arms = robot.tool_poses(joints.at(track.stamps_ns[covered]))[..., :3, 3]
    rows = [sorted(_far_apart(places)) for places in arms]
    for arm, chosen in enumerate(rows):
        if len(chosen) == 1 and any(len(others) > 1 for others in rows):
            continue  # an arm that rests tells less than one that moves
        for row in chosen:
            index = int(covered[row])
            seconds = float(track.stamps_ns[index] - joints.stamps_ns[0]) * 1e-9
            frame = clicked_frame(name, seconds, np.asarray(track.frames[index]))
            label = robot.tools[arm].arm if len(robot.tools) > 1 else ''
            found.append({**frame, 'arm': label, 'tips': tips[arm]})
    return found


def _far_apart(places: FloatArray) -> list[int]:
    """Return the rows whose places (T, 3) are far from each other, the first among them."""
    chosen = [0]
    away = np.linalg.norm(places - places[0], axis=1)
    while len(chosen) < min(_NUM_FRAMES, len(places)) and away.max() > 0.02:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return chosen
