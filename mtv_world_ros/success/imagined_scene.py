"""Where the objects of a task are at the end of a rollout, each found once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mtv_world_ros.data_types import BoolArray, FloatArray
from mtv_world_ros.geometry.mask_geometry import block_size, count_reversals, Location
from mtv_world_ros.success.goal_pictures import Picture, PictureMasks
from mtv_world_ros.success.situation import CannotTell
from mtv_world_ros.success.views import Views
from mtv_world_ros.vision.jaccard import mean_of_known


@dataclass(slots=True)
class Placed:
    """Where the bound objects are; a `Situation`. Each is located once, when it is asked for."""

    views: Views
    bound: Mapping[str, str]
    picture_masks: PictureMasks
    notes: dict[str, None] = field(default_factory=dict)
    sigmas: dict[str, float] = field(default_factory=dict)
    _ends: dict[str, Location] = field(default_factory=dict)

    def item(self, role: str) -> int:
        """Returns the index of a placeholder's object."""
        return self.views.index(self.bound[role])

    def end(self, role: str) -> FloatArray:
        """See `Situation`."""
        if role not in self._ends:
            found, hidden = self.views.end(self.item(role))
            if hidden:
                name = self.bound[role]
                self.notes[f"'{name}' is partly hidden: taken to stand where it stood"] = None
            self._ends[role], self.sigmas[role] = found, found.sigma_m
        return self._ends[role].point

    def start(self, role: str) -> FloatArray:
        """See `Situation`."""
        point = self.views.memory.start_point(self.item(role))
        if not np.isfinite(point).all():
            raise CannotTell(f"where '{self.bound[role]}' was at the start is not known")
        return point

    def stack_height(self, upper: str, lower: str) -> float:
        """See `Situation`; both are taken as cubes, of the size that was last seen whole."""
        memory, footage = self.views.memory, self.views.footage
        edges = []
        for role in (upper, lower):
            item = self.item(role)
            areas = memory.seen_masks[:, item].sum((-2, -1)).astype(np.float64)
            point = memory.seen_points[item]
            if not np.isfinite(point).all():
                point = self.end(role)
            edges.append(block_size(footage.cameras, tuple(footage.poses[:, -1]), areas, point))
        return float(np.mean(edges))

    def lift(self, role: str) -> float:
        """See `Situation`."""
        heights = self.views.memory.points[self.item(role), :, 2]
        return float(np.nanmax(heights) - self.start(role)[2])

    def swings(self, role: str, swing: float) -> int:
        """See `Situation`; what the view tells that shows most of them."""
        counts = []
        for leans in self.views.memory.leans[:, self.item(role)]:
            known = leans[np.isfinite(leans)]
            if len(known):
                reversals = count_reversals(np.unwrap(known, period=np.pi), swing)
                counts.append(int(reversals[-1]))
        return max(counts, default=0)

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
