from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.core.data_types import Observation
from mtv_world_ros.core.errors import PolicyError, SimulatorError
from mtv_world_ros.robot.model import check_positions
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.faults.catalogue import parse_variant, PolicyVariant
from mtv_world_ros.simulation.simulator import SimEpisode
from mtv_world_ros.success.task import ever_and_final

TASK = 'stack_blocks_two'
START_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope='module')
def sim(robot, expert):
    return SimEpisode(robot, expert.home, rendering=False)


def _policy(name, expert, task=TASK, seed=0):
    policy = scripted_policy(name, task, seed, expert)
    policy.reset(seed=seed)
    return policy


def _observation(seconds, expert):
    """An observation without cameras: a scripted policy looks at the stamp alone."""
    return Observation(
        cameras=(),
        frames=np.zeros((0, 1, 1, 3), np.uint8),
        positions=expert.home,
        stamp_ns=START_NS + round(seconds * 1e9),
    )


def _episode(policy, expert, step_s):
    """All commands (N, J), every 0.1 s, of which `step_s` are executed of each answer."""
    rows, elapsed = [], 0.0
    while (answer := policy.act(_observation(elapsed, expert))) is not None:
        kept = answer.times <= step_s + 1e-9
        rows.append(answer.positions[kept])
        elapsed += step_s
    return np.concatenate(rows)


def _succeeds(sim, policy, seed):
    sim.reset(seed, policy.task)
    last = len(policy.plan.times) - 1
    for k in range(1, round(policy.seconds / 0.02) + 1):
        sim.advance(policy.plan.positions[min(k, last)])
        if k % 5 == 0:
            sim.observe()
    return ever_and_final(policy.task.succeeds(sim.situation()))[1]


def test_names_and_variants_are_the_same_thing():
    assert parse_variant('expert') == PolicyVariant()
    assert parse_variant(' expert-noise-0.02 ').size('noise') == 0.02
    both = parse_variant('expert-miss-.5-late-0.3')
    assert both.sizes == (('miss', 0.5), ('late', 0.3)) and both.size('noise') == 0.0
    assert both.name == 'expert-miss-0.5-late-0.3' and parse_variant(both.name) == both
    assert parse_variant('expert-stop-0').name == 'expert-stop-0'


@pytest.mark.parametrize(
    ('name', 'says'),
    [
        ('exprt', r"'exprt' is no scripted policy \(did you mean 'expert'\?\).*joint_noise-0.02"),
        ('expert-noise', "'expert-noise' is no scripted policy; .*mtv-world rank --list-faults"),
        ('expert-nois-0.1', r"unknown fault 'nois' \(did you mean 'noise'\?\); known are the 162"),
        ('expert-miss-0.1-miss-0.2', "fault 'miss' is given twice"),
        ('expert-miss-1.5', "'miss' is 1.5; it must be 0 to 1"),
        ('expert-noise--1', 'is no scripted policy'),
        ('', "'' is no scripted policy"),
    ],
)
def test_a_wrong_name_is_refused_with_what_would_be_right(name, says):
    with pytest.raises(PolicyError, match=says):
        parse_variant(name)


def test_unknown_tasks_are_named(expert):
    with pytest.raises(SimulatorError, match='did you mean'):
        scripted_policy('expert', 'stack_block_two', 0, expert)


def test_answers_are_the_plan_however_much_of_each_is_executed(expert):
    policy = _policy('expert', expert)
    plan, whole = policy.plan, _episode(policy, expert, 3.2)
    # every fifth sample of the plan, from 0.1 s on, then the arms hold still
    num = (len(plan.times) - 1) // 5
    np.testing.assert_allclose(whole[:num], plan.positions[5 : 5 * num + 1 : 5], atol=1e-9)
    np.testing.assert_allclose(whole[num + 1 :] - plan.positions[-1], 0, atol=1e-9)
    policy.reset(seed=0)
    parts = _episode(policy, expert, 0.4)
    num = min(len(parts), len(whole))
    np.testing.assert_allclose(parts[:num], whole[:num], atol=1e-9)


def test_the_episode_ends_and_times_before_it_are_refused(expert):
    policy = _policy('expert', expert)
    assert policy.act(_observation(5.0, expert)) is not None  # the first stamp is the start
    assert policy.act(_observation(5.0 + policy.seconds - 0.01, expert)) is not None
    assert policy.act(_observation(5.0 + policy.seconds, expert)) is None
    with pytest.raises(PolicyError, match='1.000 s older'):
        policy.act(_observation(4.0, expert))
    with pytest.raises(PolicyError, match='was not reset'):
        scripted_policy('expert', TASK, 0, expert).act(_observation(0.0, expert))


def test_a_seed_gives_the_same_plan_again_and_another_seed_another(expert):
    policy = _policy('expert-noise-0.05-place-0.02', expert)
    first = policy.plan.positions
    policy.reset(seed=1)
    other = policy.plan.positions
    policy.reset(seed=0)
    np.testing.assert_array_equal(policy.plan.positions, first)
    assert other.shape != first.shape or not np.allclose(other, first)


def test_every_variant_keeps_to_the_joint_limits_and_starts_where_the_arms_are(expert, robot):
    for name in ('expert', 'expert-noise-0.5', 'expert-late-0.5', 'expert-wrong-1'):
        plan = _policy(name, expert).plan
        check_positions(robot, plan.positions)
        np.testing.assert_allclose(plan.positions[0], expert.home, atol=1e-9)


def test_noise_is_of_its_size_on_arms_and_none_on_grippers(expert, robot):
    steady, shaky = (_policy(f'expert{n}', expert).plan.positions for n in ('', '-noise-0.02'))
    error = shaky - steady
    grippers = [robot.joint_names.index(tool.gripper_joint) for tool in robot.tools]
    assert not error[:, grippers].any()
    # a straight line between two independent draws has 2/3 of their variance on average
    arms = np.delete(error, grippers, axis=1)
    assert 0.02 * np.sqrt(2 / 3) * 0.8 < arms.std() < 0.02 * np.sqrt(2 / 3) * 1.2


def test_late_grippers_follow_and_a_stopped_arm_stands_still(expert, robot):
    steady, late, half = (
        _policy(name, expert).plan.positions
        for name in ('expert', 'expert-late-0.4', 'expert-stop-0.5')
    )
    gripper = [robot.joint_names.index(tool.gripper_joint) for tool in robot.tools]
    np.testing.assert_array_equal(late[20:, gripper], steady[:, gripper])
    arms = np.delete(np.arange(steady.shape[1]), gripper)
    np.testing.assert_array_equal(late[: len(steady)][:, arms], steady[:, arms])
    middle = (len(steady) - 1) // 2
    np.testing.assert_array_equal(half[:middle], steady[:middle])
    assert (half[middle:] == steady[middle]).all()


def test_a_wrong_object_is_taken_in_place_of_the_one_named(expert, robot):
    """Where the gripper first closes is where the other block lies."""
    policy = _policy('expert-wrong-1', expert)
    objects = {item.role: item for item in policy.scene.objects}
    tools = robot.tool_poses(policy.plan.positions)[..., :3, 3]
    openings = robot.gripper_openings(policy.plan.positions)
    arm = int(np.argmin(openings.min(1)))
    closed = tools[arm, int(np.argmax(openings[arm] < 0.01))]
    distance = {r: np.hypot(*(closed - item.position)[:2]) for r, item in objects.items()}
    assert min(distance, key=lambda role: distance[role]) != 'a' and min(distance.values()) < 0.005


def test_a_wrong_object_needs_another_one_that_can_be_grasped(expert):
    policy = scripted_policy('expert-wrong-1', TASK, 0, expert)
    policy.scene = replace(policy.scene, objects=policy.scene.objects[:1])
    with pytest.raises(PolicyError, match='no other object to take'):
        policy.reset(seed=0)


@pytest.mark.slow
def test_success_is_graded_by_the_faults(sim, expert):
    """The expert succeeds, small faults fail sometimes, large ones always."""

    def outcomes(name: str, wanted: set[bool]) -> set[bool]:
        """Of eight seeds, or of fewer that had all that is wanted of several."""
        seen = set()
        for seed in range(8):
            seen.add(bool(_succeeds(sim, _policy(name, expert, seed=seed), seed)))
            if len(wanted) > 1 and seen == wanted:
                break
        return seen

    wanted = {
        'expert': {True},
        'expert-place-0.02': {True, False},
        'expert-miss-0.5': {True, False},
        'expert-miss-1': {False},
        'expert-stop-0': {False},
    }
    assert {name: outcomes(name, seen) for name, seen in wanted.items()} == wanted


def test_home_is_where_the_scenario_begins(expert, robot, workcell):
    """A policy that stops at once keeps both tools at rest."""
    plan = _policy('expert-stop-0', expert).plan
    tools = robot.tool_poses(plan.positions)[:, -1, :3, 3]
    np.testing.assert_allclose(tools, list(workcell.home_tools.values()), atol=1e-3)
