"""Fault kinds as functions: names and aliases, changes of a plan, and kinds drawn from a seed."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import PolicyError, SimulatorError
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.faults.actions import push
from mtv_world_ros.simulation.faults.catalogue import (
    FAULTS,
    kind_named,
    kinds_named,
    kinds_of,
    parse_variant,
    policies_of,
    PolicyVariant,
    refuse_test_kinds,
)
from mtv_world_ros.simulation.faults.commands import COMMANDS, delay
from mtv_world_ros.simulation.faults.drawn import NUM_DRAWN
from mtv_world_ros.simulation.faults.fault import Family, FaultSize
from mtv_world_ros.simulation.faults.move_plan import Draws, MovePlan
from mtv_world_ros.simulation.way_points import UP, WayPoint

OBJECT, GOAL = np.array([0.2, 0.3, 0.02]), np.array([-0.1, 0.35, 0.05])


def stops() -> list[WayPoint]:
    up = np.array([0.0, 0.0, 0.1])
    return [
        WayPoint('above', OBJECT + up, 0.0, 0.6),
        WayPoint('grasp', OBJECT, 0.0, 0.6),
        WayPoint('close', OBJECT, 0.0, 0.0, 0.4),
        WayPoint('lift', OBJECT + up, 0.0, 0.0),
        WayPoint('carry', GOAL + up / 2, 0.3, 0.0),
        WayPoint('lower', GOAL, 0.3, 0.0),
        WayPoint('open', GOAL, 0.3, 0.5, 0.3),
        WayPoint('retreat', GOAL + up, 0.3, 1.0),
        WayPoint('home', np.array([0.25, -0.1, 0.2]), 0.0, 1.0),
    ]


def draws() -> Draws:
    rng = np.random.default_rng(0)
    return Draws(
        yaw=0.0,
        sign=-1.0,
        angle=np.pi / 2,
        errors=np.ones((40, 3)),
        openings=np.full(40, -1.0),
        rng=rng,
        objects=[OBJECT, GOAL - [0.0, 0.0, 0.03]],
    )


def after(change, size):
    return change(MovePlan(stops(), draws()), size).stops


def test_every_kind_says_what_happens_and_keeps_its_earlier_name():
    aliases = [fault.alias for fault in FAULTS.values() if fault.alias]
    assert len(aliases) == 162 and len({*aliases, *FAULTS}) == len(aliases) + len(FAULTS)
    with pytest.raises(PolicyError, match="unknown fault kind ''"):
        kind_named('')
    assert kind_named('high') == kind_named('grasp_height') == 'grasp_height'
    early, late = parse_variant('expert-high-0.02'), parse_variant('expert-grasp_height-0.02')
    assert early.name == 'expert-high-0.02' and early.kinds == late.kinds == ('grasp_height',)
    assert early.size('high') == early.size('grasp_height') == late.size('high') == 0.02
    with pytest.raises(PolicyError, match="'grasp_height' is given twice"):
        parse_variant('expert-high-0.02-grasp_height-0.03')


def test_both_names_give_the_same_plan(expert):
    plans = []
    for name in ('expert-tinker-3', 'expert-random_actions_with_object-3'):
        policy = scripted_policy(name, 'place_bread_plate', 1, expert)
        policy.reset(seed=1)
        plans.append(policy.plan.positions)
    np.testing.assert_array_equal(*plans)


def test_every_kind_is_a_function_or_is_carried_out_by_the_policy_itself():
    without = [
        kind
        for kind, fault in FAULTS.items()
        if not (fault.way_points or fault.second_arm or fault.commands)
    ]
    assert without == [
        *('grasp_missed', 'object_position_noise', 'wrong_object'),
        *('goal_object_moved_after', 'goal_position_noise'),
    ]
    assert all(fault.text and not fault.text.endswith('.') for fault in FAULTS.values())


def test_every_change_of_commands_is_used_and_has_its_place_among_them():
    kinds = [fault for fault in FAULTS.values() if fault.commands]
    assert {fault.order for fault in kinds} == {*range(len(COMMANDS))}
    delayed, slow = FAULTS['gripper_delay'], FAULTS['motion_slow']
    assert delayed.order < slow.order, 'the grippers are late, and then all is slow'


def test_faults_of_a_policy_are_applied_in_the_order_of_the_changes_of_commands(expert):
    names = (
        'expert-motion_slow-0.5-gripper_delay-0.6',
        'expert-gripper_delay-0.6-motion_slow-0.5',
    )
    both, same = (plan(expert, name) for name in names)
    np.testing.assert_array_equal(both, same)
    late = plan(expert, 'expert-gripper_delay-0.6')
    # slower by half: what is late by 0.6 s then is so by 0.9 s
    at = np.minimum(np.arange(len(both)) / 1.5, len(late) - 1)
    rows = np.arange(len(late))
    slowed = np.stack([np.interp(at, rows, column) for column in late.T], axis=1)
    np.testing.assert_allclose(both, slowed, atol=1e-9)


def plan(expert, name):
    policy = scripted_policy(name, 'place_bread_plate', 1, expert)
    policy.reset(seed=1)
    return policy.plan.positions


def test_a_family_enters_functions_under_their_names_with_their_docstrings():
    family = Family('height')

    @family.way_points('up', FaultSize(0.1, 1.0, unit='m'), split='test')
    def raised(move, size):
        """It is raised
        this far.
        """
        return move.shift(('all',), size * UP)

    family.commands('later', 'l', FaultSize(0.2, 1.0), delay, 'this much later', contact=False)
    up, later = family.kinds['raised'], family.kinds['later']
    assert (up.family, up.split, up.alias) == ('height', 'test', 'up')
    assert up.text == 'it is raised this far'
    rises = [
        s.position[2] - t.position[2] for s, t in zip(after(raised, 0.2), stops(), strict=True)
    ]
    assert rises == pytest.approx([0.2] * 9)
    assert (later.split, later.text, later.contact) == ('train', 'this much later', False)
    with pytest.raises(TypeError, match='needs_'):
        family.enter('wrong', '', FaultSize(0.1, 1.0), needs_='gripper', text='')


def test_way_points_are_changed_by_phase_by_name_or_by_span():
    move = MovePlan(stops(), draws())
    for names, numbers in (
        (('grasp', 'close'), [1, 2]),
        (('start',), [0]),
        (('carry_end',), [4]),
        (('moving',), [*range(8)]),
        (('all',), [*range(9)]),
        (move.span('lift', 'open'), [3, 4, 5, 6]),
    ):
        changed = move.shift(names, 0.1 * UP).stops
        moved = [k for k, pair in enumerate(zip(stops(), changed, strict=True)) if is_off(*pair)]
        assert moved == numbers
    two = move.insert(1, [move.like('close', phase='grasp')])
    changed = two.shift(('grasp',), 0.1 * UP).stops
    assert sum(is_off(*pair) for pair in zip(two.stops, changed, strict=True)) == 2, 'all of them'
    assert len(move.stops) == 9, 'a plan stays as it was'


def is_off(one: WayPoint, other: WayPoint) -> bool:
    return not np.array_equal(one.position, other.position)


def test_directions_are_along_and_across_the_fingers_anywhere_or_to_the_goal():
    move = MovePlan(stops(), draws())
    to_goal = (GOAL - OBJECT)[:2] / np.linalg.norm((GOAL - OBJECT)[:2])
    for way, expected in (
        (move.along, (-1, 0)),
        (move.across, (0, -1)),
        (move.anywhere, (0, 1)),
        (move.to_goal(0.1), to_goal),
        (move.to_goal(1.0), (0, 1)),  # within the size: anywhere
    ):
        np.testing.assert_allclose(way, [*expected, 0.0], atol=1e-12)


def test_a_drawn_direction_is_another_one_for_every_plan():
    given = draws()
    change = FAULTS['dragged_and_grasped_there'].way_points
    assert change is not None
    one, other = (change(MovePlan(stops(), given), 0.1).stops for _ in range(2))
    # its own grasp and what is inserted before go the same way
    np.testing.assert_allclose(one[5].position - OBJECT, one[6].position - OBJECT)
    assert np.linalg.norm(one[5].position - OBJECT) == pytest.approx(0.1)
    assert np.linalg.norm(one[5].position - other[5].position) > 1e-3


def test_what_is_pushed_is_met_from_behind_by_shut_fingers():
    at, way = MovePlan(stops(), draws()).like('grasp'), np.array([-1.0, 0.0, 0.0])
    over, behind, end, left = push(at, way, 0.1 * UP, far=0.05, stroke_s=0.3)
    assert {s.opening for s in (over, behind, end, left)} == {0.0}
    np.testing.assert_allclose(behind.position - OBJECT, [0.07, 0, 0], atol=1e-12)
    np.testing.assert_allclose(end.position - OBJECT, [-0.02, 0, 0], atol=1e-12)
    np.testing.assert_allclose(over.position - behind.position, [0, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(left.position - end.position, [0, 0, 0.1], atol=1e-12)
    assert end.seconds == 0.3 and behind.seconds is None


def test_two_changes_of_a_drawn_kind_share_their_direction():
    # both `drawn`: found by their texts among many seeds
    name = next(
        name
        for seed in range(200)
        for name in kinds_of(f'drawn:{seed}')
        if FAULTS[name].text.count('m off, drawn') == 2
    )
    changed = after(FAULTS[name].way_points, 1.0)
    ways = [s.position - t.position for s, t in zip(changed, stops(), strict=True)]
    ways = [way / np.linalg.norm(way) for way in ways if np.linalg.norm(way) > 0]
    assert len(ways) >= 2
    np.testing.assert_allclose(ways, np.repeat(ways[:1], len(ways), axis=0), atol=1e-9)


def test_kinds_drawn_from_a_seed_are_of_the_split_test_and_their_name_gives_them_again():
    names = kinds_named('drawn:5')
    assert len(set(names)) == NUM_DRAWN == len({FAULTS[name].text for name in names})
    assert FAULTS[names[0]] == FAULTS['drawn_5_0'] != FAULTS['drawn_6_0']
    assert {FAULTS[name].split for name in names} == {'test'}
    with pytest.raises(PolicyError, match='split test are not for training'):
        refuse_test_kinds(['expert-drawn_5_0-1'], 'training')
    assert not {*names} & {*kinds_of('test')}
    assert len(policies_of('drawn:5')) == 1 + 2 * NUM_DRAWN
    with pytest.raises(PolicyError, match='known are .* drawn:SEED'):
        kinds_of('drawn:x')


@pytest.mark.parametrize('seed', [0, 1])
def test_drawn_faults_change_the_plan_and_a_size_of_none_does_not(expert, seed):
    def plan(name):
        policy = scripted_policy(name, 'place_bread_plate', 2, expert)
        policy.reset(seed=2)
        return policy.plan.positions

    usual, changed = plan('expert'), 0
    assert parse_variant('expert-drawn_0_0-0') == PolicyVariant()
    for name in policies_of(f'drawn:{seed}')[1:]:
        try:
            own = plan(name)
        except (PolicyError, SimulatorError):  # out of reach in this scene
            continue
        changed += own.shape != usual.shape or np.abs(own - usual).max() > 1e-3
        assert np.isfinite(own).all()
    assert changed >= 0.8 * 2 * NUM_DRAWN


def test_the_command_prints_kinds(capsys):
    with pytest.raises(SystemExit) as end:
        main(['rank', '--list-faults', 'high,drawn_5_0'])
    assert not end.value.code
    said = capsys.readouterr().out
    assert 'grasp_height (high): height, train; 0.02 m, at most 0.1 m' in said
    assert 'drawn_5_0: drawn, test; 1, at most 3' in said
    assert main(['rank', '--list-faults', 'hihg']) == 1
    assert "did you mean 'high'" in capsys.readouterr().err


@pytest.mark.parametrize('number', range(NUM_DRAWN))
def test_a_drawn_kind_of_contact_changes_a_grasp_a_hold_or_a_release(number):
    name = f'drawn_contact_{number}_{number}'
    assert kinds_of(f'drawn_contact:{number}')[number] == name
    kind = FAULTS[name]
    assert kind.split == 'test' and not kind.commands and kind.way_points
    assert 1 <= len(kind.text.split('; ')) <= 2
    assert FAULTS[name] == kind  # its name alone gives it again
    assert FAULTS[f'drawn_{number}_{number}'] != kind


def test_a_gripper_opens_no_further_than_it_can():
    for size, expected in ((0.7, 0.7), (3.0, 1.0)):
        found = after(FAULTS['opens_while_carrying'].way_points, size)
        openings = [stop.opening for stop in found if stop.phase in ('carry', 'lower')]
        assert openings == [expected] * 2
