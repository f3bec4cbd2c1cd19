"""Files that only stand in another one's place, in every reader: Git LFS pointers, HTML pages."""

import shutil

import numpy as np
import pytest

from mtv_world_ros.core.bounded_input import placeholder
from mtv_world_ros.core.errors import CheckpointError, EpisodeError
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.importing.lerobot import LeRobotDataset
from mtv_world_ros.importing.lerobot_episodes import import_dataset
from mtv_world_ros.importing.number_tables import read_table
from mtv_world_ros.importing.video_frames import frames_at, VideoFileFrames
from mtv_world_ros.model.tensor_files import read_tensors

POINTER = (
    'version https://git-lfs.github.com/spec/v1\n'
    'oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n'
)
PAGE = '<!DOCTYPE html>\n<html><head><title>Sign in</title></head></html>'
SAID = {POINTER: "is a pointer of Git LFS, not the file: run 'git lfs pull'",
        PAGE: 'is an HTML page, not the file: its download failed'}  # fmt: skip


@pytest.mark.parametrize('content', [POINTER, PAGE], ids=['git_lfs', 'html'])
@pytest.mark.parametrize(
    ('name', 'read', 'error'),
    [
        ('a.mp4', VideoFileFrames, EpisodeError),
        ('a.mp4', lambda path: list(frames_at(path, np.arange(3) / 10, 0.02)), EpisodeError),
        ('a.csv', lambda path: read_table(path, ['']), EpisodeError),
        ('a.json', lambda path: read_table(path, ['joints']), EpisodeError),
        ('a.mcap', lambda path: list(BagReader(path).messages()), EpisodeError),
        ('a.db3', lambda path: list(BagReader(path).messages()), EpisodeError),
        ('a.safetensors', lambda path: read_tensors(path), CheckpointError),
    ],
    ids=['video', 'video_at', 'csv', 'json', 'mcap', 'sqlite', 'weights'],
)
def test_a_file_that_stands_in_for_another_is_named(tmp_path, content, name, read, error):
    (tmp_path / name).write_text(content)
    with pytest.raises(error) as raised:
        read(tmp_path / name)
    assert f"{name}' {SAID[content]}" in str(raised.value)


def test_a_lerobot_folder_that_was_cloned_without_git_lfs_is_named(
    datasets, make_mapping, tmp_path
):
    root = shutil.copytree(datasets('v2.1'), tmp_path / 'set')
    for file in [*root.rglob('*.mp4')]:
        file.write_text(POINTER)
    failed = import_dataset(root, make_mapping(), tmp_path / 'out').failed
    assert set(failed) == {0, 1} and SAID[POINTER] in failed[0]
    for file in [*root.rglob('*.parquet')]:
        file.write_text(POINTER)
    failed = import_dataset(root, make_mapping(), tmp_path / 'out').failed
    assert 'parquet' in failed[0] and SAID[POINTER] in failed[0]
    v3 = shutil.copytree(datasets('v3.0'), tmp_path / 'v3')
    for file in [*v3.rglob('*.parquet')]:
        file.write_text(POINTER)
    with pytest.raises(EpisodeError, match='pointer of Git LFS'):
        LeRobotDataset(v3)


def test_other_files_and_missing_ones_stand_in_for_nothing(tmp_path):
    (tmp_path / 'a.csv').write_text('t,q1\n0,1\n')
    (tmp_path / 'empty').write_text('')
    assert placeholder(tmp_path / 'a.csv') == placeholder(tmp_path / 'empty') == ''
    assert placeholder(tmp_path / 'missing') == placeholder(tmp_path) == ''
