"""Which images and joint states make up an observation."""

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.ros.messages.conversions import make_header, NANO
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.parameters import NodeSettings
from mtv_world_ros.ros.sensing.observations import ObservationBuffer

NOW = 1_000 * NANO
MS = 1_000_000


@pytest.fixture
def make_buffer(ros, tmp_path):
    cameras = load_calibration(ros.make_calibration(tmp_path / 'calibration.yaml'))

    def make(skew=0.05, joint_names=('a', 'b'), seen=None):
        limits = NodeSettings(max_view_skew_s=skew)
        buffer = ObservationBuffer(
            cameras=[cameras[view] for view in ('low', 'high')],
            joint_names=joint_names,
            width=96,
            height=72,
            limits=lambda: limits,
        )
        for number, view in enumerate(('low', 'high')):
            info = ros.make_info(view)
            if seen is not None:
                info.width, info.height = seen[number]
                focal, x, y = info.width, (info.width - 1) / 2, (info.height - 1) / 2
                info.k = [focal, 0.0, x, 0.0, focal, y, 0.0, 0.0, 1.0]
            buffer.add_camera_info(view, info)
        return buffer

    return make


def joints(stamp_ns, **positions):
    return JointState(
        header=make_header(stamp_ns), name=list(positions), position=list(positions.values())
    )


def shade(ros, view, stamp_ns, value):
    image = ros.make_image(view, stamp_ns)
    image.data = bytes([value]) * len(image.data)
    return image


@pytest.mark.parametrize(
    ('seen', 'wanted'),
    [
        ([(384, 288), (384, 288)], (384, 288)),
        ([(384, 288), (320, 240)], (384, 288)),
        ([(1920, 1080), (640, 480)], (739, 416)),
        ([(64, 48), (64, 48)], (64, 48)),
    ],
)
def test_objects_are_looked_for_at_the_size_of_the_images(make_buffer, ros, seen, wanted):
    buffer = make_buffer(seen=seen)
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    for view, (width, height) in zip(('low', 'high'), seen, strict=True):
        image = ros.make_image(view, NOW)
        image.width, image.height, image.step = width, height, 3 * width
        image.encoding, image.data = 'rgb8', bytes(3 * width * height)
        buffer.add_image(view, image)
    found = buffer.observe(NOW).observation
    assert found.frames.shape == (2, wanted[1], wanted[0], 3)
    for camera in found.cameras:
        assert (camera.width, camera.height) == wanted
        assert camera.K[0, 2] == pytest.approx((wanted[0] - 1) / 2)
        assert camera.K[1, 2] == pytest.approx((wanted[1] - 1) / 2)


def test_views_that_arrive_one_after_the_other_are_paired_by_stamp(make_buffer, ros):
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    for step, value in ((-200, 1), (-100, 2)):
        for view in ('low', 'high'):
            buffer.add_image(view, shade(ros, view, NOW + step * MS, value))
    buffer.add_image('low', shade(ros, 'low', NOW, 3))  # high's is still on its way
    scene = buffer.observe(NOW)
    assert scene.observation.stamp_ns == scene.source_stamp_ns == NOW - 100 * MS
    assert scene.observation.frames[:, 0, 0, 0].tolist() == [2, 2]
    buffer.add_image('high', shade(ros, 'high', NOW, 3))
    assert buffer.observe(NOW).observation.frames[:, 0, 0, 0].tolist() == [3, 3]


def test_skew_within_the_limit_is_stamped_with_the_older_view(make_buffer, ros):
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    buffer.add_image('low', ros.make_image('low', NOW))
    buffer.add_image('high', ros.make_image('high', NOW - 40 * MS))
    assert buffer.observe(NOW).observation.stamp_ns == NOW - 40 * MS
    buffer.add_image('high', ros.make_image('high', NOW - 60 * MS))
    with pytest.raises(Rejection, match='the views are 0.060 s apart') as refused:
        buffer.observe(NOW)
    assert refused.value.reason == Reason.VIEWS_OUT_OF_SYNC


def test_joint_states_of_several_publishers_are_merged_at_the_images_time(make_buffer, ros):
    buffer = make_buffer()
    for view in ('low', 'high'):
        buffer.add_image(view, ros.make_image(view, NOW - 50 * MS))
    for step in range(-100, 1, 10):
        buffer.add_joint_state(joints(NOW + step * MS, a=step, lift=9.0))
    buffer.add_joint_state(joints(NOW - 30 * MS, b=7.0))
    np.testing.assert_array_equal(buffer.observe(NOW).observation.positions, [-50, 7])


def test_one_joint_that_stopped_is_stale(make_buffer, ros):
    buffer = make_buffer()
    for view in ('low', 'high'):
        buffer.add_image(view, ros.make_image(view, NOW))
    buffer.add_joint_state(joints(NOW - 700 * MS, a=0.0, b=0.0))
    buffer.add_joint_state(joints(NOW, a=0.0))
    with pytest.raises(Rejection, match="state of joint 'b' is 0.700 s old"):
        buffer.observe(NOW)


def test_an_image_from_the_future_is_forgotten_with_the_next(make_buffer, ros):
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    for view in ('low', 'high'):
        buffer.add_image(view, ros.make_image(view, NOW + 10 * NANO))
    with pytest.raises(Rejection, match='stamped 10.000 s in the future'):
        buffer.observe(NOW)
    for view in ('low', 'high'):
        buffer.add_image(view, ros.make_image(view, NOW))
    assert buffer.observe(NOW).observation.stamp_ns == NOW


def test_clearing_forgets_images_and_joints_but_not_the_cameras(make_buffer, ros):
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    for view in ('low', 'high'):
        buffer.add_image(view, ros.make_image(view, NOW))
    buffer.clear()
    for reason, add in (
        (Reason.IMAGE_MISSING, lambda: buffer.add_image('low', ros.make_image('low', NOW))),
        (Reason.IMAGE_MISSING, lambda: buffer.add_image('high', ros.make_image('high', NOW))),
        (Reason.JOINT_STATE_MISSING, lambda: buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))),
    ):
        with pytest.raises(Rejection) as refused:
            buffer.observe(NOW)
        assert refused.value.reason == reason
        add()
    assert buffer.observe(NOW).observation.stamp_ns == NOW


def test_cameras_that_swap_their_views_are_refused_until_a_reset(make_buffer, ros):
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    for view in ('low', 'high'):
        buffer.add_image(view, ros.make_image(view, NOW))
    buffer.observe(NOW)
    for view, other in (('low', 'high'), ('high', 'low')):
        buffer.add_image(view, ros.make_image(other, NOW + MS))
    with pytest.raises(Rejection, match="'high_optical_frame' now, before") as refused:
        buffer.observe(NOW + MS)
    assert refused.value.reason is Reason.CAMERA_POSE_CHANGED
    buffer.accept_cameras(list(buffer._intrinsics._calibrated.values()))
    buffer.observe(NOW + MS)


def test_a_joint_without_a_number_does_not_blind_the_others(make_buffer):
    buffer = make_buffer()
    with pytest.raises(Rejection, match="joint 'b': its position is nan") as refused:
        buffer.add_joint_state(joints(NOW, a=0.1, b=float('nan')))
    assert refused.value.reason == Reason.JOINT_STATE_INVALID
    texts = buffer.problems(NOW)
    assert 'no fresh joint_states of b' in texts


def test_a_joint_named_twice_does_not_blind_the_others(make_buffer):
    buffer = make_buffer()
    twice = JointState(header=make_header(NOW), name=['a', 'b', 'b'], position=[0.1, 0.2, 0.3])
    with pytest.raises(Rejection, match="joint 'b': it is named twice, at 0.2 and at 0.3"):
        buffer.add_joint_state(twice)
    assert 'no fresh joint_states of b' in buffer.problems(NOW)


def test_joints_of_another_device_do_not_matter(make_buffer):
    buffer = make_buffer()
    names, values = ['wheel', 'a', 'wheel', 'b'], [float('nan'), 0.1, 2.0, 0.2]
    buffer.add_joint_state(JointState(header=make_header(NOW), name=names, position=values))
    assert not [text for text in buffer.problems(NOW) if 'joint_states' in text]
