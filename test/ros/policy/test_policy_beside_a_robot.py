"""The policy node in observe mode: real cameras, the world model beside it."""

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
    """The cameras go on; the episode does not look at them again, and the next one starts anew."""
    ros.make_checkpoint(tmp_path / 'checkpoint')
    world = ros.start_node(tmp_path, 'pace:=burst', 'mode:=imagine')
    policy = ros.start_policy(tmp_path, 'max_image_age_s:=1.5', 'max_chunks:=2')
    client = ros.Client()
    try:
        client.subscribe(ros.REPORT, '/policy/report', 100)
        client.connect_inputs({t: k for t, k in ros.INPUTS.items() if t != '/joint_trajectory'})

        def ends():
            reports = map(values_of, client.statuses('/policy/report'))
            return [(v['how'], v['num_chunks']) for v in reports if v['state'] == 'ended']

        def has_ended(number):
            client.send_scene()
            client.spin_for(0.05)
            return len(ends()) == number

        for number in (1, 2):
            assert client.call(ros.TRIGGER, '/policy/start', ros.TRIGGER.Request()).success
            client.wait(lambda number=number: has_ended(number), 'the end')
        assert ends() == [('max_chunks', '2')] * 2
        starts = [v['observation_stamp_ns'] for v in client.report_values('chunk')][::2]
        assert int(starts[0]) < int(starts[1])
    finally:
        client.close()
        for process in (policy, world):
            assert process.stop() == 0, process.output()
