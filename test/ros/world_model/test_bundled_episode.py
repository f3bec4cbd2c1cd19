"""The node as it is installed, with the bundled checkpoint and the bundled episode."""

import signal
import subprocess
import sys

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image

from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.files import share_path
from mtv_world_ros.ros.messages.image_messages import to_rgb
from mtv_world_ros.ros.messages.stamps import NANO, to_ns

START_S = 120


@pytest.fixture
def bundled():
    try:
        share_path('resource', 'checkpoint', 'world_model.json')
        return share_path('resource', 'demo_episode')
    except ConfigError as error:
        pytest.skip(f'no bundled checkpoint or episode: {error}')


def test_bundled_episode_is_imagined_over_the_middleware(bundled, ros, tmp_path):
    values = {
        'use_sim_time': 'true',
        'compressed_input': 'true',
        'pace': 'burst',
        'num_inference_steps': '1',
        'calibration_file': bundled / 'calibration.yaml',
    }
    flags = [part for key, value in values.items() for part in ('-p', f'{key}:={value}')]
    module = [sys.executable, '-m', 'mtv_world_ros.ros.world_model.node', '--ros-args', *flags]
    process = ros.NodeProcess(module, tmp_path / 'node.log')
    client = ros.Client()
    player = None
    try:
        topics = {f'/world_model/{v}/predicted/image_raw': Image for v in ros.VIEWS}
        infos = {f'/world_model/{v}/predicted/camera_info': CameraInfo for v in ros.VIEWS}
        for topic in topics:
            client.wait(lambda t=topic: client.node.count_publishers(t), 'the node', START_S)
        client.connect_outputs(topics | infos, depth=16)
        play = [sys.executable, '-m', 'mtv_world_ros.ros.bags.player', str(bundled), '--clock']
        player = subprocess.Popen([*play, '--lock-step', '--duration', '0.5'], env=ros.ENVIRONMENT)
        client.wait(lambda: player.poll() is not None, 'the end of the episode', START_S)
        assert player.returncode == 0
        client.wait(lambda: client.report_values('done'), 'the report')
        chunks = client.report_values('chunk')
        assert chunks, process.output()
        client.wait_for_all([*topics, *infos])
        episode = read_episode(bundled)
        expected = np.arange(1, int(chunks[0]['frames']) + 1) * NANO // 5
        for topic in topics:
            images = client.received[topic][: len(expected)]
            got = [to_ns(image.header.stamp) - episode.trajectories[0][0] for image in images]
            np.testing.assert_array_equal(got, expected)
        view = next(iter(topics))
        first = to_rgb(client.received[view][0]).astype(int)
        assert first.shape == (72, 96, 3)
        assert 20 < first.mean() < 235 and first.std() > 10
        assert all(float(chunk['real_time_factor']) > 0 for chunk in chunks)
    finally:
        if player is not None and player.poll() is None:
            player.send_signal(signal.SIGINT)
            player.wait(timeout=20)
        client.close()
        assert process.stop(signal.SIGINT) == 0, process.output()
