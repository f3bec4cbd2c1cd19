"""Golden values by the conventions of davis2017-evaluation (db_eval_iou)."""

import numpy as np
import pytest

from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.vision.jaccard import (
    held_masks,
    jaccard,
    mean_of_known,
    object_jaccard,
    score_statuses,
)
from test.support.square_masks import objects, square


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


@pytest.mark.parametrize('word', ['absent', 'ambiguous', 'out_of_palette', 'teleport'])
def test_object_that_the_recording_leaves_in_doubt_is_nan_with_its_reason(word):
    a, b = square(0, 0), square(40, 20)
    true = objects([[[a], [b]]], status=(('ok', word),))
    pred = objects([[[a], [a]]])
    np.testing.assert_array_equal(object_jaccard(pred, true), [[[1.0], [np.nan]]])
    assert score_statuses(pred, true) == (('ok', f'true: {word}'),)


def test_object_that_the_prediction_lost_scores_0_and_says_so():
    a, none = square(0, 0), np.zeros((60, 90), bool)
    pred = objects([[[none], [a]]], status=(('absent', 'ambiguous'),))
    true = objects([[[a], [a]]])
    np.testing.assert_array_equal(object_jaccard(pred, true), [[[0.0], [np.nan]]])
    assert score_statuses(pred, true) == (('predicted: absent', 'predicted: ambiguous'),)


def test_scores_of_other_objects_are_refused():
    a = objects([[[square(0, 0)]]], names=('red block',))
    b = objects([[[square(0, 0)]]], names=('blue block',))
    with pytest.raises(MtvWorldError, match='names, views and frames'):
        object_jaccard(a, b)


def test_persistence_of_a_still_object_is_1_and_of_a_gone_one_0():
    a, b = square(0, 0), square(40, 20)
    true = objects([[[a, a], [b, b]]])
    held = held_masks(np.array([[a, a]]), true)
    assert object_jaccard(held, true).tolist() == [[[1.0, 1.0], [0.0, 0.0]]]


def test_mean_of_nothing_known_is_nan_without_warning(recwarn):
    assert np.isnan(mean_of_known(np.array([np.nan, np.nan])))
    assert not recwarn
