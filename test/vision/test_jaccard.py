"""Golden values by the conventions of davis2017-evaluation (db_eval_iou)."""

import numpy as np
import pytest

from mtv_world_ros.data_types import ObjectMasks
from mtv_world_ros.errors import MtvWorldError
from mtv_world_ros.vision.jaccard import (
    boundary_f,
    jaccard,
    mean_of_known,
    moves,
    object_scores,
    persistence_scores,
    skill,
)


def square(x, y, size=27, shape=(60, 90)):
    mask = np.zeros(shape, bool)
    mask[y : y + size, x : x + size] = True
    return mask


def objects(masks, status=None, names=('red block', 'blue block')):
    masks = np.asarray(masks, bool)
    status = status or (('ok',) * masks.shape[1],) * masks.shape[0]
    return ObjectMasks(names=names[: masks.shape[1]], masks=masks, status=status)


def test_square_of_27_px_displaced_by_10_px_scores_0_46():
    score = jaccard(square(10, 10), square(20, 10))
    assert score == pytest.approx(27 * 17 / (27 * 37))
    assert round(float(score), 2) == 0.46


@pytest.mark.parametrize(
    ('pred', 'true', 'expected'),
    [
        ([[0, 0], [0, 0]], [[0, 0], [0, 0]], 1.0),
        ([[1, 0], [0, 0]], [[0, 0], [0, 0]], 0.0),
        ([[0, 0], [0, 0]], [[1, 0], [0, 0]], 0.0),
        ([[1, 1], [0, 0]], [[1, 0], [1, 0]], 1 / 3),
        ([[1, 1], [1, 1]], [[1, 1], [0, 0]], 0.5),
    ],
)
def test_small_masks_follow_davis(pred, true, expected):
    assert jaccard(np.array(pred, bool), np.array(true, bool)) == pytest.approx(expected)


def by_pixel_sets(pred, true):
    """The DAVIS 2017 measure of one frame, from its definition over sets of pixels."""
    one, other = ({tuple(p) for p in np.argwhere(mask)} for mask in (pred, true))
    return len(one & other) / len(one | other) if one | other else 1.0


@pytest.mark.parametrize('seed', range(6))
def test_random_masks_score_as_counted_over_sets_of_pixels(seed):
    rng = np.random.default_rng(seed)
    shape = (4, 5, 3, 4)  # small and sparse, so that some masks are empty
    pred, true = (
        rng.random(shape) < rng.choice([0, 0.1, 0.5, 0.9, 1], (*shape[:2], 1, 1)) for _ in range(2)
    )
    expected = [[by_pixel_sets(pred[i, j], true[i, j]) for j in range(5)] for i in range(4)]
    assert np.allclose(jaccard(pred, true), expected)


def test_leading_axes_are_kept():
    assert jaccard(np.zeros((2, 3, 4, 5), bool), np.zeros((2, 3, 4, 5), bool)).shape == (2, 3)


def test_masks_of_another_size_are_an_error_that_names_both():
    with pytest.raises(MtvWorldError, match='5x4 and 6x4'):
        jaccard(np.zeros((4, 5), bool), np.zeros((4, 6), bool))


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


@pytest.mark.parametrize('word', ['absent', 'ambiguous', 'out_of_palette', 'teleport'])
def test_object_that_the_recording_leaves_in_doubt_is_nan_with_its_reason(word):
    a, b = square(0, 0), square(40, 20)
    true = objects([[[a], [b]]], status=(('ok', word),))
    scores = object_scores(objects([[[a], [a]]]), true)
    assert np.isnan(scores.objects[0, 1]) and np.isnan(scores.frames[0, 1]).all()
    assert scores.status == (('ok', f'true: {word}'),)
    assert scores.objects.mean() == 1.0 and scores.union[0] == 1.0


def test_object_that_the_prediction_lost_scores_0_and_says_so():
    a, none = square(0, 0), np.zeros((60, 90), bool)
    pred = objects([[[none], [a]]], status=(('absent', 'ambiguous'),))
    scores = object_scores(pred, objects([[[a], [a]]]))
    assert scores.objects[0, 0] == 0.0 and np.isnan(scores.objects[0, 1])
    assert scores.status == (('predicted: absent', 'predicted: ambiguous'),)


def test_view_without_a_scored_object_is_nan_never_0_or_1():
    a = square(0, 0)
    scores = object_scores(objects([[[a]]]), objects([[[a]]], status=(('absent',),)))
    assert np.isnan(scores.union).all() and np.isnan(scores.objects).all()


def test_scores_of_other_objects_are_refused():
    a = objects([[[square(0, 0)]]], names=('red block',))
    b = objects([[[square(0, 0)]]], names=('blue block',))
    with pytest.raises(MtvWorldError, match='names, views and frames'):
        object_scores(a, b)


def test_persistence_of_a_still_object_is_1_and_of_a_gone_one_0():
    a, b = square(0, 0), square(40, 20)
    true = objects([[[a, a], [b, b]]])
    copy = persistence_scores(np.array([[a, a]]), true)
    assert copy.objects.tolist() == [[1.0, 0.0]]


def test_skill_is_0_at_persistence_1_at_perfect_and_unknown_without_room():
    assert skill(np.array([0.4, 1.0]), np.array([0.4, 0.4])).tolist() == [0.0, 1.0]
    assert np.isnan(skill(1.0, 1.0))


def test_hiding_an_object_is_no_motion_but_displacing_it_is():
    a, hidden, gone = square(0, 0), square(0, 0), square(40, 20)
    hidden[10:] = False
    true = np.array([[[a, hidden], [a, gone]]])
    assert moves(true, np.array([[a, a]])).tolist() == [[False, True]]
    assert not moves(np.array([[[a]]]), np.array([[hidden]])).any()


def test_mean_of_nothing_known_is_nan_without_warning(recwarn):
    assert np.isnan(mean_of_known(np.array([np.nan, np.nan])))
    assert not recwarn


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
