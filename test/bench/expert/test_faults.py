"""The fault catalogue: its splits, and that every kind does something of its own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from mtv_world_ros.bench.expert.faults.catalogue import (
    draw_variant,
    FAULTS,
    kinds_named,
    kinds_of,
    parse_variant,
    PolicyVariant,
    refuse_kinds,
    SPLITS,
)
from mtv_world_ros.bench.expert.faults.variant_faults import WayPointFaults, with_faults
from mtv_world_ros.bench.expert.scripted_policy import scripted_policy
from mtv_world_ros.bench.expert.way_points import WayPoint
from mtv_world_ros.data_types import JointTrajectory
from mtv_world_ros.errors import PolicyError
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.geometry.robot.model import RobotModel

SEED, TASK = 4, 'place_block_a2b_left'


@cache
def trajectory(expert, name: str) -> JointTrajectory:
    policy = scripted_policy(name, TASK, SEED, expert)
    policy.reset(seed=SEED)
    return policy.plan


def plan(expert, name: str) -> np.ndarray:
    return trajectory(expert, name).positions


def test_the_catalogue_is_wide_enough_and_its_splits_are_apart():
    assert len(FAULTS) >= 16 and len({kind.family for kind in FAULTS.values()}) >= 6
    by_split = [set(kinds_of(split)) for split in SPLITS]
    assert set.union(*by_split) == set(FAULTS) and sum(map(len, by_split)) == len(FAULTS)
    assert all(len(kinds) >= 6 for kinds in by_split)


@pytest.mark.parametrize('kind', sorted(FAULTS))
def test_every_kind_changes_the_plan_and_a_larger_size_changes_it_more(expert, kind):
    fault = FAULTS[kind]
    expert_plan = plan(expert, 'expert')
    changed = plan(expert, f'expert-{kind}-{fault.typical:g}')
    length = min(len(changed), len(expert_plan))
    assert np.abs(changed[:length] - expert_plan[:length]).max() > 1e-3
    tools = [expert.robot.lower - 1e-6, expert.robot.upper + 1e-6]
    assert (changed >= tools[0]).all() and (changed <= tools[1]).all()


def test_siblings_part_where_the_fault_begins(expert):
    expert_plan, high = plan(expert, 'expert'), plan(expert, 'expert-drops-0.5')
    differs = np.flatnonzero(np.abs(high[: len(expert_plan)] - expert_plan).max(axis=1) > 1e-6)
    # the tempo is shared out over more way points, so only the way to the first one is the same
    assert differs[0] > 0
    late = plan(expert, 'expert-late-0.3')
    differs = np.flatnonzero(np.abs(late[: len(expert_plan)] - expert_plan).max(axis=1) > 1e-6)
    grippers = [expert.robot.joint_names.index(tool.gripper_joint) for tool in expert.robot.tools]
    arms = [j for j in range(expert_plan.shape[1]) if j not in grippers]
    np.testing.assert_array_equal(late[: len(expert_plan), arms], expert_plan[:, arms])
    assert differs[0] > 20


def arm_columns(expert) -> list[int]:
    grippers = [expert.robot.joint_names.index(tool.gripper_joint) for tool in expert.robot.tools]
    return [j for j in range(len(expert.robot.joint_names)) if j not in grippers]


def used_openings(expert, name: str) -> tuple[int, np.ndarray, np.ndarray]:
    """The gripper that a plan uses, its openings, and with a fault that changes nothing else."""
    plans, arms = [plan(expert, one) for one in ('expert', name)], arm_columns(expert)
    np.testing.assert_array_equal(plans[1][:, arms], plans[0][:, arms])
    openings = [expert.robot.gripper_openings(positions) for positions in plans]
    used = int(np.argmax(np.ptp(openings[0], axis=1)))
    np.testing.assert_array_equal(openings[1][1 - used], openings[0][1 - used])
    return used, openings[0][used], openings[1][used]


def test_a_loop_carries_out_commands_of_its_length_once_more(expert):
    expert_plan, loop = plan(expert, 'expert'), plan(expert, 'expert-loop-2')
    assert len(loop) == len(expert_plan) + 100
    np.testing.assert_allclose(loop[-50:], expert_plan[-50:])
    first = int(np.argmax(np.abs(loop[: len(expert_plan)] - expert_plan).max(axis=1) > 1e-9))
    # where the way back has been blended in, they are the commands of two seconds ago
    np.testing.assert_allclose(loop[first + 30 : first + 90], expert_plan[first - 70 : first - 10])


def test_smoothed_arms_cut_corners_and_the_grippers_stay(expert):
    expert_plan, smooth = plan(expert, 'expert'), plan(expert, 'expert-smooth-1')
    arms = arm_columns(expert)
    grippers = [j for j in range(expert_plan.shape[1]) if j not in arms]
    np.testing.assert_array_equal(smooth[:, grippers], expert_plan[:, grippers])
    travel = [np.ptp(p[:, arms], axis=0).sum() for p in (smooth, expert_plan)]
    assert 0.5 * travel[1] < travel[0] < travel[1]
    np.testing.assert_allclose(smooth[100, arms], expert_plan[75:125, arms].mean(axis=0))


def test_spikes_are_short_and_a_weak_joint_is_one(expert):
    expert_plan = plan(expert, 'expert')
    errors = [plan(expert, name) - expert_plan for name in ('expert-spike-0.3', 'expert-weak-0.1')]
    touched = np.abs(errors[0]).max(axis=1) > 1e-9
    # three of 0.4 s at 50 Hz at most
    assert 0 < touched.sum() <= 60
    joints = np.flatnonzero(np.abs(errors[1]).max(axis=0) > 1e-9)
    assert len(joints) == 1 and joints[0] in arm_columns(expert)
    joint = int(joints[0])
    away = expert_plan[:, joint] - expert_plan[0, joint]
    np.testing.assert_allclose(errors[1][:, joint], -0.1 * away, atol=1e-12)


def test_a_wrong_zero_is_constant_once_it_has_set_in(expert):
    error = plan(expert, 'expert-zero-0.02') - plan(expert, 'expert')
    assert np.abs(error[0]).max() == 0 and np.ptp(error[50:], axis=0).max() < 1e-9
    assert (np.abs(error[-1, arm_columns(expert)]) > 1e-4).all()


def test_commands_are_left_out_or_held(expert):
    expert_plan, skip = plan(expert, 'expert'), plan(expert, 'expert-skip-1')
    assert len(skip) == len(expert_plan) - 50
    np.testing.assert_array_equal(skip[-50:], expert_plan[-50:])
    choppy = plan(expert, 'expert-choppy-1')
    # of every second, the first tenth is the way to the command that is then held
    held = choppy[: len(choppy) // 50 * 50].reshape(-1, 50, choppy.shape[1])[:, 5:]
    np.testing.assert_allclose(held, np.broadcast_to(held[:, :1], held.shape), atol=1e-12)
    np.testing.assert_allclose(choppy[90], expert_plan[50])


def test_a_twitch_is_of_the_grippers_and_a_tremble_of_the_arms(expert):
    expert_plan, arms = plan(expert, 'expert'), arm_columns(expert)
    twitch = plan(expert, 'expert-twitch-0.3')
    np.testing.assert_array_equal(twitch[:, arms], expert_plan[:, arms])
    openings = expert.robot.gripper_openings(twitch)
    assert (openings >= expert.robot.gripper_openings(expert_plan) - 1e-9).all()
    assert openings.min() == pytest.approx(0, abs=1e-9)
    error = plan(expert, 'expert-tremble-0.03') - expert_plan
    assert np.abs(error[:, arms]).max() == pytest.approx(0.03, rel=0.02)
    assert np.abs(np.delete(error, arms, axis=1)).max() == 0


def test_the_arm_at_rest_mirrors_the_other(expert):
    expert_plan, mirror = plan(expert, 'expert'), plan(expert, 'expert-mirror-1')
    heights, across = (
        [poses[:, axis, 3] for poses in expert.robot.tool_poses(mirror)] for axis in (2, 0)
    )
    np.testing.assert_allclose(heights[0], heights[1], atol=0.01)
    np.testing.assert_allclose(across[0], -across[1], atol=0.01)
    moves = np.ptp(expert_plan, axis=0) > 0
    np.testing.assert_array_equal(mirror[:, moves], expert_plan[:, moves])


def test_every_chunk_is_off_its_time_by_as_much_as_it_says(expert):
    expert_plan, seams = plan(expert, 'expert'), plan(expert, 'expert-seams-0.8')
    assert len(seams) == len(expert_plan) + 40
    np.testing.assert_allclose(seams[:40], expert_plan[:40], atol=1e-12)
    # the first tenth of a second of a chunk is the jump; the rest are commands of the expert
    found = []
    for chunk in (2, 3, 4, 5, 6):
        rows = np.arange(chunk * 40 + 5, chunk * 40 + 40)
        errors = [
            np.abs(seams[rows] - expert_plan[np.clip(rows + by, 0, len(expert_plan) - 1)]).max()
            for by in range(-40, 41)
        ]
        assert min(errors) < 1e-12
        found.append(int(np.argmin(errors)) - 40)
    assert len(set(found)) > 2 and max(np.abs(found)) > 10


def test_joints_are_late_each_by_its_own_time_and_swing_about_their_commands(expert):
    expert_plan, arms = plan(expert, 'expert'), arm_columns(expert)
    grippers = [j for j in range(expert_plan.shape[1]) if j not in arms]
    ragged, ring = plan(expert, 'expert-ragged-0.4'), plan(expert, 'expert-ring-0.8')
    assert len(ragged) == len(expert_plan) + 20
    for changed in (ragged, ring):
        np.testing.assert_array_equal(
            changed[: len(expert_plan), grippers], expert_plan[:, grippers]
        )
    np.testing.assert_allclose(ragged[-1], expert_plan[-1])
    moves = [j for j in arms if np.ptp(expert_plan[:, j]) > 0.2]
    begins = [
        np.argmax(np.abs(positions[:, moves] - positions[0, moves]) > 0.05, axis=0)
        for positions in (expert_plan, ragged)
    ]
    late = begins[1] - begins[0]
    assert (late >= 0).all() and late.max() <= 21 and np.ptp(late) > 0
    # a joint that overshoots goes a longer way
    ways = [np.abs(np.diff(p[:, moves], axis=0)).sum(axis=0) for p in (expert_plan, ring)]
    assert (ways[1] > 1.2 * ways[0]).all()
    np.testing.assert_allclose(plan(expert, 'expert-ring-0.001'), expert_plan, atol=1e-9)


def test_arms_that_swap_their_commands_do_so_once(expert):
    expert_plan, swap = plan(expert, 'expert'), plan(expert, 'expert-swap-1')
    rows = np.flatnonzero(np.abs(swap - expert_plan).max(axis=1) > 1e-9)
    assert 0 < len(rows) <= 40 and np.ptp(rows) == len(rows) - 1
    half, middle = plan(expert, 'expert-swap-0.5'), int(rows[len(rows) // 2])
    np.testing.assert_allclose(half, (swap + expert_plan) / 2, atol=1e-9)
    # the arm at rest is where the other would have been, which is at home
    moves = np.ptp(expert_plan, axis=0) > 0
    np.testing.assert_allclose(swap[middle, moves], expert_plan[0, moves], atol=1e-9)
    assert np.abs(swap[middle, ~moves] - expert_plan[0, ~moves]).max() > 0.1


def test_faults_of_two_arms_are_refused_of_one(expert):
    given = plan(expert, 'expert')
    franka = load_robot(share_path('config', 'robots', 'franka.yaml'))
    one = JointTrajectory(
        joint_names=franka.joint_names,
        times=np.arange(len(given)) * 0.02,
        positions=np.zeros((len(given), len(franka.joint_names))),
    )
    kinds = [kind for kind, fault in FAULTS.items() if 'two_arms' in fault.needs]
    assert len(kinds) == 12
    for kind in kinds:
        variant = parse_variant(f'expert-{kind}-{FAULTS[kind].typical:g}')
        with pytest.raises(PolicyError, match=f"{kind} takes two arms, robot 'franka' has 1"):
            with_faults(one, variant, franka, np.random.default_rng(0))


@pytest.mark.parametrize('kind', [k for k, fault in FAULTS.items() if 'gripper' in fault.needs])
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
    rng, name = np.random.default_rng(0), f'expert-{kind}-{FAULTS[kind].typical:g}'
    assert len(with_faults(given, PolicyVariant(), bare, rng).times) > 0
    with pytest.raises(PolicyError, match=f"{kind} takes a gripper, robot 'bare' has none"):
        with_faults(given, parse_variant(name), bare, rng)


def test_it_circles_about_its_object_at_its_height():
    place, up = np.array([0.0, 0.3, 0.03]), np.array([0, 0, 0.1])
    stops = [
        WayPoint('above', place + up, 0.0, 1.0), WayPoint('grasp', place, 0.0, 1.0),
        WayPoint('close', place, 0.0, 0.0), WayPoint('lift', place + up, 0.0, 0.0),
    ]  # fmt: skip
    faults = WayPointFaults(parse_variant('expert-stir-0.03'), np.random.default_rng(0))
    changed = faults.applied(stops, faults.draws(0.0, [place]))
    assert changed[:2] == stops[:2] and changed[-2:] == stops[2:] and len(changed) == 14
    ways = np.array([stop.position - place for stop in changed[2:11]])
    np.testing.assert_allclose(np.linalg.norm(ways[:, :2], axis=1), 0.03)
    np.testing.assert_allclose(ways[:, 2], 0.0)
    np.testing.assert_allclose(ways[:8].sum(axis=0), 0.0, atol=1e-9)
    np.testing.assert_array_equal(changed[11].position, place)


@pytest.mark.parametrize(
    'task', ['stack_blocks_two', 'move_object_two', 'collect_toy', 'shake_bottle']
)
def test_it_meddles_with_another_object_once_the_task_is_done(expert, task):
    plans = []
    for name in ('expert', 'expert-meddle-0.04'):
        policy = scripted_policy(name, task, SEED, expert)
        policy.reset(seed=SEED)
        plans.append(policy.plan.positions)
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
    faults = WayPointFaults(parse_variant(name), np.random.default_rng(0))
    return stops, faults.applied(stops, faults.draws(0.0, [own]))


def test_what_is_pushed_along_is_grasped_where_it_should_be():
    stops, changed = changed_stops('expert-herd-0.06')
    push, rest = changed[:4], changed[4:]
    assert all(stop.opening == 0 for stop in push) and len(rest) == len(stops)
    ways = np.array([b.position - a.position for a, b in zip(stops, rest, strict=True)])
    assert abs(ways[0, 0]) == pytest.approx(0.06)
    np.testing.assert_allclose(ways[:4], np.broadcast_to(ways[0], (4, 3)), atol=1e-12)
    np.testing.assert_array_equal(ways[4:], 0.0)
    # down beside the object at the height of its grasp, and on until shortly before it
    begin, end = push[1].position - stops[1].position, push[2].position - stops[1].position
    side = np.sign(ways[0, 0])
    assert (side * begin[0], side * end[0]) == pytest.approx((-0.07, 0.03))
    assert begin[2] == end[2] == 0 and abs(begin[1]) == abs(end[1]) == pytest.approx(0.02)


def test_what_was_put_down_is_pressed_on_and_dragged_to_the_side_of_the_arm():
    stops, changed = changed_stops('expert-rub-0.09')
    assert changed[:8] == stops[:8] and changed[-1] == stops[-1] and len(changed) == 13
    above, down, dragged, up = changed[8:12]
    assert all(stop.opening == 0 for stop in (above, down, dragged, up))
    np.testing.assert_array_equal(above.position, stops[7].position)
    np.testing.assert_allclose(down.position - stops[6].position, [0, 0, 0.025], atol=1e-12)
    way = dragged.position - down.position
    assert np.linalg.norm(way) == pytest.approx(0.09) and way[2] == 0 and way[1] < 0
    np.testing.assert_allclose(up.position - above.position, way)


def test_half_way_it_lets_the_object_fall_and_takes_it_again():
    stops, changed = changed_stops('expert-juggle-0.08')
    assert changed[:4] == stops[:4] and changed[-5:] == stops[-5:] and len(changed) == 15
    heights = [stop.position[2] for stop in changed[4:10]]
    assert heights == pytest.approx([0.13, 0.11, 0.11, 0.03, 0.03, 0.13])
    assert [stop.opening for stop in changed[4:10]] == [0, 0, 1, 1, 0, 0]
    assert all(stop.position[0] == pytest.approx(-0.1) for stop in changed[4:10])


@pytest.mark.parametrize(
    ('kind', 'same', 'more'),
    [
        ('rub', 0.8, 80),
        ('juggle', 0.3, 80),
        ('tidy', 0.8, 60),
        ('grind', 0.6, 80),
        ('waggle', 0.3, 80),
        ('jiggle', 0.6, 40),
        ('smear', 0.35, 80),
        ('gnaw', 0.6, 80),
        ('jostle', 0.8, 60),
        ('rattle', 0.8, 80),
    ],
)
def test_what_is_added_leaves_the_other_moves_their_tempo(expert, kind, same, more):
    expert_plan, changed = plan(expert, 'expert'), plan(expert, f'expert-{kind}-0.08')
    # four or six way points more take at least 0.4 s each, before scaling
    assert len(changed) > len(expert_plan) + more
    first = np.argmax(np.abs(changed[: len(expert_plan)] - expert_plan).max(axis=1) > 1e-12)
    assert first > same * len(expert_plan)
    if kind == 'juggle':
        # from the lift's height on over the half of the way that is left
        after = [row[-100:] for row in (expert_plan, changed)]
        np.testing.assert_allclose(after[0], after[1], atol=0.02)


def test_fingers_snap_shut_over_the_last_part_of_the_way_down():
    stops, changed = changed_stops('expert-snap-0.04')
    assert changed[0] == stops[0] and changed[2:] == stops[2:]
    grasp, close = changed[1:3]
    np.testing.assert_allclose(grasp.position - close.position, [0, 0, 0.04], atol=1e-12)
    assert (grasp.opening, close.opening) == (1, 0)


def test_a_grasp_is_torn_between_its_object_and_the_nearest_other_one():
    stops, _ = changed_stops('expert')
    own, near, far = stops[1].position, np.array([0.1, 0.2, 0.05]), np.array([-0.2, 0.3, 0.03])
    faults = WayPointFaults(parse_variant('expert-torn-0.2'), np.random.default_rng(0))
    changed = faults.applied(stops, faults.draws(0.0, [far, near, own + [0.03, 0, 0]]))
    ways = [b.position - a.position for a, b in zip(stops[:3], changed[:3], strict=True)]
    np.testing.assert_allclose(ways, np.broadcast_to([0.02, -0.02, 0], (3, 3)), atol=1e-12)
    assert changed[3:] == stops[3:]
    assert [stop.phase for stop in faults.applied(stops, faults.draws(0.0, [own]))] == [
        s.phase for s in stops
    ]


@pytest.mark.parametrize('away', [0.06, 0.2])
def test_it_cuts_the_corner_and_slides_in_from_where_it_comes_from(away):
    stops, changed = changed_stops(f'expert-cut-{away}')
    assert changed[:4] == stops[:4] and changed[-4:] == stops[-4:] and len(changed) == 10
    over, low, lower = changed[4:7]
    np.testing.assert_allclose(over.position - stops[4].position, [away, 0, 0], atol=1e-12)
    np.testing.assert_allclose(low.position - lower.position, [away, 0, 0], atol=1e-12)
    assert over.opening == low.opening == 0 and low.phase == 'carry'


def test_what_was_put_down_is_pushed_by_shut_fingers():
    stops, changed = changed_stops('expert-tidy-0.05')
    assert changed[:8] == stops[:8] and changed[-1] == stops[-1] and len(changed) == 13
    push = changed[8:12]
    assert all(stop.opening == 0 for stop in push)
    ways = np.array([stop.position - stops[6].position for stop in push])
    np.testing.assert_allclose(ways[:, 2], [0.1, 0, 0, 0.1], atol=1e-12)
    # from 7 cm before to 2 cm behind, by a way beside the middle
    np.testing.assert_allclose(ways[[0, 2], :2], ways[[1, 3], :2], atol=1e-12)
    way = (ways[2] - ways[1]) / 0.09
    assert np.linalg.norm(way) == pytest.approx(1)
    assert (ways[1] @ way, ways[2] @ way) == pytest.approx((-0.07, 0.02))
    assert 1e-3 < np.linalg.norm(ways[1] + 0.07 * way) < 0.08


def test_shut_fingers_open_beside_the_object_which_is_grasped_where_it_was():
    stops, changed = changed_stops('expert-splay-0.7')
    assert changed[5:] == stops
    ways = np.array([stop.position - stops[1].position for stop in changed[:5]])
    side = np.sign(ways[0, 0])
    np.testing.assert_allclose(side * ways[:, 0], [0.06, 0.06, 0.04, 0.04, 0.04])
    np.testing.assert_allclose(ways[:, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(ways[:, 2], [0.1, 0, 0, 0, 0.1], atol=1e-12)
    assert [stop.opening for stop in changed[:5]] == [0, 0, 0, 0.7, 0.7]


@pytest.mark.parametrize('size', [0.04, 0.1])
def test_what_is_let_go_too_early_is_pushed_on_from_behind(size):
    stops, changed = changed_stops(f'expert-putt-{size}')
    assert changed[:4] == stops[:4] and changed[-1] == stops[-1] and len(changed) == 13
    # from the grasp to the goal it goes towards -x
    for late, early in zip(stops[4:8], changed[4:8], strict=True):
        np.testing.assert_allclose(early.position - late.position, [size, 0, 0], atol=1e-12)
        assert (early.phase, early.opening) == (late.phase, late.opening)
    push = changed[8:12]
    assert all(stop.opening == 0 for stop in push)
    ways = np.array([stop.position - stops[5].position for stop in push])
    np.testing.assert_allclose(ways[:, 0], [size + 0.07, size + 0.07, 0.03, 0.03])
    np.testing.assert_allclose(ways[:, 1], ways[0, 1])
    assert 1e-4 < abs(ways[0, 1]) < 0.1
    np.testing.assert_allclose(ways[:, 2], [0.1, 0, 0, 0.1], atol=1e-12)


def test_it_lets_the_object_fall_leaning_and_grasps_where_it_was():
    stops, changed = changed_stops('expert-topple-0.9')
    assert changed[7:] == stops
    assert [stop.opening for stop in changed[:7]] == [1, 1, 0, 0, 0, 1, 1]
    leans = [stop.lean for stop in changed[:7]]
    assert [abs(lean) for lean in leans] == pytest.approx([0, 0, 0, 0, 0.9, 0.9, 0])
    assert leans[4] == leans[5]
    ways = np.array([stop.position - stops[1].position for stop in changed[:7]])
    np.testing.assert_allclose(ways[:, :2], 0.0)
    np.testing.assert_allclose(ways[:, 2], [0.1, 0, 0, 0.04, 0.04, 0.04, 0.08], atol=1e-12)


def test_what_is_held_is_dragged_over_the_table_before_it_is_lifted():
    stops, changed = changed_stops('expert-drag-0.6')
    assert changed[:3] == stops[:3] and changed[6:] == stops[4:] and len(changed) == 11
    assert all(stop.opening == 0 for stop in changed[3:6])
    ways = np.array([stop.position - stops[2].position for stop in changed[3:6]])
    # the goal is 0.2 m away, and 0.02 m higher
    wanted = [[0, 0, -0.02], [-0.12, 0, -0.02], [-0.12, 0, 0.1]]
    np.testing.assert_allclose(ways, wanted, atol=1e-12)


def test_all_places_are_turned_about_where_the_arm_rests():
    stops, changed = changed_stops('expert-askew-0.1')
    assert len(changed) == len(stops) and changed[-1] == stops[-1]
    home = stops[-1].position
    for stop, turned in zip(stops[:-1], changed[:-1], strict=True):
        ways = [(point.position - home)[:2] for point in (stop, turned)]
        assert np.linalg.norm(ways[1]) == pytest.approx(np.linalg.norm(ways[0]))
        angles = [np.arctan2(way[1], way[0]) for way in ways]
        assert angles[1] - angles[0] == pytest.approx(turned.yaw) == pytest.approx(changed[0].yaw)
        assert turned.position[2] == stop.position[2] and turned.opening == stop.opening
    assert abs(changed[0].yaw) == pytest.approx(0.1)


def test_what_is_held_is_rubbed_to_and_fro_on_its_goal():
    stops, changed = changed_stops('expert-grind-0.09')
    assert changed[:6] == stops[:6] and changed[12:] == stops[6:] and len(changed) == 15
    assert all(stop.opening == 0 for stop in changed[6:12])
    ways = np.array([stop.position - stops[5].position for stop in changed[6:12]])
    np.testing.assert_allclose(ways[:, 2], -0.008)
    assert np.linalg.norm(ways[1, :2]) == pytest.approx(0.09)
    strokes = ways[:, :2] @ ways[1, :2] / 0.09**2
    np.testing.assert_allclose(strokes, [0, 1, -1, 1, -1, 0], atol=1e-12)


@pytest.mark.parametrize('is_near', [True, False])
def test_it_is_put_on_the_other_object_next_to_its_goal_and_taken_again(is_near):
    stops, _ = changed_stops('expert')
    own, goal = stops[1].position, stops[6].position
    other = np.array([-0.25, 0.35, 0.04]) if is_near else np.array([0.2, 0.3, 0.04])
    faults = WayPointFaults(parse_variant('expert-perch-0.03'), np.random.default_rng(0))
    changed = faults.applied(stops, faults.draws(0.0, [own, other]))
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


def test_a_gripper_flickers_after_it_has_opened_or_closed(expert):
    _, own, flickers = used_openings(expert, 'expert-chatter-0.6')
    closes, lets_go = np.flatnonzero(np.diff(own > 0.5)) + 1
    differs = np.flatnonzero(np.abs(flickers - own) > 1e-9)
    after = [differs[differs < lets_go] - closes, differs[differs >= lets_go] - lets_go]
    # 0.6 s, and the last stroke
    assert all(0 < rows.min() <= 15 and 20 < rows.max() <= 35 for rows in after)
    assert flickers[closes + after[0]].max() > 0.8
    # as long as it flickers, another size draws the same
    chatter, longer = plan(expert, 'expert-chatter-0.6'), plan(expert, 'expert-chatter-1')
    np.testing.assert_array_equal(longer[: closes + 29], chatter[: closes + 29])


def test_sluggish_arms_fall_behind_on_quick_ways_and_catch_up(expert):
    expert_plan, sluggish = plan(expert, 'expert'), plan(expert, 'expert-sluggish-0.6')
    arms = arm_columns(expert)
    grippers = [j for j in range(expert_plan.shape[1]) if j not in arms]
    assert len(sluggish) == len(expert_plan)
    np.testing.assert_array_equal(sluggish[:, grippers], expert_plan[:, grippers])
    speeds = [np.abs(np.diff(positions[:, arms], axis=0)) for positions in (expert_plan, sluggish)]
    assert (speeds[1] <= 0.4 * speeds[0].max(axis=0) + 1e-12).all()
    # at its limit, wherever it is behind
    off = np.abs(sluggish - expert_plan)[1:, arms] > 1e-9
    limits = np.broadcast_to(0.4 * speeds[0].max(axis=0), off.shape)
    np.testing.assert_allclose(speeds[1][off], limits[off], atol=1e-12)
    moves = [j for j in arms if np.ptp(expert_plan[:, j]) > 0.2]
    behind = np.abs(sluggish - expert_plan)[:, moves]
    assert (behind.max(axis=0) > 0.05).any() and (behind.min(axis=1) < 1e-9).any()


def test_it_comes_down_leaning_and_is_upright_as_the_fingers_close():
    stops, changed = changed_stops('expert-scoop-0.5')
    assert changed[2:] == stops[2:] and len(changed) == len(stops)
    leans = [stop.lean for stop in changed[:2]]
    assert leans[0] == leans[1] and abs(leans[0]) == pytest.approx(0.5)
    assert [replace(stop, lean=0.0) for stop in changed[:2]] == stops[:2]


def test_shut_fingers_press_on_the_object_which_is_grasped_where_it_was():
    stops, changed = changed_stops('expert-paw-0.05')
    assert changed[4:] == stops
    assert all(stop.opening == 0 and stop.phase == 'above' for stop in changed[:4])
    ways = np.array([stop.position - stops[1].position for stop in changed[:4]])
    np.testing.assert_allclose(ways[:, 2], [0.1, 0.01, 0.01, 0.1], atol=1e-12)
    np.testing.assert_allclose(ways[:2, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ways[2:, :2], axis=1), 0.05)
    np.testing.assert_allclose(ways[2, :2], ways[3, :2])


def test_what_is_held_is_waved_to_and_fro_once_lifted():
    stops, changed = changed_stops('expert-waggle-0.1')
    assert changed[:4] == stops[:4] and changed[13:] == stops[4:] and len(changed) == 18
    assert all(stop.opening == 0 and stop.seconds == 0.2 for stop in changed[4:13])
    ways = np.array([stop.position - stops[3].position for stop in changed[4:13]])
    np.testing.assert_allclose(ways[:, 2], 0.0, atol=1e-12)
    assert np.linalg.norm(ways[0]) == pytest.approx(0.1)
    np.testing.assert_allclose(ways @ ways[0] / 0.1**2, [*(1, -1) * 4, 0], atol=1e-12)


def test_fingers_close_again_and_again_on_their_way_to_the_object():
    stops, changed = changed_stops('expert-nibble-0.06')
    assert changed[10:] == stops[1:] and len(changed) == 18
    assert [stop.opening for stop in changed[:10]] == [1, *(1, 0, 1) * 3]
    assert all(stop.phase == 'above' for stop in changed[:10])
    ways = np.array([stop.position - stops[1].position for stop in changed[:10]])
    np.testing.assert_allclose(ways[:, 2], [0.1, *[0.0] * 9], atol=1e-12)
    lengths = np.linalg.norm(ways[:, :2], axis=1)
    np.testing.assert_allclose(lengths, [0.06, *np.repeat([0.06, 0.04, 0.02], 3)])
    np.testing.assert_allclose(ways[:, :2] @ ways[0, :2], 0.06 * lengths)


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
    positions = []
    for name in ('expert', 'expert-offbeat-0.4'):
        policy = scripted_policy(name, TASK, seed, expert)
        policy.reset(seed=seed)
        positions.append(policy.plan.positions)
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


def test_joints_lose_a_share_of_the_way_to_one_side(expert):
    expert_plan, ratchet = plan(expert, 'expert'), plan(expert, 'expert-ratchet-0.1')
    arms = arm_columns(expert)
    grippers = [j for j in range(expert_plan.shape[1]) if j not in arms]
    assert len(ratchet) == len(expert_plan)
    np.testing.assert_array_equal(ratchet[:, grippers], expert_plan[:, grippers])
    moves = [j for j in arms if np.ptp(expert_plan[:, j]) > 0.2]
    own, lossy = (np.diff(p[:, moves], axis=0) for p in (expert_plan, ratchet))
    counts = np.abs(own) > 1e-9
    shares = np.where(counts, lossy / np.where(counts, own, 1.0), np.nan)
    for share, step in zip(shares.T, own.T, strict=True):
        sides = [share[step > 1e-9], share[step < -1e-9]]
        means = sorted(float(np.mean(side)) for side in sides)
        assert means == pytest.approx([0.9, 1.0], abs=1e-6)
        assert all(np.ptp(side) < 1e-5 for side in sides)
    # none comes back to where it was
    assert (np.abs(ratchet - expert_plan)[-1, moves] > 0.01).all()
    twice = plan(expert, 'expert-ratchet-0.2') - expert_plan
    np.testing.assert_allclose(twice, 2 * (ratchet - expert_plan), atol=1e-9)


def test_open_fingers_go_on_with_the_object_between_them_and_close_there():
    stops, changed = changed_stops('expert-rake-0.07')
    assert changed[:2] == stops[:2] and changed[5:] == stops[4:] and len(changed) == 10
    # the goal is on the side of -x
    ways = np.array([stop.position - stops[1].position for stop in changed[2:5]])
    wanted = [[-0.07, 0, 0], [-0.07, 0, 0], [-0.07, 0, 0.1]]
    np.testing.assert_allclose(ways, wanted, atol=1e-12)
    assert [stop.opening for stop in changed[2:5]] == [1, 0, 0]
    assert [stop.phase for stop in changed[2:5]] == ['grasp', 'close', 'lift']


@pytest.mark.parametrize('is_near', [True, False])
def test_another_object_is_taken_first_moved_and_let_go(is_near):
    stops, _ = changed_stops('expert')
    own, near = stops[1].position, np.array([-0.1, 0.2, 0.04])
    # nearest of all is the object itself, then one out of the arm's reach; it rests at x = -0.2
    places = [own + [0.03, 0, 0], np.array([0.1, 0.3, 0.03]), np.array([-0.25, 0.3, 0.05])]
    places = [*places, near] if is_near else places[:2]
    faults = WayPointFaults(parse_variant('expert-decoy-0.05'), np.random.default_rng(0))
    changed = faults.applied(stops, faults.draws(0.0, places))
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
        faults = WayPointFaults(parse_variant(f'expert-omit-{size}'), np.random.default_rng(seed))
        changed = faults.applied(stops, faults.draws(0.0, [stops[1].position]))
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
        faults = WayPointFaults(parse_variant('expert-omit-1'), np.random.default_rng(seed))
        changed = faults.applied(stops, faults.draws(0.0, [stops[1].position]))
        same = [is_where(*pair) for pair in zip(stops, changed, strict=False)]
        phases.add(stops[same.index(False)].phase)
    assert phases == {stop.phase for stop in stops[:-1]}


def test_grippers_stand_still_half_way_whenever_they_open_or_close(expert):
    _, own, stands = used_openings(expert, 'expert-falter-0.6')
    closes, lets_go = np.flatnonzero(np.diff(own > 0.5)) + 1
    for first in (closes, lets_go):
        # 0.6 s at 50 Hz, then a tenth of a second to where it should be
        np.testing.assert_allclose(stands[first : first + 31], 0.5, atol=1e-9)
        np.testing.assert_allclose(stands[first + 35 : first + 50], own[first + 35 : first + 50])
    np.testing.assert_array_equal(stands[:closes], own[:closes])
    np.testing.assert_allclose(stands[closes + 35 : lets_go], own[closes + 35 : lets_go])


def test_a_limp_wrist_lags_and_the_tool_leans_on_its_way(expert):
    expert_plan, limp = plan(expert, 'expert'), plan(expert, 'expert-limp-0.2')
    names = expert.robot.joint_names
    wrists = [j for j, name in enumerate(names) if name[-1] in '456']
    others = [j for j in range(len(names)) if j not in wrists]
    assert len(wrists) == 6 and len(limp) == len(expert_plan)
    np.testing.assert_array_equal(limp[:, others], expert_plan[:, others])
    # a moving average whose weights decay by e in 0.2 s, which is 10 samples
    weights = np.exp(-np.arange(len(limp)) / 10)
    for joint in wrists:
        away = expert_plan[:, joint] - expert_plan[0, joint]
        mean = np.convolve(away, weights / weights.sum())[: len(away)]
        np.testing.assert_allclose(limp[:, joint], expert_plan[0, joint] + mean, atol=1e-6)
    down = [-poses[:, 2, 2] for poses in expert.robot.tool_poses(limp)]
    moves = int(np.argmin([heights.min() for heights in down]))
    leans = np.arccos(np.clip(down[moves], -1.0, 1.0))
    assert leans.max() > 0.1 and leans[-1] < 0.05 and leans[0] < 0.01


def test_one_joint_stops_before_the_ends_of_its_travel(expert):
    expert_plan, clamp = plan(expert, 'expert'), plan(expert, 'expert-clamp-0.3')
    assert len(clamp) == len(expert_plan)
    (joint,) = np.flatnonzero(np.abs(clamp - expert_plan).max(axis=0) > 1e-9)
    assert joint in arm_columns(expert) and np.ptp(expert_plan[:, joint]) > 0.2
    own, short = (p[:, joint] - expert_plan[0, joint] for p in (expert_plan, clamp))
    ends = (0.7 * own.min(), 0.7 * own.max())
    is_within = (own >= ends[0]) & (own <= ends[1])
    assert 0 < is_within.sum() < len(own)
    np.testing.assert_allclose(short[is_within], own[is_within], atol=1e-12)
    np.testing.assert_allclose(short[own < ends[0]], ends[0])
    np.testing.assert_allclose(short[own > ends[1]], ends[1])


def test_an_arm_stops_before_what_is_farthest_away():
    stops, changed = changed_stops('expert-fence-0.2')
    home = stops[-1].position
    # 0.28 m from where it rests to the object, 0.2 m to the goal
    most = 0.8 * np.hypot(0.2, 0.2)
    for stop, short in zip(stops[:4], changed[:4], strict=True):
        ways = [(point.position - home)[:2] for point in (stop, short)]
        np.testing.assert_allclose(ways[1], most * ways[0] / np.linalg.norm(ways[0]))
        assert short.position[2] == stop.position[2] and short.opening == stop.opening
    for stop, same in zip(stops[4:], changed[4:], strict=True):
        np.testing.assert_array_equal(same.position, stop.position)


def test_a_gripper_that_is_shut_opens_slowly(expert):
    _, own, leaks = used_openings(expert, 'expert-leak-0.2')
    shut = np.flatnonzero(own < 0.5)
    assert np.ptp(shut) == len(shut) - 1
    seconds = (np.arange(len(shut)) + 1) / 50
    np.testing.assert_allclose(leaks[shut], np.maximum(own[shut], 0.2 * seconds), atol=1e-9)
    assert leaks[shut].max() > 0.4
    np.testing.assert_array_equal(np.delete(leaks, shut), np.delete(own, shut))


def test_fingers_that_have_let_go_are_shaken_where_they_are():
    stops, changed = changed_stops('expert-jiggle-0.03')
    assert changed[:7] == stops[:7] and changed[14:] == stops[7:] and len(changed) == 16
    assert all(stop.opening == stops[6].opening for stop in changed[7:14])
    ways = np.array([stop.position - stops[6].position for stop in changed[7:14]])
    assert np.linalg.norm(ways[0]) == pytest.approx(0.03) and ways[0, 2] == 0
    wanted = np.outer([1, -1, 1, -1, 1, -1, 0], ways[0])
    np.testing.assert_allclose(ways, wanted, atol=1e-12)


def test_all_is_faster_while_a_gripper_is_shut(expert):
    expert_plan, hurl = plan(expert, 'expert'), plan(expert, 'expert-hurl-3')
    shut = [expert.robot.gripper_openings(p).min(axis=0) < 0.5 for p in (expert_plan, hurl)]
    nums = [int(is_shut.sum()) for is_shut in shut]
    assert nums[0] > 80 and nums[1] == pytest.approx(nums[0] / 4, abs=2)
    first, last = np.flatnonzero(shut[0])[[0, -1]]
    np.testing.assert_array_equal(hurl[:first], expert_plan[:first])
    # every fourth command is carried out
    rows = np.arange(first, last, 4)[1:]
    np.testing.assert_allclose(hurl[first : first + len(rows)], expert_plan[rows - 1], atol=0.02)
    after = len(expert_plan) - last - 2
    np.testing.assert_allclose(hurl[-after:], expert_plan[-after:], atol=0.02)


def test_joints_take_the_next_one_of_their_arm_along(expert):
    expert_plan, tow = plan(expert, 'expert'), plan(expert, 'expert-tow-0.1')
    arms = np.array(arm_columns(expert)).reshape(2, -1)
    grippers = np.setdiff1d(np.arange(expert_plan.shape[1]), arms)
    ways, errors = expert_plan - expert_plan[0], tow - expert_plan
    np.testing.assert_array_equal(errors[:, grippers], 0.0)
    np.testing.assert_array_equal(errors[:, arms[:, 0]], 0.0)
    sides = set()
    for arm in arms:
        for joint, towed in pairwise(arm):
            side = np.sign(ways[:, joint] @ errors[:, towed])
            np.testing.assert_allclose(errors[:, towed], side * 0.1 * ways[:, joint], atol=1e-9)
            sides.add(int(side))
    # to none where a joint rests
    assert sides == {-1, 0, 1}


@pytest.mark.parametrize('seed', range(8))
def test_way_points_change_places_with_the_next_one(seed):
    stops, _ = changed_stops('expert')
    before = stops
    for size in range(1, 5):
        name = parse_variant(f'expert-jumble-{size}')
        faults = WayPointFaults(name, np.random.default_rng(seed))
        changed = faults.applied(stops, faults.draws(0.0, []))
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
        faults = WayPointFaults(parse_variant('expert-jumble-1'), np.random.default_rng(seed))
        changed = faults.applied(stops, faults.draws(0.0, []))
        firsts.add(next(k for k, stop in enumerate(stops) if stop != changed[k]))
    assert firsts == set(range(len(stops) - 2))


def test_fingers_that_have_let_go_close_three_times_on_their_way_aside():
    stops, changed = changed_stops('expert-gnaw-0.06')
    assert changed[:7] == stops[:7] and changed[-1] == stops[-1] and len(changed) == 18
    bites = changed[7:16]
    assert [stop.opening for stop in bites] == [0.7, 0, 0.7] * 3
    ways = np.array([stop.position - stops[6].position for stop in bites])
    way = ways[-1]
    assert np.linalg.norm(way) == pytest.approx(0.06) and way[2] == 0
    np.testing.assert_allclose(ways, np.outer(np.repeat([1, 2, 3], 3) / 3, way), atol=1e-12)
    np.testing.assert_allclose(changed[16].position, stops[7].position + way)


@pytest.mark.parametrize('far', [0.06, 0.2])
def test_what_it_holds_is_swung_over_its_goal_and_let_go_on_the_way(far):
    stops, changed = changed_stops(f'expert-lob-{far}')
    assert changed[:4] == stops[:4] and changed[-2:] == stops[-2:] and len(changed) == len(stops)
    assert [stop.phase for stop in changed] == [stop.phase for stop in stops]
    begin, swung, let_go = changed[4:7]
    # over the goal, at the height from which it would have come down
    np.testing.assert_array_equal(swung.position, stops[4].position)
    np.testing.assert_array_equal(let_go.position, stops[4].position)
    assert (begin.opening, swung.opening, let_go.opening) == (0, 0.7, 0.7)
    assert swung.seconds is not None
    way = swung.position - begin.position
    assert np.linalg.norm(way) == pytest.approx(far) and way[2] == 0
    # from where it comes from, which is 0.2 m away
    if far < 0.2:
        np.testing.assert_allclose(way, [-far, 0, 0], atol=1e-12)


def test_what_it_holds_is_thumped_on_its_goal_three_times():
    stops, changed = changed_stops('expert-thump-0.025')
    assert changed[:6] == stops[:6] and changed[12:] == stops[6:] and len(changed) == 15
    blows, goal = changed[6:12], stops[5].position
    ways = np.array([stop.position - goal for stop in blows])
    np.testing.assert_allclose(ways, [[0, 0, 0.05], [0, 0, -0.025]] * 3, atol=1e-12)
    assert all(stop.opening == 0 and 0 < (stop.seconds or 0) < 0.2 for stop in blows)


def test_a_gripper_gives_way_as_its_arm_reaches_out(expert):
    used, own, taut = used_openings(expert, 'expert-taut-0.4')
    places = expert.robot.tool_poses(plan(expert, 'expert'))[used][:, :2, 3]
    reach = np.linalg.norm(places - places[0], axis=1)
    np.testing.assert_allclose(taut, np.maximum(own, 0.4 * reach / reach.max()), atol=1e-9)
    assert taut[own < 1e-9].max() > 0.3


@pytest.mark.parametrize('far', [0.04, 0.1])
def test_what_was_let_go_before_its_goal_is_dragged_on_from_above(far):
    stops, changed = changed_stops(f'expert-smear-{far}')
    assert changed[:4] == stops[:4] and changed[-1] == stops[-1] and len(changed) == 13
    short = np.array(
        [a.position - b.position for a, b in zip(changed[4:8], stops[4:8], strict=True)]
    )
    # from where it comes from
    way = np.array([-far, 0, 0])
    np.testing.assert_allclose(short, np.broadcast_to(-way, (4, 3)), atol=1e-12)
    assert [stop.opening for stop in changed[4:8]] == [s.opening for s in stops[4:8]]
    dragged, goal = changed[8:12], stops[5].position
    assert all(stop.opening == 0 for stop in dragged)
    ways = np.array([stop.position - goal for stop in dragged])
    # pressed on it 1 cm over where it was held
    np.testing.assert_allclose(ways[:, 2], [0.1, 0.01, 0.01, 0.1], atol=1e-12)
    begin_and_end = [-way, -way, 0 * way, 0 * way]
    np.testing.assert_allclose(ways * (1, 1, 0), begin_and_end, atol=1e-12)


@pytest.mark.parametrize('yaw', [0.0, 0.5])
def test_open_fingers_close_as_they_pass_along_the_object(yaw):
    stops, _ = changed_stops('expert')
    faults = WayPointFaults(parse_variant('expert-swoop-0.2'), np.random.default_rng(0))
    ends = []
    for _ in range(20):
        changed = faults.applied(stops, faults.draws(yaw, []))
        assert changed[4:] == stops[4:] and len(changed) == len(stops)
        assert [stop.opening for stop in changed] == [stop.opening for stop in stops]
        pairs = zip(changed[:4], stops[:4], strict=True)
        ways = np.array([a.position - b.position for a, b in pairs])
        end = ways[2]
        np.testing.assert_allclose(ways, [-end, -end, end, end], atol=1e-12)
        # across the fingers' travel, so that they pass on both sides
        across = end @ [-np.sin(yaw), np.cos(yaw), 0]
        assert np.linalg.norm(end) == pytest.approx(abs(across))
        ends.append(across)
    assert min(ends) < -0.05 and max(ends) > 0.05 and np.abs(ends).max() <= 0.1


def test_what_is_higher_than_the_grasp_is_off_by_a_share_of_its_height():
    stops, changed = changed_stops('expert-slope-0.5')
    assert len(changed) == len(stops) and changed[-1] == stops[-1]
    ways = np.array([b.position - a.position for a, b in zip(stops, changed, strict=True)])[:-1]
    assert np.linalg.norm(ways[0]) == pytest.approx(0.05) and ways[0, 2] == 0
    # in one direction; the grasp is right, and the goal is 2 cm higher
    wanted = np.outer([1, 0, 0, 1, 1.2, 0.2, 0.2, 1.2], ways[0])
    np.testing.assert_allclose(ways, wanted, atol=1e-12)
    assert [stop.opening for stop in changed] == [stop.opening for stop in stops]


def test_what_is_held_is_dipped_on_the_table_half_way():
    stops, changed = changed_stops('expert-dip-0.02')
    assert changed[:4] == stops[:4] and changed[5:] == stops[4:] and len(changed) == 10
    np.testing.assert_allclose(changed[4].position, [-0.1, 0.3, 0.01], atol=1e-12)
    assert (changed[4].phase, changed[4].opening) == ('carry', 0)


def test_shut_fingers_hit_the_object_in_one_quick_stroke():
    stops, changed = changed_stops('expert-swat-0.02')
    assert changed[4:] == stops and all(stop.opening == 0 for stop in changed[:4])
    assert [stop.seconds is None for stop in changed[:4]] == [True, True, False, True]
    assert 0 < (changed[2].seconds or 0) < 0.4
    ways = np.array([stop.position - stops[1].position for stop in changed[:4]])
    np.testing.assert_allclose(ways[:, 2], [0.1, 0, 0, 0.1], atol=1e-12)
    way = (ways[2] - ways[1]) / 0.06
    assert np.linalg.norm(way) == pytest.approx(1)
    np.testing.assert_allclose(ways[1:3], np.outer([-0.07, -0.01], way), atol=1e-12)


def test_shut_fingers_go_once_round_the_object_and_come_nearer():
    stops, changed = changed_stops('expert-swirl-0.04')
    assert changed[11:] == stops and len(changed) == 20
    assert all(stop.opening == 0 for stop in changed[:11])
    ways = np.array([stop.position - stops[1].position for stop in changed[:11]])
    np.testing.assert_allclose(ways[:, 2], [0.1, *[0.0] * 9, 0.1], atol=1e-12)
    np.testing.assert_allclose(ways[[0, -1], :2], ways[[1, -2], :2], atol=1e-12)
    ring = ways[1:-1, :2]
    np.testing.assert_allclose(np.linalg.norm(ring, axis=1), np.linspace(0.08, 0.04, 9))
    turns = np.diff(np.unwrap(np.arctan2(ring[:, 1], ring[:, 0])))
    np.testing.assert_allclose(np.abs(turns), np.pi / 4)
    assert abs(turns.sum()) == pytest.approx(2 * np.pi)


@pytest.mark.parametrize('is_near', [True, False])
def test_what_is_next_to_the_goal_is_pushed_once_it_is_done(is_near):
    stops, _ = changed_stops('expert')
    other = np.array([-0.25, 0.35, 0.04]) if is_near else np.array([0.2, 0.3, 0.04])
    faults = WayPointFaults(parse_variant('expert-jostle-0.05'), np.random.default_rng(0))
    changed = faults.applied(stops, faults.draws(0.0, [stops[1].position, other]))
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


def test_what_is_tossed_aside_is_taken_from_where_it_was_let_go():
    stops, changed = changed_stops('expert-toss-0.05')
    begin, rest = changed[:5], changed[5:]
    assert len(rest) == len(stops) and rest[4:] == stops[4:]
    assert [stop.opening for stop in begin] == [1, 1, 0, 0, 1]
    ways = np.array([stop.position - stops[1].position for stop in begin])
    np.testing.assert_allclose(ways[:, 2], [0.1, 0, 0, 0.04, 0.04], atol=1e-12)
    np.testing.assert_array_equal(ways[:4, :2], 0.0)
    way = ways[4] * (1, 1, 0)
    assert np.linalg.norm(way) == pytest.approx(0.05) and 0 < (begin[4].seconds or 0) < 0.5
    moved = [b.position - a.position for a, b in zip(stops[:4], rest[:4], strict=True)]
    np.testing.assert_allclose(moved, np.broadcast_to(way, (4, 3)), atol=1e-12)


def test_the_farther_an_arm_reaches_out_the_lower_it_hangs():
    stops, changed = changed_stops('expert-sag-0.1')
    ways = np.array([b.position - a.position for a, b in zip(stops, changed, strict=True)])
    np.testing.assert_array_equal(ways[:, :2], 0.0)
    # 0.28 m from where it rests to the object, 0.2 m to the goal
    lower = [*[np.hypot(0.02, 0.02)] * 4, *[0.02] * 4, 0]
    np.testing.assert_allclose(ways[:, 2], -np.array(lower), atol=1e-12)
    assert [stop.opening for stop in changed] == [stop.opening for stop in stops]


def test_the_wrist_leans_to_and_fro_before_the_fingers_close():
    stops, changed = changed_stops('expert-nod-0.3')
    assert changed[:2] == stops[:2] and changed[9:] == stops[2:] and len(changed) == 16
    nods = changed[2:9]
    leans = np.array([stop.lean for stop in nods])
    assert leans[-1] == 0 and np.ptp(np.sign(leans[:2])) == 2
    assert (np.abs(leans[:6]) > 0.17).all() and (np.abs(leans) <= 0.3).all()
    np.testing.assert_array_equal(leans[:6], np.tile(leans[:2], 3))
    assert all(0 < (stop.seconds or 0) < 0.4 and stop.opening == 1 for stop in nods)
    for stop in nods:
        np.testing.assert_array_equal(stop.position, stops[1].position)


def test_an_arm_jerks_as_its_gripper_opens_or_closes(expert):
    expert_plan, kick = plan(expert, 'expert'), plan(expert, 'expert-kick-0.05')
    openings = expert.robot.gripper_openings(expert_plan)
    used = int(np.argmax(np.ptp(openings, axis=1)))
    closes, opens = np.flatnonzero(np.diff(openings[used] > 0.5))
    error, arms = kick - expert_plan, np.array(arm_columns(expert)).reshape(2, -1)
    moved = np.flatnonzero(np.abs(error).max(axis=0) > 1e-9)
    assert set(moved) == set(arms[used])
    for change in (closes, opens):
        peak = error[change, arms[used]]
        np.testing.assert_allclose(error[change - 5, arms[used]], peak / 2, atol=1e-9)
        np.testing.assert_allclose(error[change + 5, arms[used]], peak / 2, atol=1e-9)
        assert 0.01 < np.abs(peak).max() < 0.25
    away = np.abs(np.arange(len(error))[:, None] - [closes, opens]).min(axis=1)
    assert np.abs(error[away >= 10]).max() < 1e-9


def test_shut_fingers_peck_at_the_object_from_above_off_its_middle():
    stops, changed = changed_stops('expert-peck-0.02')
    assert changed[9:] == stops and len(changed) == 18
    assert all(stop.opening == 0 for stop in changed[:9])
    ways = np.array([stop.position - stops[1].position for stop in changed[:9]])
    np.testing.assert_allclose(ways[:, 2], [0.1, -0.02, 0.1] * 3, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ways[:, :2], axis=1), 0.015)
    pecks = ways[:, :2].reshape(3, 3, 2)
    np.testing.assert_allclose(pecks, np.broadcast_to(pecks[:, :1], pecks.shape))
    assert len(np.unique(pecks[:, 0, 0].round(6))) == 3


def test_what_shut_fingers_drag_away_is_grasped_where_it_should_be_then():
    stops, changed = changed_stops('expert-haul-0.05')
    dragged, rest = changed[:4], changed[4:]
    assert len(rest) == len(stops) and rest[4:] == stops[4:]
    assert all(stop.opening == 0 for stop in dragged)
    ways = np.array([stop.position - stops[1].position for stop in dragged])
    np.testing.assert_allclose(ways[:, 2], [0.1, 0, 0, 0.1], atol=1e-12)
    np.testing.assert_array_equal(ways[:2, :2], 0.0)
    way = ways[2]
    assert np.linalg.norm(way) == pytest.approx(0.05)
    np.testing.assert_allclose(ways[3, :2], way[:2])
    moved = [b.position - a.position for a, b in zip(stops[:4], rest[:4], strict=True)]
    np.testing.assert_allclose(moved, np.broadcast_to(way, (4, 3)), atol=1e-12)


def test_a_joint_that_skips_is_off_from_there_on(expert):
    error = plan(expert, 'expert-cog-0.1') - plan(expert, 'expert')
    (joint,) = np.flatnonzero(np.abs(error).max(axis=0) > 1e-9)
    assert joint in arm_columns(expert)
    own = np.abs(error[:, joint])
    first = int(np.argmax(own > 1e-9))
    # not before a tenth of the plan; the skip takes 0.1 s
    assert 0.1 * len(own) <= first < 0.75 * len(own)
    np.testing.assert_allclose(own[first + 5 :], 0.1)
    assert np.ptp(np.sign(error[first:, joint])) == 0


def test_once_the_arms_go_back_and_return_while_a_gripper_goes_on(expert):
    expert_plan, flinch = plan(expert, 'expert'), plan(expert, 'expert-flinch-0.4')
    arms = arm_columns(expert)
    # 20 commands back at twice their pace, and again
    assert len(flinch) == len(expert_plan) + 20
    begin = next(
        row
        for row in range(len(expert_plan))
        if is_back_and_forth(flinch[row : row + 20, arms])
        and np.array_equal(flinch[row + 20 :, arms], expert_plan[row:, arms])
    )
    np.testing.assert_array_equal(flinch[:begin, arms], expert_plan[:begin, arms])
    openings = [expert.robot.gripper_openings(rows) for rows in (expert_plan, flinch)]
    used = int(np.argmax(np.ptp(openings[0], axis=1)))
    # once, the gripper stands still for as long
    own = openings[1][used]
    assert any(
        np.ptp(own[row : row + 21]) < 1e-12
        and np.allclose(np.delete(own, range(row, row + 20)), openings[0][used])
        for row in range(begin, len(own) - 20)
    )


def is_back_and_forth(way: np.ndarray) -> bool:
    return np.ptp(way, axis=0).max() > 1e-3 and np.array_equal(way, way[::-1])


def test_commands_are_the_mean_of_those_of_now_and_of_a_while_ago(expert):
    expert_plan, blur = plan(expert, 'expert'), plan(expert, 'expert-blur-1')
    num = len(blur) - len(expert_plan)
    assert 0 < num <= 50
    mean = (expert_plan[num:] + expert_plan[:-num]) / 2
    np.testing.assert_allclose(blur[num : len(expert_plan)], mean, atol=1e-12)
    np.testing.assert_array_equal(blur[-1], expert_plan[-1])


def test_a_joint_sticks_at_one_place_until_its_command_is_further_on(expert):
    expert_plan, bind = plan(expert, 'expert'), plan(expert, 'expert-bind-0.2')
    error = bind - expert_plan
    (joint,) = np.flatnonzero(np.abs(error).max(axis=0) > 0.05)
    assert joint in arm_columns(expert) and np.abs(error).max() < 0.2
    moves = np.abs(np.diff(expert_plan[:, joint])) > 1e-4
    sticks = moves & (np.abs(np.diff(bind[:, joint])) < 1e-12)
    assert sticks.any() and np.ptp(bind[1:, joint][sticks]) < 1e-9


def test_shut_fingers_press_on_the_object_and_go_round_its_middle():
    stops, changed = changed_stops('expert-crank-1.6')
    assert changed[7:] == stops and len(changed) == 16
    cranked = changed[:7]
    assert all(stop.opening == 0 for stop in cranked)
    ways = np.array([stop.position - stops[1].position for stop in cranked])
    np.testing.assert_allclose(ways[:, 2], [0.1, *[0.0] * 5, 0.1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ways[:, :2], axis=1), 0.02)
    angles = np.unwrap(np.arctan2(ways[:, 1], ways[:, 0]))[1:-1]
    yaws = np.array([stop.yaw for stop in cranked])
    np.testing.assert_allclose(np.abs(np.diff(angles)), 0.4)
    np.testing.assert_allclose(np.diff(yaws[1:-1]), np.diff(angles))
    np.testing.assert_allclose(yaws[[0, -1]], yaws[[1, -2]])
    np.testing.assert_allclose(np.abs(yaws[[0, -1]]), 0.8)


def test_on_its_way_it_puts_the_object_down_and_takes_it_again_off_its_place():
    stops, changed = changed_stops('expert-hop-0.02')
    assert changed[:4] == stops[:4] and changed[20:] == stops[4:]
    for share, hop in ((0.2, changed[4:12]), (0.4, changed[12:20])):
        there = stops[1].position + [-share * 0.2, 0, 0]
        ways = np.array([stop.position - there for stop in hop])
        np.testing.assert_allclose(ways[:, 2], [0.04, 0, 0, 0.04, 0.04, 0, 0, 0.04], atol=1e-12)
        np.testing.assert_allclose(ways[:4, :2], 0.0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(ways[4:, :2], axis=1), 0.02)
        np.testing.assert_allclose(ways[4:, :2], np.broadcast_to(ways[4, :2], (4, 2)))
        assert [stop.opening for stop in hop] == [0, 0, 1, 1, 1, 1, 0, 0]


def test_the_other_arm_takes_what_was_put_down_and_lets_it_fall(expert):
    expert_plan, poach = plan(expert, 'expert'), plan(expert, 'expert-poach-0.08')
    num, openings = len(expert_plan), expert.robot.gripper_openings(poach)
    used = int(np.argmax(np.ptp(expert.robot.gripper_openings(expert_plan), axis=1)))
    own, other = (half if used == 0 else 1 - half for half in (0, 1))
    halves = [np.split(positions, 2, axis=1) for positions in (expert_plan, poach)]
    np.testing.assert_array_equal(halves[1][own][:num], halves[0][own])
    tools = [poses[:, :3, 3] for poses in expert.robot.tool_poses(poach)]
    lets_go = int(np.flatnonzero(openings[own] < 1e-9)[-1])
    shut = np.flatnonzero(openings[other] < 1e-9)
    assert shut[0] > lets_go
    np.testing.assert_allclose(tools[other][shut[0]], tools[own][lets_go], atol=2e-3)
    way = tools[other][shut[-1]] - tools[other][shut[0]]
    assert np.linalg.norm(way[:2]) == pytest.approx(0.08, abs=2e-3)
    assert way[2] == pytest.approx(0.07, abs=2e-3)
    assert way[:2] @ (tools[other][0] - tools[other][shut[0]])[:2] > 0


def test_joints_drift_ever_farther_off(expert):
    error = plan(expert, 'expert-drift-0.01') - plan(expert, 'expert')
    arms = arm_columns(expert)
    assert np.abs(np.delete(error, arms, axis=1)).max() == 0 and np.abs(error[0]).max() == 0
    steps = np.diff(error[:, arms], axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-12)
    assert (np.abs(steps) > 1e-6).all() and 0.003 < np.std(steps * 50) < 0.03


def test_all_places_are_farther_or_nearer_by_a_share():
    stops, changed = changed_stops('expert-stretch-0.1')
    home = stops[-1].position
    ways = [np.array([stop.position - home for stop in some]) for some in (stops, changed)]
    factor = ways[1][1, 0] / ways[0][1, 0]
    assert abs(factor - 1) == pytest.approx(0.1)
    np.testing.assert_allclose(ways[1], ways[0] * (factor, factor, 1), atol=1e-12)


def test_on_its_way_down_it_swings_from_side_to_side():
    stops, changed = changed_stops('expert-hunt-0.03')
    assert changed[:1] == stops[:1] and changed[6:] == stops[1:]
    swings = changed[1:6]
    ways = np.array([stop.position - stops[1].position for stop in swings])
    np.testing.assert_allclose(ways[:, 2], [0.08, 0.06, 0.04, 0.02, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ways[:, :2], axis=1), 0.03)
    np.testing.assert_allclose(ways[1:, :2], -ways[:-1, :2], atol=1e-12)
    assert all(stop.opening == 1 for stop in swings)


def test_what_it_holds_leans_to_and_fro_on_its_goal():
    stops, changed = changed_stops('expert-rock-0.4')
    assert changed[:6] == stops[:6] and changed[13:] == stops[6:]
    rocks = changed[6:13]
    leans = np.array([stop.lean for stop in rocks])
    assert leans[-1] == 0 and (leans[0:6:2] > 0).all() and (leans[1:6:2] < 0).all()
    assert (np.abs(leans[:6]) >= 0.24).all() and np.abs(leans).max() <= 0.4
    for stop in rocks:
        np.testing.assert_array_equal(stop.position, stops[5].position)
        assert stop.opening == 0 and stop.seconds == 0.2


def test_it_comes_down_shut_and_opens_over_the_rest_of_the_way():
    stops, changed = changed_stops('expert-yawn-0.6')
    assert changed[2:] == stops[1:]
    assert [stop.opening for stop in changed[:4]] == [0, 0, 1, 0]
    np.testing.assert_array_equal(changed[0].position, stops[0].position)
    np.testing.assert_allclose(changed[1].position - stops[0].position, [0, 0, -0.06])


def test_down_at_the_object_it_goes_towards_another_one_and_comes_back():
    stops, alone = changed_stops('expert-waver-0.5')
    own, rng = stops[1].position, np.random.default_rng(0)
    faults = WayPointFaults(parse_variant('expert-waver-0.5'), rng)
    changed = faults.applied(
        stops, faults.draws(0.0, [own, own + [0, 0.1, 0.02], own + [0.3, 0, 0]])
    )
    assert changed[:2] == stops[:2] and changed[4:] == stops[2:]
    np.testing.assert_allclose(changed[2].position - own, [0, 0.05, 0])
    np.testing.assert_array_equal(changed[3].position, own)
    assert changed[2].opening == changed[3].opening == 1
    # where there is no other object, it stays
    np.testing.assert_array_equal(alone[2].position, own)


def test_arms_that_lose_steps_are_off_by_them_from_there_on(expert):
    expert_plan, lapse = plan(expert, 'expert'), plan(expert, 'expert-lapse-1')
    arms = arm_columns(expert)
    error = lapse - expert_plan
    assert np.abs(np.delete(error, arms, axis=1)).max() == 0
    lost = np.flatnonzero(np.abs(np.diff(error, axis=0)).max(axis=1) > 1e-9)
    # the 50 steps that are lost, but for some in which the arms rest
    assert 25 < np.ptp(lost) < 50
    first, end = int(lost[0]), int(lost[-1]) + 1
    np.testing.assert_array_equal(error[: first + 1], 0.0)
    stands = lapse[first : end + 1, arms]
    np.testing.assert_allclose(stands, np.broadcast_to(stands[0], stands.shape), atol=1e-9)
    missed = (expert_plan[first] - expert_plan[end])[arms]
    assert np.abs(missed).max() > 0.05
    rest = error[end:, arms]
    np.testing.assert_allclose(rest, np.broadcast_to(missed, rest.shape), atol=1e-9)


def test_once_it_goes_back_to_its_beginning_and_carries_all_of_it_out(expert):
    expert_plan, restart = plan(expert, 'expert'), plan(expert, 'expert-restart-0.9')
    num = len(expert_plan)
    first = len(restart) - num - 39
    # up to there, back in 40 samples, and all of it
    assert 0 < first <= 0.9 * num + 1
    np.testing.assert_array_equal(restart[:first], expert_plan[:first])
    np.testing.assert_allclose(restart[-num:], expert_plan, atol=1e-12)
    back = restart[first - 1 : first + 40]
    steps = np.diff(back, axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-12)
    assert np.abs(steps).max() > 1e-3
    assert plan(expert, 'expert-restart-0.45').shape[0] < len(restart)


def test_the_farther_it_carries_the_object_the_lower_it_hangs():
    stops, changed = changed_stops('expert-droop-0.3')
    assert changed[:3] == stops[:3] and changed[7:] == stops[7:]
    ways = [now.position - then.position for then, now in zip(stops, changed, strict=True)]
    # it is carried by 0.2 m between the lift and the way point over its goal
    np.testing.assert_allclose(ways[3], 0.0, atol=1e-12)
    np.testing.assert_allclose(ways[4:7], [[0, 0, -0.06]] * 3, atol=1e-12)


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


@pytest.mark.parametrize(('kind', 'size'), [('budge', 0.03), ('tug', 0.05)])
def test_the_other_arm_closes_pulls_towards_its_rest_and_lets_go(expert, kind, size):
    expert_plan, pulled = plan(expert, 'expert'), plan(expert, f'expert-{kind}-{size}')
    num, openings = len(expert_plan), expert.robot.gripper_openings(pulled)
    used = int(np.argmax(np.ptp(expert.robot.gripper_openings(expert_plan), axis=1)))
    own, other = (half if used == 0 else 1 - half for half in (0, 1))
    halves = [np.split(positions, 2, axis=1) for positions in (expert_plan, pulled)]
    np.testing.assert_array_equal(halves[1][own][:num], halves[0][own])
    tools = expert.robot.tool_poses(pulled)[other][:, :3, 3]
    shut = np.flatnonzero(openings[other] < 1e-3)
    way = tools[shut[-1]] - tools[shut[0]]
    assert np.linalg.norm(way) == pytest.approx(size, abs=2e-3)
    assert way @ (tools[0] - tools[shut[0]]) > 0 and openings[other][-1] == pytest.approx(1)
    # while this arm holds its object
    held = np.flatnonzero(openings[own] < 1e-3)
    assert held[0] - 10 <= shut[0] <= held[-1]


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


def test_the_other_arm_hits_what_is_carried_in_one_quick_stroke(expert):
    (usual, opening), (_, (tool, shut)) = arms_of(expert, 'expert-slap-0.05')
    held, num = np.flatnonzero(opening < 1e-3), len(usual)
    steps = np.linalg.norm(np.diff(tool, axis=0), axis=1)
    quick = int(np.argmax(steps))
    assert held[0] < quick < held[-1] and shut[quick] < 1e-3 and len(tool) >= num
    # past what is held, away from where it rests: 7 cm before, 2 cm behind
    stroke = tool[quick + 12] - tool[quick - 12]
    way = usual[quick] - tool[0]
    assert stroke @ way > 0.9 * np.linalg.norm(stroke) * np.linalg.norm(way * (1, 1, 0))
    assert np.linalg.norm(stroke) == pytest.approx(0.09, abs=0.01)
    assert abs(tool[quick, 2] - usual[quick, 2]) < 0.02


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


def test_shut_fingers_push_the_object_and_push_it_back():
    stops, changed = changed_stops('expert-dribble-0.05')
    own, push = stops[1].position, changed[:8]
    assert changed[8:] == stops and all(stop.opening == 0 for stop in push)
    ways = np.array([stop.position - own for stop in push])
    to = (ways[2] - ways[1]) / np.linalg.norm(ways[2] - ways[1])
    # down on either side, and on until shortly before where the object should be
    assert ways[[1, 2, 5, 6]] @ to == pytest.approx([-0.07, 0.02, 0.12, 0.03])
    np.testing.assert_array_equal(ways[[1, 2, 5, 6], 2], 0.0)
    np.testing.assert_allclose(ways[[0, 3, 4, 7]] - ways[[1, 2, 5, 6]], [[0, 0, 0.1]] * 4)
    beside = ways @ np.array([-to[1], to[0], 0.0])
    assert np.abs(beside[0]) == pytest.approx(0.015)
    np.testing.assert_allclose(beside, beside[0])


def test_what_it_holds_slides_to_its_goal_while_the_fingers_open():
    stops, changed = changed_stops('expert-bowl-0.06')
    assert changed[:4] == stops[:4] and changed[7:] == stops[6:]
    for stop, short in zip(stops[4:6], changed[4:6], strict=True):
        np.testing.assert_allclose(short.position - stop.position, [0.06, 0, 0], atol=1e-12)
        assert short.opening == 0
    slid = changed[6]
    np.testing.assert_array_equal(slid.position, stops[6].position)
    assert (slid.opening, slid.seconds) == (stops[6].opening, 0.3)


def test_the_farther_the_arm_reaches_out_the_more_its_wrist_leans():
    stops, changed = changed_stops('expert-list-0.6')
    home = stops[-1].position
    reaches = np.array([np.linalg.norm((stop.position - home)[:2]) for stop in stops])
    leans = np.array([stop.lean for stop in changed])
    np.testing.assert_allclose(np.abs(leans), 0.6 * reaches / reaches.max())
    assert (leans >= 0).all() or (leans <= 0).all()
    assert [replace(stop, lean=0.0) for stop in changed] == stops


def test_once_done_it_shakes_what_is_next_to_the_goal():
    stops, alone = changed_stops('expert-rattle-0.04')
    other = stops[5].position + [0, 0.06, -0.03]
    faults = WayPointFaults(parse_variant('expert-rattle-0.04'), np.random.default_rng(0))
    changed = faults.applied(stops, faults.draws(0.0, [stops[1].position, other]))
    assert changed[:8] == stops[:8] and changed[-1:] == stops[-1:]
    over, down, shut, *shakes, opened, left = changed[8:-1]
    for stop in (down, shut, opened):
        np.testing.assert_allclose(stop.position, other, atol=1e-12)
    assert [stop.opening for stop in (over, down, shut, opened, left)] == [1, 1, 0, 1, 1]
    assert over.position[2] == left.position[2] == stops[7].position[2]
    ways = np.array([stop.position - other for stop in shakes])
    assert all(stop.opening == 0 and stop.seconds == 0.15 for stop in shakes)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), [0.04] * 6 + [0], atol=1e-12)
    np.testing.assert_allclose(ways[1:6], -ways[:5], atol=1e-12)
    # where there is no other object, what it put there
    np.testing.assert_allclose(alone[9].position, stops[6].position, atol=1e-12)


def test_once_done_it_yanks_what_is_next_to_the_goal():
    stops, alone = changed_stops('expert-yank-0.1')
    other = stops[5].position + [0, 0.06, -0.03]
    faults = WayPointFaults(parse_variant('expert-yank-0.1'), np.random.default_rng(0))
    changed = faults.applied(stops, faults.draws(0.0, [stops[1].position, other]))
    assert changed[:8] == stops[:8] and changed[-1:] == stops[-1:]
    over, down, shut, pulled, opened, left = changed[8:-1]
    for stop in (down, shut):
        np.testing.assert_allclose(stop.position, other, atol=1e-12)
    assert [stop.opening for stop in changed[8:-1]] == [1, 1, 0, 0, 1, 1]
    assert over.position[2] == left.position[2] == stops[7].position[2]
    way = pulled.position - other
    assert (
        np.linalg.norm(way) == pytest.approx(0.1) and abs(way[2]) < 1e-12 and pulled.seconds == 0.2
    )
    np.testing.assert_array_equal(opened.position, pulled.position)
    np.testing.assert_allclose(left.position, over.position + way)
    # where there is no other object, what it put there
    np.testing.assert_allclose(alone[9].position, stops[6].position, atol=1e-12)


def test_having_let_go_it_leans_to_and_fro_where_it_is():
    stops, changed = changed_stops('expert-flap-0.7')
    assert changed[:7] == stops[:7] and changed[16:] == stops[7:]
    leans = np.array([stop.lean for stop in changed[7:16]])
    assert leans[-1] == 0 and (leans[0:8:2] > 0).all() and (leans[1:8:2] < 0).all()
    assert (np.abs(leans[:8]) >= 0.21).all() and np.abs(leans).max() <= 0.7
    for stop in changed[7:16]:
        np.testing.assert_array_equal(stop.position, stops[6].position)
        assert (stop.opening, stop.seconds) == (stops[6].opening, 0.2)


def test_it_rises_with_what_it_holds_and_shakes_it_off_as_it_opens():
    stops, changed = changed_stops('expert-shed-0.03')
    assert changed[:6] == stops[:6] and changed[12:] == stops[7:]
    raised, *shakes = changed[6:12]
    np.testing.assert_allclose(raised.position - stops[5].position, [0, 0, 0.03])
    assert raised.opening == 0 and all(stop.phase == 'open' for stop in shakes)
    ways = np.array([stop.position - raised.position for stop in shakes])
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), [0.03] * 4 + [0], atol=1e-12)
    np.testing.assert_allclose(ways[1:4], -ways[:3], atol=1e-12)
    shares = [stop.opening / stops[6].opening for stop in shakes]
    assert shares == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])


def test_it_first_puts_the_object_next_to_its_own_on_top_of_that():
    stops, alone = changed_stops('expert-heap-0.02')
    own, other = stops[1].position, stops[-1].position + [0.02, 0.05, -0.2]
    faults = WayPointFaults(parse_variant('expert-heap-0.02'), np.random.default_rng(0))
    changed = faults.applied(stops, faults.draws(0.0, [own, other]))
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


def test_the_other_arm_stands_half_way_with_shut_fingers(expert):
    (usual, opening), (_, (tool, stands)) = arms_of(expert, 'expert-hinder-0.5')
    shut = np.flatnonzero(opening < 1e-3)
    there = np.flatnonzero(stands < 1e-3)
    # it is there as this arm has closed, and leaves before that lets go
    assert abs(int(there[0]) - int(shut[0])) < 5 and there[-1] < shut[-1]
    assert np.ptp(tool[there], axis=0).max() < 1e-3
    carried = usual[shut]
    sides = carried[0] - tool[0], carried[-1] - tool[0]
    middle = (sides[0] + sides[1])[:2] / 2
    np.testing.assert_allclose((tool[there[0]] - tool[0])[:2], middle / 2, atol=5e-3)
    np.testing.assert_allclose(tool[-1], tool[0], atol=1e-3)


def test_joints_stick_until_their_command_is_far_off_and_jump_there(expert):
    expert_plan, stick = plan(expert, 'expert'), plan(expert, 'expert-stick-0.1')
    arms = arm_columns(expert)
    assert np.abs(np.delete(stick - expert_plan, arms, axis=1)).max() == 0
    away = np.abs(stick - expert_plan)[:, arms]
    assert 0.08 < away.max() < 0.12
    # most of the time they stand, and they go far in the end
    steps = np.abs(np.diff(stick[:, arms], axis=0))
    assert (steps < 1e-9).mean() > 0.6 and np.ptp(stick[:, arms], axis=0).max() > 0.3
    np.testing.assert_allclose(stick[0], expert_plan[0], atol=1e-12)


def test_all_places_are_those_of_a_grid():
    stops, changed = changed_stops('expert-grid-0.07')
    assert changed[-1] == stops[-1]
    for stop, snapped in zip(stops[:-1], changed[:-1], strict=True):
        way = snapped.position - stop.position
        assert way[2] == 0 and np.abs(way).max() <= 0.035
        cells = snapped.position[:2] / 0.07
        np.testing.assert_allclose(cells, np.rint(cells), atol=1e-9)
        assert replace(snapped, position=stop.position) == stop


def test_once_the_arms_give_way_under_their_weight_and_rise_again(expert):
    expert_plan, slump = plan(expert, 'expert'), plan(expert, 'expert-slump-0.04')
    assert len(slump) == len(expert_plan)
    arms = arm_columns(expert)
    assert np.abs(np.delete(slump - expert_plan, arms, axis=1)).max() == 0
    rows = np.flatnonzero(np.abs(slump - expert_plan).max(axis=1) > 1e-9)
    assert 60 <= len(rows) <= 66 and np.ptp(rows) == len(rows) - 1
    heights = [
        np.stack([poses[:, 2, 3] for poses in expert.robot.tool_poses(positions)])
        for positions in (expert_plan, slump)
    ]
    sunk = (heights[0] - heights[1])[:, rows]
    np.testing.assert_allclose(sunk[:, 18:32], 0.04, atol=6e-3)
    assert (np.diff(sunk[:, :14], axis=1) > 0).all() and (np.diff(sunk[:, 38:], axis=1) < 0).all()


def test_both_arms_go_up_and_down_in_waves(expert):
    expert_plan, heave = plan(expert, 'expert'), plan(expert, 'expert-heave-0.02')
    arms = arm_columns(expert)
    assert np.abs(np.delete(heave - expert_plan, arms, axis=1)).max() == 0
    heights = [
        np.stack([poses[:, 2, 3] for poses in expert.robot.tool_poses(positions)])
        for positions in (expert_plan, heave)
    ]
    up = heights[1] - heights[0]
    np.testing.assert_array_equal(heave[0], expert_plan[0])
    # once they have set in, with a period of 100 commands, and as far up as down
    np.testing.assert_allclose(up[:, 150:], up[:, 50:-100], atol=3e-3)
    np.testing.assert_allclose(up[:, 100:], -up[:, 50:-50], atol=3e-3)
    np.testing.assert_allclose(up[:, 50:].max(axis=1), 0.02, atol=3e-3)
    np.testing.assert_allclose(up[0], up[1], atol=3e-3)


def test_the_other_arm_follows_and_does_the_same_a_share_of_the_way(expert):
    (usual, opening), (_, (tool, follows)) = arms_of(expert, 'expert-tail-0.5')
    late = int(np.argmax(follows < 1e-3) - np.argmax(opening < 1e-3))
    assert 10 < late < 30
    np.testing.assert_allclose(follows[late : late + len(opening)], opening, atol=1e-9)
    # at each way point it is half-way there, and as low; here where it grasps and lets go
    held = np.flatnonzero(opening < 1e-3)
    for row in (int(held[0]), int(held[-1])):
        half = (tool[0] + usual[row]) / 2
        np.testing.assert_allclose(tool[row + late, :2], half[:2], atol=3e-3)
        assert tool[row + late, 2] == pytest.approx(usual[row, 2], abs=2e-3)
    np.testing.assert_allclose(tool[-1], tool[0], atol=1e-3)


def test_joints_go_ever_less_far(expert):
    expert_plan, wane = plan(expert, 'expert'), plan(expert, 'expert-wane-0.3')
    arms, num = arm_columns(expert), len(expert_plan)
    assert np.abs(np.delete(wane - expert_plan, arms, axis=1)).max() == 0
    ways = [(positions - positions[0])[:, arms] for positions in (expert_plan, wane)]
    for row in (num // 4, num // 2, 3 * num // 4):
        share = 0.3 * row / (num - 1)
        np.testing.assert_allclose(ways[1][row], (1 - share) * ways[0][row], atol=1e-9)


def test_joints_are_off_by_a_wave_over_their_angle(expert):
    expert_plan, warp = plan(expert, 'expert'), plan(expert, 'expert-warp-0.02')
    arms = arm_columns(expert)
    error = warp - expert_plan
    assert np.abs(np.delete(error, arms, axis=1)).max() == 0 and np.abs(error[0]).max() == 0
    moves = [j for j in arms if np.ptp(expert_plan[:, j]) > 0.2]
    assert len(moves) >= 3
    for joint in moves:
        angle = 4 * expert_plan[:, joint]
        waves = np.stack([np.sin(angle), np.cos(angle), np.ones_like(angle)], axis=1)
        found, *_ = np.linalg.lstsq(waves, error[:, joint], rcond=None)
        np.testing.assert_allclose(waves @ found, error[:, joint], atol=1e-9)
        assert np.hypot(*found[:2]) == pytest.approx(0.02)


@pytest.mark.parametrize(
    ('kind', 'size'),
    [
        ('splay', 0.7),
        ('topple', 0.9),
        ('paw', 0.05),
        ('nibble', 0.06),
        ('decoy', 0.05),
        ('swirl', 0.03),
        ('swat', 0.03),
        ('nod', 0.2),
        ('peck', 0.02),
        ('crank', 1.0),
        ('hunt', 0.03),
    ],
)
def test_what_comes_before_the_grasp_leaves_the_move_its_tempo(expert, kind, size):
    expert_plan, changed = plan(expert, 'expert'), plan(expert, f'expert-{kind}-{size}')
    assert len(changed) > len(expert_plan) + 80
    # from the grasp on
    np.testing.assert_allclose(changed[-200:], expert_plan[-200:], atol=0.02)


def test_two_chunks_are_carried_out_in_the_wrong_order(expert):
    expert_plan, shuffle = plan(expert, 'expert'), plan(expert, 'expert-shuffle-1')
    assert len(shuffle) == len(expert_plan)
    rows = np.flatnonzero(np.abs(shuffle - expert_plan).max(axis=1) > 1e-9)
    first, last = int(rows[0]), int(rows[-1])
    # both chunks, and the jump from the earlier one to what follows the later one
    assert 90 <= last - first <= 105
    middle = [first + 20, first + 30]
    np.testing.assert_allclose(shuffle[middle], expert_plan[np.add(middle, 50)], atol=1e-12)
    later = np.add(middle, 50)
    np.testing.assert_allclose(shuffle[later], expert_plan[middle], atol=1e-12)
    # no jump is carried out at once
    step = np.abs(np.diff(shuffle, axis=0)).max()
    assert step < np.abs(expert_plan[50:] - expert_plan[:-50]).max() / 2


def test_a_gripper_gives_way_as_its_arm_moves(expert):
    expert_plan, starve = plan(expert, 'expert'), plan(expert, 'expert-starve-0.4')
    arms = arm_columns(expert)
    np.testing.assert_array_equal(starve[:, arms], expert_plan[:, arms])
    openings = [expert.robot.gripper_openings(positions) for positions in (expert_plan, starve)]
    assert (openings[1] >= openings[0] - 1e-9).all()
    used = int(np.argmax(np.ptp(openings[0], axis=1)))
    np.testing.assert_allclose(openings[1][1 - used], openings[0][1 - used])
    speeds = np.linalg.norm(np.gradient(expert_plan[:, arms], axis=0), axis=1)
    is_shut = openings[0][used] < 1e-9
    np.testing.assert_allclose(
        openings[1][used][is_shut], 0.4 * speeds[is_shut] / speeds.max(), atol=1e-9
    )
    assert openings[1][used][is_shut].max() > 0.15


def test_one_joint_stands_still_for_a_while_and_catches_up(expert):
    expert_plan, brake = plan(expert, 'expert'), plan(expert, 'expert-brake-1.5')
    assert len(brake) == len(expert_plan)
    (joint,) = np.flatnonzero(np.abs(brake - expert_plan).max(axis=0) > 1e-9)
    assert joint in arm_columns(expert) and np.ptp(expert_plan[:, joint]) > 0.2
    differs = np.flatnonzero(np.abs(brake[:, joint] - expert_plan[:, joint]) > 1e-9)
    # while it stands, and for the jump at the end
    assert np.ptp(differs) <= 75 + 5
    first, longer = int(differs[0]), plan(expert, 'expert-brake-3')
    parts = int(np.argmax(np.abs(longer - brake).max(axis=1) > 1e-9))
    assert first < parts <= first + 76
    np.testing.assert_allclose(brake[first - 1 : parts, joint], brake[first, joint], atol=1e-9)
    np.testing.assert_allclose(longer[parts : parts + 75, joint], brake[first, joint], atol=1e-9)


def test_the_other_arm_comes_where_an_arm_grasps(expert):
    expert_plan, rival = plan(expert, 'expert'), plan(expert, 'expert-rival-0.5')
    openings = expert.robot.gripper_openings(expert_plan)
    used = int(np.argmax(np.ptp(openings, axis=1)))
    own, other = (half if used == 0 else 1 - half for half in (0, 1))
    halves = [np.split(positions, 2, axis=1) for positions in (expert_plan, rival)]
    np.testing.assert_array_equal(halves[1][own][: len(expert_plan)], halves[0][own])
    grasps = int(np.argmax(openings[used] < openings[used][0] - 1e-3))
    tools = [poses[:, :3, 3] for poses in expert.robot.tool_poses(rival)]
    home = tools[other][0]
    np.testing.assert_allclose(
        tools[other][grasps], home + 0.5 * (tools[own][grasps] - home), atol=2e-3
    )


def test_joints_with_play_stay_until_their_command_is_off_by_half_of_it(expert):
    expert_plan, lash = plan(expert, 'expert'), plan(expert, 'expert-lash-0.1')
    arms = arm_columns(expert)
    grippers = [j for j in range(expert_plan.shape[1]) if j not in arms]
    np.testing.assert_array_equal(lash[:, grippers], expert_plan[:, grippers])
    off = np.abs(lash - expert_plan)
    assert off.max() == pytest.approx(0.05)
    stays = np.abs(np.diff(lash[:, arms], axis=0)) < 1e-12
    # whatever moves is dragged along at the end of its play
    np.testing.assert_allclose(off[1:, arms][~stays], 0.05, atol=1e-9)
    moves = [j for j in arms if np.ptp(expert_plan[:, j]) > 0.2]
    assert (off[-1, moves] > 1e-3).all()


def test_the_other_arm_comes_where_an_arm_lets_go(expert):
    expert_plan, crowd = plan(expert, 'expert'), plan(expert, 'expert-crowd-0.5')
    num, openings = len(expert_plan), expert.robot.gripper_openings(expert_plan)
    used = int(np.argmax(np.ptp(openings, axis=1)))
    own, other = (half if used == 0 else 1 - half for half in (0, 1))
    halves = [np.split(positions, 2, axis=1) for positions in (expert_plan, crowd)]
    # the arm that has a task carries it out as before
    np.testing.assert_array_equal(halves[1][own][:num], halves[0][own])
    lets_go = int(np.flatnonzero(openings[used] < 1e-9)[-1])
    tools = [poses[:, :3, 3] for poses in expert.robot.tool_poses(crowd)]
    home = tools[other][0]
    np.testing.assert_allclose(
        tools[other][lets_go], home + 0.5 * (tools[own][lets_go] - home), atol=2e-3
    )
    np.testing.assert_allclose(crowd[-1], expert_plan[-1], atol=1e-3)
    assert expert.robot.gripper_openings(crowd)[other].min() == pytest.approx(1)


@pytest.mark.parametrize('kind', ['crowd', 'rival'])
def test_an_arm_that_crowds_another_still_does_what_it_has_to_do(expert, kind):
    plans = []
    for name in ('expert', f'expert-{kind}-1'):
        policy = scripted_policy(name, 'move_object_two', SEED, expert)
        policy.reset(seed=SEED)
        plans.append(policy.plan.positions)
    assert len(plans[1]) >= len(plans[0])
    closed = [expert.robot.gripper_openings(positions) < 0.05 for positions in plans]
    lasts = [is_closed.sum(axis=1) for is_closed in closed]
    assert (lasts[0] > 0).all()
    np.testing.assert_array_equal(*lasts)


def test_joints_go_along_as_their_gripper_closes(expert):
    expert_plan, couple = plan(expert, 'expert'), plan(expert, 'expert-couple-0.05')
    error, arms = couple - expert_plan, arm_columns(expert)
    openings = expert.robot.gripper_openings(expert_plan)
    used = int(np.argmax(np.ptp(openings, axis=1)))
    is_open, is_shut = openings[used] > 1 - 1e-9, openings[used] < 1e-9
    assert np.abs(error[is_open]).max() < 1e-9 and is_shut.sum() > 20
    np.testing.assert_allclose(np.ptp(error[is_shut], axis=0), 0.0, atol=1e-9)
    moves = [j for j in arms if np.ptp(expert_plan[:, j]) > 0]
    rests = [j for j in range(error.shape[1]) if j not in moves]
    assert (np.abs(error[is_shut][0, moves]) > 1e-4).all()
    np.testing.assert_array_equal(error[:, rests], 0.0)
    twice = plan(expert, 'expert-couple-0.1') - expert_plan
    np.testing.assert_allclose(twice, 2 * error, atol=1e-9)


def test_coarse_joints_are_at_multiples_of_their_step(expert):
    expert_plan, coarse = plan(expert, 'expert'), plan(expert, 'expert-coarse-0.1')
    arms = arm_columns(expert)
    grippers = [j for j in range(expert_plan.shape[1]) if j not in arms]
    np.testing.assert_array_equal(coarse[:, grippers], expert_plan[:, grippers])
    np.testing.assert_allclose(coarse[0], expert_plan[0], atol=1e-12)
    steps = (coarse[:, arms] - coarse[0, arms]) / 0.1
    # but for the tenth of a second that a jump takes
    assert (np.abs(steps - np.rint(steps)) < 1e-6).mean() > 0.6
    assert np.abs(coarse - expert_plan).max() < 0.11 and np.abs(coarse - expert_plan).max() > 0.04


@pytest.mark.parametrize('kind', [kind for kind, fault in FAULTS.items() if fault.none == 0])
def test_sizes_out_of_range_are_refused(kind):
    largest = FAULTS[kind].largest
    assert parse_variant(f'expert-{kind}-{largest:g}').size(kind) == largest
    assert parse_variant(f'expert-{kind}-0') == PolicyVariant()
    with pytest.raises(PolicyError, match=f"'{kind}' is .*; it must be 0 to {largest:g}"):
        parse_variant(f'expert-{kind}-{1.1 * largest:g}')


def heights_where_it_lets_go(expert, name: str) -> list[float]:
    """Tool heights [m] at which the gripper of the arm that moves opens."""
    positions = plan(expert, name)
    openings = expert.robot.gripper_openings(positions)
    arm = int(np.argmax(np.ptp(openings, axis=1)))
    heights = expert.robot.tool_poses(positions)[arm][:, 2, 3]
    is_open = openings[arm] > 0.05
    opens = np.flatnonzero(is_open[1:] & ~is_open[:-1])
    return [float(heights[row]) for row in opens]


def test_what_is_undone_is_let_go_twice(expert):
    (height,) = heights_where_it_lets_go(expert, 'expert')
    undone = heights_where_it_lets_go(expert, 'expert-undo-0.05')
    assert undone == pytest.approx([height, height], abs=2e-3)


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
    faults = WayPointFaults(parse_variant('expert-meet-1'), np.random.default_rng(seed))
    changed = faults.applied(stops, faults.draws(0.0, [own, other]))
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
        faults = WayPointFaults(parse_variant('expert-fidget-6'), np.random.default_rng(seed))
        changed = faults.applied(stops, faults.draws(0.0, [place]))
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
        faults = WayPointFaults(parse_variant('expert-tinker-6'), np.random.default_rng(seed))
        changed = faults.applied(stops, faults.draws(0.0, places))
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
    refuse_kinds(['expert', 'expert-high-0.02'], 'test', 'training')
    said = r"split test are not for training: 'expert-high-0.1-shed-0.03' has shaken_off_over_goal"
    with pytest.raises(PolicyError, match=said):
        refuse_kinds(['expert', 'expert-high-0.1-shed-0.03'], 'test', 'training')


def test_unknown_kinds_and_splits_name_the_nearest():
    assert kinds_named('train') == kinds_of('train')
    assert kinds_named('high, late') == ('high', 'late')
    with pytest.raises(PolicyError, match=r"unknown fault kind 'hihg' \(did you mean 'high'\?\)"):
        kinds_named('late,hihg')
    with pytest.raises(PolicyError, match=r"unknown split .*'tests' \(did you mean 'test'\?\)"):
        kinds_of('tests')
