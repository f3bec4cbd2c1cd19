"""Runs a policy on an episode twice: in the simulator and in imagination."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import nan
import time
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import ObjectMasks, SuccessEstimate
from mtv_world_ros.core.errors import CannotTell, ConfigError
from mtv_world_ros.core.estimate_words import cannot_tell
from mtv_world_ros.data.episode import NOMINAL
from mtv_world_ros.policies.policy import Policy
from mtv_world_ros.ranking.both_worlds import BothWorlds
from mtv_world_ros.ranking.flips import last_frames_png, OBJECTS, objects_png
from mtv_world_ros.ranking.jobs import Job, Result, StoredEstimate, StoredFutures
from mtv_world_ros.ranking.no_picture_rule import judge_without_pictures
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.rollout import Rollout
from mtv_world_ros.rollout.world import ImaginedWorld, PolicyRun, run_policy, World
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.scenes.tasks import Task
from mtv_world_ros.simulation.simulated_world import SimulatedWorld
from mtv_world_ros.simulation.simulator import SimEpisode
from mtv_world_ros.success.task import TaskSpec

#: (policy, task, seed, expert) -> policy; has to be picklable for several processes
MakePolicy = Callable[[str, Task, int, Expert], Policy]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunnerConfig:
    """Settings of a ranking's episodes.

    Attributes:
        num_inference_steps: denoising steps a chunk; 0 = those the model is made for.
        max_chunks: answers of the policy at most.
        hold: number of consecutive answers after which an episode ends if the task is done, or the
            estimate abstains; 0 = the episode continues.
        clips: keep each episode as a video, a contact sheet and frames; takes as long as
            imagining it.
        physics: physics of the simulator, a key of `config/physics.yaml`.
        make_policy: function that returns the policy of an episode.
    """

    num_inference_steps: int = 1
    max_chunks: int = 8
    hold: int = 0
    clips: bool = True
    physics: str = NOMINAL
    make_policy: MakePolicy = scripted_policy

    def __post_init__(self) -> None:
        if self.hold < 0:
            raise ConfigError(f'--hold is {self.hold}; it must be 0 or more')
        if self.num_inference_steps < 0 or self.max_chunks < 1:
            raise ConfigError(
                f'{self.num_inference_steps} denoising steps and {self.max_chunks} chunks: steps '
                'must be 0 or more, chunks 1 or more (--steps, --max-chunks)'
            )


class EpisodeRunner:
    """Runs jobs one after the other in one process.

    Args:
        pipeline: imagines and judges; its robot is the simulator's.
        config: denoising steps, limits and physics of the episodes.
    """

    def __init__(self, pipeline: Pipeline, config: RunnerConfig) -> None:
        self.pipeline, self.config = pipeline, config
        self._expert = Expert(pipeline.robot, physics=config.physics)
        self._sim = SimEpisode(pipeline.robot, self._expert.home, physics=config.physics)

    def score(self, job: Job) -> Result:
        """Return the result of a policy on an episode in both worlds.

        Raises:
            PolicyError: the policy cannot answer.
            MtvWorldError: the episode cannot be simulated or imagined.
        """
        return self.imagine(job, self.simulate(job))

    def simulate(self, job: Job) -> SimulatedEpisode:
        """Return the rollout of a policy in the simulator."""
        task = job.load_task()
        policy = self.config.make_policy(job.policy, task, job.seed, self._expert)
        spec = self.pipeline.spec
        world = SimulatedWorld(self._sim, task, fps=spec.fps, chunk_s=spec.chunk_seconds)
        run = self._run(policy, world, job)
        ever, final = world.outcome()
        return SimulatedEpisode(
            policy=policy,
            world=world,
            task=task.definition if job.task_definition else None,
            instruction=world.instruction,
            run=run,
            ever=ever,
            final=final,
        )

    def imagine(self, job: Job, real: SimulatedEpisode) -> Result:
        """Return the result of a policy whose rollout was simulated already."""
        world = real.world
        begun = time.perf_counter()
        observed = self._begin(real, job)
        found = [observed.observe(chunk.frames, chunk.positions) for chunk in world.chunks]
        judging_s = time.perf_counter() - begun
        begun = time.perf_counter()
        options = self._options(real, job, observed.names)  # a describer is asked once
        imagined = ImaginedWorld(self.pipeline, world.start, options)
        run = self._run(real.policy, imagined, job)
        imagining_s = time.perf_counter() - begun
        begun = time.perf_counter()
        pictures = self._pictures_alone(job, real, observed.names) or imagined.success
        pictures_s = time.perf_counter() - begun
        both = BothWorlds(
            fps=self.pipeline.spec.fps,
            real=world.chunks,
            observed=found,
            imagined=imagined.chunks,
        )
        last = last_frames_png(observed.observation.frames, imagined.rollout.observation.frames)
        return Result(
            policy=job.policy,
            task=job.task,
            index=job.index,
            seed=job.seed,
            ever=real.ever,
            final=real.final,
            imagined=StoredEstimate.of(imagined.success),
            foreseen=StoredEstimate.of_motions(imagined.success),
            pictures=StoredEstimate.of(pictures),
            seen=StoredEstimate.of(found[-1].success if found else None),
            no_picture=self._judge_without_pictures(job, real, observed.names),
            num_chunks=real.run.num_chunks,
            num_imagined=run.num_chunks,
            is_over=real.run.is_over and run.is_over,
            end=real.run.end,
            imagined_end=run.end,
            seconds={
                'policy': real.run.policy_s,
                'physics': world.physics_s,
                'rendering': world.rendering_s,
                'judging the simulated frames': judging_s,
                'imagining': imagining_s,
                'imagining without foresight': pictures_s,
            },
            futures=StoredFutures.of(imagined.success, imagined.futures_key),
            course=both.course(),
            files={
                '.png': base64.b64encode(last).decode(),
                **({OBJECTS: _objects_shown(found[-1].masks)} if found else {}),
                **(both.files() if self.config.clips else {}),
            },
        )

    def _pictures_alone(
        self, job: Job, real: SimulatedEpisode, objects: tuple[str, ...]
    ) -> SuccessEstimate | None:
        """Return the estimate of an episode in which no motion is foreseen.

        None = none ever is.
        """
        if self.pipeline.judge.object_motion is None:
            return None
        pipeline, options = self.pipeline.without_foresight(), self._options(real, job, objects)
        world = ImaginedWorld(pipeline, real.world.start, options)
        self._run(real.policy, world, job)
        return world.success

    def _judge_without_pictures(
        self, job: Job, real: SimulatedEpisode, objects: tuple[str, ...]
    ) -> StoredEstimate:
        """Return the verdict of the no-picture rule."""
        world, episode = real.world, self._begin(real, job, objects)
        commands = np.concatenate([world.start.positions[None], *world.commands])
        try:
            success = judge_without_pictures(self.pipeline, episode, commands)
        except CannotTell as reason:
            return StoredEstimate.stated(nan, cannot_tell(reason))
        return StoredEstimate.stated(float(success), 'the no-picture rule')

    def _begin(self, real: SimulatedEpisode, job: Job, objects: tuple[str, ...] = ()) -> Rollout:
        """Return an episode that begins with the simulator's first observation."""
        return self.pipeline.begin(real.world.start, self._options(real, job, objects))

    def _options(
        self, real: SimulatedEpisode, job: Job, objects: tuple[str, ...]
    ) -> RolloutOptions:
        """Return the options of the rollouts that begin with the simulator's first observation."""
        return RolloutOptions(
            instruction=real.instruction,
            objects=objects,
            task=real.task,
            seed=job.seed,
            num_inference_steps=self.config.num_inference_steps,
        )

    def _run(self, policy: Policy, world: World, job: Job) -> PolicyRun:
        return run_policy(
            policy,
            world,
            seed=job.seed,
            max_chunks=self.config.max_chunks,
            hold=self.config.hold,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedEpisode:
    """An episode in the simulator.

    Attributes:
        policy: the policy that acted.
        world: the observations and commands.
        task: definition of a task that is not bundled; None = it is bundled.
        instruction: the language instruction.
        run: number of answers, end and time of the episode.
        ever: the task was done at some time.
        final: whether the task was done at the end.
    """

    policy: Policy
    world: SimulatedWorld
    task: TaskSpec | None
    instruction: str
    run: PolicyRun
    ever: bool
    final: bool


@dataclass(frozen=True, slots=True)
class Results:
    """Results of one job, by checkpoint; None = the checkpoint was not requested."""

    by_checkpoint: tuple[Result | None, ...]

    def as_json(self) -> dict[str, Any]:
        """Return plain values by number of the checkpoint."""
        return {str(k): r.as_json() for k, r in enumerate(self.by_checkpoint) if r is not None}


class ComparisonRunner:
    """Runs jobs in the imagination of several checkpoints; each is simulated once.

    Args:
        runners: runners of the checkpoints, one each; their models have the same frame rate.
    """

    def __init__(self, runners: Sequence[EpisodeRunner]) -> None:
        self._runners = runners
        rates = {runner.pipeline.spec.fps for runner in runners}
        if len(rates) > 1:
            raise ConfigError(
                f'the checkpoints have the frame rates {sorted(rates)} Hz; only those of one rate '
                'can share simulated rollouts: rank them one after the other'
            )

    def score(self, wanted: WantedJob) -> Results:
        """Return the results of a policy on an episode, one for each checkpoint that lacks it."""
        job, real = wanted.job, self._runners[0].simulate(wanted.job)
        return Results(
            tuple(
                runner.imagine(job, real) if number in wanted.checkpoints else None
                for number, runner in enumerate(self._runners)
            )
        )


@dataclass(frozen=True, slots=True)
class WantedJob:
    """A job, and the numbers of the checkpoints that are to imagine it."""

    job: Job
    checkpoints: tuple[int, ...]


def _objects_shown(masks: ObjectMasks) -> str:
    """Return the object masks of the last real frames in the format of `Result.files`."""
    return base64.b64encode(objects_png(masks.masks[:, :, -1])).decode()


def make_runner(
    make_pipelines: Sequence[Callable[[], Pipeline]], config: RunnerConfig
) -> ComparisonRunner:
    """Return a runner; picklable with `functools.partial`."""
    return ComparisonRunner([EpisodeRunner(make(), config) for make in make_pipelines])
