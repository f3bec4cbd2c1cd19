"""The share of foreseen motions in which a task succeeds: evidence before any picture.

Foresight gives several motions for one plan, from poses and sizes within the error of the masks.
Where some of them fail, a grasp is near its limits.

K motions, N steps, O objects, A arms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from mtv_world_ros.data_types import BoolArray, FloatArray
from mtv_world_ros.errors import CannotTell
from mtv_world_ros.geometry.chunk_plan import ChunkPlan
from mtv_world_ros.geometry.object_motion import FoundObjects
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.success.situation import TruePoses
from mtv_world_ros.success.task import ever_and_final, TaskSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeseenEnds:
    """Outcome of a task at the end of each motion.

    Attributes:
        done: (K,) whether the task is done.
        weights: (K,) weight of each motion.
    """

    done: BoolArray
    weights: FloatArray

    @property
    def share(self) -> float:
        """Weighted share of the motions that succeed."""
        return float(np.average(self.done, weights=self.weights))

    @property
    def is_majority(self) -> BoolArray:
        """(K,) whether a motion has the outcome of the weighted majority."""
        return self.done == (self.share >= 0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeseenMotions:
    """Motions since the objects were found.

    Attributes:
        names: of O objects.
        points: (K, N, O, 3) [m], NaN where not known.
        rotations: (K, N, O, 3, 3) from the frame in which the objects were found, or were whole.
        sizes: (K, O, 3) extents [m].
        openings: (K, A, N) of the grippers, 0 closed to 1 open.
        weights: (K,) weight of each motion.
        step_s: time between rows [s].
        is_begun: whether the motions begin with the rollout, not later.
    """

    names: tuple[str, ...]
    points: FloatArray
    rotations: FloatArray
    sizes: FloatArray
    openings: FloatArray
    weights: FloatArray
    step_s: float = 0.1
    is_begun: bool = True

    def at_frames(self, plan: ChunkPlan) -> FloatArray:
        """Returns centres (K, 1 + T, O, 3) at the start and the frames kept of a chunk [m].

        Args:
            plan: the chunk, at whose end these motions end.
        """
        each = round(plan.frame_s / self.step_s)
        rows = self.points.shape[1] - 1 - each * np.arange(plan.num_frames, -1, -1)
        return self.points[:, np.maximum(rows, 0)]

    def ends(
        self, task: TaskSpec, bound: Mapping[str, str], starts: FloatArray
    ) -> ForeseenEnds | None:
        """Returns whether the task is done at the end of each; None = they do not tell.

        Args:
            task: its relations are evaluated.
            bound: placeholder -> name of its object.
            starts: (O, 3) where the objects were when the rollout began [m], NaN = as row 0.
        """
        if not set(bound.values()) <= set(self.names):
            return None
        if not self.is_begun and any(relation.is_of_course for relation in task.relations):
            return None
        items = {role: self.names.index(name) for role, name in bound.items()}
        if not np.isfinite(self.points[:, :, list(items.values())]).all():
            return None
        try:
            done = [self._done(k, task, items, starts) for k in range(len(self.points))]
        except CannotTell:
            return None
        return ForeseenEnds(done=np.array(done), weights=self.weights)

    def _done(
        self, number: int, task: TaskSpec, items: Mapping[str, int], starts: FloatArray
    ) -> bool:
        points, turns = self.points[number], self.rotations[number]
        first = np.where(np.isfinite(starts), starts, points[0])
        points = np.concatenate([first[None], points])
        turns = np.concatenate([turns[:1], turns])
        openings = self.openings[number]
        openings = np.concatenate([openings[:, :1], openings], axis=1)
        sizes = {
            role: _size(self.sizes[number, item], task.sizes_m.get(role))
            for role, item in items.items()
        }
        poses = TruePoses(
            positions={role: points[:, item] for role, item in items.items()},
            rotations={role: turns[:, item] for role, item in items.items()},
            sizes=sizes,
            openings=openings,
        )
        return ever_and_final(task.holds(poses, openings))[1]


def foreseen_of(
    robot: RobotModel, objects: FoundObjects, num_steps: int, *, is_begun: bool = True
) -> ForeseenMotions:
    """Returns the foreseen motions of objects, without the steps after `num_steps`.

    Grippers of a motion without openings are as wide as commanded.
    """
    assert objects.positions is not None
    kept = slice(0, num_steps)
    commanded = robot.gripper_openings(objects.positions).T
    openings = [commanded if m.openings is None else m.openings for m in objects.motions]
    return ForeseenMotions(
        names=objects.names,
        points=np.stack([motion.points[kept] for motion in objects.motions]),
        rotations=np.stack([motion.rotations[kept] for motion in objects.motions]),
        sizes=objects.tracked.sizes,
        openings=np.stack([rows[kept].T for rows in openings]),
        weights=np.array([motion.weight for motion in objects.motions]),
        step_s=objects.tracked.step_s,
        is_begun=is_begun,
    )


def _size(measured: FloatArray, usual: Sequence[float] | None) -> tuple[float, float, float]:
    """Extents of an object as masks show them, or else as usual [m]."""
    known = measured if usual is None or np.isfinite(measured).all() else usual
    x, y, z = map(float, known)
    return (x, y, z)


def foreseen_feature(ends: ForeseenEnds | None) -> float:
    """Returns the share of the motions that succeed, -1 (none) to 1 (all); NaN = not known."""
    return nan if ends is None else 2 * ends.share - 1
