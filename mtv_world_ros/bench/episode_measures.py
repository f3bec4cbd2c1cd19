"""What an episode shows of its objects: how much they are seen, and how much they move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data.episode import Episode
from mtv_world_ros.data_types import BoolArray, FloatArray, ObjectMasks
from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.vision.jaccard import mean_of_known, moves, persistence_scores


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeMeasures:
    """Numbers of one episode's true masks.

    Attributes:
        views: V names.
        objects: O names.
        visible: (V, O) share of all frames in which any pixel of the object is seen.
        moving: (V, O) whether it leaves its first place.
        copy: (V, O) mean J of the first frame held, over the frames after it.
    """

    views: tuple[str, ...]
    objects: tuple[str, ...]
    visible: FloatArray
    moving: BoolArray
    copy: FloatArray

    def copy_all(self) -> FloatArray:
        """Returns the (V,) mean J of the held first frame over all objects."""
        return mean_of_known(self.copy, axis=1)

    def copy_moving(self) -> FloatArray:
        """Returns the (V,) same over those that move; NaN where none does."""
        return mean_of_known(np.where(self.moving, self.copy, np.nan), axis=1)


def measure(episode: Episode) -> EpisodeMeasures:
    """Measures an episode by its recorded masks.

    Raises:
        EpisodeError: it has no masks of a view.
    """
    names = episode.info.objects
    missing = [view for view in episode.views if view not in (episode.masks or {})]
    if missing or not names:
        raise EpisodeError(
            f"'{episode.info.path}' has no masks of {', '.join(missing) or 'objects'}; only "
            'simulated episodes have them'
        )
    assert episode.masks is not None
    num_frames = min(len(episode.masks[view].stamps_ns) for view in episode.views)
    ids = np.stack([np.asarray(episode.masks[v].frames[:num_frames]) for v in episode.views])
    masks = np.stack([ids == number for number in range(1, len(names) + 1)], axis=1)
    ok = tuple(tuple('ok' for _ in names) for _ in episode.views)
    later = ObjectMasks(names=names, masks=masks[:, :, 1:], status=ok)
    return EpisodeMeasures(
        views=episode.views,
        objects=names,
        visible=masks.any((-2, -1)).mean(2),
        moving=moves(later.masks, masks[:, :, 0]),
        copy=persistence_scores(masks[:, :, 0], later).objects,
    )
