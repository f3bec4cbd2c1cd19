"""The fault catalogue: its splits, and that every kind does something of its own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
import json
from pathlib import Path

import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import PolicyError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.faults.catalogue import (
    draw_variant,
    FAULTS,
    kinds_named,
    kinds_of,
    parse_variant,
    PolicyVariant,
    refuse_test_kinds,
    SPLITS,
)
from mtv_world_ros.simulation.faults.variant_faults import WayPointFaults, with_faults
from mtv_world_ros.simulation.way_points import WayPoint
from test.support.tables import table

SEED, TASK = 4, 'place_block_a2b_left'
#: seed, number of commands, mean, deviation and middle row of the positions, by policy
RECORDED = json.loads((Path(__file__).parents[2] / 'golden' / 'kinds.json').read_text())


@cache
def trajectory(expert, name: str, task: str = TASK, seed: int = SEED) -> JointTrajectory:
    policy = scripted_policy(name, task, seed, expert)
    policy.reset(seed=seed)
    return policy.plan


def plan(expert, name: str, task: str = TASK, seed: int = SEED) -> np.ndarray:
    return trajectory(expert, name, task, seed).positions


def applied(name: str, stops: list[WayPoint], objects, seed: int = 0) -> list[WayPoint]:
    """What the faults of a policy make of way points, where these objects are in the scene."""
    faults = WayPointFaults(parse_variant(name), np.random.default_rng(seed))
    return faults.applied(stops, faults.draws(0.0, objects))


KINDS = [name for name in RECORDED if name != 'expert']


@table('name', KINDS[::10])
def test_a_tenth_of_the_kinds_gives_the_plans_that_their_own_functions_gave(expert, name):
    check_plan(expert, name)


@pytest.mark.slow
@table('name', KINDS)
def test_every_kind_gives_the_plan_that_its_own_function_gave(expert, name):
    check_plan(expert, name)


def check_plan(expert, name):
    """Recorded by `test/golden/record.py` at v0.1.0, where each kind was a function of its own."""
    seed, num_commands, *wanted = RECORDED[name]
    at, usual = (plan(expert, one, 'stack_blocks_two', seed) for one in (name, 'expert'))
    assert len(at) == num_commands
    found = (at.mean(axis=0), at.std(axis=0), at[len(at) // 2])
    np.testing.assert_allclose(found, wanted, atol=2e-4)
    assert at.shape != usual.shape or np.abs(at - usual).max() > 1e-3
    assert (at >= expert.robot.lower - 1e-6).all() and (at <= expert.robot.upper + 1e-6).all()


@pytest.mark.parametrize(('kind', 'size'), [('rub', 0.08), ('gnaw', 0.08)])
def test_what_is_added_after_the_release_leaves_the_move_its_tempo(expert, kind, size):
    usual, changed = plan(expert, 'expert'), plan(expert, f'expert-{kind}-{size}')
    # way points that are added take at least 0.4 s each, before scaling
    assert len(changed) > len(usual) + 80
    first = np.argmax(np.abs(changed[: len(usual)] - usual).max(axis=1) > 1e-12)
    assert first > 0.6 * len(usual)


@pytest.mark.parametrize(('kind', 'size'), [('splay', 0.7), ('swirl', 0.03), ('crank', 1.0)])
def test_what_is_added_before_the_grasp_leaves_the_move_its_tempo(expert, kind, size):
    usual, changed = plan(expert, 'expert'), plan(expert, f'expert-{kind}-{size}')
    assert len(changed) > len(usual) + 80
    # from the grasp on
    np.testing.assert_allclose(changed[-200:], usual[-200:], atol=0.02)


def test_the_catalogue_is_wide_enough_and_its_splits_are_apart():
    assert len(FAULTS) >= 16 and len({kind.family for kind in FAULTS.values()}) >= 6
    by_split = [set(kinds_of(split)) for split in SPLITS]
    assert set.union(*by_split) == set(FAULTS) and sum(map(len, by_split)) == len(FAULTS)
    assert all(len(kinds) >= 6 for kinds in by_split)


def test_siblings_part_where_the_fault_begins(expert):
    expert_plan, high = plan(expert, 'expert'), plan(expert, 'expert-drops-0.5')
    differs = np.flatnonzero(np.abs(high[: len(expert_plan)] - expert_plan).max(axis=1) > 1e-6)
    # the tempo is shared out over more way points, so only the way to the first one is the same
    assert differs[0] > 0
    late = plan(expert, 'expert-late-0.3')
    differs = np.flatnonzero(np.abs(late[: len(expert_plan)] - expert_plan).max(axis=1) > 1e-6)
    arms = arm_columns(expert)
    np.testing.assert_array_equal(late[: len(expert_plan), arms], expert_plan[:, arms])
    assert differs[0] > 20


def arm_columns(expert) -> list[int]:
    grippers = [expert.robot.joint_names.index(tool.gripper_joint) for tool in expert.robot.tools]
    return [j for j in range(len(expert.robot.joint_names)) if j not in grippers]


def test_faults_of_two_arms_are_refused_of_one(expert):
    given = plan(expert, 'expert')
    franka = load_robot(share_path('config', 'robots', 'franka', 'robot.yaml'))
    one = JointTrajectory(
        joint_names=franka.joint_names,
        times=np.arange(len(given)) * 0.02,
        positions=np.zeros((len(given), len(franka.joint_names))),
    )
    kinds = [kind for kind, fault in FAULTS.items() if 'two_arms' in fault.needs]
    assert len(kinds) == 12
    for kind in kinds:
        variant = parse_variant(f'expert-{kind}-{FAULTS[kind].size.typical:g}')
        with pytest.raises(PolicyError, match=f"{kind} takes two arms, robot 'franka' has 1"):
            with_faults(one, variant, franka, np.random.default_rng(0))


@table('kind', [k for k, fault in FAULTS.items() if 'gripper' in fault.needs])
def test_faults_of_a_gripper_are_refused_of_a_robot_without_one(expert, kind):
    robot = expert.robot
    bare = RobotModel(
        name='bare',
        model=robot.pinocchio_model,
        joint_names=robot.joint_names,
        tools=[replace(tool, gripper_joint=None) for tool in robot.tools],
        base_link=robot.base_link,
        mimics=robot.mimics,
    )
    given = trajectory(expert, 'expert')
    rng, name = np.random.default_rng(0), f'expert-{kind}-{FAULTS[kind].size.typical:g}'
    assert len(with_faults(given, PolicyVariant(), bare, rng).times) > 0
    with pytest.raises(PolicyError, match=f"{kind} takes a gripper, robot 'bare' has none"):
        with_faults(given, parse_variant(name), bare, rng)


@pytest.mark.parametrize(
    'task', ['stack_blocks_two', 'move_object_two', 'collect_toy', 'shake_bottle']
)
def test_it_meddles_with_another_object_once_the_task_is_done(expert, task):
    plans = [plan(expert, name, task) for name in ('expert', 'expert-meddle-0.04')]
    openings = [expert.robot.gripper_openings(positions) for positions in plans]
    closed = [
        int((np.diff((opening < 0.05).astype(int), axis=1) == 1).sum()) for opening in openings
    ]
    assert closed[1] == closed[0] + 1


def changed_stops(name: str) -> tuple[list[WayPoint], list[WayPoint]]:
    """A move's way points, and what a fault makes of them."""
    own, goal, up = np.array([0.0, 0.3, 0.03]), np.array([-0.2, 0.3, 0.05]), np.array([0, 0, 0.1])
    home = np.array([-0.2, 0.1, 0.1])
    places = [
        ('above', own + up, 1.0), ('grasp', own, 1.0), ('close', own, 0.0),
        ('lift', own + up, 0.0), ('carry', goal + up, 0.0), ('lower', goal, 0.0),
        ('open', goal, 0.7), ('retreat', goal + up, 1.0), ('home', home, 1.0),
    ]  # fmt: skip
    stops = [WayPoint(phase, place, 0.0, opening) for phase, place, opening in places]
    return stops, applied(name, stops, [own])


def test_a_grasp_is_torn_between_its_object_and_the_nearest_other_one():
    stops, _ = changed_stops('expert')
    own, near, far = stops[1].position, np.array([0.1, 0.2, 0.05]), np.array([-0.2, 0.3, 0.03])
    changed = applied('expert-torn-0.2', stops, [far, near, own + [0.03, 0, 0]])
    ways = [b.position - a.position for a, b in zip(stops[:3], changed[:3], strict=True)]
    np.testing.assert_allclose(ways, np.broadcast_to([0.02, -0.02, 0], (3, 3)), atol=1e-12)
    assert changed[3:] == stops[3:]
    alone = applied('expert-torn-0.2', stops, [own])
    assert [stop.phase for stop in alone] == [stop.phase for stop in stops]


@pytest.mark.parametrize('is_near', [True, False])
def test_it_is_put_on_the_other_object_next_to_its_goal_and_taken_again(is_near):
    stops, _ = changed_stops('expert')
    own, goal = stops[1].position, stops[6].position
    other = np.array([-0.25, 0.35, 0.04]) if is_near else np.array([0.2, 0.3, 0.04])
    changed = applied('expert-perch-0.03', stops, [own, other])
    assert changed[:4] == stops[:4] and changed[11:] == stops[4:] and len(changed) == 16
    over, low, let_go, wide, again, taken, raised = changed[4:11]
    assert [s.opening for s in changed[4:11]] == [0, 0, 0.7, 1, 1, 0, 0]
    lows = [s.position for s in (let_go, again, taken)]
    np.testing.assert_array_equal(lows, np.repeat(low.position[None], 3, axis=0))
    highs = [s.position - low.position for s in (over, wide, raised)]
    np.testing.assert_allclose(highs, np.repeat([[0, 0, 0.05]], 3, axis=0), atol=1e-12)
    # as high over the other's top, or the table, as it was over the table
    height = 0.032 + (0.08 if is_near else 0)
    assert low.position[2] == pytest.approx(height)
    middle = other if is_near else goal
    assert np.linalg.norm((low.position - middle)[:2]) == pytest.approx(0.03)


@pytest.mark.parametrize(
    ('kind', 'size'), [('paw', 0.05), ('waggle', 0.1), ('nibble', 0.06), ('decoy', 0.05)]
)
def test_directions_are_drawn_anew_and_are_the_same_for_another_size(kind, size):
    stops, _ = changed_stops('expert')
    own, runs = stops[1].position, []
    for share in (1.0, 0.5):
        name = parse_variant(f'expert-{kind}-{share * size}')
        faults = WayPointFaults(name, np.random.default_rng(0))
        # a plan out of reach is drawn once more
        runs.append([faults.applied(stops, faults.draws(0.0, [own])) for _ in range(2)])
    farthest = [
        [max((s.position - own for s in run[:8]), key=lambda w: np.linalg.norm(w[:2]))[:2]
         for run in both]
        for both in runs
    ]  # fmt: skip
    np.testing.assert_allclose(farthest[1], 0.5 * np.array(farthest[0]), atol=1e-12)
    assert np.linalg.norm(farthest[0][0] - farthest[0][1]) > 1e-3


@pytest.mark.parametrize('seed', range(6))
def test_grippers_have_a_tempo_of_their_own(expert, seed):
    positions = [plan(expert, name, seed=seed) for name in ('expert', 'expert-offbeat-0.4')]
    (expert_plan, offbeat), arms = positions, arm_columns(expert)
    num = len(expert_plan)
    np.testing.assert_array_equal(offbeat[:num, arms], expert_plan[:, arms])
    openings = [expert.robot.gripper_openings(p) for p in (expert_plan, offbeat)]
    used = int(np.argmax(np.ptp(openings[0], axis=1)))
    np.testing.assert_allclose(openings[1][:, -1], openings[0][:, -1], atol=1e-9)
    # when it is half shut, and half open again
    own, off = (np.flatnonzero(np.diff(opening[used] > 0.5)) for opening in openings)
    tempo = own / off
    assert len(off) == 2 and tempo[0] == pytest.approx(tempo[1], rel=0.02)
    assert 1 / 1.41 < tempo[0] < 1.41 and abs(tempo[0] - 1) > 1e-3
    # it waits for slow grippers
    assert len(offbeat) == pytest.approx(num * max(1.0, 1 / tempo[0]), rel=0.02)


@pytest.mark.parametrize('is_near', [True, False])
def test_another_object_is_taken_first_moved_and_let_go(is_near):
    stops, _ = changed_stops('expert')
    own, near = stops[1].position, np.array([-0.1, 0.2, 0.04])
    # nearest of all is the object itself, then one out of the arm's reach; it rests at x = -0.2
    places = [own + [0.03, 0, 0], np.array([0.1, 0.3, 0.03]), np.array([-0.25, 0.3, 0.05])]
    places = [*places, near] if is_near else places[:2]
    changed = applied('expert-decoy-0.05', stops, places)
    assert changed[6:] == stops
    ways = np.array([stop.position - (near if is_near else own) for stop in changed[:6]])
    np.testing.assert_allclose(ways[:, 2], [0.1, 0, 0, 0, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(ways[:3, :2], 0.0, atol=1e-12)
    assert np.linalg.norm(ways[3, :2]) == pytest.approx(0.05)
    np.testing.assert_allclose(ways[4:, :2], np.broadcast_to(ways[3, :2], (2, 2)), atol=1e-12)
    assert [stop.opening for stop in changed[:6]] == [1, 1, 0, 0, 1, 1]


def is_where(one: WayPoint, other: WayPoint) -> bool:
    """Whether two way points are the same but for their phases."""
    return one.opening == other.opening and np.array_equal(one.position, other.position)


@pytest.mark.parametrize('seed', range(8))
def test_way_points_are_left_out(seed):
    stops, _ = changed_stops('expert')
    kept = []
    for size in range(1, 5):
        changed = applied(f'expert-omit-{size}', stops, [stops[1].position], seed)
        assert len(changed) == len(stops) - size
        # all have different places or openings; none is new, and their order stays
        numbers = [
            next(k for k, own in enumerate(stops) if is_where(own, stop)) for stop in changed
        ]
        assert numbers == sorted(numbers) and numbers[-1] == len(stops) - 1
        # what it closes or opens at is the next one
        for phase in ('close', 'open'):
            wanted = next(k for k in numbers if k >= [s.phase for s in stops].index(phase))
            assert changed[numbers.index(wanted)].phase == phase
        kept.append(set(numbers))
    # a larger size leaves out the same ones, and more
    assert all(more < less for less, more in pairwise(kept))


def test_any_way_point_but_the_last_may_be_left_out():
    stops, _ = changed_stops('expert')
    phases = set()
    for seed in range(60):
        changed = applied('expert-omit-1', stops, [stops[1].position], seed)
        same = [is_where(*pair) for pair in zip(stops, changed, strict=False)]
        phases.add(stops[same.index(False)].phase)
    assert phases == {stop.phase for stop in stops[:-1]}


@pytest.mark.parametrize('seed', range(8))
def test_way_points_change_places_with_the_next_one(seed):
    stops, _ = changed_stops('expert')
    before = stops
    for size in range(1, 5):
        changed = applied(f'expert-jumble-{size}', stops, [], seed)
        # a larger size does what a smaller one does, and one exchange more
        moved = [
            k for k, pair in enumerate(zip(before, changed, strict=True)) if pair[0] != pair[1]
        ]
        first, second = moved
        assert second == first + 1 < len(stops) - 1
        assert (changed[first], changed[second]) == (before[second], before[first])
        before = changed


def test_any_two_way_points_but_the_last_may_change_places():
    stops, _ = changed_stops('expert')
    firsts = set()
    for seed in range(60):
        changed = applied('expert-jumble-1', stops, [], seed)
        firsts.add(next(k for k, stop in enumerate(stops) if stop != changed[k]))
    assert firsts == set(range(len(stops) - 2))


@pytest.mark.parametrize('is_near', [True, False])
def test_what_is_next_to_the_goal_is_pushed_once_it_is_done(is_near):
    stops, _ = changed_stops('expert')
    other = np.array([-0.25, 0.35, 0.04]) if is_near else np.array([0.2, 0.3, 0.04])
    changed = applied('expert-jostle-0.05', stops, [stops[1].position, other])
    assert changed[:8] == stops[:8] and changed[-1] == stops[-1] and len(changed) == 13
    push = changed[8:12]
    assert all(stop.opening == 0 for stop in push)
    ways = np.array([stop.position for stop in push]) - (other if is_near else stops[6].position)
    # up as high as it rose before
    assert [push[0].position[2], push[3].position[2]] == pytest.approx([0.15, 0.15])
    np.testing.assert_allclose(ways[1:3, 2], 0.0, atol=1e-12)
    way = (ways[2] - ways[1]) / 0.09
    assert np.linalg.norm(way) == pytest.approx(1)
    np.testing.assert_allclose(ways[1:3], np.outer([-0.07, 0.02], way), atol=1e-12)


def test_down_at_the_object_it_goes_towards_another_one_and_comes_back():
    stops, alone = changed_stops('expert-waver-0.5')
    own = stops[1].position
    changed = applied('expert-waver-0.5', stops, [own, own + [0, 0.1, 0.02], own + [0.3, 0, 0]])
    assert changed[:2] == stops[:2] and changed[4:] == stops[2:]
    np.testing.assert_allclose(changed[2].position - own, [0, 0.05, 0])
    np.testing.assert_array_equal(changed[3].position, own)
    assert changed[2].opening == changed[3].opening == 1
    # where there is no other object, it stays
    np.testing.assert_array_equal(alone[2].position, own)


def visits_of(name, objects, seed=0):
    """What another arm does in a move whose way points take a second each."""
    stops, _ = changed_stops('expert')
    faults = WayPointFaults(parse_variant(name), np.random.default_rng(seed))
    home = WayPoint('home', np.array([-0.25, -0.1, 0.2]), 0.0, 1.0)
    return faults.visits(stops, faults.draws(0.0, objects), home, [1.0] * len(stops))


def test_the_other_arm_pulls_at_what_is_carried_or_lies_next_to_the_goal():
    stops, _ = changed_stops('expert')
    own, goal = stops[1].position, stops[5].position
    objects = [own, goal + [0, 0.03, -0.02], goal + [0, 0.3, 0]]
    (budge,), (tug,) = (
        visits_of(f'expert-{name}', objects) for name in ('budge-0.02', 'tug-0.05')
    )
    np.testing.assert_array_equal(budge.ways(1.0)[1].position, objects[1])
    assert (budge.meets, budge.done) == (3, 3)
    assert budge.ways(1.0)[0].position[2] > objects[1][2] + 0.05
    np.testing.assert_array_equal(tug.ways(1.0)[1].position, stops[4].position)
    assert (tug.meets, tug.done) == (5, 3)
    for visit, size in ((budge, 0.02), (tug, 0.05)):
        _, _, shut, pulled, *_ = visit.ways(1.0)
        assert np.linalg.norm(pulled.position - shut.position) == pytest.approx(size)
    assert visits_of('expert', objects) == []


def arms_of(expert, name: str, *, kept: bool = True):
    """Tool and opening of the arm that the expert uses; with a fault, of this and of the other.

    If `kept`, the arm does what it does without the fault.
    """
    plans = [plan(expert, one) for one in ('expert', name)]
    openings = [expert.robot.gripper_openings(positions) for positions in plans]
    used = int(np.argmax(np.ptp(openings[0], axis=1)))
    if kept:
        halves = [np.split(positions, 2, axis=1)[used] for positions in plans]
        np.testing.assert_array_equal(halves[1][: len(plans[0])], halves[0])
    tools = [[poses[:, :3, 3] for poses in expert.robot.tool_poses(p)] for p in plans]
    order = (used, 1 - used)
    return (tools[0][used], openings[0][used]), [
        (tools[1][arm], openings[1][arm]) for arm in order
    ]


def test_shut_hands_squeeze_the_object_from_either_side(expert):
    (usual, opening), arms = arms_of(expert, 'expert-vise-0.01', kept=False)
    place = usual[int(np.argmax(opening < 1e-3))]
    (own, own_shut), (other, other_shut) = ((tool, opened < 1e-3) for tool, opened in arms)
    # the first time that it is down there, and shut
    is_low = (own[:, 2] < place[2] + 2e-3) & own_shut
    first = int(np.argmax(is_low))
    last = first + int(np.argmin(is_low[first:])) - 1
    side = np.sign((other - own)[0, 0])
    # from 7 cm off on its side, 3 cm of which are object and finger
    np.testing.assert_allclose(own[first] - place, [-0.07 * side, 0, 0], atol=4e-3)
    np.testing.assert_allclose(own[last] - place, [-0.02 * side, 0, 0], atol=4e-3)
    # against the other one
    assert other_shut[first:last].all() and (other[first:last, 2] < place[2] + 3e-3).all()
    np.testing.assert_allclose((other[last] - other[first])[0], -0.05 * side, atol=5e-3)
    assert (other - own)[last, 0] * side > 0


def test_the_other_arm_roams_low_and_open_through_places_near_objects(expert):
    _, (_, (tool, opening)) = arms_of(expert, 'expert-roam-3')
    assert opening.min() == pytest.approx(1)
    assert 0.015 < tool[:, 2].min() < 0.04 and np.ptp(tool[:, :2], axis=0).max() > 0.05
    np.testing.assert_allclose(tool[-1], tool[0], atol=1e-3)
    objects, places = [np.array([0.1, 0.3, 0.01]), np.array([-0.1, 0.3, 0.03])], []
    for seed in range(40):
        (visit,) = visits_of('expert-roam-2', objects, seed)
        places += [stop.position for stop in visit.ways(1.0)[1:3]]
    assert len(places) == 80 and {place[2] for place in places} == {0.02, 0.03}
    nearest = [min(np.linalg.norm((p - item)[:2]) for item in objects) for p in places]
    assert 0.02 < np.mean(nearest) < 0.06


def test_it_first_puts_the_object_next_to_its_own_on_top_of_that():
    stops, alone = changed_stops('expert-heap-0.02')
    own, other = stops[1].position, stops[-1].position + [0.02, 0.05, -0.2]
    changed = applied('expert-heap-0.02', stops, [own, other])
    assert changed[8:] == stops
    over, down, shut, raised, above, put, let_go, left = changed[:8]
    assert [stop.opening for stop in changed[:8]] == [1, 1, 0, 0, 0, 0, 1, 1]
    for stop in (down, shut):
        np.testing.assert_allclose(stop.position, other, atol=1e-12)
    np.testing.assert_array_equal(raised.position[:2], other[:2])
    assert over.position[2] > other[2]
    way = put.position - own
    assert np.linalg.norm(way[:2]) == pytest.approx(0.02)
    # its underside half a centimetre over the own one's top; it comes from and leaves to above
    assert put.position[2] == pytest.approx(2 * own[2] + other[2] + 0.005)
    np.testing.assert_array_equal(let_go.position, put.position)
    for stop in (above, left):
        np.testing.assert_allclose(stop.position - put.position, [0, 0, 0.03], atol=1e-12)
    assert raised.position[2] == above.position[2]
    # where there is no other object, its own one
    np.testing.assert_array_equal(alone[1].position, own)


@pytest.mark.parametrize('kind', ['crowd', 'rival'])
def test_an_arm_that_crowds_another_still_does_what_it_has_to_do(expert, kind):
    plans = [plan(expert, name, 'move_object_two') for name in ('expert', f'expert-{kind}-1')]
    assert len(plans[1]) >= len(plans[0])
    closed = [expert.robot.gripper_openings(positions) < 0.05 for positions in plans]
    lasts = [is_closed.sum(axis=1) for is_closed in closed]
    assert (lasts[0] > 0).all()
    np.testing.assert_array_equal(*lasts)


@table('kind', [kind for kind, fault in FAULTS.items() if fault.size.none == 0])
def test_sizes_out_of_range_are_refused(kind):
    largest = FAULTS[kind].size.largest
    assert parse_variant(f'expert-{kind}-{largest:g}').size(kind) == largest
    assert parse_variant(f'expert-{kind}-0') == PolicyVariant()
    with pytest.raises(PolicyError, match=f"'{kind}' is .*; it must be 0 to {largest:g}"):
        parse_variant(f'expert-{kind}-{1.1 * largest:g}')


@pytest.mark.parametrize('seed', range(4))
def test_what_is_held_is_carried_low_to_another_object(seed):
    own, other = np.array([0.0, 0.3, 0.03]), np.array([0.2, 0.35, 0.03])
    up, goal = np.array([0, 0, 0.15]), np.array([-0.2, 0.3, 0.03])
    places = [
        ('above', own + up, 1.0), ('grasp', own, 1.0), ('close', own, 0.2),
        ('lift', own + up, 0.2), ('carry', goal + up, 0.2), ('lower', goal, 0.2),
        ('open', goal, 1.0), ('retreat', goal + up, 1.0),
    ]  # fmt: skip
    stops = [WayPoint(phase, place, 0.0, opening) for phase, place, opening in places]
    changed = applied('expert-meet-1', stops, [own, other], seed)
    (first,) = [k for k, stop in enumerate(changed) if stop.phase == 'open']
    number = {id(stop): k for k, stop in enumerate(stops)}
    assert [number[id(stop)] for stop in changed if id(stop) in number] == list(range(8))
    new = [stop for stop in changed[4:first] if id(stop) not in number]
    assert len(new) == len(changed) - 8 == 4 and all(stop.opening == 0.2 for stop in new)
    low = [stop.position for stop in new[1:3]]
    assert all(own[2] <= place[2] <= own[2] + 0.09 for place in low)
    assert np.linalg.norm((low[1] - other)[:2]) < 0.15


def test_at_an_object_one_thing_changes_after_the_other():
    stops, _ = changed_stops('expert')
    place, counts = np.array([0.1, 0.3, 0.05]), {'opening': 0, 'lean': 0, 'yaw': 0, 'position': 0}
    floor = min(stop.position[2] for stop in stops)
    for seed in range(20):
        changed = applied('expert-fidget-6', stops, [place], seed)
        own = {id(stop) for stop in stops}
        new = [stop for stop in changed if id(stop) not in own]
        assert len(new) == 9 and len(changed) == len(stops) + 9
        assert np.linalg.norm((new[1].position - place)[:2]) < 0.15
        assert all(stop.position[2] >= floor - 1e-9 for stop in new)
        for before, after in pairwise(new[1:-1]):
            same = np.array_equal(before.position, after.position)
            differ = [
                n for n in ('opening', 'lean', 'yaw') if getattr(before, n) != getattr(after, n)
            ]
            differ += [] if same else ['position']
            assert len(differ) <= 1
            for name in differ:
                counts[name] += 1
    assert counts['opening'] > 20 and min(counts.values()) > 5


def test_what_is_held_is_pressed_dragged_put_on_objects_and_let_go():
    stops, _ = changed_stops('expert')
    places = [stops[2].position, np.array([0.1, 0.3, 0.05])]
    low, seen, counts = stops[2].position[2], [], []
    for seed in range(40):
        changed = applied('expert-tinker-6', stops, places, seed)
        own = {id(stop) for stop in stops}
        new = [number for number, stop in enumerate(changed) if id(stop) not in own]
        assert new == list(range(new[0], new[-1] + 1)), 'in one run'
        assert changed[new[0] - 1].phase in ('close', 'lift', 'carry', 'lower')
        assert len(changed) == len(stops) + len(new) and 6 <= len(new) <= 12
        run = [changed[number] for number in new]
        assert all(stop.position[2] >= low - 0.025 - 1e-9 for stop in run)
        seen += run
        counts.append(len(new))
    assert any(stop.position[2] < low - 0.01 for stop in seen), 'pressed down'
    assert any(stop.opening == 1.0 for stop in seen) and any(stop.lean for stop in seen)
    assert np.mean(counts) > 6.5, 'some come to an object, over it first'
    others = [stop for stop in seen if np.linalg.norm((stop.position - places[1])[:2]) < 0.08]
    assert any(stop.position[2] < 2 * places[1][2] + low for stop in others)


def test_random_policies_are_of_the_kinds_asked_for():
    rng = np.random.default_rng(0)
    drawn = [draw_variant(kinds_of('calibrate'), rng) for _ in range(400)]
    assert {kind for variant in drawn for kind in variant.kinds} == set(kinds_of('calibrate'))
    assert any(variant == PolicyVariant() for variant in drawn)
    assert all(parse_variant(variant.name) == variant for variant in drawn)


def test_test_kinds_are_refused_by_name():
    refuse_test_kinds(['expert', 'expert-high-0.02'], 'training')
    said = r"split test are not for training: 'expert-high-0.1-shed-0.03' has shaken_off_over_goal"
    with pytest.raises(PolicyError, match=said):
        refuse_test_kinds(['expert', 'expert-high-0.1-shed-0.03'], 'training')


def test_unknown_kinds_and_splits_name_the_nearest():
    assert kinds_named('train') == kinds_of('train')
    assert kinds_named('high, late') == ('high', 'late')
    with pytest.raises(PolicyError, match=r"unknown fault kind 'hihg' \(did you mean 'high'\?\)"):
        kinds_named('late,hihg')
    with pytest.raises(PolicyError, match=r"unknown split .*'tests' \(did you mean 'test'\?\)"):
        kinds_of('tests')
