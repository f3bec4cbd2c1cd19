"""The simulator as a world in which a policy acts, see `rollout.world.World`."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
import time

import numpy as np

from mtv_world_ros.core.data_types import ByteArray, FloatArray, JointTrajectory, Observation
from mtv_world_ros.data.episode import simulated_place
from mtv_world_ros.robot.plan import Plan
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.simulation.collect.record import START_NS
from mtv_world_ros.simulation.scenes.tasks import Task
from mtv_world_ros.simulation.simulator import CONTROL_PERIOD_S, SimEpisode, SimObservation
from mtv_world_ros.success.task import ever_and_final

#: between the instants at which success is judged, as in recorded episodes [s]
_LOOK_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenChunk:
    """Frames and joints while one answer was executed.

    Attributes:
        frames: (V, T, H, W, 3) uint8 RGB at the model's rate.
        positions: (1 + T, J) measured, row 0 before the first frame [rad or m].
        commands: (T, J) commands at the frames [rad or m].
    """

    frames: ByteArray
    positions: FloatArray
    commands: FloatArray


class SimulatedWorld:
    """The simulator as a world.

    Attributes:
        start: first observation of the episode.
        observation: the newest observation.
        chunks: the observed chunks, one per answer of the policy.
        commands: (C, J) executed commands at the control rate, one array an answer [rad or m].
        physics_s: time that the physics took [s].
        rendering_s: time that pictures took, and building the scene [s].

    Args:
        sim: simulator of the episode.
        task: the task, or the name of a bundled one.
        fps: frame rate of the model [Hz]; pictures are taken at this rate, answers executed for
            whole frames.
        chunk_s: time after which a policy is asked again by default [s].
    """

    def __init__(self, sim: SimEpisode, task: str | Task, *, fps: float, chunk_s: float) -> None:
        self._sim, self._task, self._fps, self.chunk_s = sim, task, fps, chunk_s
        self.rendering_s = self.physics_s = 0.0
        self.chunks: list[SeenChunk] = []
        self.commands: list[FloatArray] = []
        self._target = np.array(sim.home)

    def reset(self, *, seed: int) -> Observation:
        """Build the scene of a seed; return the first observation."""
        begun = time.perf_counter()
        self.start = self.observation = self._observation(self._sim.reset(seed, self._task))
        self.rendering_s, self.physics_s = time.perf_counter() - begun, 0.0
        self.chunks, self.commands = [], []
        self._target = np.array(self._sim.home)
        return self.observation

    @property
    def instruction(self) -> str:
        """The language instruction."""
        return self._sim.instruction

    def step(self, answer: JointTrajectory) -> Observation:
        """Execute an answer; the arms hold up to a whole frame.

        Raises:
            PlanError: the robot cannot execute it.
        """
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
        return self.observation

    def is_done(self) -> bool:
        """Return whether the task's predicate holds now."""
        return self.outcome()[1]

    def outcome(self) -> tuple[bool, bool]:
        """Return whether the task was ever done, and is done at the end."""
        return ever_and_final(self._sim.task.succeeds(self._sim.situation()))

    def _advance(self, targets: FloatArray, number: int, is_frame: bool) -> SimObservation | None:
        """Return one control period; what is seen after it, if a picture is due."""
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
            place=simulated_place(self._sim.physics),
        )
