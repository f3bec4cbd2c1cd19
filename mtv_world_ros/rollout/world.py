"""A policy in the loop: worlds in which it acts, and the one loop that drives them.

`World` is the same for the simulator and for imagination, so that a policy meets both alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from math import isfinite
import time
from typing import Protocol

from mtv_world_ros.core.data_types import JointTrajectory, Observation, SuccessEstimate
from mtv_world_ros.core.errors import PolicyError
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.policies.policy import first_part, Policy
from mtv_world_ros.rollout.options import DEFAULT_OPTIONS, RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.rollout.rollout import Rollout
from mtv_world_ros.success.estimator import verdict


class World(Protocol):
    """An environment in which a policy acts: the simulator, or imagination."""

    @property
    def instruction(self) -> str:
        """Text for the robot, once the world was reset."""
        ...

    @property
    def chunk_s(self) -> float:
        """Time after which a policy is asked again by default [s]."""
        ...

    def reset(self, *, seed: int) -> Observation:
        """Begin an episode; return its first observation."""
        ...

    def step(self, answer: JointTrajectory) -> Observation:
        """Execute an answer to the newest observation; return the observation after it.

        Args:
            answer: joints in any order; times count from the newest observation.

        Raises:
            PlanError: the robot cannot execute it.
        """
        ...

    def is_done(self) -> bool | None:
        """Return whether the task is done now; None = that cannot be told."""
        ...


class End(StrEnum):
    """Reason why an episode ended."""

    POLICY = 'the policy ended it'
    HELD = 'success held'
    ABSTAINS = 'the estimate abstains'
    TIME_OUT = 'time out'


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyRun:
    """Course of an episode.

    Attributes:
        num_chunks: number of answers that were executed.
        end: reason why there were no more.
        policy_s: time that the policy took [s].
    """

    num_chunks: int
    end: End
    policy_s: float

    @property
    def is_over(self) -> bool:
        """True if the episode ended before its limit."""
        return self.end != End.TIME_OUT


def run_policy(
    policy: Policy,
    world: World,
    *,
    seed: int = 0,
    max_chunks: int = 0,
    chunk_s: float = 0.0,
    hold: int = 0,
) -> PolicyRun:
    """Run a policy in a world for one episode.

    Args:
        policy: the policy; it is reset.
        world: the world; it is reset.
        seed: seed of the policy's and the world's randomness.
        max_chunks: number of answers after which the episode ends; 0 = the policy ends it.
        chunk_s: the policy is asked again after this time, or where its answer ends [s]; 0 = the
            world's.
        hold: the episode also ends when the task is done, or the estimate abstains, after this
            number of answers in a row; 0 = the episode does not end for that.

    Raises:
        PolicyError: the policy cannot answer.
        PlanError: its answer does not fit the robot.
    """
    policy.reset(seed=seed)
    observation = world.reset(seed=seed)
    chunk_s = chunk_s or world.chunk_s
    policy_s, verdicts = 0.0, list[bool | None]()
    while not max_chunks or len(verdicts) < max_chunks:
        begun = time.perf_counter()
        answer = policy.act(observation, world.instruction)
        policy_s += time.perf_counter() - begun
        if answer is None:
            return PolicyRun(num_chunks=len(verdicts), end=End.POLICY, policy_s=policy_s)
        observation = world.step(first_part(answer, observation.positions, chunk_s))
        verdicts.append(world.is_done() if hold else False)
        end = _end_of(verdicts[-hold:]) if len(verdicts) >= hold > 0 else None
        if end is not None:
            return PolicyRun(num_chunks=len(verdicts), end=end, policy_s=policy_s)
    return PolicyRun(num_chunks=len(verdicts), end=End.TIME_OUT, policy_s=policy_s)


def _end_of(verdicts: Sequence[bool | None]) -> End | None:
    """Return the end of an episode after these verdicts; None = no end."""
    if all(verdicts):
        return End.HELD
    return End.ABSTAINS if all(verdict is None for verdict in verdicts) else None


class ImaginedWorld:
    """Imagination as a world: predicted frames at the cameras' size, commanded joints, estimates.

    Attributes:
        observation: the newest one: real at first, then the last predicted frames.
        chunks: the chunks that were imagined since the last reset.

    Args:
        pipeline: imagines and judges.
        start: the real observation that every episode begins with.
        options: options of the rollouts; their seed is that of `reset`.
        on_chunk: called with every chunk once it is ready.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        start: Observation,
        options: RolloutOptions = DEFAULT_OPTIONS,
        on_chunk: Callable[[Prediction], object] = lambda _: None,
    ) -> None:
        self._pipeline, self._start, self._options = pipeline, start, options
        self._on_chunk = on_chunk
        self.chunks: list[Prediction] = []
        self.observation = start
        self._rollout: Rollout | None = None

    @property
    def rollout(self) -> Rollout:
        """The episode that was begun by the last reset.

        Raises:
            PolicyError: there was none.
        """
        if self._rollout is None:
            raise PolicyError('no episode was begun in this world: call its reset() first')
        return self._rollout

    @property
    def instruction(self) -> str:
        """Text for the robot."""
        return self._options.instruction

    @property
    def chunk_s(self) -> float:
        """Duration of a chunk of the model [s]."""
        return self._pipeline.spec.chunk_seconds

    @property
    def success(self) -> SuccessEstimate | None:
        """The estimate at the end of the newest chunk; None before the first one."""
        return self.chunks[-1].success if self.chunks else None

    @property
    def futures_key(self) -> str:
        """Digest of the simulated futures of the episode; empty = nothing is foreseen."""
        objects = None if self._rollout is None else self._rollout.objects
        return '' if objects is None else objects.futures_key

    def reset(self, *, seed: int) -> Observation:
        """Begin an episode at the real observation; return that."""
        self._rollout = self._pipeline.begin(self._start, replace(self._options, seed=seed))
        self.chunks, self.observation = [], self._start
        return self.observation

    def step(self, answer: JointTrajectory) -> Observation:
        """Imagine an answer; return the last predicted frames.

        Raises:
            PlanError: the robot cannot execute it.
            RolloutPreempted: `should_stop` of the options said so.
        """
        for chunk in self.rollout.extend(answer):
            self.chunks.append(chunk)
            self._on_chunk(chunk)
        height, width = self._start.frames.shape[1:3]
        seen = self.rollout.observation
        # a policy meets one size of images, whoever shows them
        self.observation = replace(
            seen, cameras=self._start.cameras, frames=resize_frames(seen.frames, width, height)
        )
        return self.observation

    def is_done(self) -> bool | None:
        """Return whether the estimate is a success at the end of the newest chunk.

        None = it abstains, or nothing was imagined yet.
        """
        success = self.success
        if success is None or not isfinite(success.probability):
            return None
        return verdict(success.probability, success.interval) == 1
