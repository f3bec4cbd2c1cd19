import numpy as np

from mtv_world_ros.core.images import resize_frames, resize_labels


def test_frames_shrink_to_the_mean_of_their_area():
    frames = np.random.default_rng(0).integers(0, 256, (2, 8, 12, 3), np.uint8)
    small = resize_frames(frames, 3, 2)
    means = frames.reshape(2, 2, 4, 3, 4, 3).mean((2, 4))
    assert small.shape == (2, 2, 3, 3)
    np.testing.assert_allclose(small, means, atol=0.51)


def test_frames_of_the_right_size_are_not_copied():
    frames = np.zeros((1, 4, 6, 3), np.uint8)
    assert resize_frames(frames, 6, 4) is frames


def test_labels_keep_their_values():
    labels = np.zeros((1, 8, 8), np.uint8)
    labels[0, 2:6, 2:6] = 7
    small = resize_labels(labels, 4, 4)
    assert set(np.unique(small)) == {0, 7}
    np.testing.assert_array_equal(small[0, 1:3, 1:3], 7)
    large = resize_labels(labels, 16, 16)
    np.testing.assert_array_equal(large, labels.repeat(2, 1).repeat(2, 2))
