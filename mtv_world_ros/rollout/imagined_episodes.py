"""Whole episodes of a policy in imagination, each as a bag, from real first frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, count, islice
import json
from math import isfinite, nan
from pathlib import Path
from queue import Empty, SimpleQueue
import shutil
from threading import Thread
import time
from typing import Any

from mtv_world_ros.core.data_types import JointTrajectory, Observation
from mtv_world_ros.core.errors import (
    ConfigError,
    ModelMemoryError,
    MtvWorldError,
    PolicyError,
    RolloutPreempted,
)
from mtv_world_ros.core.executor import run_all
from mtv_world_ros.core.files import check_free, check_room, write_whole
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.core.workers import Workers
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.observations import observation_after
from mtv_world_ros.policies.policy import EpisodeOrigin, Policy
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.plan import PlanLimits
from mtv_world_ros.rollout.assembly import assemble_policy, policy_settings, PolicyMaker
from mtv_world_ros.rollout.candidates import (
    candidate_policy,
    CandidatePolicy,
    check_candidates,
)
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.rollout.prediction_writer import chunk_values, ERROR, OK, PredictionWriter
from mtv_world_ros.rollout.world import End, ImaginedWorld, run_policy
from mtv_world_ros.success.estimator import verdict_word
from mtv_world_ros.success.own_tasks import own_task
from mtv_world_ros.success.task import TaskSpec

#: free space that the bags and reports need before anything is computed [bytes]
ROOM_BYTES = 8 * 2**20
#: longest time of an episode on the wall, a hanging policy included [s]
LONGEST_EPISODE_S = 3600.0
#: distance between the seeds of two episodes
SEED_STEP = 1000
#: limits of the answers of a policy, as those of the node by default
LIMITS = PlanLimits(max_horizon_s=60.0, may_omit_joints=True)
_HOW = {End.POLICY: 'done', End.TIME_OUT: 'max_chunks'}


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeOptions:
    """Options of imagined episodes.

    Attributes:
        policy: YAML file, name of one in `config/policies`, or a scripted policy such as
            `expert-miss-0.5`.
        count: number of episodes.
        max_chunks: number of answers after which an episode ends; 0 = the policy ends it.
        instruction: text for the robot; empty = the start's.
        seed: episode k uses seed + 1000 k.
        num_inference_steps: denoising steps a chunk; 0 = those the model is made for.
        num_candidates: number of plans that the policy is asked for when an episode begins; the
            best one in simulated futures is imagined.
    """

    policy: str
    count: int = 1
    max_chunks: int = 0
    instruction: str = ''
    seed: int = 0
    num_inference_steps: int = 0
    num_candidates: int = 1

    def __post_init__(self) -> None:
        if self.num_candidates < 1:
            raise ConfigError(f'--candidates is {self.num_candidates}; it must be at least 1')


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeStart:
    """The real moment that an imagined episode starts from.

    Attributes:
        source: folder of the recorded episode, or `live`.
        observation: frames at the cameras' size, and joint positions.
        instruction: text for the robot; empty = not known.
        origin: task, scene and recording, for policies that use them in place of pictures.
        robot: the robot as it describes itself; None = the pipeline's.
        stored_objects: names of the objects that are stored with the recorded episode.
        task: task that the recorded episode defines; None = a task that the instruction matches.
    """

    source: str
    observation: Observation
    instruction: str
    origin: EpisodeOrigin
    robot: RobotModel | None = None
    stored_objects: tuple[str, ...] = ()
    task: TaskSpec | None = None

    def at_place(self, place: str) -> EpisodeStart:
        """Return the start with the name of its robot cell, see `Observation.place`."""
        return replace(self, observation=replace(self.observation, place=place))


def recorded_start(path: Path, pipeline: Pipeline) -> EpisodeStart:
    """Return the first moment of a recorded episode.

    Args:
        path: folder of the rosbag2 episode.
        pipeline: names the views and the joints.

    Raises:
        EpisodeError: the episode cannot be read.
        CalibrationError: a view is not calibrated.
        ConfigError: the task that the episode defines cannot be used.
    """
    views, robot = pipeline.spec.views, pipeline.robot
    episode = read_episode(path, views=views, with_masks=False, robot=robot)
    observation = observation_after(episode, views, robot, 0.0)
    info = episode.info
    return EpisodeStart(
        source=str(path),
        observation=observation,
        instruction=info.instruction,
        stored_objects=info.objects,
        task=own_task(info),
        origin=EpisodeOrigin(
            task=info.task,
            scene_seed=-1 if info.seed is None else info.seed,
            recording=str(path.absolute()),
            recording_ns=observation.stamp_ns,
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedSource:
    """Recorded episodes that imagined ones start from, in turn.

    Attributes:
        paths: folders of the recorded episodes.
        place: name of the robot cell; None = what the recording states.
    """

    paths: Sequence[Path]
    place: str | None = None

    def start(self, number: int, pipeline: Pipeline) -> EpisodeStart:
        """Return the start of the imagined episode of a number; see `recorded_start`."""
        path = self.paths[number % len(self.paths)]
        start = recorded_start(path, pipeline)
        return start if self.place is None else start.at_place(self.place)

    def starts(self, pipeline: Pipeline) -> Iterator[EpisodeStart]:
        """Return the starts one after the other, without end."""
        return (self.start(number, pipeline) for number in count())


def check_recording(policy: str, robot: RobotModel, *, is_recorded: bool) -> None:
    """Check that a policy which repeats a recording has one.

    Args:
        policy: name or file of the policy.
        robot: the robot that it moves.
        is_recorded: whether the episodes start from recorded ones.

    Raises:
        ConfigError: it repeats a recording, and there is none.
        PolicyError: there is no such policy.
    """
    settings = policy_settings(policy, robot)
    if settings.needs_recording and not is_recorded:
        raise ConfigError(
            f"policy '{policy}' repeats what was commanded in a recorded episode: give --episodes"
        )


def clear_episodes(out: Path, *, overwrite: bool) -> None:
    """Remove the imagined episodes of an earlier run from a folder, and make it.

    Raises:
        ConfigError: there are some, and they are not to be overwritten.
    """
    check_room(out, ROOM_BYTES)
    for bag in sorted(out.glob('episode_*')):
        check_free(bag, overwrite)
        shutil.rmtree(bag)
    out.mkdir(parents=True, exist_ok=True)
    (out / 'episodes.json').unlink(missing_ok=True)


def _makers(options: EpisodeOptions, robot: RobotModel) -> list[PolicyMaker]:
    """Return what makes the policies of an episode, one for each candidate plan."""
    check_candidates(options.policy, robot, options.num_candidates)
    return [assemble_policy(options.policy, robot) for _ in range(options.num_candidates)]


def _bag(out: Path, number: int) -> Path:
    return out / f'episode_{number:05d}'


def imagine_episodes(
    pipeline: Pipeline,
    options: EpisodeOptions,
    starts: Iterator[EpisodeStart],
    out: Path,
    *,
    overwrite: bool = False,
    on_start: Callable[[EpisodeStart], object] = lambda _: None,
    on_chunk: Callable[[Prediction], object] = lambda _: None,
) -> list[dict[str, Any]]:
    """Run the episodes; `out` gets a bag for each, and `episodes.json`.

    Args:
        pipeline: imagines and judges.
        options: policy, number of episodes and limits.
        starts: sources of the episodes' starts; asked once for each.
        out: folder of the results.
        overwrite: remove the episodes of an earlier run from it, once the first start is there.
        on_start: called at the start of each episode.
        on_chunk: called with every chunk once it is ready.

    Returns:
        Contents of `episodes.json`, one entry for each episode that was begun.

    Raises:
        ConfigError: `out` holds episodes, and `overwrite` is not set; no such policy.
        EpisodeError: a recorded episode cannot be used, or the disk is full.
        ObservationError: the cameras or the robot gave no observation.
    """
    makers = _makers(options, pipeline.robot)
    results = list[dict[str, Any]]()
    first = next(starts)
    clear_episodes(out, overwrite=overwrite)
    chosen = islice(chain([first], starts), options.count)
    for number, start in enumerate(Progress(chosen, total=options.count, unit='episode')):
        on_start(start)
        run = _EpisodeRun(pipeline, options, number, start, _bag(out, number))
        try:
            run.imagine(makers, on_chunk)
        finally:
            results.append({**run.result(), 'start': start.source})
            write_whole(out / 'episodes.json', json.dumps(results, indent=2) + '\n')
    return results


def imagine_recorded(
    make_pipeline: Callable[[], Pipeline],
    options: EpisodeOptions,
    source: RecordedSource,
    out: Path,
    workers: Workers,
    *,
    overwrite: bool = False,
) -> list[dict[str, Any]]:
    """Run episodes that start from recorded ones on several workers; see `imagine_episodes`.

    Args:
        make_pipeline: returns the pipeline; called once in every worker; has to be picklable.
        options: policy, number of episodes and limits.
        source: recorded episodes that imagination starts from.
        out: folder of the results.
        workers: where the episodes are imagined.
        overwrite: remove the episodes of an earlier run from it.

    Returns:
        Contents of `episodes.json`, one entry for each episode.

    Raises:
        ConfigError, EpisodeError: see `imagine_episodes` and `executor.started`.
    """
    clear_episodes(out, overwrite=overwrite)
    make_run = partial(_RecordedRun, make_pipeline, options, source, out)
    results = list[dict[str, Any]]()
    done = run_all(range(options.count), make_run, replace(workers, writes=out))
    for _, result in Progress(done, total=options.count, unit='episode'):
        results.append(result)
        results.sort(key=lambda one: one['episode'])
        write_whole(out / 'episodes.json', json.dumps(results, indent=2) + '\n')
    for unfinished in out.glob('.episode_*.tmp'):  # of workers that died
        shutil.rmtree(unfinished, ignore_errors=True)
    return results


class _RecordedRun:
    """Imagines the episode of a number in a worker."""

    def __init__(
        self,
        make_pipeline: Callable[[], Pipeline],
        options: EpisodeOptions,
        source: RecordedSource,
        out: Path,
    ) -> None:
        self._pipeline, self._options = make_pipeline(), options
        self._source, self._out = source, out
        self._makers = _makers(options, self._pipeline.robot)

    def __call__(self, number: int) -> dict[str, Any]:
        start = self._source.start(number, self._pipeline)
        bag = _bag(self._out, number)
        if bag.exists():  # of a worker that died
            shutil.rmtree(bag)
        run = _EpisodeRun(self._pipeline, self._options, number, start, bag)
        run.imagine(self._makers, lambda _: None)
        return {**run.result(), 'start': start.source}


class _EpisodeRun:
    """One imagined episode and its bag.

    Args:
        pipeline: imagines and judges.
        options: policy and limits.
        number: number of the episode.
        start: start of the episode.
        bag: folder of its bag.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        options: EpisodeOptions,
        number: int,
        start: EpisodeStart,
        bag: Path,
    ) -> None:
        self._pipeline = pipeline if start.robot is None else pipeline.with_robot(start.robot)
        self._options, self._start, self._bag = options, start, bag
        self._number, self._seed = number, options.seed + SEED_STEP * number
        self._begun_s = time.monotonic()
        self._num_chunks, self._policy = 0, options.policy
        self._last: Prediction | None = None
        self._choice = ''
        self._how, self._text = 'interrupted', 'it was stopped before its end'

    def imagine(
        self, makers: Sequence[PolicyMaker], on_chunk: Callable[[Prediction], object]
    ) -> None:
        """Run the policy until the episode ends; an error of the episode is its end."""
        robot, seen = self._pipeline.robot, self._start.observation
        instruction = self._options.instruction or self._start.instruction
        with PredictionWriter(self._bag, robot.joint_names, keep=True) as writer:
            writer.write_instruction(seen.stamp_ns, instruction)
            for camera, frame in zip(seen.cameras, seen.frames, strict=True):
                writer.write_observed(camera, seen.stamp_ns, frame)

            def keep(prediction: Prediction) -> None:
                self._last = prediction
                writer.write_chunk(prediction)
                end_ns = prediction.stamp_ns + round(float(prediction.video.times[-1]) * 1e9)
                writer.write_report(end_ns, OK, 'imagined', chunk_values(prediction))
                on_chunk(prediction)

            options = RolloutOptions(
                instruction=instruction,
                stored_objects=self._start.stored_objects,
                task=self._start.task,
                num_inference_steps=self._options.num_inference_steps,
                limits=LIMITS,
                should_stop=self._is_late,
            )
            world = _RecordedWorld(self._pipeline, seen, options, keep, writer)
            self._end(makers, world, options)
            if self._how not in ('done', 'max_chunks', 'max_seconds'):
                values = {'how': self._how, 'text': self._text}
                writer.write_report(world.observation.stamp_ns, ERROR, self._how, values)

    def result(self) -> dict[str, Any]:
        """Return the entry of `episodes.json`; numbers are null where the estimate abstains."""
        success = None if self._last is None else self._last.success
        low, high = (nan, nan) if success is None else success.interval
        probability = nan if success is None else success.probability
        numbers = {'success': probability, 'success_low': low, 'success_high': high}
        seconds = round(time.monotonic() - self._begun_s, 3)
        return {
            'episode': self._number,
            'bag': str(self._bag),
            'episode_s': seconds,
            'total_s': seconds,
            'how': self._how,
            'text': self._text,
            'policy': self._policy,
            **({'choice': self._choice} if self._choice else {}),
            'task': self._start.origin.task,
            'scene_seed': self._start.origin.scene_seed,
            'seed': self._seed,
            'num_chunks': self._num_chunks,
            **{key: value if isfinite(value) else None for key, value in numbers.items()},
            'verdict': verdict_word(probability, (low, high)),
            'trust': '' if success is None else success.trust,
            'reasons': '' if success is None else '; '.join(success.reasons),
        }

    def _end(
        self, makers: Sequence[PolicyMaker], world: _RecordedWorld, options: RolloutOptions
    ) -> None:
        """Run the episode; set how it ended."""
        policy: Policy | None = None
        try:
            policies = [make(self._start.origin) for make in makers]
            policy = candidate_policy(policies, self._pipeline, options)
            self._policy = policy.name
            with _PolicyThread(policy, self._left_s) as asked:
                run = run_policy(
                    asked, world, seed=self._seed, max_chunks=self._options.max_chunks
                )
            self._how, self._text = _HOW[run.end], ''
        except _NoAnswerError:
            limit = LONGEST_EPISODE_S
            self._how = 'max_seconds'
            self._text = f'the policy had not answered when {limit:g} s were over'
        except RolloutPreempted:
            limit = LONGEST_EPISODE_S
            self._how, self._text = 'max_seconds', f'it took longer than {limit:g} s'
        except PolicyError as error:
            self._how, self._text = 'policy_failed', str(error)
        except ModelMemoryError as error:
            self._how, self._text = 'failed', str(error)
        except MtvWorldError as error:
            if world.is_recording_broken:
                raise
            self._how, self._text = 'rejected', str(error)
        finally:
            self._num_chunks = world.num_answers
            if isinstance(policy, CandidatePolicy):
                self._choice = policy.choice

    def _left_s(self) -> float:
        """Time that is left of the episode's longest time on the wall [s]."""
        return self._begun_s + LONGEST_EPISODE_S - time.monotonic()

    def _is_late(self) -> bool:
        return self._left_s() < 0


class _RecordedWorld(ImaginedWorld):
    """Imagination whose answers and chunks are recorded.

    Attributes:
        num_answers: number of answers that were imagined.
        is_recording_broken: whether the last error was one of the recording.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        start: Observation,
        options: RolloutOptions,
        on_chunk: Callable[[Prediction], object],
        writer: PredictionWriter,
    ) -> None:
        super().__init__(pipeline, start, options, self._keep)
        self._take, self._writer = on_chunk, writer
        self.num_answers, self.is_recording_broken = 0, False

    def step(self, answer: JointTrajectory) -> Observation:
        """Record and imagine an answer; return the last predicted frames."""
        self.is_recording_broken = True
        self._writer.write_plan(self.observation.stamp_ns, answer)
        self.is_recording_broken = False
        seen = super().step(answer)
        self.num_answers += 1
        return seen

    def _keep(self, prediction: Prediction) -> None:
        self.is_recording_broken = True
        self._take(prediction)
        self.is_recording_broken = False


class _NoAnswerError(PolicyError):
    """The policy did not answer in time."""


class _PolicyThread:
    """A policy that is asked in a thread of its own, so that one that hangs ends the episode.

    Its errors of any kind are `PolicyError`s.

    Args:
        policy: the policy; all its calls come from one thread.
        left_s: returns the time that it may take now [s].
    """

    def __init__(self, policy: Policy, left_s: Callable[[], float]) -> None:
        self._policy, self._left_s, self.name = policy, left_s, policy.name
        self._questions = SimpleQueue[Callable[[], JointTrajectory | None] | None]()
        self._answers = SimpleQueue[JointTrajectory | None | BaseException]()

    def __enter__(self) -> _PolicyThread:
        # a daemon: one that hangs does not keep the process from ending
        Thread(target=self._run, name='policy', daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._questions.put(None)

    def reset(self, *, seed: int) -> None:
        """Begin an episode."""
        self._ask(lambda: self._policy.reset(seed=seed))

    def act(self, observation: Observation, instruction: str) -> JointTrajectory | None:
        """Return the policy's answer."""
        return self._ask(lambda: self._policy.act(observation, instruction))

    def _ask(self, question: Callable[[], JointTrajectory | None]) -> JointTrajectory | None:
        self._questions.put(question)
        try:
            answer = self._answers.get(timeout=max(self._left_s(), 0.0))
        except Empty:
            raise _NoAnswerError(f"policy '{self.name}' has not answered") from None
        if isinstance(answer, PolicyError):
            raise answer
        if isinstance(answer, Exception):  # a policy is a user's code
            raise PolicyError(f'{type(answer).__name__}: {answer}') from answer
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _run(self) -> None:
        while (question := self._questions.get()) is not None:
            try:
                self._answers.put(question())
            except BaseException as error:
                self._answers.put(error)
