from __future__ import annotations

import contextlib
from pathlib import Path
import shutil
from typing import Any

import numpy as np
import pytest
import yaml

from mtv_world_ros.core.errors import CalibrationError, EpisodeError, MtvWorldError
from mtv_world_ros.data.episode_reader import list_episodes, read_episode, read_info
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.robot.file import load_robot, robot_path
from test.support.unknown_cameras import forget_poses

START_NS, PERIOD_NS, FRAMES = 1_700_000_000_000_000_000, 100_000_000, 8


def expected_picture(index: int) -> np.ndarray:
    y, x = np.mgrid[:48, :64]
    planes = [(x * 3 + 10 * index) % 256, y * 4, np.full_like(x, 20 * index % 256)]
    return np.stack(planes, axis=-1).clip(0, 255).astype(np.uint8)


def read(path: Path, **options: Any):
    return read_episode(path, with_cameras=False, **options)


def test_what_was_written_is_read_back(episode_path):
    episode = read_episode(episode_path)
    info = episode.info
    assert (info.task, info.outcome, info.seed) == ('stack_blocks_two', 'success', 7)
    assert info.objects == ('red block', 'blue block')
    assert info.instruction == 'stack the red block on the blue block'
    assert (info.robot, info.metadata) == ('yam_bimanual', {'simulator': 'test'})
    assert episode.views == ('low', 'high')
    assert (episode.truncated, episode.warnings) == (False, ())
    assert episode.instructions == [(START_NS, info.instruction)]
    expected_stamps = START_NS + PERIOD_NS * np.arange(FRAMES)
    for view in episode.views:
        stamps, frames = episode.images[view]
        np.testing.assert_array_equal(stamps, expected_stamps)
        assert stamps.dtype == np.int64
        decoded = np.asarray(frames)
        assert decoded.shape == (FRAMES, 48, 64, 3)
        for index in range(FRAMES):
            error = decoded[index].astype(int) - expected_picture(index)
            assert abs(error).mean() < 3
    states = episode.joint_states
    assert states is not None
    np.testing.assert_array_equal(states.stamps_ns, expected_stamps)
    assert states.joint_names == ('left_joint1', 'left_joint2', 'left_gripper')
    np.testing.assert_array_equal(states.positions[3], [3, 1, -3])
    ((stamp, trajectory),) = episode.trajectories
    assert stamp == START_NS
    np.testing.assert_allclose(trajectory.times, [0.1, 0.25, 0.5], atol=1e-9)
    np.testing.assert_array_equal(trajectory.positions, np.arange(9.0).reshape(3, 3) / 7)
    np.testing.assert_array_equal(trajectory.velocities, np.arange(9.0).reshape(3, 3) / 7 * 2)


def test_raw_images_and_masks_come_back_exactly(make_episode):
    episode = read_episode(make_episode('raw', compressed=False))
    for index in range(FRAMES):
        np.testing.assert_array_equal(episode.images['low'].frames[index], expected_picture(index))
    assert episode.masks is not None
    ids = np.asarray(episode.masks['high'].frames)
    assert (ids.shape, ids.dtype) == ((FRAMES, 48, 64), np.uint8)
    expected = np.zeros((48, 64), np.uint8)
    expected[5:15, 9:24], expected[30:40, 30:50] = 1, 2
    np.testing.assert_array_equal(ids[4], expected)
    assert read_episode(episode.info.path, with_masks=False).masks is None


def test_cameras_come_from_the_folder_and_from_camera_info(episode_path):
    cameras = read_episode(episode_path).cameras
    low = cameras['low']
    assert (low.view, low.width, low.height, low.mount_link) == ('low', 64, 48, 'base')
    np.testing.assert_allclose(low.K, [[70.4, 0, 32], [0, 71.4, 24], [0, 0, 1]])
    np.testing.assert_allclose(low.T_mount_camera[:3, 3], [0.1, 0.2, 0.3])
    assert low.distortion_model == 'none'


def test_frames_are_decoded_one_by_one_or_in_slices(episode_path):
    frames = read_episode(episode_path).images['low'].frames
    everything = np.asarray(frames)
    assert len(frames) == FRAMES
    np.testing.assert_array_equal(frames[-1], everything[-1])
    np.testing.assert_array_equal(frames[2:6:2], everything[[2, 4]])
    np.testing.assert_array_equal(frames[[5, 0]], everything[[5, 0]])
    assert np.asarray(frames, dtype=np.float32).dtype == np.float32
    with pytest.raises(IndexError):
        frames[FRAMES]


def test_views_are_given_in_the_order_asked_for(episode_path):
    episode = read_episode(episode_path, views=('high', 'low'))
    assert episode.views == tuple(episode.images) == tuple(episode.cameras) == ('high', 'low')
    assert read_episode(episode_path, views=['high']).views == ('high',)


def test_a_missing_view_is_named_with_those_that_are_there(make_episode):
    path = make_episode('single', views=('high',))
    assert read_episode(path).views == ('high',)
    with pytest.raises(EpisodeError, match=r"no view 'low'.*its views are high.*`topics`"):
        read_episode(path, views=('low', 'high'))
    match = r"of another robot: '\w+', not 'franka': .*no view 'low'"
    with pytest.raises(EpisodeError, match=match):
        read_episode(path, views=('low',), robot=load_robot(robot_path('franka')))
    with pytest.raises(EpisodeError, match=r"no view 'hihg'.*did you mean 'high'"):
        read_episode(path, views=('hihg',))


def test_a_cut_episode_is_read_up_to_the_cut_and_says_so(make_episode, tmp_path):
    path = make_episode('long')
    file = path / 'long_0.mcap'
    content = file.read_bytes()
    outcomes = set()
    for length in range(0, len(content) - 1, max(len(content) // 40, 1)):
        file.write_bytes(content[:length])
        try:
            episode = read_episode(path)
        except EpisodeError as error:
            assert 'cut off' in str(error)
            outcomes.add('refused')
            continue
        if episode.truncated:
            assert 'cut off' in episode.warnings[0]
        assert episode.info.task == 'stack_blocks_two'  # from metadata.yaml
        outcomes.add('cut' if episode.truncated else 'whole')
    assert outcomes >= {'refused', 'whole'}


def test_without_calibration_the_file_to_add_is_named(make_episode):
    path = make_episode('bare')
    calibration = (path / 'calibration.yaml').read_text()
    forget_poses(path)
    (path / 'elsewhere.yaml').write_text(calibration)
    with pytest.raises(CalibrationError, match=r'bare/calibration.yaml.*poses'):
        read_episode(path)
    assert read(path).cameras == {}
    assert 'low' in read_episode(path, calibration=path / 'elsewhere.yaml').cameras
    with pytest.raises(CalibrationError, match='missing.yaml'):
        read_episode(path, calibration=path / 'missing.yaml')


def test_a_view_without_calibration_is_named(make_episode):
    path = make_episode('half')
    content = yaml.safe_load((path / 'calibration.yaml').read_text())
    del content['views']['high']
    (path / 'calibration.yaml').write_text(yaml.safe_dump(content))
    with pytest.raises(CalibrationError, match=r"no view 'high'; it has low"):
        read_episode(path)
    assert tuple(read_episode(path, views=['low']).cameras) == ('low',)


def test_info_is_read_with_and_without_metadata_yaml(make_episode):
    path = make_episode('episode')
    expected = read_info(path)
    assert (expected.task, expected.outcome, expected.seed) == ('stack_blocks_two', 'success', 7)
    (path / 'metadata.yaml').unlink()
    assert read_info(path) == expected
    assert read_info(path / 'episode_0.mcap').objects == ('red block', 'blue block')


def test_unfinished_episodes_are_not_listed(make_episode, tmp_path):
    paths = [make_episode('b'), make_episode('a')]
    shutil.copytree(paths[0], tmp_path / '.c.1234.tmp')
    (tmp_path / 'notes').mkdir()
    assert list_episodes(tmp_path) == [tmp_path / 'a', tmp_path / 'b']


@pytest.mark.parametrize('seed', range(12))
def test_a_damaged_file_never_ends_in_another_error(seed, episode_path, tmp_path):
    rng = np.random.default_rng(seed)
    content = bytearray((episode_path / 'episode_0.mcap').read_bytes())
    for position in rng.integers(0, len(content), 4):
        content[position] = rng.integers(0, 256)
    shutil.copytree(episode_path, tmp_path / 'episode')
    (tmp_path / 'episode' / 'episode_0.mcap').write_bytes(content)
    with contextlib.suppress(MtvWorldError):
        episode = read_episode(tmp_path / 'episode')
        assert all(np.asarray(track.frames).ndim == 4 for track in episode.images.values())


@pytest.mark.parametrize(('every', 'is_used'), [(1, True), (4, False)])
def test_masks_of_another_rate_than_the_images_are_not_used_and_said(tmp_path, every, is_used):
    """A mask of every fourth image stood for the three that follow."""
    path = tmp_path / 'e'
    with EpisodeWriter(
        path, task='', instruction='lift', robot='franka', objects=('cup',)
    ) as writer:
        for k in range(12):
            stamp = START_NS + k * 2 * 10**8
            writer.write_image('door', stamp, np.zeros((24, 32, 3), np.uint8))
            if k % every == 0:
                writer.write_mask('door', stamp, np.ones((24, 32), np.uint8))
    episode = read_episode(path, with_cameras=False)
    assert (episode.masks is not None) == is_used
    said = [text for text in episode.warnings if 'no mask of their time' in text]
    assert len(said) == (not is_used)
    if said:
        assert (
            "view 'door': 75% of its 12 images have no mask of their time (3 masks, up to "
            in (said[0])
        )
