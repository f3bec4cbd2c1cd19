"""`mtv-world check --live` records what a player publishes, over the real middleware."""

import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed (pip install .[ros])')

from mtv_world_ros.core.errors import ConfigError, EpisodeError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.inspection.live import record_topics


@pytest.fixture
def player():
    episode = str(share_path('resource', 'demo_episode'))
    command = [
        sys.executable,
        '-m',
        'mtv_world_ros.ros.bags.player',
        episode,
        '--loop',
        '--no-wait',
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    yield
    process.send_signal(signal.SIGINT)
    process.wait(timeout=120)


def test_running_topics_become_a_bag_that_can_be_checked(player, tmp_path):
    bag = record_topics(('low', 'high'), tmp_path / 'live', 3.0)
    calibration = share_path('resource', 'demo_episode', 'calibration.yaml')
    episode = read_episode(bag, views=('low', 'high'), calibration=calibration, with_masks=False)
    # 10 Hz for 3 s, of which a busy machine loses some
    assert len(episode.images['low'].frames) >= 10
    assert episode.images['high'].frames[0].shape == (288, 384, 3)
    assert len(episode.joint_states.stamps_ns) >= 50


def test_silence_is_an_error_that_names_the_topic(tmp_path):
    with pytest.raises(EpisodeError, match="nobody publishes .*'/joint_states'"):
        record_topics(('low',), tmp_path / 'live', 1.0, wait_s=0.5)
    assert not (tmp_path / 'live').exists()


def test_no_time_is_refused(tmp_path):
    with pytest.raises(ConfigError, match='--seconds is 0'):
        record_topics(('low',), tmp_path / 'live', 0)
