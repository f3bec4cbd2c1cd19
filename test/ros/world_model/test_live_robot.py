"""The node beside a robot that describes itself and publishes TF."""

import re
import sys

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_msgs.msg import Header, String

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.transforms import pose, quaternion
from mtv_world_ros.robot.file import robot_path
from mtv_world_ros.ros.messages.conversions import NANO, to_ns, to_stamp

needs_tf2 = pytest.mark.tf2_msgs
URDF = (robot_path('yam_bimanual').parent / 'yam_bimanual.urdf').read_text()
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LOW, HIGH = 'low_optical_frame', 'high_optical_frame'


@pytest.fixture
def new_client(ros):
    client = ros.Client()
    yield client
    client.close()


def describe(client, urdf):
    """Publish a description as robot_state_publisher does, and wait until it is looked at."""
    before = client.diagnostic_values().get('robot_description')
    publisher = client.node.create_publisher(String, '/robot_description', LATCHED)
    publisher.publish(String(data=urdf))
    client.wait(
        lambda: (
            client.diagnostic_values().get('robot_description', 'none') not in (before, 'none')
        ),
        'the description',
    )
    return publisher


def test_description_of_this_robot_and_of_another_one(start, new_client, ros):
    client = new_client
    start()
    client.connect_inputs(ros.INPUTS)
    describe(client, re.sub('upper="3.66519"', 'upper="2.0"', URDF))
    assert client.diagnostic_values()['robot_description'] == 'used'
    assert client.imagine_one()['state'] == 'done'
    bent = np.repeat(ros.HOME[None], 4, axis=0)
    bent[:, 1] = np.linspace(1.1, 2.5, 4)  # within the limits of the checkpoint's description
    end = client.imagine_one(positions=bent, times=(0.2, 0.4, 0.6, 0.8))
    assert end['reason'] == 'joint_limits' and ' 2' in end['text']

    describe(client, URDF.replace('left_joint3', 'left_elbow'))
    end = client.imagine_one()
    assert (end['state'], end['reason']) == ('rejected', 'robot_description')
    assert "no joint 'left_joint3'" in end['text'] and 'use_robot_description' in end['text']
    status = [s for s in client.statuses('/diagnostics') if s.name == 'world_model'][-1]
    assert status.level == DiagnosticStatus.WARN and 'another robot' in status.message

    describe(client, URDF)
    assert client.imagine_one(positions=bent, times=(0.2, 0.4, 0.6, 0.8))['state'] == 'done'


def with_mesh(urdf, file):
    """The description with a mesh as the shape of each link."""
    shape = f'<visual><geometry><mesh filename="{file}"/></geometry></visual></link>'
    return re.sub(r'</link>', shape, urdf)


@pytest.mark.parametrize(
    'file',
    [
        'package://of_nobody/meshes/arm.dae',
        'file:///nowhere/arm.stl',
        'pointer.stl',
        'https://host/arm.glb',
        '',
    ],
    ids=['package', 'missing', 'git lfs', 'other type', 'no name'],
)
def test_meshes_of_a_description_are_not_needed(start, new_client, ros, tmp_path, file):
    """Lengths, offsets and limits are taken from it; shapes are the checkpoint's."""
    client = new_client
    if file == 'pointer.stl':
        (tmp_path / file).write_text('version https://git-lfs.github.com/spec/v1\n')
        file = (tmp_path / file).as_uri()
    start()
    client.connect_inputs(ros.INPUTS)
    describe(client, with_mesh(URDF, file))
    assert client.diagnostic_values()['robot_description'] == 'used'
    assert client.imagine_one()['state'] == 'done'


def test_speed_limits_of_a_description_hold_and_0_is_none(start, new_client, ros):
    client = new_client
    node = start()
    client.connect_inputs(ros.INPUTS)
    publisher = client.node.create_publisher(String, '/robot_description', LATCHED)
    times, fast = (0.2, 0.4, 0.6, 0.8), np.repeat(ros.HOME[None], 4, axis=0)
    fast[:, 0] = np.linspace(0.4, 1.6, 4)  # 2 rad/s
    for count, (limit, state) in enumerate((('0', 'done'), ('0.5', 'rejected'), ('4.0', 'done'))):
        described = re.sub(r'velocity="[^"]*"', f'velocity="{limit}"', URDF)
        publisher.publish(String(data=described))
        taken = lambda count=count: node.output().count('robot_description: robot') > count  # noqa: E731
        client.wait(taken, 'the description')
        end = client.imagine_one(positions=fast, times=times)
        assert end['state'] == state, (limit, end)
        if state == 'rejected':
            assert end['reason'] == 'joint_speeds' and "'left_joint1'" in end['text']


def test_descriptions_can_be_ignored(start, new_client, ros):
    client = new_client
    start('use_robot_description:=false')
    client.connect_inputs(ros.INPUTS)
    client.node.create_publisher(String, '/robot_description', LATCHED).publish(String(data='x'))
    assert client.imagine_one()['state'] == 'done'
    assert 'robot_description' not in client.diagnostic_values()


def test_poses_from_tf_need_tf2_msgs(tmp_path, ros, monkeypatch):
    for name in ('tf2_msgs', 'tf2_msgs.msg'):
        monkeypatch.setitem(sys.modules, name, None)
    status, said = ros.run_node(tmp_path, 'extrinsics:=tf')
    assert status == 1
    assert "'extrinsics' is 'tf'" in said and 'tf2_msgs' in said


class Broadcaster:
    """Publishes TF as a robot does."""

    def __init__(self, client):
        from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]

        self.client, self.kind = client, TFMessage
        self.static = client.node.create_publisher(TFMessage, '/tf_static', LATCHED)
        self.moving = client.node.create_publisher(TFMessage, '/tf', 10)
        client.wait(lambda: self.moving.get_subscription_count(), 'a listener of /tf')

    def send(self, *edges, moving=False, stamp_ns=None):
        """Publish (parent, child, T)."""
        stamp_ns = self.client.now_ns() if stamp_ns is None else stamp_ns
        items = [self.transform(stamp_ns, *edge) for edge in edges]
        (self.moving if moving else self.static).publish(self.kind(transforms=items))
        self.client.spin_for(0.3)

    @staticmethod
    def transform(stamp_ns, parent, child, T):
        item = TransformStamped(header=Header(stamp=to_stamp(stamp_ns), frame_id=parent))
        item.child_frame_id = child
        for name, value in zip('xyz', T[:3, 3], strict=True):
            setattr(item.transform.translation, name, float(value))
        for name, value in zip('xyzw', quaternion(T[:3, :3]), strict=True):
            setattr(item.transform.rotation, name, float(value))
        return item


@pytest.fixture
def cameras(tmp_path, ros):
    return load_calibration(ros.make_calibration(tmp_path / 'placed.yaml'))


@needs_tf2
def test_a_camera_placed_by_tf_on_the_robot_and_one_on_its_wrist(start, new_client, ros, cameras):
    client = new_client
    start('extrinsics:=tf')
    client.connect_inputs(ros.INPUTS)
    tf = Broadcaster(client)
    end = client.imagine_one()
    assert (end['state'], end['reason']) == ('rejected', 'camera_pose_missing')
    assert LOW in end['text']

    wrist = pose((0.0, 0.05, 0.02), (0, 0, 0, 1))
    half = pose((0, 0.1, 0), (0, 0, 0, 1))
    low = cameras['low'].T_mount_camera
    tf.send(
        ('base', 'stand', half),
        ('stand', LOW, np.linalg.inv(half) @ low),
        ('left_link_6', HIGH, wrist),
    )
    # robot_state_publisher moves the arm's links
    for k in range(3):
        tf.send(('base', 'left_link_6', pose((0.1 * k, 0, 0.3), (0, 0, 0, 1))), moving=True)
    assert client.imagine_one()['state'] == 'done'
    client.wait(lambda: client.diagnostic_values().get('extrinsics.high') == 'tf', 'the sources')

    # the camera was moved: refused until it is accepted
    tf.send(('left_link_6', HIGH, pose((0.0, 0.06, 0.02), (0, 0, 0, 1))))
    end = client.imagine_one()
    assert end['reason'] == 'camera_pose_changed' and "'left_link_6'" in end['text']
    assert client.reset().success
    assert client.imagine_one()['state'] == 'done'


@needs_tf2
def test_a_camera_on_a_head_that_turns_is_where_it_was_at_the_time_of_the_image(
    start, new_client, ros, cameras
):
    client, shown = new_client, '/world_model/high/trajectory/image_raw'
    start('extrinsics:=tf')
    client.connect_inputs(ros.INPUTS)
    client.connect_outputs({shown: Image})
    tf, high = Broadcaster(client), cameras['high'].T_mount_camera
    tf.send(('base', LOW, cameras['low'].T_mount_camera), ('head', HIGH, np.eye(4)))

    def turn(angle):
        """The head's joint is in /tf alone."""
        turned = pose((0, 0, 0), (0, np.sin(angle / 2), 0, np.cos(angle / 2)))
        stamp_ns = client.now_ns()
        tf.send(('base', 'head', high @ turned), moving=True, stamp_ns=stamp_ns)
        return stamp_ns

    def draw():
        """Return the trajectory video of a plan from the newest images."""
        client.received[shown].clear()
        since = len(client.report_values())
        client.send_trajectory()
        assert client.next_end(since)['state'] == 'done'
        client.wait(lambda: len(client.received[shown]) == ros.NUM_FRAMES, 'the video')
        return np.array([message.data for message in client.received[shown]])

    client.send_scene(turn(0.0))
    ahead = draw()
    assert client.diagnostic_values().get('extrinsics.high') != 'tf, moving'
    client.send_scene(turn(0.3))
    aside = draw()
    client.wait(
        lambda: client.diagnostic_values().get('extrinsics.high') == 'tf, moving', 'the source'
    )
    assert (ahead != aside).any()
    stamp_ns = turn(0.0)  # after the image that the next plan starts from
    np.testing.assert_array_equal(draw(), aside)
    client.send_scene(stamp_ns)
    np.testing.assert_array_equal(draw(), ahead)


@needs_tf2
def test_a_head_that_turned_may_be_elsewhere_when_the_clock_starts_over(
    start, new_client, ros, cameras
):
    client = new_client
    start('extrinsics:=tf', 'use_sim_time:=true')
    client.connect_inputs(ros.INPUTS)
    clock = client.node.create_publisher(Clock, '/clock', 10)
    tf, high = Broadcaster(client), cameras['high'].T_mount_camera
    tf.send(('base', LOW, cameras['low'].T_mount_camera), ('head', HIGH, np.eye(4)))

    def end_at(second, x):
        """Return how a plan ends at a time with the head at a place."""

        def follows():
            clock.publish(Clock(clock=to_stamp(second * NANO)))
            arrays = client.received['/diagnostics']
            return arrays and to_ns(arrays[-1].header.stamp) == second * NANO

        client.wait(follows, f'the node at {second} s')
        place = high @ pose((x, 0, 0), (0, 0, 0, 1))
        tf.send(('base', 'head', place), moving=True, stamp_ns=second * NANO)
        client.send_scene(second * NANO)
        return client.imagine_one(scene='sent')['state']

    assert [end_at(60, 0.0), end_at(61, 0.2), end_at(1, 0.1)] == ['done'] * 3
    assert client.diagnostic_values()['clock_jumps_back'] == '1'


@needs_tf2
def test_tf_older_than_the_image(start, new_client, ros, cameras):
    client = new_client
    start('extrinsics:=tf', 'max_tf_age_s:=0.5')
    client.connect_inputs(ros.INPUTS)
    tf = Broadcaster(client)
    tf.send(('base', LOW, cameras['low'].T_mount_camera))
    high = ('base', HIGH, cameras['high'].T_mount_camera)
    tf.send(high, moving=True, stamp_ns=client.now_ns() - 3 * NANO)
    end = client.imagine_one()
    assert end['reason'] == 'camera_pose_stale'
    assert re.search(r'3\.\d+ s older than the image', end['text']), end['text']
    tf.send(high, moving=True)
    assert client.imagine_one()['state'] == 'done'


@needs_tf2
def test_frames_of_views_that_tf_lacks_are_published_latched(start, new_client, ros, cameras):
    from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]

    client = new_client
    start()
    client.connect_inputs(ros.INPUTS)
    client.connect_outputs({'/world_model/low/predicted/image_raw': Image})
    # a driver publishes the frames inside of its camera, and nobody where the camera is
    inside = pose((0.01, 0.02, 0), (0.5, -0.5, 0.5, 0.5))
    Broadcaster(client).send(('high_link', HIGH, inside))
    assert client.imagine_one()['state'] == 'done'
    client.wait(lambda: client.received['/world_model/low/predicted/image_raw'], 'a frame')
    shown = client.received['/world_model/low/predicted/image_raw'][0].header.frame_id

    late, got = ros.Client(), []  # RViz, started later
    late.node.create_subscription(
        TFMessage, '/tf_static', got.append, QoSProfile(depth=10, durability=LATCHED.durability)
    )
    late.wait(lambda: len(got) >= 2, 'latched frames')
    late.close()
    frames = {t.child_frame_id: t for message in got for t in message.transforms}
    assert shown == LOW and frames[LOW].header.frame_id == 'base'
    for child, expected in (
        (LOW, cameras['low'].T_mount_camera),
        ('high_link', cameras['high'].T_mount_camera @ np.linalg.inv(inside)),
    ):
        p, q = frames[child].transform.translation, frames[child].transform.rotation
        T = pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
        np.testing.assert_allclose(T, expected, atol=1e-6)
    assert frames[HIGH].header.frame_id == 'high_link'  # no second parent
