"""Two worlds in which a policy's commands are executed: the simulator, and imagination."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from math import ceil, isfinite
import time
from typing import Protocol

import numpy as np

from mtv_world_ros.core.data_types import (
    ByteArray,
    FloatArray,
    JointTrajectory,
    Observation,
    SuccessEstimate,
)
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.policies.policy import first_part, Policy
from mtv_world_ros.ranking.rollout_jobs import StoredEstimate
from mtv_world_ros.robot.plan import Plan
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.rollout.rollout import Rollout
from mtv_world_ros.simulation.collect.record import START_NS
from mtv_world_ros.simulation.simulator import CONTROL_PERIOD_S, SimEpisode, SimObservation
from mtv_world_ros.success.task import ever_and_final

#: between the instants at which success is judged, as in recorded episodes [s]
_LOOK_S = 0.1


class World(Protocol):
    """Where a policy's commands are executed."""

    @property
    def observation(self) -> Observation:
        """What is seen now."""
        ...

    def execute(self, answer: JointTrajectory) -> None:
        """Executes an answer to the present observation, no longer than a chunk."""
        ...

    def is_done(self) -> bool | None:
        """Tells whether the task is done now; None = cannot tell."""
        ...


class End(StrEnum):
    """Why an episode ended."""

    POLICY = 'the policy ended it'
    HELD = 'success held'
    ABSTAINS = 'the estimate abstains'
    TIME_OUT = 'time out'


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyRun:
    """How an episode went.

    Attributes:
        num_chunks: answers that were executed.
        end: why there were no more.
        policy_s: time that the policy took [s].
    """

    num_chunks: int
    end: End
    policy_s: float

    @property
    def is_over(self) -> bool:
        """Whether something else than the limit ended it."""
        return self.end != End.TIME_OUT


def run_policy(
    policy: Policy,
    world: World,
    instruction: str,
    *,
    chunk_s: float,
    max_chunks: int,
    hold: int = 0,
) -> PolicyRun:
    """Runs a policy that was reset until the episode ends, or up to a limit of answers.

    Args:
        policy: the policy, which was reset.
        world: the world that executes its answers.
        instruction: the language instruction.
        chunk_s: the policy is asked again after this time, or where its answer ends [s].
        max_chunks: answers at most.
        hold: the episode also ends when the task is done, or the estimate abstains, after
            this number of answers in a row; 0 = then it goes on.

    Raises:
        PolicyError: the policy cannot answer.
        TrajectoryError: its answer does not fit the robot.
    """
    policy_s, verdicts = 0.0, []
    for number in range(max_chunks):
        begun = time.perf_counter()
        answer = policy.act(world.observation, instruction)
        policy_s += time.perf_counter() - begun
        if answer is None:
            return PolicyRun(num_chunks=number, end=End.POLICY, policy_s=policy_s)
        world.execute(first_part(answer, world.observation.positions, chunk_s))
        verdicts.append(world.is_done() if hold else False)
        end = _end_of(verdicts[-hold:]) if len(verdicts) >= hold > 0 else None
        if end is not None:
            return PolicyRun(num_chunks=number + 1, end=end, policy_s=policy_s)
    return PolicyRun(num_chunks=max_chunks, end=End.TIME_OUT, policy_s=policy_s)


def _end_of(verdicts: Sequence[bool | None]) -> End | None:
    """How an episode ends after these verdicts; None = it goes on."""
    if all(verdicts):
        return End.HELD
    return End.ABSTAINS if all(verdict is None for verdict in verdicts) else None


class ImaginedWorld:
    """Predicted frames at the cameras' size, commanded joints, estimates.

    Attributes:
        observation: the current one: real at first, then the last predicted frames.
        chunks: the imagined chunks.

    Args:
        episode: the imagined episode.
        start: the real observation that it begins with.
    """

    def __init__(self, episode: Rollout, start: Observation) -> None:
        self._episode, self._start = episode, start
        self.observation = start
        self.chunks: list[Prediction] = []

    @property
    def success(self) -> SuccessEstimate | None:
        """The estimate at the end; None before the first answer."""
        return self.chunks[-1].success if self.chunks else None

    def execute(self, answer: JointTrajectory) -> None:
        """Imagines an answer."""
        self.chunks += self._episode.extend(answer)
        height, width = self._start.frames.shape[1:3]
        seen = self._episode.observation
        # a policy meets one size of images, whoever shows them
        self.observation = replace(
            seen, cameras=self._start.cameras, frames=resize_frames(seen.frames, width, height)
        )

    def is_done(self) -> bool | None:
        """Tells whether the estimate is a success at the end of the last answer.

        None = it abstains.
        """
        judged = StoredEstimate.of(self.success)
        return judged.success == 1 if isfinite(judged.probability) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenChunk:
    """Frames and joints while one answer was executed.

    Attributes:
        frames: (V, T, H, W, 3) uint8 RGB at the model's rate.
        positions: (1 + T, J) measured, row 0 before the first frame [rad or m].
        commands: (T, J) at the frames [rad or m].
    """

    frames: ByteArray
    positions: FloatArray
    commands: FloatArray


class SimulatedWorld:
    """One episode of the simulator.

    Attributes:
        start: first observation.
        observation: the current observation.
        chunks: the observed chunks, one per answer of the policy.
        commands: (C, J) that were executed at the control rate, one array an answer.
        physics_s: time that the physics took [s].
        rendering_s: time that pictures took, and building the scene [s].

    Args:
        sim: the simulator.
        fps: of the model; pictures are taken at this rate, answers executed for whole frames.
        seed: the episode's random seed.
        task: name of the task.
    """

    def __init__(self, sim: SimEpisode, fps: float, seed: int, task: str) -> None:
        begun = time.perf_counter()
        self._sim, self._fps = sim, fps
        self.start = self.observation = self._observation(sim.reset(seed, task))
        self.rendering_s, self.physics_s = time.perf_counter() - begun, 0.0
        self.chunks: list[SeenChunk] = []
        self.commands: list[FloatArray] = []
        self._target = np.array(sim.home)

    @property
    def instruction(self) -> str:
        """The language instruction."""
        return self._sim.instruction

    def execute(self, answer: JointTrajectory) -> None:
        """Executes an answer; the arms hold up to a whole frame."""
        before = self.observation
        # checked as in imagination
        matched = Plan.of(answer, self._sim.robot, before).trajectory
        num_frames = max(1, ceil(float(matched.times[-1]) * self._fps - 1e-6))
        num = round(num_frames / self._fps / CONTROL_PERIOD_S)
        times = np.linspace(CONTROL_PERIOD_S, num * CONTROL_PERIOD_S, num)
        # from where the arms were sent last, as a controller would
        commands = resample(matched, self._target, times)
        rows = [round(k / self._fps / CONTROL_PERIOD_S) - 1 for k in range(1, num_frames + 1)]
        seen = [self._advance(row, k, k in rows) for k, row in enumerate(commands)]
        shown = [self._observation(found) for found in seen if found is not None]
        self.chunks.append(
            SeenChunk(
                frames=np.stack([found.frames for found in shown], axis=1),
                positions=np.stack([found.positions for found in (before, *shown)]),
                commands=commands[rows],
            )
        )
        self.commands.append(commands)
        self._target = commands[-1]
        self.observation = shown[-1]

    def is_done(self) -> bool:
        """Tells whether the task's predicate holds now."""
        return self.outcome()[1]

    def outcome(self) -> tuple[bool, bool]:
        """Returns whether the task was ever done, and is done at the end."""
        return ever_and_final(self._sim.task.succeeds(self._sim.situation()))

    def _advance(self, targets: FloatArray, number: int, is_frame: bool) -> SimObservation | None:
        """One control period; what is seen after it, if a picture is due."""
        begun = time.perf_counter()
        self._sim.advance(targets)
        if (number + 1) % round(_LOOK_S / CONTROL_PERIOD_S) == 0 and not is_frame:
            self._sim.observe(rendering=False)
        self.physics_s += time.perf_counter() - begun
        if not is_frame:
            return None
        begun = time.perf_counter()
        seen = self._sim.observe()
        self.rendering_s += time.perf_counter() - begun
        return seen

    def _observation(self, seen: SimObservation) -> Observation:
        cameras = self._sim.calibrated_cameras
        return Observation(
            cameras=cameras,
            frames=np.stack([seen.images[camera.view] for camera in cameras]),
            positions=seen.positions,
            stamp_ns=START_NS + round(seen.time_s * 1e9),
        )
