import numpy as np
import pytest

from mtv_world_ros.errors import EpisodeError
from mtv_world_ros.vision.segmenters.recorded import RecordedSegmenter

OBJECTS = ('red block', 'blue block')


def recording():
    """(2, 3, 4, 6, 3) frames and their identities: object 1 walks right, object 2 hides once."""
    frames = np.random.default_rng(0).integers(0, 256, (2, 3, 4, 6, 3), dtype=np.uint8)
    ids = np.zeros((2, 3, 4, 6), np.uint8)
    for index in range(3):
        ids[:, index, 0, index] = 1
    ids[:, [0, 2], 3, 3:5] = 2
    return frames, ids


def test_recorded_frames_get_the_recorded_masks_in_the_order_asked_for():
    frames, ids = recording()
    segmenter = RecordedSegmenter(frames, ids, OBJECTS)
    found = segmenter.segment(frames[:, 1:], ('blue block', 'red block'))
    assert found.masks.sum((3, 4)).tolist() == [[[0, 2], [1, 1]]] * 2
    assert found.masks[0, 1, 0, 0].tolist() == [False, True, False, False, False, False]
    assert found.status == (('ok', 'ok'),) * 2


def test_object_that_no_frame_shows_is_absent():
    frames, ids = recording()
    found = RecordedSegmenter(frames, ids, OBJECTS).segment(frames[:, 1:2], (*OBJECTS, 'cup'))
    assert found.status == (('ok', 'absent', 'absent'),) * 2


def test_predicted_frame_is_not_recorded():
    frames, ids = recording()
    predicted = frames.copy()
    predicted[0, 2, 0, 0, 0] ^= 1
    found = RecordedSegmenter(frames, ids, OBJECTS).segment(predicted, OBJECTS)
    assert found.status == (('not_recorded', 'not_recorded'), ('ok', 'ok'))
    assert not found.masks[0, :, 2].any()


def test_frame_of_the_other_view_is_not_recorded():
    frames, ids = recording()
    found = RecordedSegmenter(frames, ids, OBJECTS).segment(frames[::-1], OBJECTS)
    assert {word for row in found.status for word in row} == {'not_recorded'}


def test_recording_of_a_real_robot_has_no_masks():
    with pytest.raises(EpisodeError, match='no identities'):
        RecordedSegmenter(recording()[0], None, OBJECTS)
