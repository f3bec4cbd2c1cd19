import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.evaluation.episode_scorer import shares_over_time
from mtv_world_ros.evaluation.evaluate_episodes import evaluate
from mtv_world_ros.evaluation.results import EpisodeResult, rollout_path
from mtv_world_ros.viewing import stored_rollout
from mtv_world_ros.viewing.scored_rollout import StoredRollout
from mtv_world_ros.viewing.stored_rollout import (
    join_stretches,
    load_rollout,
    MAX_SIDE,
    save_rollout,
)

VIDEOS = ('real', 'trajectory', 'imagined')


def rollout(frames=6, height=37, width=51, objects=('red block', 'blue block'), stretch=0):
    """Smooth moving pictures of odd size, a square per object that moves to the right."""
    rows, columns = np.mgrid[:height, :width].astype(float)
    waves = [
        128 + 100 * np.sin(rows / 9 + t / 5 + k) * np.cos(columns / 11 + k) for t in range(frames)
        for k in range(3)
    ]  # fmt: skip
    video = np.stack(waves).reshape(frames, 3, height, width).transpose(0, 2, 3, 1)
    video = np.stack([video, video[:, ::-1]]).astype(np.uint8)
    masks = np.zeros((2, len(objects), frames, height, width), bool)
    for o in range(len(objects)):
        for t in range(frames):
            masks[:, o, t, height // 4 : height // 2, t + o : t + o + width // 4] = True
    j = np.linspace(0, 1, 2 * len(objects) * frames).reshape(2, len(objects), frames)
    return StoredRollout(
        views=('low', 'high'),
        objects=objects,
        fps=5.0,
        stretches=np.full(frames, stretch),
        times=np.arange(1, frames + 1) / 5,
        real=video,
        trajectory=video // 2,
        imagined=255 - video,
        true_masks=masks,
        masks=~masks,
        j=j,
    )


def test_rollout_survives_the_disk(tmp_path):
    kept = rollout()
    kept.j[1, 0, 2] = np.nan
    path = rollout_path(tmp_path, 'episode_0')
    save_rollout(path, kept)
    assert [file.name for file in path.parent.iterdir()] == ['episode_0.rollout.npz']
    read = load_rollout(path)
    assert (read.views, read.objects, read.fps) == (kept.views, kept.objects, kept.fps)
    assert (read.true_masks == kept.true_masks).all() and (read.masks == kept.masks).all()
    assert (read.times == kept.times).all() and (read.stretches == kept.stretches).all()
    assert np.allclose(read.j, kept.j, atol=1e-6, equal_nan=True)
    for name in VIDEOS:
        error = np.abs(getattr(read, name).astype(float) - getattr(kept, name))
        assert error.mean() < 1.5 and error.max() < 20, name


def test_file_is_much_smaller_than_what_it_holds(tmp_path):
    kept = rollout(frames=40, height=72, width=96)
    save_rollout(tmp_path / 'x.npz', kept)
    raw = sum(getattr(kept, name).nbytes for name in VIDEOS)
    assert (tmp_path / 'x.npz').stat().st_size < raw / 20


def test_large_frames_are_shrunk_with_their_masks(tmp_path):
    save_rollout(tmp_path / 'x.npz', rollout(frames=2, height=480, width=640))
    read = load_rollout(tmp_path / 'x.npz')
    assert read.real.shape == (2, 2, 240, MAX_SIDE, 3)
    rows, columns = np.nonzero(read.true_masks[0, 0, 0])
    assert (rows.min(), rows.max() + 1, columns.max() + 1) == (60, 120, 80)


def test_long_episodes_are_cut(tmp_path, monkeypatch):
    monkeypatch.setattr(stored_rollout, 'MAX_FRAMES', 4)
    save_rollout(tmp_path / 'x.npz', rollout(frames=6))
    read = load_rollout(tmp_path / 'x.npz')
    assert read.imagined.shape[1] == len(read.times) == read.j.shape[2] == 4


def test_rollout_without_objects_survives_the_disk(tmp_path):
    save_rollout(tmp_path / 'x.npz', rollout(objects=()))
    read = load_rollout(tmp_path / 'x.npz')
    assert read.objects == () and read.masks.shape == (2, 0, 6, 37, 51)


def test_stretches_are_joined_in_order():
    joined = join_stretches([rollout(stretch=0), rollout(frames=3, stretch=1)])
    assert joined.stretches.tolist() == [0] * 6 + [1] * 3
    assert joined.real.shape[1] == joined.masks.shape[2] == 9
    with pytest.raises(EpisodeError, match='differ in views'):
        join_stretches([rollout(), rollout(objects=('red block',))])
    with pytest.raises(EpisodeError, match='at least one'):
        join_stretches([])


def test_parts_that_do_not_fit_each_other_are_refused():
    with pytest.raises(EpisodeError, match=r'masks has shape .* expected \(2, 2, 6, 37, 51\)'):
        dataclasses.replace(rollout(), masks=np.zeros((2, 2, 5, 37, 51), bool))


def test_broken_file_is_named(tmp_path):
    path = tmp_path / 'x.npz'
    save_rollout(path, rollout())
    whole = path.read_bytes()
    for broken in (whole[: len(whole) // 2], b'', b'no archive'):
        path.write_bytes(broken)
        with pytest.raises(EpisodeError, match='x.npz.*evaluate the episode again'):
            load_rollout(path)
    with pytest.raises(EpisodeError, match='nothing.npz'):
        load_rollout(tmp_path / 'nothing.npz')


def test_file_with_a_broken_video_is_named(tmp_path):
    path = tmp_path / 'x.npz'
    save_rollout(path, rollout())
    with np.load(path) as file:
        held = dict(file)
    np.savez(path, **{**held, 'real': held['real'][:50]})
    with pytest.raises(EpisodeError, match='x.npz'):
        load_rollout(path)


def test_pickled_objects_are_not_loaded(tmp_path):
    class Trap:
        def __reduce__(self):
            return print, ('loaded',)

    path = tmp_path / 'x.npz'
    np.savez(path, shape=np.array([Trap()], dtype=object))
    with pytest.raises(EpisodeError, match='x.npz'):
        load_rollout(path)


def test_evaluation_keeps_what_it_scored(make_pipeline, episodes, recordings, oracle, tmp_path):
    evaluate(make_pipeline(oracle), episodes[:1], tmp_path, show_progress=False)
    read = load_rollout(rollout_path(tmp_path, 'episode_0'))
    assert read.stretches.tolist() == [0] * 4 + [1] * 4
    assert np.allclose(read.times, np.arange(1, 9) / 5, atol=1e-6)
    recorded = recordings[0].frames[:, 2:17:2].astype(float)
    for name in ('real', 'imagined'):
        assert np.abs(getattr(read, name) - recorded).mean() < 2
    assert (read.masks == read.true_masks).all() and (read.j == 1).all()
    red = read.true_masks[0, read.objects.index('red block')]
    assert red.sum((1, 2)).min() > 60 and read.trajectory.any()
    stored = json.loads((tmp_path / 'episodes' / 'episode_0.json').read_text())['result']
    row = next(r for r in stored['rows'] if r['view'] == 'low' and r['name'] == 'red block')
    assert row['j_frames'] == read.j[0, read.objects.index('red block'), :4].tolist()


def test_shares_over_time_are_of_the_end_of_each_chunk_and_are_read_back():
    def chunk(seconds, share):
        futures = None if share is None else SimpleNamespace(share=share)
        return SimpleNamespace(imagined_seconds=seconds, success=SimpleNamespace(futures=futures))

    chunks = [chunk(1.6, 0.25), chunk(3.2, None), chunk(4.8, 1.0)]
    shares = shares_over_time(chunks, 2.0)
    assert shares == [(3.6, 0.25), (6.8, 1.0)]
    values = {
        'episode': 'a', 'task': '', 'zero_shot': '', 'outcome': 'success', 'rows': (),
        'quality': {}, 'probability': 0.5, 'reasons': (), 'notes': (), 'seconds_per_chunk': 1.0,
        'seconds': {}, 'has_ids': False,
    }  # fmt: skip
    result = EpisodeResult(**values, shares=tuple(shares))
    assert EpisodeResult.from_json(json.loads(json.dumps(result.as_json()))).shares == (*shares,)
    before = EpisodeResult(**values).as_json()
    before.pop('shares')  # as versions before wrote it
    assert EpisodeResult.from_json(before).shares == ()
