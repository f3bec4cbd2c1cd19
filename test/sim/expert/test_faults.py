"""The fault catalogue: its splits, and that every kind does something of its own."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.errors import PolicyError
from mtv_world_ros.sim.expert.faults import (
    draw_variant,
    FAULTS,
    kinds_named,
    kinds_of,
    parse_variant,
    PolicyVariant,
    refuse_kinds,
    SPLITS,
)
from mtv_world_ros.sim.expert.scripted_policy import scripted_policy

SEED, TASK = 4, 'place_block_a2b_left'


def plan(expert, name: str) -> np.ndarray:
    policy = scripted_policy(name, TASK, SEED, expert)
    policy.reset(seed=SEED)
    return policy.plan.positions


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


def test_random_policies_are_of_the_kinds_asked_for():
    rng = np.random.default_rng(0)
    drawn = [draw_variant(kinds_of('calibrate'), rng) for _ in range(60)]
    assert {kind for variant in drawn for kind in variant.kinds} == set(kinds_of('calibrate'))
    assert any(variant == PolicyVariant() for variant in drawn)
    assert all(parse_variant(variant.name) == variant for variant in drawn)


def test_test_kinds_are_refused_by_name():
    refuse_kinds(['expert', 'expert-high-0.02'], 'test', 'training')
    with pytest.raises(
        PolicyError, match=r"split test are not for training: 'expert-lean-0.3-high-0.1' has lean"
    ):
        refuse_kinds(['expert', 'expert-lean-0.3-high-0.1'], 'test', 'training')


def test_unknown_kinds_and_splits_name_the_nearest():
    assert kinds_named('train') == kinds_of('train')
    assert kinds_named('high, late') == ('high', 'late')
    with pytest.raises(PolicyError, match=r"unknown fault kind 'hihg' \(did you mean 'high'\?\)"):
        kinds_named('late,hihg')
    with pytest.raises(PolicyError, match=r"unknown split .*'tests' \(did you mean 'test'\?\)"):
        kinds_of('tests')
