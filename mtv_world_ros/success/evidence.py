"""What the masks of a rollout say about a task: places in space and Jaccard indices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray, ObjectMasks
from mtv_world_ros.success.jaccard import jaccard, mean_of_known
from mtv_world_ros.success.localise import block_size, centroids, locate, Location, moved_mask
from mtv_world_ros.success.task import Relation


class CannotTell(Exception):
    """Why there is no evidence; caught by the estimator, never a user's error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceConfig:
    """When masks are not enough.

    Attributes:
        last_frames: frames at the end whose median counts.
        max_residual: largest miss of the views' rays, as a share of the image's diagonal.
        max_disagreement: largest difference between views of the subject's J with its goal.
        min_visible: smallest area of the subject at the end, as a share of its largest.
        hidden_below: a target that shows less than this share of its start area, and lies
            within its start mask, is taken to stand where it stood.
    """

    last_frames: int = 3
    max_residual: float = 0.02
    max_disagreement: float = 0.7
    min_visible: float = 0.3
    hidden_below: float = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class Views:
    """Masks of a rollout in calibrated views.

    Attributes:
        masks: of the T predicted frames.
        start_masks: of the frame before them (T = 1).
        cameras: V cameras at the masks' size.
        start_poses: V poses T_base_camera (4, 4) at the start.
        end_poses: V poses T_base_camera (4, 4) at the end.
    """

    masks: ObjectMasks
    start_masks: ObjectMasks
    cameras: Sequence[CameraModel]
    start_poses: Sequence[FloatArray]
    end_poses: Sequence[FloatArray]

    def index(self, name: str) -> int:
        """Returns the object's index.

        Raises:
            CannotTell: it has no mask.
        """
        if name not in self.masks.names:
            raise CannotTell(f"'{name}' is not among the objects {list(self.masks.names)}")
        return self.masks.names.index(name)

    def start_mask(self, item: int) -> BoolArray:
        """Returns the (V, H, W) masks of one object at the start."""
        return self.start_masks.masks[:, item, 0]

    def start_ok(self, item: int) -> BoolArray:
        """Returns (V,) whether the start mask is to be trusted."""
        return np.array([row[item] == 'ok' for row in self.start_masks.status])

    def end_ok(self, item: int) -> BoolArray:
        """Returns (V,) whether the object is known, and seen in the last frame."""
        ok = np.array([row[item] == 'ok' for row in self.masks.status])
        return ok & self.masks.masks[:, item, -1].any((1, 2))

    def start_jaccard(self, item: int, last: int) -> FloatArray:
        """Returns (V,) J of the last masks with the start mask, NaN where either is not known."""
        return self._jaccard(item, self.start_mask(item), last)

    def goal_jaccard(
        self, item: int, start: FloatArray, goal: FloatArray, last: int
    ) -> FloatArray:
        """Returns (V,) J of the last masks with the start mask moved from `start` to `goal`."""
        moved = [
            moved_mask(mask, camera, pose, start, goal)
            for mask, camera, pose in zip(
                self.start_mask(item), self.cameras, self.end_poses, strict=True
            )
        ]
        return self._jaccard(item, np.stack(moved), last)

    def _jaccard(self, item: int, reference: BoolArray, last: int) -> FloatArray:
        scores = np.median(jaccard(self.masks.masks[:, item, -last:], reference[:, None]), axis=1)
        return np.where(self.start_ok(item) & self.end_ok(item), scores, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Features of a rollout for one relation.

    Attributes:
        margins: by how much each condition holds [m].
        sigma_m: standard error of the margins [m].
        goal_jaccard: (V,) J of the subject with its goal mask.
        start_jaccard: (V,) J of the subject with its start mask; 1 = it did not move.
        notes: assumptions made on the way.
    """

    margins: dict[str, float]
    sigma_m: float
    goal_jaccard: FloatArray
    start_jaccard: FloatArray
    notes: tuple[str, ...]


def gather(
    views: Views, relation: Relation, subject: int, target: int, config: EvidenceConfig
) -> Evidence:
    """Measures where subject and target end and how that compares with the relation.

    Raises:
        CannotTell: objects lost, rays that miss each other, views that disagree.
    """
    _check_visible(views, subject, config)
    end = _locate_end(views, subject, config)
    start = _locate_start(views, subject)
    below, notes = _locate_target(views, target, config)
    height = _centre_height(views, subject, target, end, below)
    goal = relation.goal(below.point, height)
    goal_jaccard = np.full(len(views.cameras), np.nan)
    if start is None:
        notes = (*notes, f"no goal mask: '{views.masks.names[subject]}' has no known start")
    else:
        goal_jaccard = views.goal_jaccard(subject, start.point, goal, config.last_frames)
    known = goal_jaccard[np.isfinite(goal_jaccard)]
    if len(known) > 1 and np.ptp(known) > config.max_disagreement:
        raise CannotTell(
            'the views disagree: J with the goal mask is '
            + ', '.join(f'{value:.2f}' for value in known)
        )
    return Evidence(
        margins=relation.margins(end.point, below.point, height),
        sigma_m=float(np.hypot(end.sigma_m, below.sigma_m)),
        goal_jaccard=goal_jaccard,
        start_jaccard=views.start_jaccard(subject, config.last_frames),
        notes=notes,
    )


def _check_visible(views: Views, item: int, config: EvidenceConfig) -> None:
    """Refuses a subject that has all but vanished in every view that knows it."""
    areas = views.masks.masks[:, item].sum((-2, -1))
    largest = np.maximum(areas.max(1), views.start_mask(item).sum((-2, -1)))
    last = np.median(areas[:, -config.last_frames :], axis=1)
    known = views.end_ok(item)
    if known.any() and (last[known] < config.min_visible * largest[known]).all():
        share = float(np.max(last[known] / largest[known]))
        raise CannotTell(
            f"'{views.masks.names[item]}' has vanished: {share:.0%} of its area is left"
        )


def _locate_end(views: Views, item: int, config: EvidenceConfig) -> Location:
    """Where the object is at the end."""
    with_gaps = centroids(views.masks.masks[:, item, -config.last_frames :])
    pixels = np.array([_median_known(view) for view in with_gaps])
    known = views.end_ok(item)
    pixels[~known] = np.nan
    found = locate(views.cameras, views.end_poses, pixels)
    name = views.masks.names[item]
    if found is None:
        words = ', '.join(
            f'{camera.view}: {row[item] if row[item] != "ok" else "lost at the end"}'
            for camera, row, ok in zip(views.cameras, views.masks.status, known, strict=True)
            if not ok
        )
        raise CannotTell(f"'{name}' is known in fewer than two views ({words or 'one view'})")
    limit = config.max_residual * float(np.hypot(views.cameras[0].width, views.cameras[0].height))
    if found.residual_px > limit:
        raise CannotTell(
            f"the views disagree on where '{name}' is: their rays miss each other by "
            f'{found.residual_px:.1f} px, more than {limit:.1f}'
        )
    return found


def _locate_start(views: Views, item: int) -> Location | None:
    """Where the object was, None where the start frame does not tell."""
    pixels = centroids(views.start_mask(item))
    pixels[~views.start_ok(item)] = np.nan
    return locate(views.cameras, views.start_poses, pixels)


def _locate_target(
    views: Views, item: int, config: EvidenceConfig
) -> tuple[Location, tuple[str, ...]]:
    """Where the target ends; where it stood if the subject hides part of it."""
    start = _locate_start(views, item)
    if start is not None and _is_hidden_in_place(views, item, config):
        name = views.masks.names[item]
        return start, (f"'{name}' is partly hidden: taken to stand where it stood",)
    return _locate_end(views, item, config), ()


def _is_hidden_in_place(views: Views, item: int, config: EvidenceConfig) -> bool:
    """Whether some view shows less of it than before, and none shows it elsewhere."""
    first, last = views.start_mask(item), views.masks.masks[:, item, -1]
    area, first_area = last.sum((-2, -1)), first.sum((-2, -1))
    inside = (first & last).sum((-2, -1))
    hidden = views.start_ok(item) & (area < config.hidden_below * first_area)
    elsewhere = inside < 0.6 * area
    return bool(hidden.any() and not elsewhere.any())


def _centre_height(
    views: Views, subject: int, target: int, end: Location, below: Location
) -> float:
    """Height of the subject's centre over the target's when stacked [m]; both taken as cubes."""
    edges = []
    for item, place in ((subject, end), (target, below)):
        areas = views.masks.masks[:, item].sum((-2, -1))
        known = np.concatenate([areas, views.start_mask(item).sum((-2, -1))[:, None]], axis=1)
        largest = np.quantile(known, 0.8, axis=1)
        edges.append(block_size(views.cameras, views.end_poses, largest, place.point))
    return float(np.mean(edges))


def _median_known(pixels: FloatArray) -> FloatArray:
    """(2,) median of the rows that are known, NaN if none is."""
    known = pixels[np.isfinite(pixels[:, 0])]
    return np.median(known, axis=0) if len(known) else np.full(2, np.nan)


def relation_jaccard(
    views: Views, subject: int | None, evidence: Evidence | None, last: int
) -> FloatArray:
    """Returns (V, O): the subject's J with its goal mask, every other's with its start mask."""
    num_objects = len(views.masks.names)
    scores = [views.start_jaccard(item, last) for item in range(num_objects)]
    if subject is not None:
        unknown = np.full(len(views.cameras), np.nan)
        scores[subject] = unknown if evidence is None else evidence.goal_jaccard
    return np.stack(scores, axis=1) if scores else np.zeros((len(views.cameras), 0))


def view_mean(values: FloatArray) -> float:
    """Returns the mean over the views that know, NaN if none does."""
    return float(mean_of_known(values))
