"""Plans of a client with Fast DDS' own settings, beside its cameras."""

import signal
import time

import pytest

SIZE = (384, 288)
NUM_PLANS = 3
#: images of each view that come right after a plan, more than a shared buffer holds
NUM_IMAGES = 12
#: a lost plan comes again 3 s after it was sent, by the client's default heartbeat period [s]
STOP_S, LATE_S = 0.3, 2.0


@pytest.fixture
def node(tmp_path, ros):
    """A node in a process of its own: Fast DDS has one set of profiles a process."""
    node = ros.start_node_process(tmp_path, 'pace:=burst')
    yield node
    assert node.stop() == 0, node.output()


@pytest.mark.slow
def test_plans_do_not_wait_behind_pictures(node, client, ros):
    """A plan and the images after it come from one client, to a node that has no time just then.

    Before plans had a port of their own, the images pushed the plan out of the shared buffer.
    """
    client.connect_inputs(ros.INPUTS)
    known = [f'publishers.{topic}' for topic in ros.INPUTS]
    client.wait(lambda: all(client.diagnostic_values().get(key, '0') != '0' for key in known))
    path = client.diagnostic_values()['receive_path./joint_trajectory']
    assert path.startswith('UDP port '), path
    images = {
        f'image_{view}': ros.to_image(ros.make_pixels(view, SIZE), ros.make_header(view, 0))
        for view in ros.VIEWS
    }
    infos = {f'info_{view}': ros.make_info(view, size=SIZE) for view in ros.VIEWS}

    def show():
        stamp_ns = client.now_ns()
        for message in images.values():
            message.header.stamp = ros.to_stamp(stamp_ns)
        client.send_scene(stamp_ns, **images, **infos)

    show()  # what comes first after two processes met each other may be lost
    client.spin_for(0.2)
    client.send_trajectory()
    client.next_end(0)
    for _ in range(NUM_PLANS):
        show()
        client.spin_for(0.2)
        seen = len(client.report_values())
        node.process.send_signal(signal.SIGSTOP)
        sent_s = time.monotonic()
        client.send_trajectory()
        for _ in range(NUM_IMAGES):
            show()
        client.spin_for(STOP_S)
        node.process.send_signal(signal.SIGCONT)
        assert client.next_end(seen)['state'] == 'done', node.output()
        assert time.monotonic() - sent_s < LATE_S, node.output()
