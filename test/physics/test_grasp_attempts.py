"""Attempts to grasp in a foreseen plan, each with the share of futures that hold something."""

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.physics.foreseen_motions import ForeseenMotions
from mtv_world_ros.physics.grasp_attempts import attempts_line, foreseen_attempts

STEP_S = 0.1
#: rows in which the gripper is closed: two attempts
FIRST, SECOND = (5, 12), (20, 28)


def _plan(first=(True, True, False, False), second=(False, False, True, True), names=('block',)):
    """Return 4 futures of 30 steps; in each the block goes along in an attempt, or stays."""
    num = 30
    openings, tool = np.ones(num), np.zeros((num, 3))
    for begin, end in (FIRST, SECOND):
        openings[begin:end] = 0.4
        tool[begin + 1 : end, 2] = 0.02 * np.arange(1, end - begin)
        tool[end:, 2] = 0.0
    points = np.zeros((4, num, len(names), 3))
    points[:, :, 1:] = 0.5
    for future in range(4):
        for (begin, end), goes in ((FIRST, first[future]), (SECOND, second[future])):
            if goes:
                points[future, begin:end, 0] = tool[begin:end]
    turns = np.broadcast_to(np.eye(3), (*points.shape, 3))
    return ForeseenMotions(
        names=names,
        points=points,
        rotations=turns,
        sizes=np.full((4, len(names), 3), 0.04),
        openings=np.broadcast_to(openings, (4, 1, num)),
        weights=np.ones(4),
        step_s=STEP_S,
        tools=tool[None],
    )


def test_each_attempt_has_the_share_of_futures_in_which_an_object_goes_along():
    first, second = foreseen_attempts(_plan(second=(True, True, True, False)))
    assert (first.name, first.share, second.share) == ('block', 0.5, 0.75)
    assert first.closed_s == pytest.approx(0.6) and first.opened_s == pytest.approx(1.2)
    assert first.opened_s is not None and first.opened_s < second.closed_s


def test_weights_of_the_futures_count():
    plan = replace(_plan(), weights=np.array([0.1, 0.1, 1.0, 1.0]))
    first, second = foreseen_attempts(plan)
    assert first.share == pytest.approx(0.2 / 2.2) and second.share == pytest.approx(2 / 2.2)


def test_futures_that_were_all_lost_chain_no_attempts():
    assert foreseen_attempts(replace(_plan(), weights=np.zeros(4))) == ()


def test_a_plan_that_chains_attempts_says_how_sure_each_is():
    line = attempts_line(foreseen_attempts(_plan()))
    assert line.startswith("2 attempts to grasp in a row: at 0.6 s 'block' goes along in 50% of")
    assert line.count('goes along') == 2
    assert attempts_line(foreseen_attempts(_plan())[:1]) == ''


def test_the_object_that_goes_along_is_named_not_one_beside_it():
    plan = _plan(names=('block', 'plate'))
    assert {one.name for one in foreseen_attempts(plan)} == {'block'}


def test_a_plan_in_which_nothing_is_held_has_shares_of_nothing():
    nothing = (False,) * 4
    shares = [one.share for one in foreseen_attempts(_plan(nothing, nothing))]
    assert shares == [0.0, 0.0]


def test_hands_that_do_not_move_and_plans_without_objects_or_tools_attempt_nothing():
    plan = _plan()
    assert foreseen_attempts(replace(plan, tools=np.zeros_like(plan.tools))) == ()
    assert foreseen_attempts(replace(plan, tools=None)) == ()
    without = replace(plan, names=(), points=plan.points[:, :, :0])
    assert foreseen_attempts(without) == ()
