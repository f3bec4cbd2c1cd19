"""How likely the task succeeds, from the imagined masks; abstains where it cannot tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import exp, isfinite, nan

import numpy as np

from mtv_world_ros.data_types import CameraModel, FloatArray, ObjectMasks, SuccessEstimate
from mtv_world_ros.errors import ConfigError, nearest
from mtv_world_ros.success.evidence import (
    CannotTell,
    Evidence,
    EvidenceConfig,
    gather,
    relation_jaccard,
    view_mean,
    Views,
)
from mtv_world_ros.success.task import load_tasks, match_task, TaskSpec

__all__ = ['EstimatorConfig', 'SuccessEstimator', 'load_tasks']

#: a gripper at least this open has let go
OPEN_GRIPPER = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatorConfig:
    """The logistic's weights, which are stated, not calibrated, and when to abstain.

    Attributes:
        margin_weight: logit per softness length of the smallest margin.
        max_margin: the smallest margin is clipped to this many softness lengths.
        jaccard_weight: logit of (2 J with the goal mask - 1).
        evidence: when masks are not enough.
    """

    margin_weight: float = 1.5
    max_margin: float = 3.0
    jaccard_weight: float = 1.0
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)


class SuccessEstimator:
    """Judges rollouts of known tasks."""

    def __init__(
        self,
        tasks: Sequence[TaskSpec] = (),
        task: str | None = None,
        config: EstimatorConfig | None = None,
    ) -> None:
        """Sets what may be judged.

        Args:
            tasks: known tasks.
            task: name of the one to judge; default: the one the instruction matches. Where the
                instruction names no objects for it, the first of two objects is its subject.
            config: weights and limits.

        Raises:
            ConfigError: `task` is not among `tasks`.
        """
        names = [known.name for known in tasks]
        if task is not None and task not in names:
            raise ConfigError(
                f"task '{task}' is not known{nearest(task, names)}; known are {sorted(names)} "
                '(add a file to config/tasks)'
            )
        self.tasks = tuple(known for known in tasks if task in (None, known.name))
        self.is_given = task is not None
        self.config = config or EstimatorConfig()

    def estimate(
        self,
        masks: ObjectMasks,
        start_masks: ObjectMasks,
        cameras: Sequence[CameraModel],
        T_base_camera: Sequence[FloatArray],
        instruction: str = '',
        *,
        T_base_camera_start: Sequence[FloatArray] | None = None,
        gripper_openings: FloatArray | None = None,
    ) -> SuccessEstimate:
        """Returns the probability that the task is done at the end of the rollout.

        `jaccard` holds J of the task's subject with its goal mask (its start mask, moved to
        where the relation wants it), and J of every other object with its own start mask.

        Args:
            masks: of the T predicted frames.
            start_masks: of the frame before them (T = 1).
            cameras: V cameras at the masks' size.
            T_base_camera: V poses (4, 4) at the end of the rollout.
            instruction: what the robot was told; says which task it is and with which objects.
            T_base_camera_start: V poses at the start; default: those of the end.
            gripper_openings: (A,) commanded at the end, 0 closed to 1 open, if known.
        """
        views = Views(
            masks=masks,
            start_masks=start_masks,
            cameras=cameras,
            start_poses=T_base_camera_start or T_base_camera,
            end_poses=T_base_camera,
        )
        last = self.config.evidence.last_frames
        subject = None
        try:
            task, bound = self._task(instruction, masks.names)
            subject = views.index(bound[task.relation.subject])
            target = views.index(bound[task.relation.target])
            evidence = gather(views, task.relation, subject, target, self.config.evidence)
        except CannotTell as reason:
            return SuccessEstimate(
                probability=nan,
                interval=(nan, nan),
                jaccard=relation_jaccard(views, subject, None, last),
                reasons=(f'abstains: {reason}',),
            )
        scores = relation_jaccard(views, subject, evidence, last)
        return self._judge(task, evidence, scores, gripper_openings)

    def _task(self, instruction: str, names: tuple[str, ...]) -> tuple[TaskSpec, dict[str, str]]:
        """The task and its objects; a given task takes the objects in their order."""
        matched = match_task(self.tasks, instruction)
        if matched is not None:
            return matched
        if self.is_given and len(names) == 2:
            relation = self.tasks[0].relation
            return self.tasks[0], {relation.subject: names[0], relation.target: names[1]}
        known = '; '.join(task.instruction for task in self.tasks) or 'none'
        raise CannotTell(f"'{instruction}' is no known task (known: {known})")

    def _judge(
        self,
        task: TaskSpec,
        evidence: Evidence,
        scores: FloatArray,
        gripper_openings: FloatArray | None,
    ) -> SuccessEstimate:
        worst = min(evidence.margins, key=lambda name: evidence.margins[name])
        margin = evidence.margins[worst]
        goal, start = view_mean(evidence.goal_jaccard), view_mean(evidence.start_jaccard)
        reached = 2 * goal - 1 if isfinite(goal) else 0.0
        spread = 1.96 * evidence.sigma_m
        low, middle, high = (
            self._probability(value / task.softness_m, reached)
            for value in (margin - spread, margin, margin + spread)
        )
        reasons = [
            f'{task.name}: {_worst_text(worst, margin)}, known to {1000 * spread:.0f} mm',
            f'J with the goal mask {goal:.2f}, with the start mask {start:.2f}',
            *evidence.notes,
        ]
        if gripper_openings is None:
            reasons.append('gripper not checked')
        elif float(np.min(gripper_openings)) < OPEN_GRIPPER:
            low, middle = 0.0, min(middle, 0.1)
            reasons.append('a gripper is still closed')
        reasons.append('uncalibrated: a logistic with stated weights, given the world model')
        return SuccessEstimate(
            probability=middle, interval=(low, high), jaccard=scores, reasons=tuple(reasons)
        )

    def _probability(self, margin: float, reached: float) -> float:
        """The logistic of the smallest margin, in softness lengths, and of J with the goal."""
        limit = self.config.max_margin
        clipped = min(max(margin, -limit), limit)
        logit = self.config.margin_weight * clipped + self.config.jaccard_weight * reached
        return 1.0 / (1.0 + exp(-logit))


def _worst_text(name: str, margin: float) -> str:
    """The condition nearest to failing, in words."""
    held = 'held' if margin >= 0 else 'missed'
    return f"'{name}' {held} by {abs(1000 * margin):.0f} mm"
