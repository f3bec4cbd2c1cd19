"""The index of episodes stands for them at the next start, and a changed episode is read again."""

from __future__ import annotations

import os
from pathlib import Path
import shutil

import numpy as np
import pytest

from mtv_world_ros.data.recordings import clip_starts
from mtv_world_ros.training.clips.episode_index import IndexedEpisode, RecordingReader
from mtv_world_ros.training.training_run import load_episodes


@pytest.fixture
def paths(episode, tmp_path) -> list[Path]:
    names = ('one', 'two', 'three')
    return [Path(shutil.copytree(episode, tmp_path / 'data' / name)) for name in names]


@pytest.fixture
def read(monkeypatch) -> list[str]:
    """Names of the episodes that are read."""
    names, reads = [], RecordingReader._read

    def noted(self: RecordingReader, path: Path):
        names.append(path.name)
        return reads(self, path)

    monkeypatch.setattr(RecordingReader, '_read', noted)
    return names


def test_a_later_start_reads_the_index_alone(paths, read, tiny, robot, tmp_path, recording):
    first, _ = load_episodes(paths, tiny, robot, tmp_path / 'cache')
    assert read == ['one', 'two', 'three']
    later, skipped = load_episodes(paths, tiny, robot, tmp_path / 'cache')
    assert read == ['one', 'two', 'three'] and not skipped
    assert later == first
    assert later[0].whole == tuple(clip_starts(recording, tiny.spec).tolist())
    assert later[0].content_digest() and later[0].digest == recording.digest
    assert np.array_equal(later[0].recording().frames, recording.frames)
    assert read == ['one', 'two', 'three', 'one']


def test_a_changed_episode_and_other_settings_are_read_again(paths, read, tiny, robot, tmp_path):
    load_episodes(paths, tiny, robot, tmp_path / 'cache')
    read.clear()
    bag = next(paths[1].glob('*.mcap'))
    os.utime(bag, ns=(1, 1))
    load_episodes(paths, tiny, robot, tmp_path / 'cache')
    assert read == ['two']
    read.clear()
    spaced = tiny.replace(video=tiny.video.replace(clip_stride_s=1e3))
    found, _ = load_episodes(paths, spaced, robot, tmp_path / 'cache')
    assert read == ['one', 'two', 'three']
    assert [len(one.starts) for one in found] == [1, 1, 1]
    assert len(found[0].whole) > 1


def test_a_damaged_index_is_made_anew(paths, read, tiny, robot, tmp_path):
    load_episodes(paths, tiny, robot, tmp_path / 'cache')
    (file,) = (tmp_path / 'cache').glob('index-*.json')
    whole = file.read_text()
    for text in ('', '[]', '{"a": {"task": 1}}', whole[:-50]):
        file.write_text(text)
        read.clear()
        found, _ = load_episodes(paths, tiny, robot, tmp_path / 'cache')
        assert len(found) == 3 and len(read) == 3
        assert file.read_text() == whole


def test_frames_with_gaps_keep_their_clips(recording, tiny):
    """Runs of frames in a row of the index."""
    one = IndexedEpisode.of(recording, tiny.spec)
    cut = IndexedEpisode.of_row(one.path, {**one.as_row(), 'whole': [[0, 2], [5, 8]]}, one.read)
    assert cut.whole == (0, 1, 2, 5, 6, 7, 8)
    rows = [IndexedEpisode.of_row(one.path, e.as_row(), one.read) for e in (one, cut)]
    assert [e.whole for e in rows] == [one.whole, cut.whole]
