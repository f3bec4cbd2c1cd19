"""Places of objects over time, against points that were projected into two views."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.core.data_types import CameraModel
from mtv_world_ros.vision.object_tracks import track_points

K = np.array([[300.0, 0, 160], [0, 300.0, 96], [0, 0, 1]])
#: from the front and from the left, 1 m away
POSES = np.stack([
    np.array([[0.0, 0, -1, 1], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
    np.array([[1.0, 0, 0, 0], [0, 0, 1, -1], [0, -1, 0, 0], [0, 0, 0, 1]]),
])  # fmt: skip
CAMERAS = tuple(
    CameraModel(view=view, width=320, height=192, K=K, mount_link='base', T_mount_camera=pose)
    for view, pose in zip(('front', 'left'), POSES, strict=True)
)


def seen(points: np.ndarray) -> np.ndarray:
    """(V, N, 1, 2) pixels of points (N, 3), by the pinhole formula."""
    rows = []
    for pose in POSES:
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        rows.append(np.stack([160 + 300 * x / z, 96 + 300 * y / z], -1)[:, None])
    return np.stack(rows)


def tracked(pixels: np.ndarray) -> np.ndarray:
    poses = np.repeat(POSES[:, None], pixels.shape[1], axis=1)
    return track_points(CAMERAS, poses, pixels)[:, 0]


def carried(num: int = 40) -> np.ndarray:
    """At rest, carried by 20 cm, at rest."""
    share = np.clip((np.arange(num) - 10) / 20, 0, 1)[:, None]
    return np.array([0.1, 0.0, 0.05]) + share * np.array([-0.1, 0.15, 0.1])


def test_what_two_views_see_is_where_it_is():
    assert tracked(seen(carried())) == pytest.approx(carried(), abs=0.02)
    assert tracked(seen(carried()))[[0, -1]] == pytest.approx(carried()[[0, -1]], abs=0.011)


def test_what_is_hidden_goes_straight_to_where_it_is_seen_again():
    pixels = seen(carried())
    pixels[1, 12:28] = np.nan
    assert tracked(pixels) == pytest.approx(carried(), abs=0.02)


def test_what_is_not_seen_again_stays():
    pixels = seen(carried())
    pixels[0, 25:] = np.nan
    found = tracked(pixels)
    assert (found[25:] == found[24]).all()


def test_small_errors_of_masks_are_no_motion():
    pixels = seen(np.repeat(carried()[:1], 40, axis=0))
    rng = np.random.default_rng(0)
    found = tracked(pixels + rng.normal(0, 1, pixels.shape))
    assert len(np.unique(found, axis=0)) == 1


def test_views_that_show_different_things_are_not_believed():
    pixels = seen(carried())
    pixels[1, 15:20, :, 1] += 60
    assert tracked(pixels) == pytest.approx(carried(), abs=0.02)


def test_what_was_never_seen_by_two_views_is_nowhere():
    pixels = seen(carried())
    pixels[1] = np.nan
    assert np.isnan(tracked(pixels)).all()
    pixels = seen(carried())
    pixels[1, :5] = np.nan
    assert np.isnan(tracked(pixels)[:5]).all() and np.isfinite(tracked(pixels)[5:]).all()
