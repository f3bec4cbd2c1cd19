from collections import Counter
import re

import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data import observations
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.rollout.offline import replay_offline

START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000


def replay(pipeline, episode, out, **options):
    return replay_offline(pipeline, episode, out, show_progress=False, **options)


def received(out, topic):
    return [
        (message.stamp_ns, messages.deserialize(message.msgtype, message.data))
        for message in BagReader(out).messages()
        if message.topic == topic
    ]


@pytest.fixture
def predictions(make_pipeline, episodes, oracle, tmp_path):
    summary = replay(make_pipeline(oracle), episodes[0], tmp_path / 'out')
    return tmp_path / 'out', summary


def test_every_topic_of_the_node_is_recorded(predictions):
    out, summary = predictions
    assert (summary.num_trajectories, summary.num_chunks, summary.num_frames) == (1, 3, 9)
    counts = Counter(message.topic for message in BagReader(out).messages())
    for view in ('low', 'high'):
        for stream in ('predicted', 'trajectory'):
            assert counts[f'/world_model/{view}/{stream}/image_raw/compressed'] == 9
            assert counts[f'/world_model/{view}/{stream}/camera_info'] == 9
        assert counts[f'/world_model/{view}/mask/image_raw'] == 9
    assert counts['/world_model/predicted/joint_states'] == 9
    assert counts['/world_model/success'] == counts['/world_model/jaccard'] == 3


def test_the_foxglove_layout_of_recordings_shows_what_is_recorded(predictions):
    out, _ = predictions
    recorded = {message.topic for message in BagReader(out).messages()}
    text = share_path('config', 'viewers', 'foxglove_recording.json').read_text()
    shown = set(re.findall(r'"(/[a-z_/]+)["\.]', text))
    assert len(shown) >= 14 and shown <= recorded, shown - recorded


def test_predictions_are_stamped_at_the_predicted_time(predictions):
    out, _ = predictions
    stamps = [stamp for stamp, _ in received(out, '/world_model/low/predicted/camera_info')]
    assert stamps == [START_NS + k * 2 * PERIOD_NS for k in range(1, 10)]
    headers = received(out, '/world_model/predicted/joint_states')
    assert [messages.header_stamp(message) for _, message in headers] == stamps


def test_predicted_images_are_read_back_as_views(predictions, recordings):
    out, _ = predictions
    names = {'low': '/world_model/low/predicted/image_raw'}
    episode = read_episode(out, views=['low'], with_cameras=False, topics=names)
    frames = np.asarray(episode.images['low'].frames)
    assert np.abs(frames.astype(int) - recordings[0].frames[0, 2::2]).mean() < 3


def test_what_the_cameras_showed_then_lies_beside_the_predictions(predictions, recordings):
    out, _ = predictions
    episode = read_episode(out, views=['low', 'high'], with_cameras=False)
    for number, view in enumerate(episode.views):
        track = episode.images[view]
        assert track.stamps_ns.tolist() == [START_NS + k * 2 * PERIOD_NS for k in range(1, 10)]
        real = recordings[0].frames[number, 2::2]
        assert np.abs(np.asarray(track.frames).astype(int) - real).mean() < 3
        (_, info), *_ = received(out, f'/{view}/camera_info')
        assert (info.height, info.width) == real.shape[1:3]


def test_mask_and_estimate_are_labelled(predictions):
    out, _ = predictions
    _, mask = received(out, '/world_model/low/mask/image_raw')[0]
    assert mask.encoding == 'mono8' and set(mask.data) == {0, 1, 2}
    _, array = received(out, '/world_model/jaccard')[-1]
    assert [d.label for d in array.layout.dim] == [
        'view: low, high',
        'object: red block, blue block',
    ]
    assert [(d.size, d.stride) for d in array.layout.dim] == [(2, 4), (2, 2)]
    _, report = received(out, '/world_model/report')[0]
    values = {pair.key: pair.value for pair in report.status[0].values}
    assert values['chunk'] == '0' and 'success_reasons' in values


def test_frames_that_the_next_trajectory_supersedes_are_left_out(
    make_pipeline, make_episode, tmp_path
):
    path = make_episode(tmp_path / 'episode', starts=(0, 6))
    summary = replay(make_pipeline(), path, tmp_path / 'out')
    assert summary.num_trajectories == 2 and len(summary.probabilities) == 2
    stamps = [
        stamp for stamp, _ in received(tmp_path / 'out', '/world_model/low/predicted/camera_info')
    ]
    assert stamps == sorted(set(stamps))
    assert stamps == [START_NS + k * 2 * PERIOD_NS for k in range(1, 10)]


def test_bad_trajectory_is_rejected_with_its_reason_and_the_next_is_imagined(
    make_pipeline, make_episode, tmp_path
):
    bad = make_episode(tmp_path / 'bad', offset=9.0)
    with pytest.raises(EpisodeError, match='left_joint1'):
        replay(make_pipeline(), bad, tmp_path / 'out')
    assert not (tmp_path / 'out').exists()
    late = make_episode(tmp_path / 'late', starts=(-8, 0))
    summary = replay(make_pipeline(), late, tmp_path / 'out')
    assert summary.num_trajectories == 1
    assert [stamp for stamp, _ in summary.rejected] == [START_NS - 8 * PERIOD_NS]
    _, report = received(tmp_path / 'out', '/world_model/report')[0]
    assert 'no frame before the trajectory' in report.status[0].message
    assert 'rejected' in str(summary)


def test_old_frames_are_rejected(make_pipeline, episodes, tmp_path, monkeypatch):
    monkeypatch.setattr(observations, 'IMAGE_AGE_S', -1)
    with pytest.raises(EpisodeError, match='frames are 0.000 s old; allowed are -1 s'):
        replay(make_pipeline(), episodes[0], tmp_path / 'out')


def test_bag_cut_in_the_middle_replays_up_to_the_cut_and_says_so(
    make_pipeline, make_episode, tmp_path
):
    path = make_episode(tmp_path / 'episode')
    file = next(path.glob('*.mcap'))
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    summary = replay(make_pipeline(), path, tmp_path / 'out')
    assert summary.num_trajectories == 1 and summary.warnings
    assert 'warning' in str(summary)


def test_existing_predictions_are_kept_when_the_replay_fails(
    make_pipeline, make_episode, episodes, tmp_path
):
    out = tmp_path / 'out'
    replay(make_pipeline(), episodes[0], out)
    before = sorted(path.name for path in out.iterdir())
    with pytest.raises(EpisodeError):
        replay(make_pipeline(), make_episode(tmp_path / 'bad', offset=9.0), out)
    assert sorted(path.name for path in out.iterdir()) == before
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith('.')] == []


def test_foreign_folder_is_not_overwritten(make_pipeline, episodes, tmp_path):
    (tmp_path / 'out').mkdir()
    (tmp_path / 'out' / 'thesis.tex').write_text('...')
    with pytest.raises(EpisodeError, match='not a bag folder'):
        replay(make_pipeline(), episodes[0], tmp_path / 'out', overwrite=True)
    with pytest.raises(EpisodeError, match='exists already'):
        replay(make_pipeline(), episodes[0], tmp_path / 'out')
    assert (tmp_path / 'out' / 'thesis.tex').exists()


def test_episode_without_trajectories_is_an_error(make_pipeline, make_episode, tmp_path):
    path = make_episode(tmp_path / 'episode', starts=())
    with pytest.raises(EpisodeError, match='no joint_trajectory'):
        replay(make_pipeline(), path, tmp_path / 'out')
