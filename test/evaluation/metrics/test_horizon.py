"""J by chunk: the mean over the frames of a chunk, with an interval over episodes."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest

from mtv_world_ros.evaluation.metrics.horizon import by_chunk
from mtv_world_ros.evaluation.metrics.jaccard_scores import ScoreRow


def row(frames: list[float], view: str = 'low', moving: bool = True) -> ScoreRow:
    return ScoreRow(
        stretch=0, num_frames=len(frames), view=view, name='block', status='ok', moving=moving,
        j=nan, j_frames=tuple(frames),
    )  # fmt: skip


def test_frames_of_a_chunk_weigh_equally_and_the_last_one_may_be_short():
    episodes = [[row([0.9, 0.7, 0.5, 0.3, 0.1])], [row([1.0, nan, 0.4])]]
    found = by_chunk(episodes, None, 'j_frames', 2)
    assert found.values == pytest.approx([(0.9 + 0.7 + 1.0) / 3, (0.5 + 0.3 + 0.4) / 3, 0.1])


def test_other_views_and_objects_that_stay_do_not_count():
    episodes = [[row([0.5, 0.5]), row([0.9, 0.9], view='high'), row([1.0, 1.0], moving=False)]]
    assert by_chunk(episodes, 'low', 'j_frames', 2).values == (0.5,)


def test_the_interval_is_that_of_means_over_episodes_drawn_anew():
    rng = np.random.default_rng(1)
    means = rng.uniform(0.2, 0.8, 40)
    episodes = [[row([m, m, 1.0 - m, 1.0 - m])] for m in means]
    found = by_chunk(episodes, None, 'j_frames', 2)
    for chunk, values in enumerate((means, 1.0 - means)):
        drawn = rng.choice(values, (4000, 40)).mean(1)
        np.testing.assert_allclose(found.band[chunk], np.percentile(drawn, [2.5, 97.5]), atol=0.01)


def test_nothing_that_moves_gives_no_chunks():
    assert by_chunk([[row([1.0], moving=False)]], None, 'j_frames', 2).values == ()
