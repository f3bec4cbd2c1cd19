"""Arrays mapped from files: the same values, no memory of their own, no open file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from mtv_world_ros.core.bounded_input import LimitError, read_arrays
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recordings import cached_recording
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.training.clips import mapped_arrays
from mtv_world_ros.training.clips.mapped_arrays import read_mapped
from mtv_world_ros.training.training_config import load_training_config


@pytest.fixture
def arrays() -> dict[str, np.ndarray]:
    """Arrays of several types and orders, small and large."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (2, 30, 36, 48, 3), np.uint8)
    return {
        'text': np.array('a name'),
        'times': np.arange(30.0),
        'frames': frames,
        'fortran': np.asfortranarray(frames[0, ..., 0]),
        'many': rng.normal(size=(1000, 14)),
        'empty': np.zeros((0, 4), np.uint8),
    }


def anonymous_bytes(file: Path) -> int | None:
    """Return the memory of its own that a mapping of a file takes; None = it is not mapped."""
    found, is_file = None, False
    for line in Path('/proc/self/smaps').read_text().splitlines():
        if '-' in line.split(' ')[0]:
            is_file = line.endswith(str(file))
        elif is_file and line.startswith('Anonymous:'):
            found = (found or 0) + 1024 * int(line.split()[1])
    return found


def test_mapped_arrays_are_those_that_were_stored(
    tmp_path: Path, arrays: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(mapped_arrays, 'MAPPED_BYTES', 1 << 12)
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / 'a.npz', **arrays)
        found = read_mapped(tmp_path / 'a.npz')
        assert found.keys() == arrays.keys() == read_arrays(tmp_path / 'a.npz').keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)
            assert found[name].dtype == array.dtype and found[name].flags.aligned


def test_mapped_frames_take_no_memory_and_keep_no_file_open(
    tmp_path: Path, arrays: dict[str, np.ndarray]
):
    file = tmp_path / 'a.npz'
    np.savez(file, **arrays)
    found = read_mapped(file)
    assert int(found['frames'].sum()) == int(arrays['frames'].sum())  # all pages are read
    assert anonymous_bytes(file) == 0
    opened = [os.path.realpath(f'/proc/self/fd/{fd}') for fd in os.listdir('/proc/self/fd')]
    assert str(file) not in opened
    file.unlink()
    np.testing.assert_array_equal(found['frames'], arrays['frames'])


def test_writing_to_a_mapped_array_leaves_the_file_as_it_is(
    tmp_path: Path, arrays: dict[str, np.ndarray]
):
    np.savez(tmp_path / 'a.npz', **arrays)
    before = (tmp_path / 'a.npz').read_bytes()
    read_mapped(tmp_path / 'a.npz')['frames'][:] = 0
    assert (tmp_path / 'a.npz').read_bytes() == before


def test_damaged_files_are_refused(tmp_path: Path, arrays: dict[str, np.ndarray]):
    file = tmp_path / 'a.npz'
    np.savez(file, **arrays)
    whole = file.read_bytes()
    at = whole.index(b'(2, 30, 36, 48, 3)')
    more = whole[:at] + b'(9, 30, 36, 48, 3)' + whole[at + 18 :]
    for content in (whole[: len(whole) // 2], b'no archive', b'', more):
        file.write_bytes(content)
        with pytest.raises(ValueError, match='BadZipFile|bytes for shape'):
            read_mapped(file)
    with pytest.raises(OSError, match='No such file'):
        read_mapped(tmp_path / 'b.npz')


def test_arrays_of_more_bytes_than_the_limit_are_refused(
    tmp_path: Path, arrays: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
):
    np.savez(tmp_path / 'a.npz', **arrays)
    monkeypatch.setenv('MTV_WORLD_MAX_ARRAY_BYTES', '100000')
    with pytest.raises(LimitError):
        read_mapped(tmp_path / 'a.npz')


def test_a_recording_made_anew_is_mapped_from_the_cache(tmp_path: Path):
    episode = share_path('resource', 'demo_episode')
    spec, robot = load_training_config('small').spec, load_robot(robot_path('yam_bimanual'))
    for _ in range(2):  # made, then found
        found = cached_recording(episode, spec, robot, tmp_path, read=read_mapped)
        (file,) = tmp_path.glob('*.npz')
        assert anonymous_bytes(file) == 0
        usual = cached_recording(episode, spec, robot, tmp_path)
        np.testing.assert_array_equal(found.frames, usual.frames)
        np.testing.assert_array_equal(found.object_ids, usual.object_ids)
        del found
        assert anonymous_bytes(file) is None
    file.write_bytes(file.read_bytes()[:1000])
    repaired = cached_recording(episode, spec, robot, tmp_path, read=read_mapped)
    np.testing.assert_array_equal(repaired.frames, usual.frames)
