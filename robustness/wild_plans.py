"""Plans that a bad policy sends, imagined by the bundled model: refused, or they end plausibly.

Every position is within the limits of its joint; what is wild is how the plan gets from one to the
next. A plan goes through the node's own checks, and what they let through is imagined for a chunk.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from mtv_world_ros.core.files import share_path
from mtv_world_ros.rollout.options import RolloutOptions

#: points of a plan
NUM_POINTS = 12
RATES_HZ = (2.0, 5.0, 10.0, 20.0, 50.0)
#: nothing on a table is thrown further than this in a chunk, by no policy [m]
FARTHEST_M = 10.0
#: arms do not reach further than this between two frames of 0.2 s [m]
REACH_M = 3.0


@cache
def bundled() -> Any:
    """The bundled model, on one thread."""
    from mtv_world_ros.rollout.pipeline import Pipeline

    return Pipeline.load('bundled', num_threads=1)


@cache
def first_scene() -> tuple[Any, str]:
    """What is seen where the bundled episode's first trajectory starts, and what is asked for."""
    from mtv_world_ros.data.episode_reader import read_episode
    from mtv_world_ros.data.observations import instruction_at

    pipeline = bundled()
    episode = read_episode(
        share_path('resource', 'demo_episode'), views=pipeline.spec.views, with_masks=False
    )
    from mtv_world_ros.data.observations import newest_observation

    stamp_ns = episode.trajectories[0][0]
    observation = newest_observation(episode, pipeline.spec.views, pipeline.robot, stamp_ns)
    return observation, instruction_at(episode, stamp_ns)


def samples() -> list[Any]:
    """A plan that stays where the robot is."""
    observation, _ = first_scene()
    times = np.arange(1, NUM_POINTS + 1) / 10.0
    return [(times, np.repeat(observation.positions[None], NUM_POINTS, axis=0), None)]


def _postures(rng: np.random.Generator) -> Any:
    """Random postures, one after the other."""
    robot = bundled().robot
    times = np.arange(1, NUM_POINTS + 1) / rng.choice(RATES_HZ)
    return times, rng.uniform(robot.lower, robot.upper, (NUM_POINTS, len(robot.lower))), None


def _swings(rng: np.random.Generator) -> Any:
    """To and fro, by a multiple of what joints can do."""
    robot, (start, _) = bundled().robot, first_scene()
    rate = rng.choice(RATES_HZ)
    step = rng.choice([0.3, 0.9, 1.5, 3.0, 10.0]) * robot.velocity_limits / rate
    rows = start.positions + step * rng.choice([-1.0, 0.0, 1.0], (NUM_POINTS, len(step))) / 2
    return np.arange(1, NUM_POINTS + 1) / rate, np.clip(rows, robot.lower, robot.upper), None


def _speeds(rng: np.random.Generator) -> Any:
    """Positions that stay, with velocities of any size."""
    times, rows, _ = samples()[0]
    size = 10.0 ** rng.uniform(-2, 300 if rng.random() < 0.3 else 4)
    return times, rows, size * rng.normal(size=rows.shape)


def _jump(rng: np.random.Generator) -> Any:
    """A plan that begins somewhere else, at once."""
    robot = bundled().robot
    times, rows, _ = samples()[0]
    where = rng.uniform(robot.lower, robot.upper)
    times = times - times[0] * rng.choice([0.0, 0.5, 1.0])
    return times, np.repeat(where[None], len(rows), axis=0), None


def _moments(rng: np.random.Generator) -> Any:
    """Points that lie nanoseconds, or minutes, apart."""
    times, rows, _ = samples()[0]
    times = np.cumsum(10.0 ** rng.uniform(-9, 1.5, len(times)))
    return times, rows + 0.01 * rng.normal(size=rows.shape), None


def _grippers(rng: np.random.Generator) -> Any:
    """Grippers that are told to open and close, as policies do: from one row to the next."""
    robot = bundled().robot
    times, rows, _ = samples()[0]
    rows = rows.copy()
    for tool in robot.tools:
        column = robot.joint_names.index(tool.gripper_joint)
        ends = [tool.gripper_closed, tool.gripper_open]
        rows[:, column] = np.clip(rng.choice(ends, len(rows)), *np.sort(ends))
    return times, rows, None


DAMAGES = (_postures, _swings, _speeds, _jump, _moments, _grippers)


def damaged(_: list[Any], rng: np.random.Generator) -> Any:
    """A wild plan."""
    return DAMAGES[rng.integers(len(DAMAGES))](rng)


def imagine(plan: Any, _: Any) -> None:
    """Imagine the first chunk of a plan.

    Raises:
        MtvWorldError: it is refused.
        AssertionError: it ends implausibly.
    """
    from mtv_world_ros.core.data_types import JointTrajectory

    pipeline, (observation, instruction) = bundled(), first_scene()
    times, rows, velocities = plan
    trajectory = JointTrajectory(
        joint_names=pipeline.robot.joint_names, times=times, positions=rows, velocities=velocities
    )
    episode = pipeline.begin(
        observation, RolloutOptions(instruction=instruction, num_inference_steps=1)
    )
    prediction = next(episode.extend(trajectory))
    check_plausible(episode, prediction)


def check_plausible(episode: Any, prediction: Any) -> None:
    """Judge what was imagined, by numbers that are not the node's."""
    success = prediction.success.probability
    assert np.isnan(success) or 0 <= success <= 1, f'a success estimate of {success}'
    robot = episode.pipeline.robot
    poses = robot.tool_poses(prediction.positions)[:, :, :3, 3]
    assert np.isfinite(poses).all(), 'tools are nowhere'
    if len(prediction.positions) > 1:
        steps = np.linalg.norm(np.diff(poses, axis=1), axis=-1)
        assert steps.max() < REACH_M, f'a tool went {steps.max():.1f} m in a frame'
    objects = episode._states[0].evidence.objects
    found = None if objects is None else objects.found
    if found is None or np.isnan(success):
        return
    for motion in found.motions:
        way = np.linalg.norm(motion.points - motion.points[:1], axis=-1)
        far = np.nanmax(way, initial=0.0)
        assert far < FARTHEST_M, f'an object went {far:.0f} m, and it was judged'
