"""The system clock is set while the node runs: what was stored before is dropped, plans go on."""

from rclpy.clock import Clock
from rclpy.duration import Duration

BLOCKS = 1200  # this seed's rollout lasts until it is stopped


class SetClock:
    """The node's clock, which can be set like the system's: rclpy tells nobody of that.

    Args:
        clock: clock of the node.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock, self.offset = clock, Duration()

    def now(self):
        return self._clock.now() + self.offset

    def __getattr__(self, name):
        return getattr(self._clock, name)


def set_clock(node, client, seconds):
    """Set the clocks of node and client by some seconds."""
    for one in (node.node, client.node):
        one._clock.offset = Duration(nanoseconds=round(seconds * 1e9))


def steps(client):
    return client.diagnostic_values().get('clock_steps', '0')


def test_plans_go_on_after_the_clock_was_set_back_and_ahead(tmp_path, ros):
    """By NTP after hours, or by hand. A plan that runs when it is set back ends as reset."""
    node = ros.start_node(tmp_path, 'pace:=burst', 'max_image_age_s:=1.0', clock=SetClock)
    client = ros.Client()
    client.node._clock = SetClock(client.node.get_clock())
    try:
        client.connect_inputs(ros.INPUTS)
        assert client.imagine_one()['state'] == 'done'
        # ahead: images of before are too old, new ones are taken
        set_clock(node, client, 3600.0)
        assert client.imagine_one(scene='none')['reason'] == 'image_stale'
        client.wait(lambda: steps(client) == '1', 'the step ahead')
        assert client.imagine_one()['state'] == 'done'
        # back: images of before are from the future, and do not hide the new ones
        client.set(seed=BLOCKS)
        client.send_scene()
        client.send_trajectory_and_wait_until_it_runs()
        since = len(client.report_values())
        set_clock(node, client, -90.0)
        assert client.next_end(since)['state'] == 'reset'
        client.wait(lambda: steps(client) == '2', 'the step back')
        client.set(seed=0)
        stamp_ns = client.send_scene()
        ended = client.imagine_one(scene='sent')
        assert ended['state'] == 'done'
        chunk = client.report_values('chunk')[-1]
        assert chunk['observation_stamp_ns'] == str(stamp_ns)
    finally:
        client.close()
        assert node.stop() == 0, node.output()
    assert 'the system clock was set by +3600' in node.output()
    assert 'the system clock was set by -3690' in node.output()
