"""Masks of start frames that remember the episode."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from test.support.scripts import imported_scripts


@pytest.fixture(scope='module')
def borders() -> Iterator[ModuleType]:
    """The experiment as a module."""
    with imported_scripts('chunk_borders') as (script,):
        yield script


def rectangle(top: int, left: int, height: int, width: int) -> np.ndarray:
    mask = np.zeros((20, 24), np.bool_)
    mask[top : top + height, left : left + width] = True
    return mask


def test_a_half_hidden_object_gets_its_whole_shape_where_its_visible_corner_is(borders):
    whole = np.logical_or(rectangle(2, 3, 6, 2), rectangle(6, 3, 2, 6))  # an L
    moved = np.roll(whole, (7, 9), (0, 1))
    visible = moved & rectangle(11, 12, 6, 6)  # its foot and some of its stem
    assert visible.sum() < whole.sum()
    np.testing.assert_array_equal(borders.placed(whole, visible), moved)


def test_a_shape_that_agrees_with_no_place_is_not_drawn(borders):
    whole = rectangle(2, 3, 2, 2)
    visible = rectangle(5, 2, 1, 18)
    np.testing.assert_array_equal(borders.placed(whole, visible), visible)


def test_an_object_stays_where_most_of_the_picture_under_its_mask_is_the_same(borders):
    then = np.full((20, 24, 3), 100, np.uint8)
    memory = SimpleNamespace(
        whole={'whole': rectangle(2, 3, 4, 5)[None, None]}, seen={'frames': then[None, None]}
    )
    now = then.copy()
    now[10:] = 0  # elsewhere
    now[2:3, 3:8] = 200  # a quarter of it
    stays = borders.RememberingPipeline._stays
    assert stays(memory, now, (0, 0))
    now[3:5, 3:8] = 200
    assert not stays(memory, now, (0, 0))
    memory.whole['whole'][:] = False
    assert not stays(memory, then, (0, 0))  # never seen


def test_differences_are_paired_by_episode_and_leave_out_what_does_not_move(borders):
    # t interval of (.1, .2, .3) by hand: .2 +- 4.303 * .1 / sqrt(3)
    found = {'a': 0.1, 'b': 0.5, 'c': 0.4, 'still': np.nan}
    other = {'a': 0.2, 'b': 0.7, 'c': 0.7, 'still': np.nan}
    first, second = borders.differences({'found': found, 'carried': other})
    assert first[1:3] == ('3', '0.3333') and second[1:3] == ('3', '0.5333')
    assert second[3] == '+0.2000 [-0.0484, +0.4484]'
