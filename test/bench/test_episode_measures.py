from pathlib import Path

import numpy as np
import pytest

from mtv_world_ros.bench.episode_measures import measure
from mtv_world_ros.data.episode import Episode, EpisodeInfo, Track
from mtv_world_ros.errors import EpisodeError


def _episode(ids, objects=('red block', 'blue block')):
    """An episode of one view from its masks (N, H, W)."""
    stamps = 1 + 100 * np.arange(len(ids), dtype=np.int64)
    track = Track(stamps, ids)
    return Episode(
        info=EpisodeInfo(path=Path('made'), objects=objects),
        views=('low',),
        cameras={},
        images={'low': track},
        joint_states=None,
        trajectories=[],
        masks={'low': track},
        instructions=[],
    )


def test_a_moved_a_resting_and_a_hidden_object_are_told_apart():
    ids = np.zeros((5, 8, 8), np.uint8)
    ids[:, 0:2, 0:2] = 2  # rests
    ids[0, 4:6, 4:6] = 1  # 4 px
    ids[1, 4:6, 5:7] = 1  # one aside: 2 of 6 px are shared
    ids[2:, 6:8, 6:8] = 1  # away
    ids[4, 0:2, 0:2] = 0  # the resting one is hidden in one of five frames
    found = measure(_episode(ids))
    assert found.visible == pytest.approx(np.array([[1.0, 0.8]]))
    assert found.moving.tolist() == [[True, False]]
    # J of the held first frame: (1/3 + 0 + 0 + 0) / 4 and (1 + 1 + 1 + 0) / 4
    assert found.copy == pytest.approx(np.array([[1 / 12, 0.75]]))
    assert found.copy_all() == pytest.approx([(1 / 12 + 0.75) / 2])
    assert found.copy_moving() == pytest.approx([1 / 12])


def test_nothing_that_moves_gives_no_number():
    ids = np.ones((3, 4, 4), np.uint8)
    assert np.isnan(measure(_episode(ids, ('red block',))).copy_moving()).all()


def test_an_episode_without_masks_is_refused():
    with pytest.raises(EpisodeError, match='no masks of objects'):
        measure(_episode(np.zeros((2, 4, 4), np.uint8), ()))
