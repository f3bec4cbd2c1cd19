"""A policy that asks several candidates for a plan and executes the best one in imagination."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

from mtv_world_ros.core.data_types import JointTrajectory, Observation, WorldModelSpec
from mtv_world_ros.core.errors import CheckpointError, ConfigError, PlanError
from mtv_world_ros.core.processes import threads_each
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.physics.checkpoint_files import load_foresight
from mtv_world_ros.policies.policy import PlannedPolicy, Policy
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import Plan
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.rollout.assembly import policy_settings
from mtv_world_ros.rollout.options import DEFAULT_OPTIONS, RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.plan_comparison import held_until
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.vision.camera_check import CameraChecker
from mtv_world_ros.vision.segmenters.choose import choose_segmenter


class CandidatePolicy:
    """Several instances of one policy with different seeds; the best one acts.

    The first question of an episode goes to all candidates. Their plans are compared in simulated
    futures of the scene, and the first candidate than which no other one is better acts for the
    rest of the episode, since later observations may show objects half hidden in a grip. The plan
    of a policy is its answer, or that of the whole episode where it knows it (`PlannedPolicy`).
    Candidate k gets seed + k, so that the first one acts as the policy would alone.

    Attributes:
        choice: chosen plan and its reason, in words; empty before the first answer.

    Args:
        policies: the candidates, two or more.
        pipeline: compares their plans; it needs no denoiser.
        options: names of the objects, task and limits.
    """

    def __init__(
        self,
        policies: Sequence[Policy],
        pipeline: Pipeline,
        options: RolloutOptions = DEFAULT_OPTIONS,
    ) -> None:
        self._policies, self._pipeline, self._options = tuple(policies), pipeline, options
        self._chosen: Policy | None = None
        self.choice = ''

    @property
    def name(self) -> str:
        """Name of the policy."""
        return self._policies[0].name

    def reset(self, *, seed: int) -> None:
        """Begin an episode with all candidates."""
        self._chosen, self.choice = None, ''
        for number, policy in enumerate(self._policies):
            policy.reset(seed=seed + number)

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Return the best candidate's commands, or None if the episode is over.

        Raises:
            PolicyError: a candidate cannot answer.
            MtvWorldError: the plans cannot be compared.
        """
        if self._chosen is not None:
            return self._chosen.act(observation, instruction)
        answers = [policy.act(observation, instruction) for policy in self._policies]
        best = self._best(answers, observation, instruction)
        self._chosen = self._policies[best]
        return answers[best]

    def _best(
        self, answers: Sequence[JointTrajectory | None], observation: Observation, instruction: str
    ) -> int:
        """Return the index of the best candidate, and set the choice."""
        count = len(answers)
        plans = {
            number: plan
            for number, (policy, answer) in enumerate(zip(self._policies, answers, strict=True))
            if answer is not None
            for plan in [policy.plan if isinstance(policy, PlannedPolicy) else answer]
            if self._can_execute(plan, observation)
        }
        if len(plans) < 2:
            best = next(iter(plans), 0)
            self.choice = f'plan {best + 1} of {count}: {len(plans)} can be executed'
            return best
        end_s = max(float(plan.times[-1]) for plan in plans.values())
        options = replace(self._options, instruction=instruction or self._options.instruction)
        found = self._pipeline.compare(
            observation, [held_until(plan, end_s) for plan in plans.values()], options
        )
        numbers = list(plans)
        self.choice = found.told_as([number + 1 for number in numbers], count)
        return numbers[found.best]

    def _can_execute(self, plan: JointTrajectory, observation: Observation) -> bool:
        """Return True if the robot can execute a plan."""
        try:
            Plan.of(plan, self._pipeline.robot, observation, self._options.limits)
        except PlanError:
            return False
        return True


def candidate_policy(
    policies: Sequence[Policy], pipeline: Pipeline, options: RolloutOptions = DEFAULT_OPTIONS
) -> Policy:
    """Return the policy of candidates; one candidate acts as it is."""
    if len(policies) == 1:
        return policies[0]
    return CandidatePolicy(policies, pipeline, options)


def check_candidates(policy: str | Path, robot: RobotModel, num_candidates: int) -> None:
    """Check that a policy can be asked for several plans at once.

    Raises:
        ConfigError: its server serves one client at a time, or there is no such policy.
    """
    if num_candidates > 1 and policy_settings(policy, robot).serves_one_client:
        raise ConfigError(
            f"the server of policy '{policy}' serves one client at a time, and candidates is "
            f'{num_candidates}: set candidates to 1'
        )


@dataclass(frozen=True, slots=True)
class _NoDenoiser:
    """A world model that imagines no frames: it has the clock and the views alone."""

    spec: WorldModelSpec

    def predict(self, *_: object, **__: object) -> NoReturn:
        """Refuse: no weights are loaded."""
        raise CheckpointError('this pipeline was loaded to compare plans; it imagines no frames')


def comparing_pipeline(checkpoint: Checkpoint, robot: RobotModel) -> Pipeline:
    """Return a pipeline that compares plans and imagines no frames; no weights are loaded.

    Args:
        checkpoint: checkpoint with object motion.
        robot: robot that executes the plans.

    Raises:
        ConfigError: the checkpoint foresees no object motion.
        CheckpointError, RobotError: a file cannot be used.
    """
    folder, control = checkpoint.object_motion, checkpoint.load_control(robot)
    motion = None
    if folder is not None and control.shows_objects:
        motion = load_foresight(folder, robot, threads_each(1))
    if motion is None:
        raise ConfigError(
            f"checkpoint '{checkpoint}' foresees no object motion, so that plans cannot be "
            'compared: set candidates to 1, or take a checkpoint with object_motion '
            '(mtv-world fit contact)'
        )
    segmenter = choose_segmenter()
    judge = replace(
        SuccessJudge.of(robot, segmenter),
        object_motion=motion,
        camera_checker=CameraChecker(robot, load_shape(robot)),
        checks_place=True,
    )
    return Pipeline(
        robot=robot,
        world_model=_NoDenoiser(checkpoint.spec),
        segmenter=segmenter,
        judge=judge,
        control=control,
    )
