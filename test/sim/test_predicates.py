import numpy as np
import pytest

from mtv_world_ros.sim.predicates import (
    a_left_of_b,
    a_on_b,
    ever_and_final,
    grippers_open,
    History,
    left_of,
    stacked,
)

B = np.array([[0.1, 0.3, 0.025]])


def _left(dx, dy):
    return bool(left_of(B + [[dx, dy, 0.0]], B)[0])


@pytest.mark.parametrize(
    ('dx', 'dy', 'succeeds'),
    [
        (-0.13, 0.0, True),
        (-0.081, 0.0, True),
        (-0.079, 0.0, False),
        (-0.199, 0.0, True),
        (-0.201, 0.0, False),
        (-0.13, 0.049, True),
        (-0.13, 0.051, False),
        (-0.13, -0.049, True),
        (-0.13, -0.051, False),
        (0.13, 0.0, False),
    ],
)
def test_left_of_holds_between_its_thresholds(dx, dy, succeeds):
    assert _left(dx, dy) is succeeds


def test_left_of_measures_distance_in_the_plane_not_along_x():
    # dx alone would be too near, the distance is not
    assert _left(-0.07, 0.045)
    assert not _left(-0.065, 0.045)


@pytest.mark.parametrize(
    ('offset', 'succeeds'),
    [
        ((0.0, 0.0, 0.05), True),
        ((0.024, -0.024, 0.05), True),
        ((0.026, 0.0, 0.05), False),
        ((0.0, -0.026, 0.05), False),
        ((0.0, 0.0, 0.0615), True),
        ((0.0, 0.0, 0.0625), False),
        ((0.0, 0.0, 0.0385), True),
        ((0.0, 0.0, 0.0375), False),
    ],
)
def test_stacked_holds_within_its_tolerances(offset, succeeds):
    assert bool(stacked(B + [offset], B, 0.05)[0]) is succeeds


def test_grippers_count_as_open_only_if_both_are():
    openings = np.array([[0.81, 0.81, 0.79], [0.81, 0.79, 0.81]])
    assert grippers_open(openings).tolist() == [True, False, False]


def _history(offset, openings, heights=(0.04, 0.05)):
    num = len(openings)
    return History(
        positions={'a': np.repeat(B + [offset], num, 0), 'b': np.repeat(B, num, 0)},
        heights=dict(zip('ab', heights, strict=True)),
        openings=np.array([openings, np.ones(num)]),
    )


def test_tasks_want_open_grippers():
    assert a_left_of_b(_history((-0.13, 0, 0), [0.5, 1.0])).tolist() == [False, True]
    assert a_on_b(_history((0, 0, 0.045), [0.5, 1.0])).tolist() == [False, True]


def test_stack_height_is_the_mean_of_both_blocks():
    assert a_on_b(_history((0, 0, 0.04), [1.0], heights=(0.03, 0.05))).all()
    assert not a_on_b(_history((0, 0, 0.055), [1.0], heights=(0.03, 0.05))).any()


def test_final_wants_success_in_each_of_the_last_samples():
    held = np.array([False, True, True, True])
    assert ever_and_final(held, held=3) == (True, True)
    assert ever_and_final(held, held=4) == (True, False)
    assert ever_and_final(np.array([True, False]), held=1) == (True, False)
    assert ever_and_final(np.zeros(4, dtype=bool), held=1) == (False, False)
    assert ever_and_final(np.ones(2, dtype=bool), held=5) == (True, False)
