"""Evidence of a rollout about a task: margins of relations, J with goals, grasps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, isnan, nan

import numpy as np

from mtv_world_ros.cameras.mask_geometry import (
    block_size,
    count_reversals,
    Location,
    upright_extents,
    widest_swing,
)
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import CannotTell
from mtv_world_ros.success.footage_memory import MOVED_M, ObservedGrasp
from mtv_world_ros.success.relations import (
    Inside,
    Margin,
    Relation,
    ServedOn,
    Within,
)
from mtv_world_ros.success.task import TaskSpec
from mtv_world_ros.success.views import Views
from mtv_world_ros.vision.jaccard import mean_of_known


@dataclass(slots=True)
class ImaginedScene:
    """A `Situation` seen in masks; each object is located once, when it is asked for.

    Centres are those of the end (T = 1); clearances and reversals are those of all frames up to
    the end. The rotation of an object is not observed.

    Attributes:
        views: masks of the rollout.
        bound: placeholder -> name of its object.
        sizes: placeholder -> usual extents (3,) of its object [m]; not there = taken as a cube
            and measured.
        notes: assumptions made on the way, in order.
        sigmas: placeholder -> standard error of where its object is at the end [m].
    """

    views: Views
    bound: Mapping[str, str]
    sizes: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    notes: dict[str, None] = field(default_factory=dict)
    sigmas: dict[str, float] = field(default_factory=dict)
    _ends: dict[str, Location] = field(default_factory=dict)

    @property
    def tools(self) -> FloatArray | None:
        """Positions (A, 1, 3) of the tools in the last frame [m]; None = not known."""
        tools = self.views.footage.tools
        return None if tools is None else tools[:, -1:]

    def item(self, role: str) -> int:
        """Return the index of a placeholder's object."""
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
        """Raise CannotTell: pictures do not show the goal of a scene."""
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

    def seen_size(self, role: str) -> tuple[float, float]:
        """See `Situation`; by the masks of the rollout's first frame."""
        if role in self.sizes:
            wide, long, high = self.sizes[role]
            return (wide + long) / 2, high
        item, footage = self.item(role), self.views.footage
        found = upright_extents(
            footage.cameras,
            list(footage.poses[:, 0]),
            self.views.start_mask(item) & self.views.start_ok(item)[:, None, None],
            self.start(role),
        )
        if not np.isfinite(found).all():
            raise CannotTell(f"the size of '{self.bound[role]}' is not known")
        return found

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


#: relations of an object with what contains or carries it
_CONTAINING = (Within, Inside, ServedOn)
#: limit of margins [softness lengths]
MAX_MARGIN = 3.0
#: maximum horizontal distance of a tool from the centre of an object that it grasped [m]
GRASP_M = 0.02
#: maximum distance of a tool from the mask of an object that it grasped at the rim [m]
RIM_GAP_M = 0.01
#: maximum distance of a carried object from its position in the tool [m]
CARRY_ERROR_M = 0.025
#: upper limit of J between the start mask and the goal mask
MAX_START_JACCARD = 0.5
#: least and largest value of the features that masks may not show although the task has them
LIMITS = {
    'goal': (-1.0, 1.0),
    'contained': (-1.0, 1.0),
    'grasp': (-MAX_MARGIN, 1.0),
    'carry': (-MAX_MARGIN, 1.0),
    'moved': (0.0, 1.0),
}
#: names of the features of masks, in order
FEATURES: tuple[str, ...] = (
    'margin',
    'mean_margin',
    'goal',
    'contained',
    'grasp',
    'carry',
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Evidence of one rollout about one task.

    Attributes:
        worst: the condition nearest to failing, or furthest from holding; None = pictures do not
            tell.
        features: features by `FEATURES`, larger = likelier; NaN = says nothing about this task.
            And `moved`, 0 where an object that has to move is where it was.
        sigma: standard error of the worst margin, in units of its softness.
        goal_jaccard: object -> (V,) J with its goal mask.
        notes: assumptions made on the way.
        unknown: names of features that the task has, and that pictures do not show.
    """

    worst: Margin | None
    features: Mapping[str, float]
    sigma: float
    goal_jaccard: Mapping[int, FloatArray]
    notes: tuple[str, ...]
    unknown: frozenset[str] = frozenset()

    @classmethod
    def none(cls, reason: CannotTell) -> Evidence:
        """Return the evidence of pictures that do not show the outcome."""
        features = dict.fromkeys((*FEATURES, 'moved'), nan)
        notes = (f'pictures do not tell: {reason}',)
        return cls(worst=None, features=features, sigma=nan, goal_jaccard={}, notes=notes)


def gather(views: Views, task: TaskSpec, bound: Mapping[str, str]) -> Evidence:
    """Measure how far a task's relations hold at the end of a rollout.

    Args:
        views: masks, poses and memory of the rollout.
        task: task whose relations are evaluated.
        bound: placeholder -> name of its object.

    Raises:
        CannotTell: objects lost, rays that miss each other, views that disagree.
    """
    scene = ImaginedScene(views, bound, task.sizes_m)
    for role in task.movers:
        views.check_visible(scene.item(role))
    margins = [margin for relation in task.relations for margin in relation.margins(scene)]
    scores = [_score(margin, task) for margin in margins]
    worst = margins[int(np.argmin(scores))]
    goals, gains = _goals(scene, task)
    grasp, carry = _grasps(scene, task)
    features = {
        'margin': min(scores),
        'mean_margin': float(np.mean(scores)),
        'goal': gains,
        'contained': _contained(scene, task),
        'grasp': grasp,
        'carry': carry,
        'moved': _moved(scene, task),
    }
    asked = {
        'goal': any(relation.goal(scene) is not None for relation in task.relations),
        'contained': any(isinstance(one, _CONTAINING) for one in task.relations),
        'grasp': bool(task.movers),
        'carry': bool(task.movers),
        'moved': bool(task.movers),
    }
    sigma = float(np.hypot.reduce(sorted(scene.sigmas.values())[-2:])) if scene.sigmas else 0.0
    return Evidence(
        worst=worst,
        features=features,
        sigma=sigma / (worst.soft or task.softness_m) if worst.unit == 'm' else 0.0,
        goal_jaccard=goals,
        notes=tuple(scene.notes),
        unknown=frozenset(name for name in LIMITS if asked[name] and isnan(features[name])),
    )


def clipped(score: float) -> float:
    """Return the score within plus and minus `MAX_MARGIN`."""
    return min(max(score, -MAX_MARGIN), MAX_MARGIN)


def _score(margin: Margin, task: TaskSpec) -> float:
    return clipped(margin.end / (margin.soft or task.softness_m))


def _goals(scene: ImaginedScene, task: TaskSpec) -> tuple[dict[int, FloatArray], float]:
    """Return J of every subject with its goal mask, and their mean gain over the start, in -1..1.

    The start counts as at most `MAX_START_JACCARD`: what was in its goal from the first frame on
    has nothing to gain, and is judged by its J.
    """
    found: dict[int, FloatArray] = {}
    gains = []
    for relation in task.relations:
        masks = _goal_masks(scene, relation)
        if masks is None:
            continue
        item = scene.item(relation.subject)
        found[item], before = scene.views.goal_jaccard(item, masks)
        before = np.minimum(before, MAX_START_JACCARD)
        gain = (found[item] - before) / (1 - before)
        gains.append(view_mean(np.clip(2 * gain - 1, -1, 1)))
    return found, float(mean_of_known(np.array(gains))) if gains else nan


def _goal_masks(scene: ImaginedScene, relation: Relation) -> BoolArray | None:
    """Return the goal masks (V, H, W): the subject where it should be.

    None if that is not one place.
    """
    goal = relation.goal(scene)
    if goal is None:
        return None
    masks = scene.views.goal_masks(scene.item(goal[0]), goal[1])
    if masks is None:
        scene.notes[f"no goal mask: '{scene.bound[goal[0]]}' has no known start"] = None
    return masks


def _contained(scene: ImaginedScene, task: TaskSpec) -> float:
    """Return the overlap of each subject with its container or plate, in -1..1.

    The smallest one.
    """
    shares = [
        scene.views.containment(scene.item(relation.subject), scene.item(relation.target))
        for relation in task.relations
        if isinstance(relation, _CONTAINING)
    ]
    known = [share for share in shares if isfinite(share)]
    return 2 * min(known) - 1 if known else nan


def _grasps(scene: ImaginedScene, task: TaskSpec) -> tuple[float, float]:
    """Return two scores of grasps as causes of object motion: place of closing, and path.

    Positive = explained, at most 1; an object that did not move needs no grasp. NaN = the robot's
    motion is not known.
    """
    if scene.views.memory.levels is None:
        return nan, nan
    near, along = [1.0], [1.0]
    for role in task.movers:
        if not _is_start_known(scene, role):
            return nan, nan
        if not _has_moved(scene, role):
            continue
        off, error = _nearest_grasp(scene, role, is_rim=scene.bound[role].split()[-1] in task.rims)
        if isnan(off):
            return nan, nan
        near.append(1 - off)
        along.append(1 - error / CARRY_ERROR_M)
        if off > 1:
            text = 'is imagined to move, but no gripper closed where it could hold it'
            scene.notes[f"'{scene.bound[role]}' {text}"] = None
    return max(min(near), -MAX_MARGIN), max(min(along), -MAX_MARGIN)


def _moved(scene: ImaginedScene, task: TaskSpec) -> float:
    """Return 0 if an object that the task moves is known to have stayed at its start, else 1.

    NaN = of one it is not known.
    """
    for role in task.movers:
        trail = scene.views.memory.points[scene.item(role)]
        known = np.isfinite(trail).all(1)
        if known.sum() > 2 and known[0] and not _has_moved(scene, role):
            scene.notes[f"'{scene.bound[role]}' has not moved"] = None
            return 0.0
    return 1.0 if all(_is_start_known(scene, role) for role in task.movers) else nan


def _nearest_grasp(scene: ImaginedScene, role: str, *, is_rim: bool) -> tuple[float, float]:
    """Distance of the nearest grasp (1 = the limit), and the error of the path it explains [m].

    NaN = a gripper closed while it was not known where the object is, and no other one grasped it.
    """
    item = scene.item(role)
    best, error, is_unknown = np.inf, np.inf, False
    for grasp in scene.views.memory.grasps:
        away = float(np.hypot(*(grasp.closed_at - grasp.points[item])[:2])) / GRASP_M
        off = max(float(grasp.gaps_m[item]), 0.0) / RIM_GAP_M if is_rim else away
        is_unknown |= isnan(away)
        if off < best:  # NaN is not
            best, error = off, _carry_error(scene, role, grasp)
    return (nan, nan) if is_unknown and best > 1 else (best, error)


def _carry_error(scene: ImaginedScene, role: str, grasp: ObservedGrasp) -> float:
    """Distance in the table plane from where the grasp would have carried the object [m]."""
    until = grasp.released_at
    if until is None:
        tools = scene.views.footage.tools
        assert tools is not None
        until = tools[grasp.arm, -1]
    way = scene.centres(role)[-1] - grasp.points[scene.item(role)]
    return float(np.hypot(*(way - (until - grasp.closed_at))[:2]))


def _is_start_known(scene: ImaginedScene, role: str) -> bool:
    """Return True if it is known where the object was in the rollout's first frame."""
    return bool(np.isfinite(scene.views.memory.start_point(scene.item(role))).all())


def _has_moved(scene: ImaginedScene, role: str) -> bool:
    """Return True if the object was away from its start in at least three known frames."""
    trail = scene.views.memory.points[scene.item(role)]
    return _is_away(np.linalg.norm(trail - trail[0], axis=1))


def _is_away(away: FloatArray) -> bool:
    """Return True if at least three known distances are larger than `MOVED_M`."""
    known = away[np.isfinite(away)]
    return len(known) > 2 and float(np.partition(known, -3)[-3]) > MOVED_M


def view_mean(values: FloatArray) -> float:
    """Return the mean of the values that are not NaN, NaN if there is none."""
    return float(mean_of_known(values))
