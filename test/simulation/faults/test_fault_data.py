"""Fault kinds as data: names and aliases, the language of steps, and kinds drawn from a seed."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.config import validated
from mtv_world_ros.core.errors import ConfigError, PolicyError, SimulatorError
from mtv_world_ros.simulation.expert.scripted_policy import scripted_policy
from mtv_world_ros.simulation.expert.way_points import Draws, WayPoint
from mtv_world_ros.simulation.faults.catalogue import (
    FaultKind,
    FAULTS,
    kind_named,
    kinds_named,
    kinds_of,
    parse_variant,
    policies_of,
    PolicyVariant,
    refuse_test_kinds,
)
from mtv_world_ros.simulation.faults.commands import COMMANDS
from mtv_world_ros.simulation.faults.drawn import NUM_DRAWN
from mtv_world_ros.simulation.faults.edits import edited, PRIMITIVES

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
        play=rng,
        objects=[OBJECT, GOAL - [0.0, 0.0, 0.03]],
    )


def after(program, size):
    return edited(program, stops(), size, draws())


def test_every_kind_says_what_happens_and_keeps_its_earlier_name():
    aliases = [fault.alias for fault in FAULTS.values()]
    assert len(FAULTS) == 162 == len(aliases) == len({*aliases, *FAULTS}) - 162
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


def test_the_catalogue_names_only_primitives_that_there_are():
    used = {'edits': set(), 'commands': set()}
    for fault in FAULTS.values():
        for key, names in used.items():
            names |= {name for step in getattr(fault, key) for name in step}
    assert used == {'edits': {*PRIMITIVES}, 'commands': {*COMMANDS}}


def test_a_mistyped_key_of_an_entry_is_named_with_the_nearest():
    values = {'family': 'height', 'split': 'train', 'text': ''}
    values['size'] = {'typical': 0.1, 'largest': 1.0}
    assert validated(FaultKind, values, 'a').size.typical == 0.1
    with pytest.raises(ConfigError, match=r"unknown key 'edit' \(did you mean 'edits'\?\)"):
        validated(FaultKind, {**values, 'edit': []}, 'a')
    with pytest.raises(ConfigError, match="'split' is 'tests'"):
        validated(FaultKind, {**values, 'split': 'tests'}, 'a')


@pytest.mark.parametrize(
    ('steps', 'said'),
    [
        ({'edits': [{'edt': {}}]}, r"unknown step 'edt' \(did you mean 'edit'\?\)"),
        ({'edits': [{'edit': {'phasse': []}}]}, "step 'edit' has no option 'phasse'"),
        ({'edits': [{'insert': {'rows': [{'bye': {}}]}}]}, r"no option 'bye' \(did you mean 'by'"),
        ({'commands': [{'delay': {'onli': ''}}]}, r"'onli' \(did you mean 'only'\?\)"),
        ({'second_arm': {'too': ''}}, r"unknown key 'too' \(did you mean 'to'\?\)"),
    ],
)
def test_a_mistyped_step_or_option_is_named_with_the_nearest(steps, said):
    values = {'family': 'height', 'split': 'train', 'text': ''}
    values |= {'size': {'typical': 0.1, 'largest': 1.0}}
    with pytest.raises(ConfigError, match=said):
        validated(FaultKind, {**values, **steps}, 'a')


def test_lengths_are_numbers_the_size_or_a_line_over_it():
    for far, expected in ((0.03, 0.03), ('size', 0.2), ([0.01, -0.5], -0.09)):
        changed = after([{'edit': {'phases': ['grasp'], 'by': {'up': far}}}], 0.2)
        assert changed[1].position[2] - OBJECT[2] == pytest.approx(expected)
        assert [s.position[2] for s in changed[2:]] == [s.position[2] for s in stops()[2:]]


def test_directions_are_along_and_across_the_fingers_anywhere_or_to_the_goal():
    to_goal = (GOAL - OBJECT)[:2] / np.linalg.norm((GOAL - OBJECT)[:2])
    for way, expected in (
        ('along', (-1, 0)),
        ('across', (0, -1)),
        ('anywhere', (0, 1)),
        ('goal', to_goal),
    ):
        (moved,) = after([{'edit': {'phases': ['close'], 'by': {way: 'size'}}}], 0.1)[2:3]
        np.testing.assert_allclose((moved.position - OBJECT)[:2], 0.1 * np.array(expected))


def test_a_drawn_direction_is_the_same_in_a_program_and_another_in_the_next():
    program = [
        {'edit': {'phases': ['grasp'], 'by': {'drawn': 0.1}}},
        {'edit': {'phases': ['close'], 'by': {'drawn': 0.1}}},
    ]
    given, same = draws(), stops()
    one, other = (edited(program, same, 1.0, given) for _ in range(2))
    np.testing.assert_array_equal(one[1].position, one[2].position)
    assert np.linalg.norm(one[1].position - OBJECT) == pytest.approx(0.1)
    assert np.linalg.norm(one[1].position - other[1].position) > 1e-3


def test_rows_are_like_a_way_point_or_the_last_row_and_may_be_repeated():
    rows = [{'like': 'close', 'by': {'up': 0.02}, 'seconds': None}, {'like': 'last', 'opening': 1}]
    insert = {'at': 'before open', 'phase': 'carry', 'repeat': [1, '1/2'], 'rows': rows}
    changed = after([{'insert': insert}], 1.0)
    made = changed[6:10]
    assert [s.phase for s in changed[:6]] == [s.phase for s in stops()[:6]]
    assert [s.phase for s in made] == ['carry'] * 4
    assert [s.phase for s in changed[10:]] == [s.phase for s in stops()[6:]]
    assert [s.opening for s in made] == [0, 1, 0, 1] and made[0].seconds is None
    heights = [s.position[2] - OBJECT[2] for s in made]
    assert heights == pytest.approx([0.02, 0.02, 0.01, 0.01])


def test_what_is_pushed_is_met_from_behind_by_shut_fingers():
    push = {'at': 'start', 'to': {'along': 1}, 'rise': {'up': 0.1}, 'stroke': 0.3}
    over, behind, end, left = after([{'push': push}], 0.05)[:4]
    assert {s.opening for s in (over, behind, end, left)} == {0.0}
    np.testing.assert_allclose(behind.position - OBJECT, [0.07, 0, 0], atol=1e-12)
    np.testing.assert_allclose(end.position - OBJECT, [-0.02, 0, 0], atol=1e-12)
    np.testing.assert_allclose(over.position - behind.position, [0, 0, 0.1], atol=1e-12)
    assert end.seconds == 0.3 and behind.seconds is None


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
    assert kind.split == 'test' and not kind.commands and 1 <= len(kind.edits) <= 2
    assert FAULTS[name] == kind  # its name alone gives it again
    assert FAULTS[f'drawn_{number}_{number}'] != kind


def test_a_gripper_opens_no_further_than_it_can():
    wide = [{'edit': {'phases': ['lift', 'carry'], 'opening': {'least': [0.0, 0.7]}}}]
    for size, expected in ((1.0, 0.7), (3.0, 1.0)):
        found = edited(wide, stops(), size, draws())
        openings = [stop.opening for stop in found if stop.phase in ('lift', 'carry')]
        assert openings == [expected] * 2
