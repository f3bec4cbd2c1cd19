"""What is carried out in a simulated episode, against what is published."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.collect.record import RecordConfig, simulate
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.opengl import missing_opengl
from mtv_world_ros.simulation.scenes.randomize import RandomizationConfig
from mtv_world_ros.simulation.scenes.tasks import task_named
from mtv_world_ros.simulation.simulated_world import SimulatedWorld
from mtv_world_ros.simulation.simulator import SimEpisode

TASK, SEED = 'stack_blocks_two', 3


@pytest.mark.skipif(bool(missing_opengl()), reason=missing_opengl() or '')
@pytest.mark.parametrize('name', ['expert', 'expert-fast-1.5', 'expert-choppy-0.6'])
def test_recorded_episodes_and_ranked_policies_are_carried_out_alike(name):
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    expert = Expert(robot)
    sim = SimEpisode(robot, expert.home, rendering=False)
    policy = scripted_policy(name, TASK, SEED, expert)
    take = simulate(
        sim,
        expert,
        task_named(TASK),
        SEED,
        RecordConfig(pictures='first'),
        miss=False,
        variant=policy.variant,
    )
    config = RandomizationConfig(width=96, height=72)
    sim = SimEpisode(robot, expert.home, config)
    world = SimulatedWorld(sim, TASK, fps=10.0, chunk_s=1.6)
    policy.reset(seed=SEED)
    observation = world.reset(seed=SEED)
    while (answer := policy.act(observation)) is not None:
        observation = world.step(answer)
    ranked = np.concatenate(world.commands)
    both = min(len(ranked), len(take.commands.positions) - 1)
    assert both > 200
    # where an answer begins, a controller does not know how fast the last one ended
    error = np.abs(ranked[:both] - take.commands.positions[1 : both + 1]).max(1)
    assert np.median(error) < 1e-9 and error.max() < 0.015
    assert world.outcome()[1] == (take.ever and take.final)
