"""Motions of objects in several futures, since the objects were found.

K motions, N steps, O objects, A arms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.physics.object_motion import FoundObjects
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import ChunkPlan


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeseenMotions:
    """Simulated motions of the objects in K futures, since the objects were found.

    Attributes:
        names: names of O objects.
        points: (K, N, O, 3) [m], NaN where not known.
        rotations: (K, N, O, 3, 3) rotations from the frame in which the objects were found, or
            were whole.
        sizes: (K, O, 3) extents [m].
        openings: (K, A, N) openings of the grippers, 0 closed to 1 open.
        weights: (K,) weight of each motion.
        step_s: time between rows [s].
        is_begun: whether the motions begin with the rollout, not later.
        is_fitted: contact parameters were fitted in this robot cell; False = they are drawn from
            the prior, and each motion may be the one that this robot makes every time.
        shown: index of the motion that the pictures show.
        tools: (A, N, 3) commanded positions of the tools [m]; None = not known.
    """

    names: tuple[str, ...]
    points: FloatArray
    rotations: FloatArray
    sizes: FloatArray
    openings: FloatArray
    weights: FloatArray
    step_s: float = 0.1
    is_begun: bool = True
    is_fitted: bool = True
    shown: int = 0
    tools: FloatArray | None = None

    def at_frames(self, plan: ChunkPlan) -> FloatArray:
        """Return centres (K, 1 + T, O, 3) at the start and the frames kept of a chunk [m].

        Args:
            plan: the chunk, at whose end these motions end.
        """
        each = round(plan.frame_s / self.step_s)
        rows = self.points.shape[1] - 1 - each * np.arange(plan.num_frames, -1, -1)
        return self.points[:, np.maximum(rows, 0)]


def foreseen_of(
    robot: RobotModel, objects: FoundObjects, num_steps: int, *, is_begun: bool = True
) -> ForeseenMotions:
    """Return the simulated motions of objects, cut after `num_steps`.

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
        is_fitted=objects.tracked.is_fitted,
        shown=objects.shown,
        tools=robot.tool_poses(objects.positions[kept])[..., :3, 3],
    )
