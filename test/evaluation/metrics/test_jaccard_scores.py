"""Which objects move, by masks of a segmenter and by where two views show them."""

import numpy as np
import pytest

from mtv_world_ros.evaluation.imagined_stretches import Stretch
from mtv_world_ros.evaluation.metrics.jaccard_scores import true_masks
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter

NAMES = ('plate', 'block')
STILL, NAN = np.zeros((3, 3)), np.full((3, 3), np.nan)
AWAY = np.array([[0.0, 0, 0], [0.015, 0, 0], [0.03, 0, 0]])


def stretch(plate, block=STILL):
    """The plate shows its left half and then its right half; the block goes to the right."""
    ids = np.zeros((2, 3, 24, 32), np.uint8)
    ids[:, 0, 8:16, 4:10] = 1
    ids[:, 1:, 8:16, 11:17] = 1
    for frame in range(3):
        ids[:, frame, 18:22, 4 + 8 * frame : 8 + 8 * frame] = 2
    points = None if plate is None else np.stack([plate, block], axis=1)
    return Stretch(
        index=0,
        start=0,
        frames=np.zeros((2, 3, 24, 32, 3), np.uint8),
        object_ids=ids,
        positions=np.zeros((3, 1)),
        points=points,
    )


@pytest.mark.parametrize(
    ('plate', 'block', 'moving'),
    [
        (None, None, [True, True]),  # masks alone
        (STILL, AWAY, [False, True]),
        (AWAY, AWAY, [True, True]),
        (NAN, AWAY, [True, True]),  # one view alone says nothing of a place
        (STILL, STILL, [False, False]),
    ],
)
def test_what_two_views_show_at_one_place_does_not_move(plate, block, moving):
    truth = true_masks(stretch(plate, block), ColourSegmenter(), NAMES, NAMES, use_ids=False)
    assert truth.moving.tolist() == [moving, moving]


def test_objects_are_told_apart_by_name_not_by_number():
    given = stretch(STILL, AWAY)
    truth = true_masks(given, ColourSegmenter(), NAMES[::-1], NAMES, use_ids=False)
    assert truth.moving.tolist() == [[True, False]] * 2
