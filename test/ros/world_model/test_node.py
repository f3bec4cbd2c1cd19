"""What the running node publishes, in both modes, and how it is steered."""

import math
import time

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from std_msgs.msg import Float32MultiArray, Float64, String

from mtv_world_ros.ros.messages.conversions import to_ns
from mtv_world_ros.ros.messages.image_messages import to_rgb

NUM_FRAMES, FRAME_NS, BLOCKS = 4, 200_000_000, 1200
CHUNK_S = 0.8
PREDICTED = {view: f'/world_model/{view}/predicted/image_raw' for view in ('low', 'high')}
INFO = '/world_model/low/predicted/camera_info'
JPEG = f'{PREDICTED["low"]}/compressed'
TRAJECTORY, MASK = '/world_model/low/trajectory/image_raw', '/world_model/low/mask/image_raw'
JOINTS = '/world_model/predicted/joint_states'
SUCCESS, JACCARD = '/world_model/success', '/world_model/jaccard'
OUTPUTS = {
    PREDICTED['low']: Image,
    PREDICTED['high']: Image,
    INFO: CameraInfo,
    JPEG: CompressedImage,
    TRAJECTORY: Image,
    MASK: Image,
    JOINTS: JointState,
    SUCCESS: Float64,
    JACCARD: Float32MultiArray,
}
FRAME_TOPICS = [topic for topic in OUTPUTS if topic not in (SUCCESS, JACCARD, MASK)]


@pytest.fixture(scope='module')
def node(tmp_path_factory, ros, client):
    process = ros.start_node(tmp_path_factory.mktemp('node'), 'pace:=burst')
    client.connect_outputs(OUTPUTS)
    client.connect_inputs(ros.INPUTS)
    client.send_scene()
    client.publish('/instruction', String(data='stack the red block on the blue block'))
    yield process
    code = process.stop()
    assert code == 0, process.output()


@pytest.fixture(autouse=True)
def forget(node, client):
    """Each test starts in observe mode, with nothing received and nothing on its way."""
    client.set(pace='burst', stamp_mode='target', seed=0)
    client.imagine(False)
    client.reset()
    client.settle(FRAME_TOPICS)
    for topic in OUTPUTS:
        client.received[topic].clear()


def stamps(messages):
    return [to_ns(message.header.stamp) for message in messages]


def wait_for_frames(client, number, topic=PREDICTED['low']):
    client.wait(lambda: len(client.received[topic]) >= number, f'{number} frames on {topic}')


def test_every_frame_arrives_in_order_stamped_in_the_future(client):
    now_ns = client.send_scene()
    client.set(seed=42)
    assert client.imagine_one(scene='sent')['state'] == 'done'
    expected = [now_ns + (k + 1) * FRAME_NS for k in range(NUM_FRAMES)]
    for topic in PREDICTED.values():
        wait_for_frames(client, NUM_FRAMES, topic)
        messages = client.received[topic]
        assert stamps(messages) == expected
        first_pixels = [to_rgb(message)[0, 0, :2].tolist() for message in messages]
        assert first_pixels == [[42, k] for k in range(NUM_FRAMES)]
    assert client.received[PREDICTED['low']][0].header.frame_id == 'low_optical_frame'
    assert client.received[PREDICTED['high']][0].header.frame_id == 'high_optical_frame'


def test_a_frame_that_one_test_lost_is_not_awaited_by_the_next(client, ros, monkeypatch):
    monkeypatch.setattr(ros, 'ANSWER_LOST_S', 0.2)
    client.imagine_one(scene='sent')
    client.wait_for_all(FRAME_TOPICS)
    client.totals[PREDICTED['low']] -= 1
    client.settle(FRAME_TOPICS)
    client.imagine_one(scene='sent')
    client.wait_for_all(FRAME_TOPICS)


def test_camera_info_goes_with_every_image_at_its_size(client):
    client.imagine_one()
    client.wait_for_all(FRAME_TOPICS)
    images, infos = client.received[PREDICTED['low']], client.received[INFO]
    assert stamps(images) == stamps(infos)
    info = infos[0]
    assert (info.width, info.height) == (images[0].width, images[0].height) == (48, 36)
    # half the size of the source: focal lengths halve, pixel centres stay at integers
    np.testing.assert_allclose(info.k, [45, 0, 23.5, 0, 45, 17.5, 0, 0, 1])
    np.testing.assert_allclose(info.p, [45, 0, 23.5, 0, 0, 45, 17.5, 0, 0, 0, 1, 0])
    assert info.header.frame_id == 'low_optical_frame'


def test_trajectory_video_masks_joints_and_jpeg_go_with_the_frames(client):
    client.imagine_one()
    client.wait_for_all(FRAME_TOPICS)
    wait_for_frames(client, NUM_FRAMES, MASK)
    expected = stamps(client.received[PREDICTED['low']])
    for topic in (JPEG, TRAJECTORY, MASK, JOINTS):
        assert stamps(client.received[topic]) == expected
    assert to_rgb(client.received[TRAJECTORY][-1]).max() > 0
    labels = np.unique(to_rgb(client.received[MASK][0]))
    assert labels.tolist() == [0, 1, 2]  # nothing, red block, blue block
    raw, jpeg = to_rgb(client.received[PREDICTED['low']][1]), to_rgb(client.received[JPEG][1])
    assert np.abs(raw.astype(int) - jpeg).mean() < 8
    turns = [message.position[0] for message in client.received[JOINTS]]
    np.testing.assert_allclose(turns, [0.0, 0.2 / 3, 0.4 / 3, 0.2], atol=1e-6)
    assert client.received[JOINTS][0].name[0] == 'left_joint1'


def test_estimate_is_published_with_its_dimensions_named(client):
    client.imagine_one()
    client.wait(lambda: client.received[JACCARD] and client.received[SUCCESS], 'the estimate')
    probability = client.received[SUCCESS][0].data
    assert math.isnan(probability) or 0 <= probability <= 1
    layout = client.received[JACCARD][0].layout.dim
    assert [d.label for d in layout] == ['view: low, high', 'object: red block, blue block']
    assert [(d.size, d.stride) for d in layout] == [(2, 4), (2, 2)]


def test_report_identifies_the_plan_and_says_when_and_how_long(client):
    client.set(seed=7)
    stamp_ns = client.send_scene()
    client.imagine_one(scene='sent', stamp_ns=stamp_ns, seconds=1.6)
    chunks = client.report_values('chunk')[-2:]
    assert [c['chunk'] for c in chunks] == ['0', '1']
    for c in chunks:
        assert c['trajectory_stamp_ns'] == str(stamp_ns)
        assert c['observation_stamp_ns'] == c['source_stamp_ns'] == str(stamp_ns)
        assert c['instruction'] == 'stack the red block on the blue block'
        assert (c['num_chunks'], c['frames']) == ('2', '4')
        assert float(c['latency_s']) > float(c['stage_s.model']) > 0
        assert 'jaccard.low.red_block' in c and 'mask_status.high.blue_block' in c
    assert [c['chunk_seed'] for c in chunks] == ['7', '8']
    ended = client.report_values('done')[-1]
    assert ended['success_reasons'] == chunks[-1]['success_reasons']
    client.wait_for_all(FRAME_TOPICS)
    sent = client.report_values('published')[-2:]
    assert [(p['rollout'], p['chunk']) for p in sent] == [
        (c['rollout'], c['chunk']) for c in chunks
    ]
    for p in sent:
        assert (p['frames_published'], p['frames_dropped']) == ('4', '0')
        assert float(p['first_frame_s']) <= float(p['last_frame_s'])


def test_trajectory_times_count_from_its_stamp(client):
    stamp_ns = client.send_scene()
    client.imagine_one(scene='sent', stamp_ns=stamp_ns - 400_000_000)
    client.wait_for_all(FRAME_TOPICS)
    assert stamps(client.received[PREDICTED['low']]) == [
        stamp_ns + FRAME_NS,
        stamp_ns + 2 * FRAME_NS,
    ]
    turns = [m.position[0] for m in client.received[JOINTS]]
    np.testing.assert_allclose(turns, [0.4 / 3, 0.2], atol=1e-6)


def test_source_stamps_are_the_observations(client):
    client.set(stamp_mode='source')
    stamp_ns = client.send_scene()
    client.imagine_one(scene='sent')
    wait_for_frames(client, NUM_FRAMES)
    assert stamps(client.received[PREDICTED['low']]) == [stamp_ns] * NUM_FRAMES
    assert client.report_values('chunk')[-1]['first_stamp_ns'] == str(stamp_ns + FRAME_NS)


def test_newer_trajectory_pre_empts_the_running_one(client):
    since = len(client.report_values())
    client.set(seed=BLOCKS)
    client.send_scene()
    client.send_trajectory_and_wait_until_it_runs()
    client.set(seed=3)
    client.send_scene()
    client.send_trajectory()
    client.wait_for_state('done', since)
    states = [r['state'] for r in client.report_values()[since:] if r['state'] != 'published']
    assert states == ['preempted', 'chunk', 'done']
    wait_for_frames(client, NUM_FRAMES)
    assert to_rgb(client.received[PREDICTED['low']][0])[0, 0, 0] == 3


def test_refused_trajectory_does_not_pre_empt(client):
    client.set(seed=BLOCKS)
    client.send_scene()
    client.send_trajectory_and_wait_until_it_runs()
    since = len(client.report_values())
    client.send_trajectory(times=(0.4, 0.2, 0.6, 0.8))
    assert client.next_end(since)['state'] == 'rejected'
    client.set(seed=0)
    client.send_scene()
    client.send_trajectory()
    assert client.next_end(since + 1)['state'] == 'preempted'
    client.wait_for_state('done', since)


@pytest.mark.parametrize('names', [(), 'robot'])
def test_an_empty_trajectory_stops_the_running_plan_and_is_answered_once(client, ros, names):
    client.set(seed=BLOCKS)
    client.send_scene()
    client.send_trajectory_and_wait_until_it_runs()
    since = len(client.report_values())
    named = {} if names == 'robot' else {'names': names}
    stamp_ns = client.now_ns()
    client.send_trajectory(times=(), positions=(), stamp_ns=stamp_ns, **named)
    running, empty = client.wait_for_ends(2, since)
    assert (running['state'], running['text']) == ('preempted', 'an empty trajectory stopped it')
    assert (empty['state'], empty['num_chunks']) == ('done', '0')
    assert empty['trajectory_stamp_ns'] == str(stamp_ns) and 'no points' in empty['text']
    client.set(seed=0)  # the node goes on
    assert client.imagine_one()['state'] == 'done'
    assert len([v for v in client.report_values()[since:] if v['state'] in ros.ENDS]) == 3


def test_an_empty_trajectory_drops_frames_that_are_not_out_yet(client):
    client.set(pace='realtime')
    since = len(client.report_values())
    client.send_scene()
    client.send_trajectory(seconds=8.0)
    client.wait_for_state('done', since)  # its frames go on for eight seconds
    client.send_trajectory(times=(), positions=())
    client.wait_for_ends(2, since)
    client.wait_for_all(FRAME_TOPICS)
    sent = [r for r in client.report_values()[since:] if r['state'] == 'published']
    assert sum(int(r['frames_dropped']) for r in sent) >= NUM_FRAMES


def test_newer_chunk_drops_frames_of_a_plan_that_no_longer_holds(client):
    client.set(pace='realtime')
    since = len(client.report_values())
    client.send_scene()
    client.send_trajectory(seconds=8.0)
    client.wait_for_state('done', since)  # its frames go on for eight seconds
    client.send_scene()
    client.send_trajectory()
    client.wait_for_ends(2, since)
    client.wait_for_all(FRAME_TOPICS)
    *older, newer = [r for r in client.report_values()[since:] if r['state'] == 'published']
    sent = [(int(r['frames_published']), int(r['frames_dropped'])) for r in older]
    assert all(published + dropped == NUM_FRAMES for published, dropped in sent)
    assert sum(dropped for _, dropped in sent) >= 1
    assert (newer['frames_published'], newer['frames_dropped']) == (str(NUM_FRAMES), '0')


def test_imagine_mode_goes_on_without_gap_or_overlap(client):
    assert client.imagine(True).message == 'imagine'
    start_ns = client.send_scene()
    client.imagine_one(scene='sent', seconds=CHUNK_S)
    for chunk in (1, 2):  # the policy answers to what it was shown, three chunks in all
        wait_for_frames(client, chunk * NUM_FRAMES, JOINTS)
        seen_ns = to_ns(client.received[JOINTS][-1].header.stamp)
        ended = client.imagine_one(scene='none', stamp_ns=seen_ns, seconds=CHUNK_S)
        assert (ended['state'], ended['mode']) == ('done', 'imagine')
    wait_for_frames(client, 3 * NUM_FRAMES)
    messages = client.received[PREDICTED['low']]
    assert stamps(messages) == [start_ns + (k + 1) * FRAME_NS for k in range(3 * NUM_FRAMES)]
    # the fake moves the picture by a pixel a frame: the last has been moved by all twelve
    first, last = to_rgb(messages[0]), to_rgb(messages[-1])
    np.testing.assert_array_equal(np.roll(first, 11, axis=1)[1:], last[1:])
    chunks = client.report_values('chunk')[-3:]
    assert {c['source_stamp_ns'] for c in chunks} == {str(start_ns)}
    assert len({c['observation_stamp_ns'] for c in chunks}) == 3


def test_a_plan_that_overtakes_what_it_answers_waits_for_it(client):
    client.imagine(True)
    client.send_scene()
    since, stamp_ns = len(client.report_values()), client.now_ns()
    client.send_trajectory(stamp_ns=stamp_ns)
    time.sleep(0.1)
    client.send_scene(stamp_ns)
    assert client.next_end(since)['state'] == 'done'
    assert client.report_values('chunk')[-1]['source_stamp_ns'] == str(stamp_ns)


def test_history_and_anchor_go_on_over_requests_until_reset(client):
    def shown(message):  # what the fake writes into each frame of its history
        pixels = to_rgb(message)[0]
        return *pixels[1, :2].tolist(), *pixels[2].tolist()

    client.imagine(True)
    client.imagine_one(seconds=CHUNK_S)
    client.imagine_one(scene='none', seconds=2 * CHUNK_S)
    wait_for_frames(client, 3 * NUM_FRAMES)
    first, second, third = map(shown, client.received[PREDICTED['low']][::NUM_FRAMES])
    assert first[:2] == (0, 255)
    # the last frame starts a chunk; its history ends with the one before, the third of its chunk
    assert second[:2] == third[:2] == (3, NUM_FRAMES - 2)
    assert first[2:] == second[2:] == third[2:]
    assert client.reset().success
    client.received[PREDICTED['low']].clear()
    client.imagine_one(seconds=CHUNK_S)
    wait_for_frames(client, NUM_FRAMES)
    assert shown(client.received[PREDICTED['low']][0])[:2] == (0, 255)


def test_imagine_mode_needs_no_cameras_after_the_first_chunk(client):
    client.imagine(True)
    assert client.imagine_one()['state'] == 'done'
    client.set(max_image_age_s=0.001)
    assert client.imagine_one(scene='none')['state'] == 'done'
    client.imagine(False)
    assert client.imagine_one(scene='none')['reason'] == 'image_stale'
    client.set(max_image_age_s=10.0)


def test_late_answer_in_imagine_mode_is_refused(client):
    client.set(max_trajectory_age_s=0.5)
    client.imagine(True)
    start_ns = client.send_scene()
    assert client.imagine_one(scene='sent')['state'] == 'done'
    late = client.imagine_one(scene='none', stamp_ns=start_ns)
    client.set(max_trajectory_age_s=1.0)
    assert late['reason'] == 'trajectory_stale'
    in_time = client.imagine_one(scene='none', stamp_ns=start_ns + 4 * FRAME_NS)
    assert in_time['state'] == 'done'


def test_pre_emption_in_imagine_mode_goes_on_from_the_last_whole_chunk(client):
    client.imagine(True)
    start_ns = client.send_scene()
    client.imagine_one(scene='sent')
    client.set(seed=BLOCKS)
    client.send_trajectory_and_wait_until_it_runs()
    client.set(seed=0)
    since = len(client.report_values())
    client.send_trajectory()
    assert client.next_end(since)['state'] == 'preempted'
    wait_for_frames(client, 2 * NUM_FRAMES)
    got = stamps(client.received[PREDICTED['low']])
    assert got == [start_ns + (k + 1) * FRAME_NS for k in range(2 * NUM_FRAMES)]


def test_reset_starts_again_from_the_real_frames(client):
    client.imagine(True)
    client.received[PREDICTED['low']].clear()
    client.imagine_one()
    wait_for_frames(client, NUM_FRAMES)
    assert client.reset().success
    stamp_ns = client.send_scene()
    client.received[PREDICTED['low']].clear()
    client.imagine_one(scene='sent')
    wait_for_frames(client, NUM_FRAMES)
    assert stamps(client.received[PREDICTED['low']])[0] == stamp_ns + FRAME_NS


def test_reset_ends_a_running_rollout(client):
    client.set(seed=BLOCKS)
    client.send_scene()
    client.send_trajectory_and_wait_until_it_runs()
    since = len(client.report_values())
    assert client.reset().success
    assert client.reset().success  # a second one finds nothing more to end
    client.set(seed=0)
    client.send_scene()
    client.send_trajectory()
    client.wait_for_state('done', since)
    states = [r['state'] for r in client.report_values()[since:] if r['state'] != 'published']
    assert states == ['reset', 'chunk', 'done']


def test_joints_are_matched_by_name_in_any_order_with_others_between(client, ros):
    names = (*ros.JOINTS[::-1], 'lift')
    rows = np.repeat(np.append(ros.HOME[::-1], 0.5)[None], 4, axis=0)
    rows[:, 13] = 0.1
    assert client.imagine_one(names=names, positions=rows)['state'] == 'done'
    wait_for_frames(client, NUM_FRAMES, JOINTS)
    assert client.received[JOINTS][-1].position[0] == pytest.approx(0.1)
    assert client.received[JOINTS][-1].position[1] == pytest.approx(1.047)


def test_joints_that_a_plan_leaves_out_stay_where_joint_states_have_them(client, ros):
    right = ros.HOME.copy()
    right[7] = 0.4
    stamp_ns = client.now_ns()
    client.send_scene(stamp_ns, joints=ros.make_joint_state(stamp_ns, positions=right))
    left = ros.JOINTS[:7]  # as a planner of one arm's group sends them
    assert client.imagine_one(scene='sent', names=left)['state'] == 'done'
    wait_for_frames(client, NUM_FRAMES, JOINTS)
    end = dict(zip(ros.JOINTS, client.received[JOINTS][-1].position, strict=True))
    assert (end['left_joint1'], end['right_joint1']) == pytest.approx((0.2, 0.4))


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('num_inference_steps', -1, 'out of range'),
        ('seed', -1, 'out of range'),
        ('max_image_age_s', 0.0, 'out of range'),
        ('max_view_skew_s', float('nan'), 'out of range'),
        ('num_seeds', 65, 'out of range'),
        ('stamp_mode', 'future', 'must be one of target, source'),
        ('pace', 'brust', "did you mean 'burst'?"),
        ('checkpoint', '/tmp', 'read-only'),
        ('calibration_file', '/nonexistent', "'/nonexistent' does not exist"),
        ('mode', 'imagine', 'read-only'),
        ('seed', 'three', 'type'),
    ],
)
def test_parameter_out_of_its_range_is_refused_with_a_reason(client, name, value, reason):
    assert reason in client.set(**{name: value})


def test_diagnostics_say_how_it_is(client):
    client.imagine_one()
    client.wait(lambda: 'latency_s.median' in client.diagnostic_values(), 'latencies')
    values = client.diagnostic_values()
    assert values['views'] == 'low, high'
    assert float(values['image_age_s.low']) < 5
    assert int(values['frames_published']) >= 4
    assert values['mode'] == 'observe'


def test_a_chunk_waits_for_a_reliable_subscriber_of_one_chunks_depth(client, ros):
    viewer = ros.Client()
    try:
        viewer.connect_outputs({t: OUTPUTS[t] for t in FRAME_TOPICS}, depth=NUM_FRAMES)
        _wait_until_known(client, FRAME_TOPICS)
        client.send_scene()
        client.send_trajectory()
        time.sleep(1.0)  # the subscriber does something else while the burst comes
        for topic in FRAME_TOPICS:
            wait_for_frames(viewer, NUM_FRAMES, topic)
        client.wait_for_all(FRAME_TOPICS)
        for topic in FRAME_TOPICS:
            assert len(viewer.received[topic]) == NUM_FRAMES
            assert set(np.diff(stamps(viewer.received[topic]))) == {FRAME_NS}
    finally:
        viewer.close()


def _wait_until_known(client, topics):
    """Wait until the node knows of a second subscriber: it has the client already."""
    for topic in topics:
        client.wait(
            lambda count=f'subscribers.{topic}': client.diagnostic_values().get(count) == '2',
            'the viewer',
        )


def test_no_frame_of_a_long_burst_is_lost(client, ros):
    viewer = ros.Client()
    try:
        viewer.connect_outputs({PREDICTED['high']: Image}, depth=100)
        _wait_until_known(client, [PREDICTED['high']])
        client.imagine_one(seconds=8.0)  # ten chunks as fast as the fake model makes them
        viewer.wait(lambda: len(viewer.received[PREDICTED['high']]) == 40, '40 frames')
        assert set(np.diff(stamps(viewer.received[PREDICTED['high']]))) == {FRAME_NS}
    finally:
        viewer.close()
