"""The node as it is installed, with the bundled checkpoint and the bundled episode."""

import importlib
import os
from pathlib import Path
import resource
import signal
import subprocess
import sys

from action_msgs.msg import GoalStatus
import numpy as np
import pytest
from rclpy.action import ActionClient
from sensor_msgs.msg import CameraInfo, Image

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.ros.messages.conversions import NANO, to_ns
from mtv_world_ros.ros.messages.image_messages import to_rgb

START_S = 120
NODE = ('-m', 'mtv_world_ros.ros.world_model.node')
CHUNK_S = 3.2


@pytest.fixture
def bundled():
    try:
        share_path('resource', 'checkpoint', 'world_model.json')
        return share_path('resource', 'demo_episode')
    except ConfigError as error:
        pytest.skip(f'no bundled checkpoint or episode: {error}')


@pytest.mark.slow
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
            player.wait(timeout=120)
        client.close()
        assert process.stop(signal.SIGINT) == 0, process.output()


@pytest.fixture
def started(bundled, ros, tmp_path):
    """The node with the bundled model, and a client that has shown it a scene."""
    values = ('pace:=burst', 'max_image_age_s:=600.0', 'max_joint_state_age_s:=600.0',
              'max_horizon_s:=600.0')  # fmt: skip
    process = ros.start_node_process(tmp_path, *values, program=NODE)
    client = ros.Client()
    client.wait(client.diagnostic_values, 'the node', START_S)
    client.connect_inputs(ros.INPUTS)
    client.send_scene()
    yield process, client
    client.close()
    assert process.stop() == 0, process.output()
    assert 'Traceback' not in process.output(), process.output()


def cpu_s(pid):
    """CPU time that a process has used [s], all threads."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def ended_children_cpu_s():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.slow
def test_sigint_while_the_bundled_model_computes_ends_the_node(started):
    process, client = started
    client.send_trajectory(seconds=40 * CHUNK_S)
    client.wait_for_state('chunk', 0)
    said = process.output()
    before_s = ended_children_cpu_s() + cpu_s(process.process.pid)
    assert process.stop(signal.SIGINT) == 0, process.output()
    # CPU time, since this machine may be busy; 0.2 s were measured
    assert ended_children_cpu_s() - before_s < 1.0
    assert len(process.output().splitlines()) <= len(said.splitlines()) + 1, process.output()


@pytest.mark.control_msgs
def test_a_goal_is_cancelled_while_the_bundled_model_computes(started, ros):
    _, client = started
    messages = importlib.import_module('control_msgs.action').FollowJointTrajectory
    actions = ActionClient(client.node, messages, '/world_model/follow_joint_trajectory')
    client.wait(actions.server_is_ready, 'the action')
    feedback = []
    trajectory = ros.make_trajectory(seconds=40 * CHUNK_S)
    asked = actions.send_goal_async(messages.Goal(trajectory=trajectory), feedback.append)
    client.wait(asked.done, 'acceptance')
    handle = asked.result()
    client.wait(lambda: feedback, 'a chunk')
    answer, result = handle.cancel_goal_async(), handle.get_result_async()
    client.wait(answer.done, 'an answer')
    assert answer.result().goals_canceling
    client.wait(result.done, 'a result')
    assert result.result().status == GoalStatus.STATUS_CANCELED
    assert 'of 40 chunks imagined' in result.result().result.error_string
    assert client.wait_for_ends(1, 0)[0]['state'] == 'preempted'
    actions.destroy()
    assert client.imagine_one()['state'] == 'done'  # the node goes on
