"""`imagine --live` starts from one observation, or says which topic did not bring it."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest

from mtv_world_ros.core.errors import ConfigError, ObservationError
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.ros.sensing import live_start

URDF = '<robot name="other"><link name="base"/></robot>'


@pytest.fixture
def checkpoint(tmp_path, ros, monkeypatch):
    monkeypatch.setattr(live_start, 'SETTLE_S', 0.2)
    ros.make_checkpoint(tmp_path / 'checkpoint')
    return Checkpoint.open(str(tmp_path / 'checkpoint'))


@pytest.fixture
def observe(checkpoint, tmp_path, ros):
    """Return a start, and the line that was said of it."""
    said = []

    def observe(*words, timeout_s=30.0):
        parameters = {
            'observation_timeout_s': timeout_s,
            'calibration_file': ros.make_calibration(tmp_path / 'calibration.yaml'),
        }
        options = [part for name, v in parameters.items() for part in ('-p', f'{name}:={v}')]
        starts = live_start.live_starts(
            checkpoint.spec,
            checkpoint.load_robot(None),
            checkpoint.cameras_file,
            ['--ros-args', *options, *words],
            said.append,
        )
        return next(starts)

    observe.said = said
    return observe


@contextmanager
def published(ros, publish, topics=()):
    """Within it a client publishes again and again; `topics` have publishers from the start."""
    client = ros.Client()
    for topic, kind in dict(topics).items():
        client.publishers[topic] = client.node.create_publisher(kind, topic, 10)
    is_over = False

    def run():
        while not is_over:
            publish(client)
            client.spin_for(0.05)

    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(run)
        try:
            yield client
        finally:
            is_over = True
            running.result()
            client.close()


def refusal(observe, *says, words=()):
    """Return why there is no observation; a busy machine gets more time for what must come."""
    text = ''
    for timeout_s in (1.0, 4.0, 16.0):
        with pytest.raises(ObservationError) as error:
            observe(*words, timeout_s=timeout_s)
        text = str(error.value)
        if all(said in text for said in says):
            break
    return text


def scene_topics(ros):
    return {t: k for t, k in ros.INPUTS.items() if t != '/joint_trajectory'}


def send_scene(client):
    client.send_scene()


def test_images_and_joints_of_one_moment(observe, ros):
    topics = {**scene_topics(ros), '/instruction': ros.STRING}

    def publish(client):
        client.send_scene()
        client.publish('/instruction', ros.STRING(data='stack the red block'))

    with published(ros, publish, topics):
        start = observe()
    seen = start.observation
    assert seen.views == ('low', 'high') and start.source == 'live'
    for frame, view in zip(seen.frames, seen.views, strict=True):
        np.testing.assert_array_equal(frame, ros.make_pixels(view))
    np.testing.assert_allclose(seen.positions, ros.HOME)
    assert start.instruction == 'stack the red block'
    (said,) = observe.said
    assert said.startswith('observed /low/image_raw, /high/image_raw at 96x72; ')
    assert said.endswith("camera poses: low file, high file; robot: the checkpoint's")


def test_compressed_images_under_other_names(observe, ros):
    """A view of which only JPEG images are published is taken from those."""
    images = {view: f'/camera_{view}/image_raw/compressed' for view in ros.VIEWS}
    topics = {
        **dict.fromkeys(images.values(), ros.COMPRESSED),
        **{f'/camera_{view}/camera_info': ros.INFO for view in ros.VIEWS},
        '/arm/joint_states': ros.JOINT_STATE,
    }

    def publish(client):
        stamp_ns = client.now_ns()
        for view, topic in images.items():
            client.publishers[topic].publish(ros.make_jpeg(view, stamp_ns))
            info = client.publishers[f'/camera_{view}/camera_info']
            info.publish(ros.make_info(view, stamp_ns))
        client.publishers['/arm/joint_states'].publish(ros.make_joint_state(stamp_ns))

    names = [f'camera_topics.{view}:=/camera_{view}' for view in ros.VIEWS]
    words = [part for name in names for part in ('-p', name)]
    with published(ros, publish, topics):
        start = observe(*words, '-r', 'joint_states:=/arm/joint_states')
    for frame, view in zip(start.observation.frames, ros.VIEWS, strict=True):
        assert np.abs(frame.astype(int) - ros.make_pixels(view)).mean() < 3


def test_topics_that_nobody_publishes_are_named(observe):
    with pytest.raises(ObservationError) as error:
        observe(timeout_s=0.3)
    text = str(error.value)
    for topic in (
        'nobody publishes /low/image_raw or /low/image_raw/compressed',
        'nobody publishes /high/camera_info',
        'nobody publishes /joint_states',
        'camera_topics.low',
        'observation_timeout_s',
    ):
        assert topic in text


def test_topics_that_bring_messages_are_not_blamed_for_a_missing_camera(observe, ros):
    def publish(client):
        client.publish('/joint_states', ros.make_joint_state(client.now_ns()))

    text = ''
    with published(ros, publish, {'/joint_states': ros.JOINT_STATE}):
        for timeout_s in (1.0, 4.0, 16.0):
            with pytest.raises(ObservationError) as error:
                observe(timeout_s=timeout_s)
            text = str(error.value)
            if 'nobody publishes /joint_states' not in text:  # it was discovered
                break
    assert 'nobody publishes /low/image_raw' in text
    assert 'nobody publishes /joint_states' not in text
    assert 'nothing was received on /joint_states' not in text


def test_a_topic_that_brings_nothing_is_named(observe, ros):
    def publish(client):
        client.send_scene(joints=None)

    with published(ros, publish, scene_topics(ros)):
        text = refusal(observe, '): nothing was received on /joint_states')
    assert text.endswith('): nothing was received on /joint_states')


def test_quality_of_service_that_does_not_match_is_named(observe, ros):
    kinds = scene_topics(ros)
    joints = kinds.pop('/joint_states')
    client_qos = ros.QoSProfile(depth=1, reliability=ros.ReliabilityPolicy.BEST_EFFORT)
    override = 'qos_overrides./joint_states.subscription.reliability:=reliable'
    with published(ros, lambda client: client.send_scene(joints=None), kinds) as client:
        client.node.create_publisher(joints, '/joint_states', client_qos)
        says = ('asked for is reliable', 'nothing was received on /joint_states')
        text = refusal(observe, *says, words=('-p', override))
    assert 'reliability best_effort, asked for is reliable' in text
    assert 'nothing was received on /joint_states' in text


@pytest.mark.parametrize(
    ('publish', 'says'),
    [
        (
            lambda client: client.send_scene(stamp_ns=client.now_ns() - 10**10),
            "image_stale: the newest image of view 'low' is 10",
        ),
        (lambda client: send_without_a_joint(client), 'joint_state_missing: no joint state of'),
    ],
)
def test_an_observation_that_cannot_be_used_says_why(observe, ros, publish, says):
    with published(ros, publish, scene_topics(ros)):
        assert says in refusal(observe, says)


def send_without_a_joint(client):
    from test.support import ros_nodes

    stamp_ns = client.now_ns()
    state = ros_nodes.make_joint_state(stamp_ns, ros_nodes.JOINTS[:-1], ros_nodes.HOME[:-1])
    client.send_scene(stamp_ns, joints=state)


def test_another_robot_is_refused_at_once(observe, ros):
    with published(ros, send_scene, scene_topics(ros)) as client:
        latched = client.node.create_publisher(ros.STRING, '/robot_description', ros.LATCHED_QOS)
        latched.publish(ros.STRING(data=URDF))
        with pytest.raises(ObservationError, match='/robot_description: '):
            observe()


def test_a_parameter_that_is_unknown_is_refused(observe):
    with pytest.raises(ConfigError, match="'imagine' has no parameter 'max_image_ages_s'"):
        observe('-p', 'max_image_ages_s:=2.0', timeout_s=0.1)


def test_a_parameter_that_left_says_what_holds_now(observe):
    with pytest.raises(ConfigError, match=r"'publish_masks': masks are always offered.*Delete it"):
        observe('-p', 'publish_masks:=false', timeout_s=0.1)


def test_arguments_that_ros_refuses_are_named(observe):
    with pytest.raises(ConfigError, match='cannot be used'):
        observe('-r', 'low')
