"""The simulator as a world that policies live in: physics, rendered frames, true success."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
import time

import numpy as np

from mtv_world_ros.data_types import ByteArray, FloatArray, JointTrajectory, Observation
from mtv_world_ros.geometry.resample import match_joints, resample
from mtv_world_ros.sim.collect.record import START_NS
from mtv_world_ros.sim.world.simulator import CONTROL_PERIOD_S, SimEpisode, SimObservation
from mtv_world_ros.success.task import ever_and_final

#: between the instants at which success is judged, as in recorded episodes [s]
_LOOK_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenChunk:
    """What was seen while an answer was executed.

    Attributes:
        start: before it.
        frames: (V, T, H, W, 3) uint8 RGB at the model's rate.
        positions: (1 + T, J) commanded, row 0 where the robot stood [rad or m].
    """

    start: Observation
    frames: ByteArray
    positions: FloatArray


class SimulatedWorld:
    """One episode of the simulator.

    Attributes:
        start: first observation.
        chunks: what was seen, one an answer.
        physics_s: time that the physics took [s].
        rendering_s: time that pictures took, and building the scene [s].

    Args:
        sim: renders.
        fps: of the model; pictures are taken at this rate, answers executed for whole frames.
        seed: of the episode.
        task: name of the task.
    """

    def __init__(self, sim: SimEpisode, fps: float, seed: int, task: str) -> None:
        begun = time.perf_counter()
        self._sim, self._fps = sim, fps
        self.start = self._observation(sim.reset(seed, task))
        self.rendering_s, self.physics_s = time.perf_counter() - begun, 0.0
        self.chunks: list[SeenChunk] = []
        self._target = np.array(sim.home)

    @property
    def instruction(self) -> str:
        """What the robot is told."""
        return self._sim.instruction

    def execute(self, observation: Observation, answer: JointTrajectory) -> Observation:
        """Returns what is seen once the answer is executed; the arms hold up to a whole frame."""
        matched = match_joints(answer, self._sim.robot, observation.positions)
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
                start=observation,
                frames=np.stack([found.frames for found in shown], axis=1),
                positions=np.concatenate([observation.positions[None], commands[rows]]),
            )
        )
        self._target = commands[-1]
        return shown[-1]

    def outcome(self) -> tuple[bool, bool]:
        """Returns whether the task's predicate ever held, and held at the end."""
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
        cameras = self._sim.scene.cameras
        return Observation(
            cameras=cameras,
            frames=np.stack([seen.images[camera.view] for camera in cameras]),
            positions=seen.positions,
            stamp_ns=START_NS + round(seen.time_s * 1e9),
        )
