import numpy as np
import pytest

from mtv_world_ros.errors import SimulatorError, TrajectoryError
from mtv_world_ros.geometry.robot import check_positions
from mtv_world_ros.sim.arm import BASE_POSITIONS
from mtv_world_ros.sim.episode import SimEpisode
from mtv_world_ros.sim.kinematics import ArmSolver, top_down
from mtv_world_ros.sim.record import chunk, expert_generator, RecordConfig, simulate
from mtv_world_ros.sim.tasks import TASKS


@pytest.fixture(scope='module')
def sim(robot, expert):
    return SimEpisode(robot, expert.home, rendering=False)


@pytest.mark.parametrize('name', TASKS)
def test_expert_succeeds_and_its_miss_leaves_the_objects_alone(sim, expert, name):
    config, task = RecordConfig(), TASKS[name]
    for seed in range(4):
        take = simulate(sim, expert, task, seed, config, miss=False)
        assert take.ever and take.final
        moved = take.moved
        missed = simulate(sim, expert, task, seed, config, miss=True)
        assert not missed.ever
        assert moved[0] > 0.05 and (missed.moved < 0.02).all()


def test_arms_follow_the_commands(sim, expert):
    take = simulate(sim, expert, TASKS['stack_blocks_two'], 0, RecordConfig(), miss=True)
    commands = take.commands.positions
    error = np.abs(take.control_positions[: len(commands)] - commands)
    assert error.max() < 0.05


def test_plan_keeps_the_joint_limits_and_starts_and_ends_at_home(robot, sim, expert):
    sim.reset(2, 'place_block_a2b_left')
    rng = expert_generator(2)
    plan = expert.plan(sim.task, sim.scene, rng, miss=False)
    check_positions(robot, plan.positions)
    np.testing.assert_allclose(plan.positions[[0, -1]], [expert.home] * 2, atol=5e-3)
    np.testing.assert_allclose(plan.velocities[-1], 0, atol=1e-2)


def test_a_resting_scene_stays_at_rest(sim, expert):
    sim.reset(0, 'stack_blocks_two')
    start = sim.object_positions()
    for _ in range(100):
        sim.advance(expert.home)
    np.testing.assert_allclose(sim.object_positions(), start, atol=1e-3)
    np.testing.assert_allclose(sim.positions(), expert.home, atol=2e-3)


def test_chunks_join_to_the_whole_trajectory(sim, expert):
    sim.reset(1, 'stack_blocks_two')
    plan = expert.plan(sim.task, sim.scene, expert_generator(1), miss=False)
    config = RecordConfig()
    first, second, late = (chunk(plan, start, config) for start in (0.0, 3.2, 6.4))
    assert first.times[0] == pytest.approx(0.1) and first.times[-1] == pytest.approx(3.2)
    np.testing.assert_array_equal(first.positions[-1], plan.positions[160])
    np.testing.assert_array_equal(second.positions[0], plan.positions[165])
    np.testing.assert_array_equal(late.positions[-1], plan.positions[-1])
    assert not late.velocities[-1].any()


def test_solver_reaches_poses_and_refuses_those_out_of_reach(robot):
    tool = robot.tools[0]
    solver = ArmSolver(robot, tool)
    x, y, _ = BASE_POSITIONS['left']
    pose = top_down(np.array([x + 0.1, y + 0.3, 0.05]), 0.3)
    joints = solver.solve(pose, np.array([0.0, 1.5, 1.5, -1.4, 0.0, 0.0]))
    positions = np.zeros((1, len(robot.joint_names)))
    positions[0, solver.indices] = joints
    np.testing.assert_allclose(robot.tool_poses(positions)[0, 0], pose, atol=2e-3)
    with pytest.raises(SimulatorError, match='out of reach'):
        solver.solve(top_down(np.array([x, y + 0.9, 0.05]), 0.0), joints)


def test_step_refuses_wrong_targets(sim):
    sim.reset(0, 'stack_blocks_two')
    with pytest.raises(TrajectoryError, match='14 finite values'):
        sim.step(np.zeros(13))
    with pytest.raises(TrajectoryError, match='14 finite values'):
        sim.step(np.full(14, np.nan))


def test_closed_loop_policy_sees_time_pass_and_joints_move(sim, expert):
    sim.reset(0, 'stack_blocks_two')
    targets = expert.home.copy()
    targets[0] += 0.2
    for _ in range(8):
        seen = sim.step(targets)
    assert seen.time_s == pytest.approx(0.8)
    assert seen.positions[0] == pytest.approx(targets[0], abs=0.02)
    assert not seen.success


def test_sampling_off_the_control_clock_is_refused():
    with pytest.raises(SimulatorError, match='multiple of 0.02'):
        RecordConfig(frame_period_s=0.033)
