"""Imagined chunks against real images that come later, over the running node."""

import time

import numpy as np
import pytest
from std_msgs.msg import Float32MultiArray

FIDELITY = '/world_model/fidelity'
PERIOD_NS = 200_000_000


@pytest.fixture(scope='module')
def node(tmp_path_factory, ros, client):
    process = ros.start_node(
        tmp_path_factory.mktemp('node'),
        'pace:=burst',
        'instruction:=stack the red block on the blue block',
    )
    client.connect_outputs({FIDELITY: Float32MultiArray})
    yield process
    assert process.stop() == 0, process.output()


def moved(ros, view, pixels):
    """The scene with everything moved to the right, at the size that the cameras have."""
    return np.roll(ros.make_pixels(view), pixels, axis=1)


def send_images(node, ros, client, stamp_ns, shift):
    client.wait(lambda: time.time_ns() >= stamp_ns)  # images of the future are refused
    for view in ros.VIEWS:
        message = ros.make_image(view, stamp_ns)
        message.data = moved(ros, view, shift).tobytes()
        client.publish(f'/{view}/image_raw', message)
    client.wait_until_seen(node, stamp_ns)


def compared(client, count):
    client.wait(lambda: len(client.report_values('fidelity')) >= count, 'the comparison')
    return client.report_values('fidelity')[-1]


def test_images_that_move_as_imagined_score_one_and_those_that_stay_do_not(node, ros, client):
    # the blocks cover 5 pixels and two halves at the model's size; a width w shifted by s has
    # J = (w - s) / (w + s), over s = 1 ... 4 on average 0.36 for w = 5 and 0.49 for w = 7
    for shift, low, high in ((2, 0.97, 1.0), (0, 0.35, 0.50)):
        before, ended = (len(client.report_values(state)) for state in ('fidelity', 'done'))
        start_ns = time.time_ns()
        client.send_scene(start_ns)
        client.send_trajectory()
        client.wait(lambda n=ended: len(client.report_values('done')) > n, 'the rollout')
        for k in range(1, 5):
            send_images(node, ros, client, start_ns + k * PERIOD_NS, k * shift)
        said = compared(client, before + 1)
        client.wait(lambda n=before: len(client.received[FIDELITY]) > n, 'the topic')
        assert said['frames_compared'] == '4'
        assert low <= float(said['fidelity_jaccard']) <= high
        message = client.received[FIDELITY][-1]
        assert np.mean(message.data) == pytest.approx(float(said['fidelity_jaccard']), abs=1e-4)
        assert len(message.data) == 4
    client.wait(lambda: client.diagnostic_values().get('fidelity_chunks') == '2', 'diagnostics')


def test_what_was_given_up_by_a_reset_is_not_compared(node, ros, client):
    before, ended = (len(client.report_values(state)) for state in ('fidelity', 'done'))
    start_ns = time.time_ns()
    client.send_scene(start_ns)
    client.send_trajectory()
    client.wait(lambda: len(client.report_values('done')) > ended, 'the rollout')
    client.reset()
    for k in range(1, 5):
        send_images(node, ros, client, start_ns + k * PERIOD_NS, 0)
    client.spin_for(0.5)
    assert len(client.report_values('fidelity')) == before


def test_chunks_that_wait_are_told_apart_by_identity_not_by_their_arrays(ros):
    """Comparing arrays raised, again and again, once two chunks of the same frames waited."""
    from types import SimpleNamespace

    from mtv_world_ros.ros.world_model.live_fidelity import Expected

    times = np.array([0.2, 0.4])
    chunks = [
        SimpleNamespace(
            prediction=SimpleNamespace(stamp_ns=0, video=SimpleNamespace(times=times.copy()))
        )
        for _ in range(2)
    ]
    first, second = map(Expected, chunks)
    first.stamps = second.stamps = np.array([1, 2])
    waiting = [first, second]
    waiting.remove(second)
    assert waiting == [first]
