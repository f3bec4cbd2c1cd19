"""The verdict of a plan comes while the plan still lies ahead, over the running node."""

from collections import Counter
from functools import wraps
import time

import numpy as np
import pytest
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Float32MultiArray, Float64, String

from mtv_world_ros.ros.messages.conversions import NANO, to_ns

#: seed of the fake world model at which a chunk takes 0.3 s
SLOW = 1400
NUM_FRAMES, CHUNK_S, PERIOD_S = 4, 0.8, 0.2
SUCCESS, JACCARD = '/world_model/success', '/world_model/jaccard'
PREDICTED, MASK = '/world_model/low/predicted/image_raw', '/world_model/low/mask/image_raw'
ENDS = ('done', 'preempted', 'rejected', 'failed', 'reset')
#: of a test of moments: other work on the machine only ever makes one late
MOST_TRIES = 5


@pytest.fixture(scope='module')
def node(tmp_path_factory, ros, client):
    process = ros.start_node(tmp_path_factory.mktemp('node'), f'seed:={SLOW}')
    client.arrivals = []

    def keep(topic):
        return lambda message: client.arrivals.append((time.time(), topic, message))

    topics = {SUCCESS: Float64, JACCARD: Float32MultiArray, PREDICTED: Image, MASK: Image}
    for topic, kind in topics.items():
        client.node.create_subscription(kind, topic, keep(topic), QoSProfile(depth=50))
    client.connect_inputs(ros.INPUTS)
    client.wait(
        lambda: all(
            client.diagnostic_values().get(f'subscribers.{topic}', '0') != '0' for topic in topics
        ),
        'the subscriptions',
    )
    client.publish('/instruction', String(data='stack the red block on the blue block'))
    assert client.imagine_one()['state'] == 'done'  # the first one takes longer
    yield process
    assert process.stop() == 0, process.output()


@pytest.fixture(autouse=True)
def observe_again(node, client):
    begin_again(client)


def begin_again(client):
    client.set(pace='realtime', seed=SLOW)
    client.reset()
    client.arrivals.clear()


def in_one_try_of_a_few(test):
    """A test of moments, tried again where something was late."""

    @wraps(test)
    def tried(client):
        for _ in range(MOST_TRIES - 1):
            try:
                return test(client)
            except AssertionError:
                begin_again(client)
        return test(client)

    return tried


def arrived(client, topic):
    """When messages of a topic came [s], and these."""
    return [(at_s, message) for at_s, name, message in client.arrivals if name == topic]


@in_one_try_of_a_few
def test_verdict_and_masks_come_before_the_first_half_of_the_plan_is_over(client):
    since = len(client.report_values())
    stamp_ns = client.send_scene()
    client.send_trajectory(stamp_ns=stamp_ns, seconds=4 * CHUNK_S)
    client.wait_for_ends(1, since)
    client.spin_for(0.3)
    judged_s = [at_s for at_s, _ in arrived(client, SUCCESS)]
    chunks = [r for r in client.report_values()[since:] if r['state'] == 'chunk']
    assert len(judged_s) == len(chunks) == 4
    assert judged_s[0] < stamp_ns / NANO + 2 * CHUNK_S
    for number, (at_s, said) in enumerate(zip(judged_s, chunks, strict=True), start=1):
        lead_s = stamp_ns / NANO + number * CHUNK_S - at_s
        assert float(said['lead_s']) == pytest.approx(lead_s, abs=0.1)
    assert float(chunks[-1]['lead_s']) > 0
    masks = arrived(client, MASK)
    assert len(masks) == 4 * NUM_FRAMES
    assert masks[-1][0] < judged_s[-1] + 0.3  # there are images of the same stamps still to come


@in_one_try_of_a_few
def test_realtime_images_come_one_period_ahead_of_their_stamps(client):
    stamp_ns = client.send_scene()
    client.send_trajectory(stamp_ns=stamp_ns, seconds=4 * CHUNK_S)
    client.wait(lambda: len(arrived(client, PREDICTED)) == 4 * NUM_FRAMES, 'the frames')
    leads = [to_ns(m.header.stamp) / NANO - at_s for at_s, m in arrived(client, PREDICTED)]
    assert all(lead_s < PERIOD_S + 0.01 for lead_s in leads)
    # a chunk of 0.8 s takes 0.3 s: too long for the first frame, the last ones are in time
    assert np.median(leads[-NUM_FRAMES:]) > PERIOD_S - 0.1
    client.spin_for(0.2)
    said = client.report_values('published')[-1]
    assert float(said['frame_lead_s']) == pytest.approx(np.median(leads[-NUM_FRAMES:]), abs=0.1)


@in_one_try_of_a_few
def test_imagined_frames_of_imagine_mode_come_at_the_models_rate(client):
    client.imagine(True)
    client.send_scene()
    client.send_trajectory()
    client.wait(lambda: len(arrived(client, PREDICTED)) == NUM_FRAMES, 'the frames')
    client.imagine(False)
    (first_s, _), *_, (last_s, _) = arrived(client, PREDICTED)
    assert 0.55 <= last_s - first_s <= 0.8  # three times 0.2 s


@in_one_try_of_a_few
def test_burst_images_come_with_the_verdict(client):
    client.set(pace='burst')
    client.send_scene()
    client.send_trajectory()
    client.wait(lambda: len(arrived(client, PREDICTED)) == NUM_FRAMES, 'the frames')
    assert arrived(client, PREDICTED)[-1][0] < arrived(client, SUCCESS)[0][0] + 0.1


def test_every_plan_at_5_hz_ends_once_and_every_chunk_has_its_verdict(client):
    since = len(client.report_values())
    for _ in range(12):  # each takes 0.3 s to imagine
        stamp_ns = client.send_scene()
        client.send_trajectory(stamp_ns=stamp_ns, seconds=1.6)
        client.spin_for(PERIOD_S)
    client.wait_for_ends(12, since)
    client.spin_for(0.3)
    reports = client.report_values()[since:]
    ends = [r for r in reports if r['state'] in ENDS]
    assert sorted(Counter(r['rollout'] for r in ends).values()) == [1] * 12
    verdicts = [r for r in reports if r['state'] == 'chunk']
    assert len(verdicts) >= 4
    assert len(arrived(client, SUCCESS)) == len(arrived(client, JACCARD)) == len(verdicts)
    by_rollout = Counter(r['rollout'] for r in verdicts)
    for end in ends:
        assert int(end['num_chunks']) == by_rollout[end['rollout']]
        # a plan that was pre-empted says what was known of it
        assert ('success' in end) == (int(end['num_chunks']) > 0)
    assert any(r['state'] == 'preempted' and r['num_chunks'] == '1' for r in ends)
