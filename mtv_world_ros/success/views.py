"""Masks of a rollout in calibrated views: status, object positions, J with a goal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.cameras.mask_geometry import centroids, locate, Location, moved_mask
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import CannotTell
from mtv_world_ros.success.footage_memory import Footage, FootageMemory
from mtv_world_ros.vision.jaccard import jaccard

#: number of frames at the end whose median is used
_LAST_FRAMES = 3
#: maximum distance between the rays of views [fraction of the image's diagonal]
_MAX_RESIDUAL = 0.02
#: maximum difference between views of the subject's J with its goal
_MAX_DISAGREEMENT = 0.7
#: minimum area of the subject at the end [fraction of its largest area]
_MIN_VISIBLE = 0.3
#: an object that shows less than this share of its last unhidden area, and lies within that mask,
#: is taken to stand where it stood then
_HIDDEN_BELOW = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class Views:
    """Masks of the last chunk of a rollout, and the memory of the chunks before.

    Attributes:
        footage: the last chunk.
        memory: memory of the rollout, with this chunk.
        used: names of the views to look at; empty = all.
    """

    footage: Footage
    memory: FootageMemory
    used: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects."""
        return self.footage.masks.names

    def index(self, name: str) -> int:
        """Return the object's index.

        Raises:
            CannotTell: the object has no mask in any view.
        """
        if name not in self.names:
            raise CannotTell(f"'{name}' is not among the objects {list(self.names)}")
        return self.names.index(name)

    def _is_used(self) -> BoolArray:
        """Return (V,) whether a view is looked at."""
        views = [camera.view for camera in self.footage.cameras]
        return np.array([not self.used or view in self.used for view in views])

    def start_mask(self, item: int) -> BoolArray:
        """Return the (V, H, W) masks of one object in the rollout's first frame."""
        return self.memory.start_masks.masks[:, item, 0]

    def start_ok(self, item: int) -> BoolArray:
        """Return (V,) True where the start mask of an object is reliable."""
        ok = np.array([row[item] == 'ok' for row in self.memory.start_masks.status])
        return ok & self._is_used()

    def end_ok(self, item: int) -> BoolArray:
        """Return (V,) True where the object is known, and seen in the last frame."""
        return self.footage.known(self.footage.num_frames)[:, item] & self._is_used()

    def start_jaccard(self, item: int) -> FloatArray:
        """Return (V,) J of the last masks with the start mask, NaN where either is not known."""
        return self._jaccard(item, self.start_mask(item))

    def goal_masks(self, item: int, goal: FloatArray) -> BoolArray | None:
        """Return (V, H, W) start masks moved to `goal` (3,); None = its start is not known."""
        start = self.memory.start_point(item)
        if not np.isfinite(start).all():
            return None
        moved = [
            moved_mask(mask, camera, poses[-1], start, goal)
            for mask, camera, poses in zip(
                self.start_mask(item), self.footage.cameras, self.footage.poses, strict=True
            )
        ]
        return np.stack(moved)

    def goal_jaccard(self, item: int, goals: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return (V,) J of the last masks, and of the start masks, with (V, H, W) goal masks.

        NaN in a view whose goal mask is empty.

        Raises:
            CannotTell: the views disagree.
        """
        scores = np.where(goals.any((-2, -1)), self._jaccard(item, goals), np.nan)
        known = scores[np.isfinite(scores)]
        if len(known) > 1 and np.ptp(known) > _MAX_DISAGREEMENT:
            raise CannotTell(
                'the views disagree: J with the goal mask is '
                + ', '.join(f'{value:.2f}' for value in known)
            )
        first = jaccard(self.start_mask(item), goals)
        return scores, np.where(np.isfinite(scores), first, np.nan)

    def _jaccard(self, item: int, reference: BoolArray) -> FloatArray:
        masks = self.footage.masks.masks[:, item, -_LAST_FRAMES:]
        scores = np.median(jaccard(masks, reference[:, None]), axis=1)
        return np.where(self.start_ok(item) & self.end_ok(item), scores, np.nan)

    def share_inside(self, item: int, regions: BoolArray) -> FloatArray:
        """Return (V,) shares of an object's mask in (V, H, W) regions; NaN = not known."""
        masks = self.footage.masks.masks[:, item, -_LAST_FRAMES:]
        area = np.maximum(masks.sum((-2, -1)), 1)
        shares = np.median((masks & regions[:, None]).sum((-2, -1)) / area, axis=1)
        return np.where(self.end_ok(item), shares, np.nan)

    def containment(self, item: int, within: int) -> float:
        """Return the share of an object's mask in another's last unhidden one; the least."""
        shares = self.share_inside(item, self.memory.seen_masks[:, within])
        known = np.isfinite(shares) & self.start_ok(within)
        return float(shares[known].min()) if known.any() else float('nan')

    def check_visible(self, item: int) -> None:
        """Raise if an object has nearly vanished in every view that knows it.

        Raises:
            CannotTell: the object has nearly vanished in all of these views.
        """
        masks = self.footage.masks.masks[:, item, -_LAST_FRAMES:]
        last = np.median(masks.sum((-2, -1)), axis=1)
        known, largest = self.end_ok(item), self.memory.largest[:, item]
        if known.any() and (last[known] < _MIN_VISIBLE * largest[known]).all():
            share = float(np.max(last[known] / largest[known]))
            raise CannotTell(f"'{self.names[item]}' has vanished: {share:.0%} of its area is left")

    def end(self, item: int) -> tuple[Location, bool]:
        """Return where the object is at the end, and whether it is hidden where it stood.

        Raises:
            CannotTell: the object was lost, or the views' rays do not meet.
        """
        point = self.memory.seen_points[item]
        if np.isfinite(point).all() and self._is_hidden_in_place(item):
            return Location(point=point, residual_px=0.0, sigma_m=self._sigma(item)), True
        return self._located(item), False

    def _located(self, item: int) -> Location:
        footage, last = self.footage, _LAST_FRAMES
        pixels = np.array(
            [_median_known(view) for view in centroids(footage.masks.masks[:, item, -last:])]
        )
        known = self.end_ok(item)
        pixels[~known] = np.nan
        found = locate(footage.cameras, tuple(footage.poses[:, -1]), pixels)
        name = self.names[item]
        if found is None:
            raise CannotTell(
                f"'{name}' is known in fewer than two views ({self._unknown(item) or 'one view'})"
            )
        camera = footage.cameras[0]
        limit = _MAX_RESIDUAL * float(np.hypot(camera.width, camera.height))
        if found.residual_px > limit:
            raise CannotTell(
                f"the views disagree on where '{name}' is: their rays miss each other by "
                f'{found.residual_px:.1f} px, more than {limit:.1f}'
            )
        return found

    def _unknown(self, item: int) -> str:
        """Return the reasons why the position of the object is not known."""
        words = []
        for camera, row, ok, used in zip(
            self.footage.cameras,
            self.footage.masks.status,
            self.end_ok(item),
            self._is_used(),
            strict=True,
        ):
            if not ok:
                word = row[item] if row[item] != 'ok' else 'lost at the end'
                words.append(f'{camera.view}: {word if used else "not used by the task"}')
        return ', '.join(words)

    def _is_hidden_in_place(self, item: int) -> bool:
        """Return True if a view shows less of the object and no view shows it elsewhere."""
        seen, last = self.memory.seen_masks[:, item], self.footage.masks.masks[:, item, -1]
        area, seen_area = last.sum((-2, -1)), seen.sum((-2, -1))
        inside = (seen & last).sum((-2, -1))
        hidden = self.start_ok(item) & (area < _HIDDEN_BELOW * seen_area)
        elsewhere = inside < 0.6 * area
        return bool(hidden.any() and not elsewhere.any())

    def _sigma(self, item: int) -> float:
        """Return the standard error of where it was last seen [m]."""
        found = locate(
            self.footage.cameras,
            tuple(self.footage.poses[:, -1]),
            centroids(self.memory.seen_masks[:, item]),
        )
        return found.sigma_m if found is not None else float('nan')


def _median_known(pixels: FloatArray) -> FloatArray:
    """Return (2,) median of the rows that are known, NaN if none is."""
    known = pixels[np.isfinite(pixels[:, 0])]
    return np.median(known, axis=0) if len(known) else np.full(2, np.nan)
