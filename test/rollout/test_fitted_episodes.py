"""Episodes whose cameras were written after their import run on every route without ROS.

The node's is in test/own_robot/test_your_robot_page.py and test/ros/bags/test_player_recorder.py.
"""

import shutil

import numpy as np
import pytest

from mtv_world_ros import judge
from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.data.bag.copying import write_copies
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.bag.writer import BagWriter
from mtv_world_ros.data.episode_cameras import write_cameras
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.rollout.imagined_episodes import (
    EpisodeOptions,
    imagine_episodes,
    RecordedSource,
)
from mtv_world_ros.rollout.offline import replay_offline


@pytest.fixture(params=['written now', 'calibrated before'])
def fitted(request, episodes, tmp_path):
    """An episode as an import of videos leaves it, with cameras by `fit camera --apply`.

    Earlier versions wrote calibration.yaml alone.
    """
    source, path = episodes[0], tmp_path / 'fitted'
    reader = BagReader(source)
    with BagWriter(path) as writer:
        kept = (m for m in reader.messages() if not m.topic.endswith('/camera_info'))
        for _ in write_copies(reader, writer, kept):
            pass
        for name, values in reader.metadata.items():
            writer.set_metadata(name, values)
    with pytest.raises(CalibrationError, match='fit camera'):
        read_episode(path)
    if request.param == 'written now':
        assert write_cameras(path, load_calibration(source / 'calibration.yaml'))
    else:
        shutil.copy(source / 'calibration.yaml', path)
    return path


def test_offline_replay_imagine_and_judge_take_it_as_they_take_the_recorded_one(
    fitted, episodes, make_pipeline, tmp_path
):
    pipeline = make_pipeline()
    summary = replay_offline(pipeline, fitted, tmp_path / 'off', show_progress=False)
    assert summary.num_trajectories == 1 and not summary.rejected
    options = EpisodeOptions(policy='recorded', max_chunks=1)
    starts = RecordedSource(paths=(fitted,)).starts(pipeline)
    (imagined,) = imagine_episodes(pipeline, options, starts, tmp_path / 'imagined')
    assert imagined['how'] in ('done', 'max_chunks') and imagined['num_chunks'] == 1
    assert (tmp_path / 'imagined' / 'episode_00000' / 'metadata.yaml').is_file()
    found, true = (
        load_recording(path, pipeline.spec, pipeline.robot) for path in (fitted, episodes[0])
    )
    for one, other in zip(found.cameras, true.cameras, strict=True):
        np.testing.assert_array_equal(one.K, other.K)
        np.testing.assert_array_equal(one.T_mount_camera, other.T_mount_camera)
    judged, expected = judge(pipeline, found), judge(pipeline, true)
    assert judged.reasons == expected.reasons
    np.testing.assert_array_equal(judged.jaccard, expected.jaccard)
