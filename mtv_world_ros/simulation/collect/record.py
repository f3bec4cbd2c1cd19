"""Simulates one episode with the expert or a faulty variant of it; writes its bag."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np

from mtv_world_ros.core.data_types import FloatArray, JointTrajectory
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.data.episode import PHYSICS
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.data.recording import stitch
from mtv_world_ros.robot.resample import resample
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.expert.scripted_policy import ScriptedPolicy
from mtv_world_ros.simulation.faults.catalogue import PolicyVariant
from mtv_world_ros.simulation.recorded_scene import dump_scene, dump_task, SCENE
from mtv_world_ros.simulation.scenes.tasks import Task
from mtv_world_ros.simulation.simulator import CONTROL_PERIOD_S, SimEpisode, SimObservation
from mtv_world_ros.success.task import ever_and_final

#: stamp of every episode's first frame [ns]; ROS takes zero for "not set"
START_NS = 1_700_000_000_000_000_000
#: an object further from its start than this was moved by a grasp that should have missed [m]
MISS_TOLERANCE_M = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordConfig:
    """Sampling settings of a recorded episode.

    Attributes:
        hold_s: time from the end of the commands to the last frame, at least [s].
        frame_period_s: between frames [s], at least 0.02; each is taken at the nearest multiple of
            0.02 s, and stamped with it.
        chunk_s: the policy publishes an action chunk this often, of this horizon [s].
        point_period_s: between the points of a chunk [s]; a multiple of 0.02.
        jpeg_quality: JPEG quality of the recorded frames, 1 to 100.
        max_attempts: seeds tried before an episode is given up.
        pictures: `all` frames have them, or only the `first`.
    """

    hold_s: float = 0.6
    frame_period_s: float = 0.1
    chunk_s: float = 3.2
    point_period_s: float = 0.1
    jpeg_quality: int = 88
    max_attempts: int = 25
    pictures: str = 'all'

    def __post_init__(self) -> None:
        if not self.frame_period_s >= CONTROL_PERIOD_S:
            raise SimulatorError(
                f'frame_period_s is {self.frame_period_s}; the simulator has at most '
                f'{1 / CONTROL_PERIOD_S:g} frames a second'
            )
        for field in ('hold_s', 'chunk_s', 'point_period_s'):
            value = getattr(self, field)
            periods = value / CONTROL_PERIOD_S
            if value <= 0 or abs(periods - round(periods)) > 1e-6:
                raise SimulatorError(
                    f'{field} is {value}; it must be a positive multiple of {CONTROL_PERIOD_S} s'
                )

    def frame_at(self, number: int) -> int:
        """Return the control period at which a frame is taken."""
        return round(number * self.frame_period_s / CONTROL_PERIOD_S)


@dataclass(frozen=True, slots=True, kw_only=True)
class Take:
    """A simulated episode in memory: T frames, C control samples.

    Attributes:
        observations: T observations, one a frame.
        control_positions: (C, J) measured joints at every control period.
        commands: the commanded trajectory.
        ever: True if the task was done in at least one frame.
        final: True if the task was done in each of the last frames.
        moved: role -> distance of the object from its start at the end [m].
        missed: role of the object that the gripper is to miss; None = none.
        any_outcome: True if the policy has faults, so that every outcome is accepted.
        object_poses: (T, O, 4, 4) T_base_object [m].
    """

    observations: tuple[SimObservation, ...]
    control_positions: FloatArray
    commands: JointTrajectory
    ever: bool
    final: bool
    moved: dict[str, float]
    missed: str | None = None
    any_outcome: bool = False
    object_poses: FloatArray

    def is_as_wanted(self) -> bool:
        """Return whether the expert succeeded to the end, or a miss moved nothing."""
        if self.any_outcome:
            return True
        if self.missed is not None:
            return not self.ever and self.moved[self.missed] < MISS_TOLERANCE_M
        return self.ever and self.final


def expert_generator(seed: int) -> np.random.Generator:
    """Return the generator of the expert's choices in an episode of this seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))


def simulate(
    sim: SimEpisode,
    expert: Expert,
    task: Task,
    seed: int,
    config: RecordConfig,
    *,
    miss: bool,
    variant: PolicyVariant | None = None,
) -> Take:
    """Run the expert, or a faulty variant of it, open loop on the episode of a seed.

    Args:
        sim: simulator; it is reset.
        expert: the scripted expert, which plans.
        task: the task to carry out.
        seed: the episode's random seed.
        config: sampling of frames and commands.
        miss: the expert displaces one grasp.
        variant: faulty variant that acts in place of the expert; None = the expert.

    Raises:
        SimulatorError: the expert cannot reach a way point.
        PolicyError: the variant finds no plan.
    """
    first = sim.reset(seed, task)
    if variant is None:
        commands = expert.plan(task, sim.scene, expert_generator(seed), miss=miss)
    else:
        policy = ScriptedPolicy(variant, expert, task, sim.scene)
        policy.reset(seed=seed)
        commands = policy.plan
    take = carry_out(sim, task, commands, first, config)
    return replace(
        take,
        missed=expert.missed_object(task, expert_generator(seed)) if miss else None,
        any_outcome=variant is not None,
    )


def carry_out(
    sim: SimEpisode,
    task: Task,
    commands: JointTrajectory,
    first: SimObservation,
    config: RecordConfig,
) -> Take:
    """Run commands open loop, as a controller would that is given the action chunks.

    Args:
        sim: simulator that has just been reset, or given a scene.
        task: the task whose relations decide success.
        commands: one row per control period.
        first: the simulator's first observation.
        config: sampling of frames and commands.
    """
    commands = as_published(commands, config)
    observations, measured = [first], [sim.positions()]
    last = len(commands.times) - 1
    least = last + round(config.hold_s / CONTROL_PERIOD_S)
    num_frames = next(n for n in count(1) if config.frame_at(n) >= least)
    for k in range(1, config.frame_at(num_frames) + 1):
        sim.advance(commands.positions[min(k, last)])
        measured.append(sim.positions())
        if k == config.frame_at(len(observations)):
            observations.append(sim.observe(rendering=config.pictures == 'all'))
    situation = sim.situation()
    ever, final = ever_and_final(task.succeeds(situation))
    return Take(
        observations=tuple(observations),
        control_positions=np.asarray(measured),
        commands=commands,
        ever=ever,
        final=final,
        moved={
            role: float(np.linalg.norm(centres[-1] - centres[0]))
            for role, centres in situation.positions.items()
        },
        object_poses=sim.seen_poses(),
    )


def as_published(commands: JointTrajectory, config: RecordConfig) -> JointTrajectory:
    """Return commands at every control period, interpolated between action chunks' points.

    Chunks have fewer points than control periods, so that fast motion between points is lost.
    The arms follow these commands, so that recorded commands and motion match.
    """
    num = len(commands.times) - 1
    starts = np.arange(0, num, round(config.chunk_s / CONTROL_PERIOD_S)) * CONTROL_PERIOD_S
    whole = stitch([(round(s * 1e9), action_chunk(commands, s, config)) for s in starts], 0)
    until = 1 + int(np.searchsorted(whole.times, num * CONTROL_PERIOD_S - 1e-9))
    times = np.arange(round(whole.times[:until][-1] / CONTROL_PERIOD_S) + 1) * CONTROL_PERIOD_S
    at = np.minimum(np.arange(len(times)), num)
    assert commands.velocities is not None
    return replace(
        commands,
        times=times,
        positions=resample(whole, commands.positions[0], times),
        velocities=np.where((np.arange(len(times)) <= num)[:, None], commands.velocities[at], 0.0),
    )


def action_chunk(
    commands: JointTrajectory, start_s: float, config: RecordConfig
) -> JointTrajectory:
    """Return the action chunk that starts at `start_s`; past the end the arms hold still."""
    stride = round(config.point_period_s / CONTROL_PERIOD_S)
    num = round(config.chunk_s / config.point_period_s)
    at = round(start_s / CONTROL_PERIOD_S) + stride * np.arange(1, num + 1)
    last = len(commands.times) - 1
    assert commands.velocities is not None
    velocities = np.where((at <= last)[:, None], commands.velocities[np.minimum(at, last)], 0.0)
    return JointTrajectory(
        joint_names=commands.joint_names,
        times=np.linspace(config.point_period_s, num * config.point_period_s, num),
        positions=commands.positions[np.minimum(at, last)],
        velocities=velocities,
    )


def _stamp(time_s: float) -> int:
    return START_NS + round(time_s * 1e9)


def write_take(
    path: Path,
    sim: SimEpisode,
    take: Take,
    seed: int | None,
    config: RecordConfig,
    **extra: str,
) -> None:
    """Write a take as a rosbag2 MCAP folder; it appears at `path` once it is complete.

    Args:
        path: folder to make.
        sim: still holding the take's scene and task.
        take: the take to write.
        seed: seed that draws its scene; None = none does.
        config: sampling that `take` was made with.
        extra: additional MCAP metadata.
    """
    objects = tuple(item.name for item in sim.scene.objects)
    metadata = {
        'ever': str(take.ever).lower(),
        'final': str(take.final).lower(),
        PHYSICS: sim.physics,
        SCENE: dump_scene(sim.scene),
        **dump_task(sim.task),
        **extra,
    }
    with EpisodeWriter(
        path,
        task=sim.task.name,
        instruction=sim.instruction,
        robot=sim.robot.name,
        cameras=sim.calibrated_cameras,
        seed=seed,
        objects=objects,
        metadata=metadata,
        jpeg_quality=config.jpeg_quality,
    ) as writer:
        writer.outcome = 'success' if take.ever and take.final else 'failure'
        writer.write_instruction(START_NS)
        chunk_every = round(config.chunk_s / CONTROL_PERIOD_S)
        names = sim.robot.joint_names
        velocities = np.gradient(take.control_positions, CONTROL_PERIOD_S, axis=0)
        last, frame = len(take.control_positions) - 1, 0
        for k, positions in enumerate(take.control_positions):
            stamp = _stamp(k * CONTROL_PERIOD_S)
            writer.write_joint_states(stamp, names, positions, velocities[k])
            if k == config.frame_at(frame):
                writer.write_object_poses(stamp, take.object_poses[frame])
                _write_frame(writer, sim, take.observations[frame], stamp)
                frame += 1
            if k % chunk_every == 0 and k < last:
                commands = action_chunk(take.commands, k * CONTROL_PERIOD_S, config)
                writer.write_trajectory(stamp, commands)


def _write_frame(writer: EpisodeWriter, sim: SimEpisode, seen: SimObservation, stamp: int) -> None:
    for camera in sim.calibrated_cameras if seen.images else ():
        writer.write_camera_info(camera.view, stamp, camera)
        writer.write_image(camera.view, stamp, seen.images[camera.view])
        writer.write_mask(camera.view, stamp, seen.masks[camera.view])
