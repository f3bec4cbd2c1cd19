"""The share of foreseen motions in which a task succeeds: evidence before any picture.

Foresight gives several motions for one plan, from poses and sizes within the error of the masks.
If a part of the motions fails, a grasp is near its limits.

K motions, N steps, O objects, A arms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import CannotTell
from mtv_world_ros.physics.foreseen_motions import ForeseenMotions
from mtv_world_ros.success.situation import TruePoses
from mtv_world_ros.success.task import ever_and_final, TaskSpec
from mtv_world_ros.success.views import Views


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeseenEnds:
    """Outcome of a task at the end of each motion.

    Attributes:
        done: (K,) whether the task is done.
        weights: (K,) weight of each motion.
        is_fitted: contact parameters were fitted in this robot cell.
    """

    done: BoolArray
    weights: FloatArray
    is_fitted: bool = True

    @property
    def outcomes(self) -> tuple[bool | None, ...]:
        """Outcome of each motion; None = the simulation of the motion was lost."""
        pairs = zip(self.done, self.weights, strict=True)
        return tuple(bool(done) if weight > 0 else None for done, weight in pairs)

    @property
    def share(self) -> float:
        """Weighted share of the motions that succeed."""
        return float(np.average(self.done, weights=self.weights))

    @property
    def num_effective(self) -> float:
        """Effective sample size: number of equally weighted motions with the same information."""
        return float(self.weights.sum() ** 2 / (self.weights**2).sum())

    @property
    def text(self) -> str:
        """Share of the motions that succeed, in words."""
        counts = f'{self.done.sum()} of {len(self.done)} foreseen motions succeed'
        return f'{counts}, {self.share:.0%} by weight'

    @property
    def num_lost(self) -> int:
        """Number of motions whose simulation was lost."""
        return int((self.weights <= 0).sum())

    @property
    def is_majority(self) -> BoolArray:
        """(K,) whether a motion has the outcome of the weighted majority."""
        return self.done == (self.share >= 0.5)


def foreseen_ends(
    motions: ForeseenMotions, task: TaskSpec, bound: Mapping[str, str], starts: FloatArray
) -> ForeseenEnds | None:
    """Return the outcome of the task at the end of each motion; None = not known.

    Args:
        motions: motions of the objects, in several futures.
        task: task whose relations are evaluated.
        bound: placeholder -> name of its object.
        starts: (O, 3) positions of the objects at the rollout's start [m], NaN = as row 0.
    """
    if not set(bound.values()) <= set(motions.names):
        return None
    if not motions.is_begun and any(relation.is_of_course for relation in task.relations):
        return None
    items = {role: motions.names.index(name) for role, name in bound.items()}
    if not np.isfinite(motions.points[:, :, list(items.values())]).all():
        return None
    try:
        done = [_is_done(motions, k, task, items, starts) for k in range(len(motions.points))]
    except CannotTell:
        return None
    return ForeseenEnds(done=np.array(done), weights=motions.weights, is_fitted=motions.is_fitted)


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureGap:
    """Largest distance of an object between the imagined frames and the drawn motion.

    Attributes:
        name: name of the object.
        distance_m: distance at the end of the chunk [m].
    """

    name: str
    distance_m: float

    @property
    def text(self) -> str:
        """Remark for the reader of an estimate."""
        return (
            f"imagined frames contradict the drawn motion: they show '{self.name}' "
            f'{1e3 * self.distance_m:.0f} mm from where it was drawn'
        )


def picture_gap(views: Views, motions: ForeseenMotions, names: Sequence[str]) -> PictureGap | None:
    """Return the distance of imagined objects from the motion drawn into the control.

    Args:
        views: masks of the imagined frames up to the end of the motions.
        motions: motions of the objects; the one that was shown counts.
        names: objects that are compared.

    Returns:
        The object that is farthest from its drawn end; None if no object can be located.
    """
    gaps = []
    for name in names:
        try:
            place, _ = views.end(views.index(name))
        except CannotTell:
            continue
        drawn = motions.points[motions.shown, -1, motions.names.index(name)]
        distance = float(np.linalg.norm(place.point - drawn))
        if isfinite(distance):
            gaps.append(PictureGap(name=name, distance_m=distance))
    return max(gaps, key=lambda gap: gap.distance_m, default=None)


def _is_done(
    motions: ForeseenMotions,
    number: int,
    task: TaskSpec,
    items: Mapping[str, int],
    starts: FloatArray,
) -> bool:
    points, turns = motions.points[number], motions.rotations[number]
    first = np.where(np.isfinite(starts), starts, points[0])
    points = np.concatenate([first[None], points])
    turns = np.concatenate([turns[:1], turns])
    openings = motions.openings[number]
    openings = np.concatenate([openings[:, :1], openings], axis=1)
    tools = motions.tools
    if tools is not None:
        tools = np.concatenate([tools[:, :1], tools], axis=1)
    sizes = {
        role: _size(motions.sizes[number, item], task.sizes_m.get(role))
        for role, item in items.items()
    }
    poses = TruePoses(
        positions={role: points[:, item] for role, item in items.items()},
        rotations={role: turns[:, item] for role, item in items.items()},
        sizes=sizes,
        openings=openings,
        tools=tools,
    )
    return ever_and_final(task.holds(poses, openings))[1]


def _size(measured: FloatArray, usual: Sequence[float] | None) -> tuple[float, float, float]:
    """Return the extents of an object as masks show them, or else as usual [m]."""
    known = measured if usual is None or np.isfinite(measured).all() else usual
    x, y, z = map(float, known)
    return (x, y, z)


def foreseen_feature(ends: ForeseenEnds | None) -> float:
    """Return the share of the motions that succeed, -1 (none) to 1 (all); NaN = not known."""
    return nan if ends is None else 2 * ends.share - 1
