import json

import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.evaluation.evaluate_episodes import evaluate
from mtv_world_ros.evaluation.metrics.feature_store import (
    FeatureTaker,
    frechet_distances,
    load_features,
)
from mtv_world_ros.evaluation.settings import EvaluationConfig


def mean_colour(frames):
    """Two features of each frame."""
    return frames.reshape(len(frames), -1, 3).mean(1)[:, :2]


def clip_length(clip):
    return np.array([[float(len(clip)), 0.0]])


def video(*levels):
    return np.stack([np.full((1, 4, 4, 3), level, np.uint8) for level in levels], 1)


@pytest.fixture
def taken(tmp_path):
    """Features of two episodes whose predictions are 10 levels too bright."""
    taker = FeatureTaker(views=('low',), num_frames=2, frames=mean_colour, clips=clip_length)
    found = []
    for index, levels in enumerate([(10, 20, 30), (40, 50, 60, 70)]):
        episode = taker.start()
        episode.add(video(*(level + 10 for level in levels)), video(*levels))
        episode.save(tmp_path / f'{index}.npz')
        found.append(load_features(tmp_path / f'{index}.npz'))
    return found


def test_shifted_features_are_at_the_square_of_the_shift(taken):
    found = frechet_distances(taken, 'low')
    assert found['fid'].value == pytest.approx(2 * 10**2)
    assert found['fid'].num_episodes == 2


def test_clips_are_whole_and_what_is_left_over_is_none(taken):
    assert [features['fvd/low/real'][:, 0].tolist() for features in taken] == [[2.0], [2.0, 2.0]]
    assert frechet_distances(taken, 'low')['fvd'].value == pytest.approx(0)


def test_view_that_was_not_measured_has_no_distance(taken):
    assert frechet_distances(taken, 'high') == {}
    assert frechet_distances(taken[:1], 'low').keys() == {'fid'}  # one clip has no covariance


def test_broken_file_is_an_error_and_a_missing_one_is_not_measured(tmp_path):
    (tmp_path / 'x.npz').write_bytes(b'PK nothing')
    with pytest.raises(EpisodeError, match='cannot be read'):
        load_features(tmp_path / 'x.npz')
    assert load_features(tmp_path / 'y.npz') == {}


@pytest.mark.slow
def test_distances_reach_metrics_and_are_kept_for_the_next_run(
    make_pipeline, episodes, oracle, tmp_path, monkeypatch
):
    module = 'mtv_world_ros.evaluation.evaluate_episodes'
    monkeypatch.setattr(f'{module}.frame_features', lambda path, device: mean_colour)
    config = EvaluationConfig(fid_weights=tmp_path / 'w.pth')
    pipeline = make_pipeline(oracle)
    evaluate(pipeline, episodes, tmp_path, config, name='x', show_progress=False)
    metrics = json.loads((tmp_path / 'metrics.json').read_text())
    # the oracle draws what was recorded
    assert metrics['views']['low']['fid'] == pytest.approx(0, abs=1e-6)
    assert metrics['views']['low']['intervals']['fid'][0] is not None
    assert metrics['views']['low']['fvd'] is None and metrics['overall']['fid'] is None
    calls = oracle.num_calls
    evaluate(pipeline, episodes, tmp_path, config, name='x', show_progress=False)
    assert oracle.num_calls == calls
    (tmp_path / 'episodes' / 'episode_0.features.npz').unlink()
    evaluate(pipeline, episodes, tmp_path, config, name='x', show_progress=False)
    assert oracle.num_calls > calls
