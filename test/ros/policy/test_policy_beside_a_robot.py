"""The policy node in observe mode: real cameras, the world model beside it."""

import json
import sys

import pytest

from mtv_world_ros.ros.messages.conversions import values_of


@pytest.fixture
def observing_policy(tmp_path, ros):
    ros.make_checkpoint(tmp_path / 'checkpoint')
    world = ros.start_node(tmp_path, 'pace:=burst', 'max_image_age_s:=1.5')
    policy = ros.start_policy(
        tmp_path, 'mode:=observe', 'max_image_age_s:=1.5', 'observation_timeout_s:=3.0'
    )
    yield policy
    assert [process.stop() for process in (policy, world)] == [0, 0]


def test_in_observe_mode_a_camera_that_stops_ends_the_episode_and_says_so(observing_policy, ros):
    client = ros.Client()
    try:
        client.subscribe(ros.REPORT, '/policy/report', 100)
        client.wait(client.diagnostic_values, 'the world model')
        client.connect_inputs({t: k for t, k in ros.INPUTS.items() if t != '/joint_trajectory'})

        def reports():
            return [values_of(s) for s in client.statuses('/policy/report')]

        assert client.call(ros.TRIGGER, '/policy/start', ros.TRIGGER.Request()).success
        client.wait(lambda: reports(), 'the begin')

        def has_chunk():
            client.send_scene()
            client.spin_for(0.1)
            return any(r['state'] == 'chunk' for r in reports())

        client.wait(has_chunk, 'a chunk')
        client.wait(lambda: reports()[-1]['state'] == 'ended', 'the end')
        end = reports()[-1]
        assert end['how'] == 'no_observation'
        assert end['text'].startswith('image_stale: ')
        client.wait(
            lambda: any(
                s.name == 'policy' and s.message.startswith('no_observation: image_stale')
                for s in client.statuses('/diagnostics')
            ),
            'the warning',
        )
    finally:
        client.close()


def test_an_imagined_episode_starts_from_what_the_cameras_show(tmp_path, ros):
    """The cameras go on; the episode does not look at them again."""
    ros.make_checkpoint(tmp_path / 'checkpoint')
    options = {'remaps': ros.JOINT_STATES}
    strict = ('pace:=burst', 'mode:=imagine', 'max_trajectory_age_s:=0.001')
    world = ros.start_node(tmp_path, *strict, *ros.FROZEN, **options)
    policy = ros.start_policy(tmp_path, *ros.FROZEN, **options)
    out = tmp_path / 'out'
    command = [
        sys.executable,
        '-m',
        'mtv_world_ros.ros.episodes.episode_runner',
        str(out),
        '--live',
    ]
    command += ['--views', 'low', 'high', '--count', '2', '--max-chunks', '2', '--no-record']
    runner = ros.NodeProcess(command, tmp_path / 'runner.log')
    client = ros.Client()
    try:
        cameras = {t: k for t, k in ros.INPUTS.items() if t != '/joint_trajectory'}
        client.wait(lambda: client.node.count_subscribers('/low/image_raw'), 'the runner')
        client.connect_inputs(cameras)

        def has_ended():
            client.send_scene()
            client.spin_for(0.1)
            return runner.process.poll() is not None

        client.wait(has_ended, 'the end', timeout_s=60.0)
        assert runner.process.returncode == 0, runner.output()
    finally:
        client.close()
        for process in (runner, policy, world):
            process.stop()
    results = json.loads((out / 'episodes.json').read_text())
    found = [(r['start'], r['how'], r['num_chunks']) for r in results]
    assert found == [('live', 'max_chunks', '2')] * 2
