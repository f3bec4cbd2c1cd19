"""Topics of an episode in a bag: images of each view, joint states, commands, instruction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import re

from mtv_world_ros.core.errors import (
    EpisodeError,
)
from mtv_world_ros.data.bag.messages import IMAGE_TYPES
from mtv_world_ros.data.bag_mapping import BagMapping
from mtv_world_ros.data.episode import (
    image_topic,
    INSTRUCTION,
    JOINT_STATES,
    JOINT_TRAJECTORY,
    OBJECT_POSES,
)

#: keys of a topic map that are not views, and the topics they stand for
STREAMS = {
    'joint_states': JOINT_STATES,
    'joint_trajectory': JOINT_TRAJECTORY,
    'instruction': INSTRUCTION,
    'object_poses': OBJECT_POSES,
}
_PLAIN_VIEW = re.compile(r'/([^/]+)/image_raw(?:/compressed|/ffmpeg)?')


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewTopics:
    """Topics of one view: images (raw or compressed), CameraInfo, masks."""

    image: str
    camera_info: str
    mask: str


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeTopics:
    """Topics of an episode."""

    views: Mapping[str, ViewTopics]
    joint_states: str
    joint_trajectory: str
    instruction: str
    object_poses: str

    def names(self, *, with_masks: bool) -> set[str]:
        """Return the names of all topics, of mask topics only on request."""
        names = {self.joint_states, self.joint_trajectory, self.instruction, self.object_poses}
        for view in self.views.values():
            names |= {view.image, view.camera_info, *([view.mask] if with_masks else [])}
        return names


def asked_topics(mapping: BagMapping | None, views: Sequence[str] | None) -> dict[str, str]:
    """Return the topics that a mapping names, by view and stream; None = of all views."""
    streams = mapping.streams() if mapping else {}
    return {k: t for k, t in streams.items() if views is None or k in (*STREAMS, *views)}


def find_topics(
    path: Path,
    found: Mapping[str, str],
    views: Sequence[str] | None,
    named: Mapping[str, str],
) -> EpisodeTopics:
    """Return the topics of an episode.

    A view's images are at `/<view>/image_raw` or `/<view>/image_raw/compressed` (raw is taken
    if both exist) unless `named` says otherwise; CameraInfo and masks have the same namespace.

    Args:
        path: the bag, for error texts.
        found: message type of each topic in the bag.
        views: views wanted; None = those of `named`, else all that are there.
        named: topic by view name or by `joint_states`, `joint_trajectory`, `instruction`.

    Raises:
        EpisodeError: a view is not there, or `named` has a key that is neither.
    """
    images = [topic for topic, kind in found.items() if kind in IMAGE_TYPES]
    if views is None:
        views = [key for key in named if key not in STREAMS] or _plain_views(images)
    unknown = [key for key in named if key not in STREAMS and key not in views]
    if unknown:
        raise EpisodeError.unknown(
            'topics:',
            unknown[0],
            [*views, *STREAMS],
            is_not=' is neither a view nor a stream; known are',
        )
    if not views:
        raise EpisodeError(
            f"'{path}' has no topic /<view>/image_raw or /<view>/image_raw/compressed; its image "
            f'topics are {listed(images)}: name the views in `topics`'
        )
    return EpisodeTopics(
        views={view: _view_topics(path, view, images, named) for view in views},
        **{key: named.get(key, topic) for key, topic in STREAMS.items()},
    )


def _plain_views(images: Sequence[str]) -> list[str]:
    matches = [_PLAIN_VIEW.fullmatch(topic) for topic in images]
    return list(dict.fromkeys(match[1] for match in matches if match))


def _view_topics(
    path: Path, view: str, images: Sequence[str], named: Mapping[str, str]
) -> ViewTopics:
    wanted = named.get(view, image_topic(view))
    forms = (wanted, f'{wanted}/compressed', f'{wanted}/ffmpeg')
    image = next((topic for topic in forms if topic in images), None)
    if image is None:
        there = _plain_views(images)
        raise EpisodeError.unknown(
            f"'{path}' has no view",
            view,
            there,
            is_not=f": there are no images at '{wanted}' or '{wanted}/compressed'; its views are",
            advice=f', its image topics {listed(images)} (map a view to a topic in `topics`)',
        )
    camera = image.removesuffix('/compressed').removesuffix('/ffmpeg').rpartition('/')[0]
    return ViewTopics(
        image=image, camera_info=f'{camera}/camera_info', mask=f'{camera}/mask/compressed'
    )


def listed(names: Sequence[str]) -> str:
    """Return names as a list of a text; `none` where there are none."""
    return ', '.join(names) or 'none'
