"""The node started in other ways: sim time, JPEG input, other topics and QoS, wrong parameters."""

import signal

from diagnostic_msgs.msg import DiagnosticStatus
import pytest
from rcl_interfaces.srv import DescribeParameters
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String

from mtv_world_ros.ros.messages.conversions import NANO, to_ns, to_stamp

PREDICTED = '/world_model/low/predicted/image_raw'
FRAME_NS = 200_000_000
#: seed at which the fake model goes on until it is told to stop
BLOCKS = 1200


@pytest.fixture
def start(tmp_path, ros):
    """Start the node with parameters; it must end cleanly at the test's end."""
    started = []

    def start(*parameters, **options):
        started.append(ros.start_node(tmp_path, 'pace:=burst', *parameters, **options))
        return started[-1]

    yield start
    for process in started:
        process.stop()


@pytest.fixture
def new_client(ros):
    client = ros.Client()
    yield client
    client.close()


def test_sim_time_and_a_clock_that_starts_over(start, new_client, ros):
    client = new_client
    start('use_sim_time:=true', 'max_image_age_s:=0.5', 'max_joint_state_age_s:=0.5')
    client.connect_outputs({PREDICTED: Image})
    client.connect_inputs(ros.INPUTS)
    clock = client.node.create_publisher(Clock, '/clock', 10)
    client.wait(clock.get_subscription_count, 'a subscriber of /clock')

    begin_ns = 1_000 * NANO
    client.send_scene(begin_ns)
    assert client.imagine_one(scene='sent')['reason'] == 'no_clock'

    def set_clock(stamp_ns):
        """Until the node's stamps follow."""

        def follows():
            clock.publish(Clock(clock=to_stamp(stamp_ns)))
            arrays = client.received['/diagnostics']
            return arrays and to_ns(arrays[-1].header.stamp) == stamp_ns

        client.wait(follows, f'the node at {stamp_ns} ns')

    set_clock(begin_ns + 60 * NANO)
    client.send_scene(begin_ns + 60 * NANO)
    assert client.imagine_one(scene='sent')['state'] == 'done'
    client.wait(lambda: len(client.received[PREDICTED]) == 4, 'four frames')
    assert to_ns(client.received[PREDICTED][0].header.stamp) == begin_ns + 60 * NANO + FRAME_NS

    set_clock(begin_ns)  # the bag starts over: what was stored lies in the future
    assert client.imagine_one(scene='none')['reason'] == 'image_missing'
    client.wait(lambda: client.diagnostic_values().get('clock_jumps_back') == '1', 'the jump')
    client.send_scene(begin_ns)
    assert client.imagine_one(scene='sent')['state'] == 'done'
    client.wait(lambda: len(client.received[PREDICTED]) == 8, 'four more')
    assert to_ns(client.received[PREDICTED][-1].header.stamp) == begin_ns + 4 * FRAME_NS


def test_jpeg_input_on_other_camera_topics(start, new_client, ros):
    client = new_client
    start(
        'compressed_input:=true',
        'camera_topics.low:=/front/colour',
        remaps=('/high/image_raw/compressed:=/top/jpeg', 'joint_trajectory:=/policy/plan'),
    )
    client.connect_outputs({PREDICTED: Image})
    topics = {'low': '/front/colour/image_raw/compressed', 'high': '/top/jpeg'}
    client.connect_inputs(dict.fromkeys(topics.values(), CompressedImage))
    infos = {'low': '/front/colour/camera_info', 'high': '/high/camera_info'}
    damaged = CompressedImage(format='jpeg', data=b'\xff\xd8\xff not an image \xff\xd9')
    stamp_ns = client.now_ns()
    damaged.header.stamp = to_stamp(stamp_ns + 1_000_000)
    for view, topic in topics.items():
        client.publish(infos[view], ros.make_info(view))
        client.publish(topic, ros.make_jpeg(view, stamp_ns))
    client.publish('/joint_states', ros.make_joint_state(stamp_ns))

    def plan():
        since = len(client.report_values())
        client.publish('/policy/plan', ros.make_trajectory())
        return client.next_end(since)

    assert plan()['state'] == 'done'
    for topic in topics.values():
        client.publish(topic, damaged)
    # refused as they come in: the images before them stay
    client.wait(lambda: client.diagnostic_values().get('rejected.image_data') == '2', 'both')
    assert plan()['state'] == 'done'
    cut = CompressedImage(format='jpeg', data=ros.make_jpeg('low', 0).data[:200])
    video = CompressedImage(format='h264', data=b'\0\0\0\1')
    for wrong, reason, count in ((cut, 'image_data', '3'), (video, 'image_encoding', '1')):
        client.publish(topics['low'], wrong)
        key = f'rejected.{reason}'
        client.wait(lambda: client.diagnostic_values().get(key) == count, reason)  # noqa: B023
    stamp_ns = client.now_ns()
    for view, topic in topics.items():
        client.publish(topic, ros.make_jpeg(view, stamp_ns))
    assert plan()['state'] == 'done'


def test_qos_overrides_and_latched_instruction(start, new_client, ros):
    client = new_client
    start(
        f'qos_overrides.{PREDICTED}.publisher.reliability:=best_effort',
        f'qos_overrides.{PREDICTED}.publisher.depth:=2',
        'qos_overrides./low/image_raw.subscription.reliability:=best_effort',
    )
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = client.node.create_publisher(String, '/instruction', latched)
    publisher.publish(String(data='stack the green block on the pink block'))
    client.wait(lambda: client.node.count_publishers(PREDICTED), 'the node')
    offered = client.node.get_publishers_info_by_topic(PREDICTED)[0].qos_profile
    assert offered.reliability == ReliabilityPolicy.BEST_EFFORT
    client.connect_inputs({t: k for t, k in ros.INPUTS.items() if t != '/low/image_raw'})
    low = client.node.create_publisher(Image, '/low/image_raw', 10)
    client.publishers['/low/image_raw'] = low
    client.wait(low.get_subscription_count, 'the camera to be connected')
    wanted = client.node.get_subscriptions_info_by_topic('/low/image_raw')[0].qos_profile
    assert wanted.reliability == ReliabilityPolicy.BEST_EFFORT
    told = client.node.get_subscriptions_info_by_topic
    client.wait(
        lambda: (
            [i.qos_profile.durability for i in told('/instruction')]
            == [DurabilityPolicy.TRANSIENT_LOCAL]
        ),
        'the instruction to be latched',
    )

    def is_seen():
        """A camera goes on sending: what is sent with best effort may be lost."""
        client.send_scene()
        return client.diagnostic_values().get('image_age_s.low', 'nan') != 'nan'

    client.wait(is_seen, 'an image of the low camera')
    ended = client.imagine_one(scene='sent')
    assert ended.get('instruction') == 'stack the green block on the pink block', ended


@pytest.mark.parametrize(
    ('parameter', 'said'),
    [
        ('seed:=-5', "'seed' must be of type int in [0, 2"),
        ('pace:=quick', "pace is 'quick'; it must be one of realtime, burst"),
        ('mode:=imagined', "did you mean 'imagine'?"),
        ('num_inference_steps:=many', "'num_inference_steps' must be of type int"),
        ('checkpont:=x', "no parameter 'checkpont' (did you mean 'checkpoint'?)"),
        ('calibration_file:=/none.yaml', "'/none.yaml' does not exist; set 'calibration_file'"),
        (f'qos_overrides.{PREDICTED}.publisher.reliability:=maybe', 'maybe'),
    ],
)
def test_wrong_parameter_at_start_is_one_clear_line(ros, tmp_path, parameter, said):
    status, output = ros.run_node(tmp_path, parameter)
    assert status == 1
    assert said in output
    assert 'Traceback' not in output


def test_health_warns_with_names_until_every_input_is_there_and_fresh(start, new_client, ros):
    client = new_client
    start('max_image_age_s:=2.0')

    def says(level, *texts):
        def met():
            said = [s for s in client.statuses('/diagnostics') if s.name == 'world_model'][-1:]
            return said and said[0].level == level and all(t in said[0].message for t in texts)

        client.wait(met, f'level {level} with {texts}')

    topics = ('/low/image_raw', '/high/camera_info', '/joint_states', '/joint_trajectory')
    says(DiagnosticStatus.WARN, *(f'nobody publishes {topic}' for topic in topics))
    client.connect_inputs({t: k for t, k in ros.INPUTS.items() if t != '/high/image_raw'})
    says(DiagnosticStatus.WARN, 'nobody publishes /high/image_raw')
    client.connect_inputs({'/high/image_raw': Image})
    says(DiagnosticStatus.WARN, "no images of view 'low'", 'no fresh joint_states of left_joint1')
    client.send_scene(info_low=None)
    says(DiagnosticStatus.WARN, "no camera_info of view 'low'")
    client.send_scene()
    says(DiagnosticStatus.OK, 'ready')
    says(DiagnosticStatus.WARN, "images of view 'high' are 2.")


def test_parameters_describe_themselves(start, new_client):
    start()
    names = [f'qos_overrides./low/image_raw.subscription.{n}' for n in ('reliability', 'depth')]
    request = DescribeParameters.Request(names=names)
    answer = new_client.call(DescribeParameters, '/world_model/describe_parameters', request)
    assert [d.name for d in answer.descriptors] == names
    assert 'best_effort' in answer.descriptors[0].description


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_ends_cleanly_in_the_middle_of_a_rollout(tmp_path, new_client, ros, number):
    client = new_client
    process = ros.start_node_process(
        tmp_path, 'pace:=burst', 'seed:=1200'
    )  # the fake model goes on until it is told to stop
    try:
        client.connect_inputs(ros.INPUTS)
        client.send_scene()
        client.send_trajectory_and_wait_until_it_runs()
        assert process.stop(number) == 0, process.output()
        assert 'Traceback' not in process.output()
    finally:  # a node that is left would answer other tests
        process.process.kill()
