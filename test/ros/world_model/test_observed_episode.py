"""What the node remembers of real frames from plan to plan, and what makes it forget."""

import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from mtv_world_ros.ros.messages.conversions import NANO, to_ns, to_stamp

INSTRUCTION = 'stack the red block on the blue block'
#: pixels of the camera by which the fake model moves everything in a chunk
CHUNK_PX = 8
PERIOD_NS = 200_000_000


@pytest.fixture
def node(tmp_path, ros):
    process = ros.start_node(tmp_path, 'pace:=burst', 'use_sim_time:=true')
    yield process
    assert process.stop() == 0, process.output()


class Stage:
    """A clock and a scene that moves to the left, as seen by the node's cameras."""

    def __init__(self, node, ros, client):
        self._node, self._ros, self._client = node, ros, client
        self._clock = client.node.create_publisher(Clock, '/clock', 10)
        client.connect_inputs(ros.INPUTS)
        client.wait(self._clock.get_subscription_count, 'a subscriber of /clock')
        client.publish('/instruction', String(data=INSTRUCTION))

    def set_clock(self, stamp_ns):
        client = self._client

        def follows():
            self._clock.publish(Clock(clock=to_stamp(stamp_ns)))
            arrays = client.received['/diagnostics']
            return arrays and to_ns(arrays[-1].header.stamp) == stamp_ns

        client.wait(follows, f'the node at {stamp_ns} ns')

    def show(self, stamp_ns, shift):
        changes = {}
        for view in self._ros.VIEWS:
            message = self._ros.make_image(view, stamp_ns)
            message.data = np.roll(self._ros.make_pixels(view), -shift, axis=1).tobytes()
            changes[f'image_{view}'] = message
        self._client.send_scene(stamp_ns, **changes)
        self._client.wait_until_seen(self._node, stamp_ns)

    def plan(self):
        """J of the object that the task does not move, with its first mask."""
        since = len(self._client.report_values())
        self._client.send_trajectory()
        assert self._client.next_end(since)['state'] == 'done'
        chunk = self._client.report_values('chunk')[-1]
        return float(chunk['jaccard.low.blue_block'])

    def live(self, begin_ns):
        """Three plans; the scene moves by what a chunk moves it back by, before the last."""
        assert self._client.reset().success
        self.set_clock(begin_ns)
        self.show(begin_ns, 0)
        first = self.plan()
        for k in range(1, 9):
            self.set_clock(begin_ns + k * PERIOD_NS)
            self.show(begin_ns + k * PERIOD_NS, k * CHUNK_PX // 8)
            if k == 4:
                self.plan()
        return first


def test_first_masks_are_remembered_over_plans_until_something_begins_anew(node, client, ros):
    stage = Stage(node, ros, client)
    begin_ns = 1_000 * NANO
    first = stage.live(begin_ns)
    assert first < 0.4  # the chunk moves the block by most of its width
    assert stage.plan() > 0.6  # where it was in the first plan's first frame
    client.publish('/instruction', String(data=f'{INSTRUCTION}.'))
    client.wait_until_told(node, instruction=f'{INSTRUCTION}.')
    assert stage.plan() < 0.4
    stage.live(begin_ns + 10 * NANO)
    assert stage.plan() > 0.6
    assert client.reset().success
    assert stage.plan() < 0.4
    # a bag that starts over
    stage.live(begin_ns + 20 * NANO)
    assert stage.plan() > 0.6
    stage.set_clock(begin_ns)
    stage.show(begin_ns, CHUNK_PX)
    assert stage.plan() < 0.4
