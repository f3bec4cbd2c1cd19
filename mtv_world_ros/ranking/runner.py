"""Runs a policy on an episode twice: in the simulator and in imagination."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass
from math import nan
import time

import numpy as np

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.pipeline import ImaginedEpisode, Pipeline
from mtv_world_ros.policies.policy import Policy
from mtv_world_ros.ranking.jobs import Job, Judged, Result
from mtv_world_ros.ranking.no_picture_rule import judge_without_pictures
from mtv_world_ros.ranking.optimism import last_frames_png
from mtv_world_ros.ranking.worlds import (
    ImaginedWorld,
    judge,
    PolicyRun,
    run_policy,
    SimulatedWorld,
    World,
)
from mtv_world_ros.sim.expert.expert import Expert
from mtv_world_ros.sim.expert.scripted_policy import scripted_policy
from mtv_world_ros.sim.world.simulator import SimEpisode
from mtv_world_ros.success.situation import CannotTell

#: (policy, task, seed, expert) -> policy; has to be picklable for several processes
MakePolicy = Callable[[str, str, int, Expert], Policy]


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutConfig:
    """How episodes are run.

    Attributes:
        num_inference_steps: denoising steps a chunk; 0 = those the model is made for.
        max_chunks: answers of the policy at most.
    """

    num_inference_steps: int = 1
    max_chunks: int = 8

    def __post_init__(self) -> None:
        if self.num_inference_steps < 0 or self.max_chunks < 1:
            raise ConfigError(
                f'{self.num_inference_steps} denoising steps and {self.max_chunks} chunks: steps '
                'must be 0 or more, chunks 1 or more (--steps, --max-chunks)'
            )


class RolloutRunner:
    """Runs jobs one after the other in one process.

    Args:
        pipeline: imagines and judges; its robot is the simulator's.
        config: how episodes are run.
        make_policy: makes a policy for an episode.
    """

    def __init__(
        self, pipeline: Pipeline, config: RolloutConfig, make_policy: MakePolicy = scripted_policy
    ) -> None:
        self.pipeline, self.config, self._make_policy = pipeline, config, make_policy
        self._expert = Expert(pipeline.robot)
        self._sim = SimEpisode(pipeline.robot, self._expert.home)

    def score(self, job: Job) -> Result:
        """Returns what a policy reached.

        Raises:
            PolicyError: the policy cannot answer.
            MtvWorldError: the episode cannot be simulated or imagined.
        """
        policy = self._make_policy(job.policy, job.task, job.seed, self._expert)
        world = SimulatedWorld(self._sim, self.pipeline.spec.fps, job.seed, job.task)
        real = self._run(policy, world, world.instruction, job)
        ever, final = world.outcome()
        begun = time.perf_counter()
        observed = self._begin(world, job)
        seen = judge(observed, world.chunks)
        judging_s = time.perf_counter() - begun
        begun = time.perf_counter()
        imagined = ImaginedWorld(self._begin(world, job))
        run = self._run(policy, imagined, world.instruction, job)
        imagining_s = time.perf_counter() - begun
        return Result(
            policy=job.policy,
            task=job.task,
            index=job.index,
            seed=job.seed,
            ever=ever,
            final=final,
            imagined=Judged.of(imagined.success),
            seen=Judged.of(seen),
            no_picture=_judge_without_pictures(self._begin(world, job), world),
            num_chunks=real.num_chunks,
            num_imagined=run.num_chunks,
            is_over=real.is_over and run.is_over,
            seconds={
                'policy': real.policy_s,
                'physics': world.physics_s,
                'rendering': world.rendering_s,
                'judging the simulated frames': judging_s,
                'imagining': imagining_s,
            },
            last_frames=base64.b64encode(
                last_frames_png(observed.observation.frames, imagined.observation.frames)
            ).decode(),
        )

    def _begin(self, simulated: SimulatedWorld, job: Job) -> ImaginedEpisode:
        """An episode that begins with the simulator's first observation."""
        return self.pipeline.begin(
            simulated.start,
            instruction=simulated.instruction,
            seed=job.seed,
            num_inference_steps=self.config.num_inference_steps,
        )

    def _run(self, policy: Policy, world: World, instruction: str, job: Job) -> PolicyRun:
        policy.reset(seed=job.seed)
        return run_policy(
            policy,
            world,
            instruction,
            chunk_s=self.pipeline.spec.chunk_seconds,
            max_chunks=self.config.max_chunks,
        )


def _judge_without_pictures(episode: ImaginedEpisode, simulated: SimulatedWorld) -> Judged:
    commands = np.concatenate([simulated.start.positions[None], *simulated.commands])
    try:
        success = judge_without_pictures(episode, commands)
    except CannotTell as reason:
        return Judged.stated(nan, f'abstains: {reason}')
    return Judged.stated(float(success), 'the no-picture rule')


def make_runner(make_pipeline: Callable[[], Pipeline], config: RolloutConfig) -> RolloutRunner:
    """Returns a runner of scripted policies; picklable with `functools.partial`."""
    return RolloutRunner(make_pipeline(), config)
