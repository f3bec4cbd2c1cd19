"""Scores by the conventions of davis2017-evaluation, and motion."""

import numpy as np
import pytest

from mtv_world_ros.evaluation.metrics.jaccard_scores import keep_doubts
from mtv_world_ros.evaluation.metrics.object_scores import (
    boundary_f,
    displaced_objects,
    moving_objects,
    object_scores,
)
from test.support.square_masks import objects, square


def test_union_and_object_mean_differ_when_objects_swap_identity():
    a, b = square(0, 0), square(40, 20)
    true = objects([[[a], [b]]])
    pred = objects([[[b], [a]]])
    scores = object_scores(pred, true)
    assert scores.union[0] == 1.0
    assert scores.objects.mean() == 0.0


def test_hidden_frames_count_as_1_in_davis_and_not_at_all_in_visible():
    a, none = square(0, 0), np.zeros((60, 90), bool)
    true = objects([[[a, none, none]]])
    pred = objects([[[none, none, none]]])
    scores = object_scores(pred, true)
    assert scores.objects[0, 0] == pytest.approx(2 / 3)
    assert scores.visible[0, 0] == 0.0


def test_scores_carry_the_doubts_of_recording_and_prediction():
    a, none = square(0, 0), np.zeros((60, 90), bool)
    pred = objects([[[a], [none]]], status=(('ambiguous', 'absent'),))
    scores = object_scores(pred, objects([[[a], [a]]]))
    assert scores.status == (('predicted: ambiguous', 'predicted: absent'),)
    assert np.isnan(scores.boundary[0, 0]) and scores.union[0] == 0.0
    scores = object_scores(pred, objects([[[a], [none]]], status=(('ok', 'teleport'),)))
    assert scores.status == (('predicted: ambiguous', 'true: teleport'),)


@pytest.mark.parametrize(
    ('first', 'later', 'kept'),
    [
        ('ambiguous', 'ok', 'ambiguous'),
        ('low_confidence', 'ok', 'low_confidence'),
        ('ambiguous', 'lost', 'lost'),
        ('ok', 'ambiguous', 'ambiguous'),
        ('out_of_view', 'ok', 'ok'),
    ],
)
def test_doubt_about_the_start_stays_with_what_is_followed_from_it(first, later, kept):
    start, rest = (objects([[[square(0, 0)]]], status=((word,),)) for word in (first, later))
    assert keep_doubts(start, rest).status == ((kept,),)


def test_view_without_a_scored_object_is_nan_never_0_or_1():
    a = square(0, 0)
    scores = object_scores(objects([[[a]]]), objects([[[a]]], status=(('absent',),)))
    assert np.isnan(scores.union).all() and np.isnan(scores.objects).all()


def test_hiding_an_object_is_no_motion_but_displacing_it_is():
    a, hidden, gone = square(0, 0), square(0, 0), square(40, 20)
    hidden[10:] = False
    true = np.array([[[a, hidden], [a, gone]]])
    assert moving_objects(true, np.array([[a, a]])).tolist() == [[False, True]]
    assert not moving_objects(np.array([[[a]]]), np.array([[hidden]])).any()


def test_a_copy_elsewhere_is_a_displaced_object():
    a, gone = square(0, 0), square(40, 20)
    first = np.array([[a]])
    assert displaced_objects(np.array([[[a | gone, a | gone]]]), first).all()
    assert not displaced_objects(np.array([[[a | gone, a]]]), first).any()  # in one frame


def test_an_object_that_the_first_frame_does_not_show_has_no_place_to_move_from():
    """It may enter, or a hand may uncover it: nothing tells."""
    a, gone = square(0, 0), square(40, 20)
    entered = np.array([[[np.zeros_like(a), a, gone, gone]]])
    nothing = np.zeros_like(entered[:, :, 0])
    assert not moving_objects(entered, nothing).any()
    assert not displaced_objects(entered, nothing).any()


def counted_f(pred, true):
    """DAVIS' `db_eval_boundary`, pixel by pixel: its `seg2bmap`, matched within the disk."""
    height, width = true.shape
    reach = int(np.ceil(0.008 * np.linalg.norm(true.shape)))

    def edge(mask):
        found = []
        for y in range(height):
            for x in range(width):
                right, below = min(x + 1, width - 1), min(y + 1, height - 1)
                others = (mask[y, right], mask[below, x], mask[below, right])
                if any(mask[y, x] != other for other in others):
                    found.append((y, x))
        return found

    def share(these, those):
        near = [any((y - v) ** 2 + (x - u) ** 2 <= reach**2 for v, u in those) for y, x in these]
        return np.mean(near)

    here, there = edge(pred), edge(true)
    if not here or not there:
        return float(not here and not there)
    precision, recall = share(here, there), share(there, here)
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


@pytest.mark.parametrize('seed', range(4))
def test_boundaries_score_as_counted_pixel_by_pixel(seed):
    rng = np.random.default_rng(seed)
    shape = (40, 130)  # a diagonal of 136: 2 px apart still match
    pred, true = (
        square(int(rng.integers(20)), int(rng.integers(20)), int(rng.integers(5, 25)), shape)
        for _ in '12'
    )
    true[5:9, 100:130] = pred[30:40, 60] = True  # at the border; a line
    assert boundary_f(pred, true) == pytest.approx(counted_f(pred, true), abs=1e-12)


def test_boundaries_a_pixel_apart_match_and_empty_ones_follow_davis():
    here, aside, far = square(10, 10), square(11, 10), square(50, 20)
    empty = np.zeros_like(here)
    stacked = boundary_f(np.stack([here, here, empty, here]), np.stack([aside, far, empty, empty]))
    np.testing.assert_array_equal(stacked, [1.0, 0.0, 1.0, 0.0])
    scores = object_scores(objects([[[here, here]]]), objects([[[aside, far]]]))
    assert scores.boundary[0, 0] == 0.5
