"""Where the objects of a task are in imagined pictures, by their masks: the seen situation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mtv_world_ros.data_types import BoolArray, FloatArray
from mtv_world_ros.errors import CannotTell
from mtv_world_ros.geometry.mask_geometry import (
    block_size,
    count_reversals,
    Location,
    widest_swing,
)
from mtv_world_ros.success.goal_pictures import Picture, PictureMasks
from mtv_world_ros.success.views import Views
from mtv_world_ros.vision.jaccard import mean_of_known


@dataclass(slots=True)
class ImaginedScene:
    """A `Situation` seen in masks; each object is located once, when it is asked for.

    Centres are those of the end (T = 1); clearances and reversals are of all frames so far. How
    an object is turned is not seen.

    Attributes:
        views: masks of the rollout.
        bound: placeholder -> name of its object.
        picture_masks: finds objects in the task's pictures.
        sizes: placeholder -> usual extents (3,) of its object [m]; not there = taken as a cube
            and measured.
        notes: assumptions made on the way, in order.
        sigmas: placeholder -> standard error of where its object is at the end [m].
    """

    views: Views
    bound: Mapping[str, str]
    picture_masks: PictureMasks
    sizes: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    notes: dict[str, None] = field(default_factory=dict)
    sigmas: dict[str, float] = field(default_factory=dict)
    _ends: dict[str, Location] = field(default_factory=dict)

    def item(self, role: str) -> int:
        """Returns the index of a placeholder's object."""
        return self.views.index(self.bound[role])

    def centres(self, role: str) -> FloatArray:
        """See `Situation`."""
        if role not in self._ends:
            found, hidden = self.views.end(self.item(role))
            if hidden:
                name = self.bound[role]
                self.notes[f"'{name}' is partly hidden: taken to stand where it stood"] = None
            self._ends[role], self.sigmas[role] = found, found.sigma_m
        return self._ends[role].point[None]

    def offsets(self, role: str, target: str) -> FloatArray:
        """See `Situation`; the target's sides are taken to lie along x and y."""
        return self.centres(role) - self.centres(target)

    def start(self, role: str) -> FloatArray:
        """See `Situation`."""
        point = self.views.memory.start_point(self.item(role))
        if not np.isfinite(point).all():
            raise CannotTell(f"where '{self.bound[role]}' was at the start is not known")
        return point

    def goal(self, role: str) -> FloatArray:
        """See `Situation`; no picture shows it."""
        raise CannotTell(f"where '{self.bound[role]}' is to go is not known")

    def size(self, role: str) -> FloatArray:
        """See `Situation`; a cube is measured where it was last seen whole."""
        if role in self.sizes:
            return np.asarray(self.sizes[role])
        memory, footage, item = self.views.memory, self.views.footage, self.item(role)
        areas = memory.seen_masks[:, item].sum((-2, -1)).astype(np.float64)
        point = memory.seen_points[item]
        if not np.isfinite(point).all():
            point = self.centres(role)[0]
        edge = block_size(footage.cameras, tuple(footage.poses[:, -1]), areas, point)
        return np.full(3, edge)

    def clearances(self, role: str) -> FloatArray:
        """See `Situation`; how far the centre is over its start, where the object stood."""
        heights = self.views.memory.points[self.item(role), :, 2] - self.start(role)[2]
        frames, known = np.arange(len(heights)), np.isfinite(heights)
        return np.interp(frames, frames[known], heights[known])

    def reversals(self, role: str, swing: float) -> FloatArray:
        """See `Situation`; by the long axis of the object's masks."""
        leans = self.views.memory.leans[self.item(role)]
        known = np.isfinite(leans[:, 0])
        if not known.any():
            return np.zeros(len(leans))
        along = widest_swing(leans[known])
        counts = count_reversals(np.unwrap(np.arcsin(along), period=np.pi), swing)
        return np.concatenate([[0.0], counts])[np.cumsum(known)]

    def pictured(self, role: str, pictures: Mapping[str, Picture]) -> BoolArray:
        """Returns (V, H, W) masks of an object in pictures; empty where a view has none."""
        cameras = self.views.footage.cameras
        return self.picture_masks.masks(pictures, self.views.names, self.item(role), cameras)

    def pictured_jaccard(self, role: str, pictures: Mapping[str, Picture]) -> float:
        """See `Situation`."""
        goals = self.pictured(role, pictures)
        return self._known(role, self.views.goal_jaccard(self.item(role), goals)[0])

    def share_inside(self, role: str, regions: Mapping[str, Picture]) -> float:
        """See `Situation`."""
        cameras = self.views.footage.cameras
        painted = np.stack(
            [
                regions[c.view].region(c)
                if c.view in regions
                else np.zeros((c.height, c.width), bool)
                for c in cameras
            ]
        )
        has_region = np.array([camera.view in regions for camera in cameras])
        inside = self.views.share_inside(self.item(role), painted)
        shares = np.where(has_region, inside, np.nan)
        self._known(role, shares)
        return float(np.nanmin(shares))

    def _known(self, role: str, scores: FloatArray) -> float:
        """The mean over the views that know."""
        if not np.isfinite(scores).any():
            raise CannotTell(f"no view of the task's pictures knows '{self.bound[role]}'")
        return float(mean_of_known(scores))
