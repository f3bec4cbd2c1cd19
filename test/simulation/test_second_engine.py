"""The engine DART as a scene's truth, drawn by MuJoCo."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from mtv_world_ros.core.errors import RobotError, SimulatorError
from mtv_world_ros.core.files import bundled
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.collect.record import carry_out, RecordConfig
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.scenes.tasks import task_named
from mtv_world_ros.simulation.simulator import SimEpisode

ROBOT = load_robot(bundled('robots', 'yam_bimanual', '--robot'))
TASK, SEED, GRAVITY, TABLE_FRICTION = 'place_block_a2b_left', 4, 9.81, 0.9
PHYSICS = 'dart'


@pytest.fixture(scope='module')
def expert():
    pytest.importorskip('dartpy', reason='dartpy is not installed (pip install .[dart])')
    return Expert(ROBOT, physics=PHYSICS)


def outcome(expert: Expert, policy: str) -> tuple[bool, float]:
    """Whether the task is done at the end, and how far the block was moved [m]."""
    acting = scripted_policy(policy, TASK, SEED, expert)
    acting.reset(seed=SEED)
    sim = SimEpisode(ROBOT, expert.home, rendering=False, physics=PHYSICS)
    record = RecordConfig(pictures='first')
    take = carry_out(sim, task_named(TASK), acting.plan, sim.reset(SEED, TASK), record)
    return take.final, take.moved['a']


@pytest.mark.slow
def test_the_expert_carries_a_block_and_what_misses_it_does_not(expert):
    final, moved = outcome(expert, 'expert')
    assert final and moved > 0.05
    final, moved = outcome(expert, 'expert-grasp_missed-1')
    assert not final and moved < 0.05


def test_arms_follow_as_those_of_the_first_engine_do(expert):
    """In free air, where no contact tells the engines apart."""
    found = []
    for physics in ('nominal', PHYSICS):
        sim = SimEpisode(ROBOT, expert.home, rendering=False, physics=physics)
        sim.reset(SEED, TASK)
        target, rows = np.array(sim.home), []
        for k in range(60):
            target[0] = sim.home[0] + 0.3 * np.sin(k / 15)
            sim.advance(target)
            rows.append(sim.positions())
        found.append(np.stack(rows))
    assert np.abs(found[0] - found[1]).max() < 0.01 < 0.2 < np.ptp(found[0][:, 0])


def test_a_block_slides_as_far_as_friction_has_it(expert):
    """Coulomb: v^2 / (2 mu g)."""
    sim = SimEpisode(ROBOT, expert.home, rendering=False, physics=PHYSICS)
    sim.reset(SEED, TASK)
    before, speed = sim.object_poses()[0, :3, 3], 0.6
    body = sim._second._bodies._solids[0]
    velocities = np.array(body.getVelocities())
    velocities[3:] = speed, 0.0, 0.0  # turns before ways, along the block's own axes
    body.setVelocities(velocities)
    for _ in range(20):
        sim.advance(sim.home)
    way = np.linalg.norm(sim.object_poses()[0, :3, 3] - before)
    assert way == pytest.approx(speed**2 / (2 * TABLE_FRICTION * GRAVITY), rel=0.1)


def test_drives_that_explicit_steps_would_excite_are_refused(expert):
    """Damping of 0.1 s of a gain of 25 limits/rad on 0.1 kg m2; below that, they diverge."""
    robot = load_robot(bundled('robots', 'franka', '--robot'))
    sim = SimEpisode(robot, Expert(robot, physics=PHYSICS).home, rendering=False, physics=PHYSICS)
    with pytest.raises(
        RobotError, match="robot 'franka': the drive of joint 'panda_joint1' is too"
    ):
        sim.reset(SEED, 'stack_blocks_two')


def test_without_the_engine_an_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, 'mtv_world_ros.simulation.dart.stepped_world', None)
    sim = SimEpisode(ROBOT, Expert(ROBOT, physics=PHYSICS).home, rendering=False, physics=PHYSICS)
    with pytest.raises(SimulatorError, match=r'needs dartpy: pip install .mtv_world_ros\[dart\]'):
        sim.reset(SEED, TASK)
