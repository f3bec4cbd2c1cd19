"""Which images and joint states make up an observation."""

from contextlib import suppress
from functools import partial
import re
from types import SimpleNamespace

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.ros.messages.conversions import make_header, NANO
from mtv_world_ros.ros.messages.rejection import Reason, Rejection
from mtv_world_ros.ros.parameters import NodeSettings
from mtv_world_ros.ros.sensing import subscriptions
from mtv_world_ros.ros.sensing.observations import ObservationBuffer
from mtv_world_ros.ros.sensing.samples import NodeTime, Samples

NOW = 1_000 * NANO
MS = 1_000_000


@pytest.fixture
def make_buffer(ros, tmp_path):
    cameras = load_calibration(ros.make_calibration(tmp_path / 'calibration.yaml'))

    def make(skew=0.05, joint_names=('a', 'b'), seen=None, clock=None):
        limits = NodeSettings(max_view_skew_s=skew)
        buffer = ObservationBuffer(
            cameras=[cameras[view] for view in ('low', 'high')],
            robot=SimpleNamespace(
                joint_names=joint_names,
                lower=np.full(len(joint_names), -3.0),
                upper=np.full(len(joint_names), 3.0),
                is_endless=np.zeros(len(joint_names), bool),
                velocity_limits=np.full(len(joint_names), 2.0),
                tools=(),
            ),
            width=96,
            height=72,
            limits=lambda: limits,
            time=clock and NodeTime(lambda: clock[0], lambda: False),
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
    buffer.clear()
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    buffer.add_image('low', ros.make_image('low', NOW))
    buffer.add_image('high', ros.make_image('high', NOW - 60 * MS))
    with pytest.raises(Rejection, match='the views are 0.060 s apart') as refused:
        buffer.observe(NOW)
    assert refused.value.reason == Reason.VIEWS_OUT_OF_SYNC


def test_the_newest_stamp_that_all_views_have_goes_before_a_nearer_pair(make_buffer, ros):
    """Synchronised cameras: of the last stamp one view has no image yet, or lost it."""
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    for view, stamps in {'low': (0, 20, 40), 'high': (0, 20, 60)}.items():
        for stamp in stamps:
            buffer.add_image(view, ros.make_image(view, NOW + stamp * MS))
    assert buffer.observe(NOW + 80 * MS).source_stamp_ns == NOW + 20 * MS
    assert not buffer.are_views_apart(NOW + 80 * MS)


def test_views_without_a_common_moment_are_apart_until_the_next_images(make_buffer, ros):
    buffer = make_buffer()
    assert not buffer.are_views_apart(NOW)  # nothing came: another reason
    buffer.add_image('low', ros.make_image('low', NOW - 154 * MS))
    buffer.add_image('high', ros.make_image('high', NOW))
    assert buffer.are_views_apart(NOW)
    buffer.add_image('low', ros.make_image('low', NOW))
    assert not buffer.are_views_apart(NOW)


def test_joint_states_of_several_publishers_are_merged_at_the_images_time(make_buffer, ros):
    buffer = make_buffer()
    for view in ('low', 'high'):
        buffer.add_image(view, ros.make_image(view, NOW - 50 * MS))
    for step in range(-100, 1, 10):
        buffer.add_joint_state(joints(NOW + step * MS, a=step / 1000, lift=9.0))
    buffer.add_joint_state(joints(NOW - 30 * MS, b=7.0))
    np.testing.assert_array_equal(buffer.observe(NOW).observation.positions, [-0.05, 7])


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


def hint_of(compressed, *published):
    """Return where images may be, in a graph with the published topics."""

    class Node:
        def resolve_topic_name(self, topic):
            return f'/cell/{topic}'

        def count_publishers(self, topic):
            return int(topic in published)

    topics = {'low': 'low', 'high': 'high'}
    return partial(subscriptions._other_image_topic, Node(), topics, compressed)


@pytest.mark.parametrize(
    ('compressed', 'published', 'said'),
    [
        ((), '/cell/low/image_raw/compressed', "set the parameter 'compressed_input' to true"),
        (('low',), '/cell/low/image_raw', "set the parameter 'compressed_input' to false"),
        ((), '/cell/other', "does the parameter 'camera_topics.low' name it?"),
    ],
)
def test_images_of_the_other_form_are_named(make_buffer, compressed, published, said):
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    buffer.image_hint = hint_of(compressed, published)
    with pytest.raises(Rejection, match=re.escape(said)) as refused:
        buffer.observe(NOW)
    assert refused.value.reason == Reason.IMAGE_MISSING


@pytest.mark.parametrize(
    ('published', 'said'),
    [
        (('low', 'low/compressed'), "is 2.000 s old; 'max_image_age_s' allows"),
        (
            ('low/compressed',),
            "is 2.000 s old; '/cell/low/image_raw/compressed' publishes compressed images: set",
        ),
    ],
)
def test_images_that_go_on_in_the_other_form_are_named(make_buffer, ros, published, said):
    """A client of raw images has ended, and a recording of compressed ones is played."""
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW + 2 * NANO, a=0.0, b=0.0))
    for view in ('low', 'high'):
        buffer.add_image(view, ros.make_image(view, NOW))
    topics = [f'/cell/{topic}'.replace('low', 'low/image_raw') for topic in published]
    buffer.image_hint = hint_of((), *topics)
    with pytest.raises(Rejection, match=re.escape(said)) as refused:
        buffer.observe(NOW + 2 * NANO)
    assert refused.value.reason == Reason.IMAGE_STALE


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


@pytest.fixture
def clock():
    """The node's time [ns], which a test may change."""
    return [NOW]


def show(buffer, ros, stamp_ns, views=('low', 'high')):
    for view in views:
        buffer.add_image(view, ros.make_image(view, stamp_ns))


def test_an_image_an_hour_ahead_is_refused_and_the_others_stay(make_buffer, ros, clock):
    taken = []
    buffer = make_buffer(clock=clock)
    buffer._on_image = lambda view, message: taken.append(message)
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    show(buffer, ros, NOW)
    with pytest.raises(Rejection, match="view 'low' is stamped 3600.000 s in the future"):
        buffer.add_image('low', ros.make_image('low', NOW + 3600 * NANO))
    assert buffer.observe(NOW).observation.stamp_ns == NOW
    assert len(taken) == 2  # who watches the images does not see it either
    with pytest.raises(Rejection, match="joint 'a' is stamped 3600.000 s in the future"):
        buffer.add_joint_state(joints(NOW + 3600 * NANO, a=0.0, b=0.0))
    assert not buffer.problems(NOW)


def test_images_that_are_all_refused_are_not_called_missing(make_buffer, ros, clock):
    buffer = make_buffer(clock=clock)
    for view in ('low', 'high'):
        with pytest.raises(Rejection):
            show(buffer, ros, NOW + 2 * NANO, [view])
    with pytest.raises(Rejection, match='stamped 2.000 s in the future; do the clocks') as refused:
        buffer.observe(NOW)
    assert refused.value.reason is Reason.IMAGE_STALE


def test_a_system_clock_that_is_set_back_does_not_blind(make_buffer, ros, clock):
    """What was stored before lies in the future then, and would stay the newest for an hour."""
    buffer = make_buffer(clock=clock)
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    show(buffer, ros, NOW)
    clock[0] = later = NOW - 900 * NANO
    buffer.add_joint_state(joints(later, a=0.0, b=0.0))
    show(buffer, ros, later)
    assert buffer.observe(later).observation.stamp_ns == later


def test_a_late_older_frame_is_not_the_newest(make_buffer, ros, clock):
    buffer = make_buffer(clock=clock)
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    show(buffer, ros, NOW)
    show(buffer, ros, NOW - 300 * MS)
    assert buffer.observe(NOW).observation.stamp_ns == NOW
    with pytest.raises(Rejection, match='is 0.800 s old; there are newer ones'):
        show(buffer, ros, NOW - 800 * MS)
    assert buffer.observe(NOW).observation.stamp_ns == NOW


def test_views_that_lose_frames_are_paired_by_the_newest_that_belong_together(make_buffer, ros):
    """Two large cameras at 10 Hz of which each loses frames of its own."""
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    for step in (-400, -300, 0):
        show(buffer, ros, NOW + step * MS, ['low'])
    for step in (-400, -300, -200, -100):
        show(buffer, ros, NOW + step * MS, ['high'])
    assert buffer.observe(NOW).observation.stamp_ns == NOW - 300 * MS
    with pytest.raises(Rejection, match='the views are 0.100 s apart'):
        buffer.observe(NOW + 250 * MS)  # those that belong together are too old by now


def test_one_joint_that_jumps_does_not_blind_the_others(make_buffer):
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW - 600 * MS, a=0.0, b=0.0))
    buffer.add_joint_state(joints(NOW - 599 * MS, a=0.0, b=0.0))
    with pytest.raises(Rejection, match="joint 'b': it jumps from 0 to 5000"):
        buffer.add_joint_state(joints(NOW, a=0.1, b=5000.0))
    assert 'no fresh joint_states of b' in buffer.problems(NOW)


def test_the_limit_of_a_jump_is_that_of_recordings(make_buffer):
    """3 times the joint's speed limit of 2 rad/s, and .05 rad of noise: .35 rad in 50 ms."""
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW - 150 * MS, a=0.0, b=0.0))
    buffer.add_joint_state(joints(NOW - 100 * MS, a=0.34, b=0.0))
    with pytest.raises(Rejection, match="joint 'a': it jumps from 0.34 to -0.02 in 0.0500 s"):
        buffer.add_joint_state(joints(NOW - 50 * MS, a=-0.02, b=0.0))
    buffer.add_joint_state(joints(NOW, a=-0.02, b=0.0))  # .05 + .6 in 100 ms


def test_a_joint_that_was_moved_is_taken_after_the_time_of_a_glitch(make_buffer):
    buffer = make_buffer()
    buffer.add_joint_state(joints(NOW - 700 * MS, a=0.0, b=0.0))
    refused = []
    for step in range(-690, 1, 10):
        try:
            buffer.add_joint_state(joints(NOW + step * MS, a=2.5, b=0.0))
        except Rejection:
            refused.append(step)
    # within reach after (2.5 - .05) / 6 s = .408 s, before a glitch may last that long
    assert refused[0] == -690 and refused[-1] == -300
    assert 'joint_states' not in ' '.join(buffer.problems(NOW))


def test_two_publishers_that_take_turns_are_no_observation(make_buffer, ros):
    """Neither of the two can be told to be the robot's."""
    buffer = make_buffer()
    show(buffer, ros, NOW)
    for step in range(-100, 1, 10):
        place = 1.2 if step % 20 else 0.0
        with suppress(Rejection):
            buffer.add_joint_state(joints(NOW + step * MS, a=place, b=0.0))
    with pytest.raises(Rejection, match='contradict each other: a are at two places'):
        buffer.observe(NOW)
    for step in range(1, 102):  # the other one is gone
        buffer.add_joint_state(joints(NOW + step * MS, a=0.0, b=0.0))
    assert buffer.observe(NOW + 101 * MS).observation.positions.tolist() == [0.0, 0.0]


def test_a_joint_that_is_measured_less_often_than_published_is_no_contradiction(make_buffer, ros):
    """Measured at 5 Hz while it moves at 1 rad/s, published at 100 Hz: it moves in steps of .2."""
    buffer = make_buffer()
    show(buffer, ros, NOW)
    for step in range(-1000, 200, 10):
        with suppress(Rejection):
            place = 0.2 * (step // 200)
            buffer.add_joint_state(joints(NOW + step * MS, a=place, b=0.0))
    assert buffer.observe(NOW + 190 * MS).observation.positions[0] in (-0.2, 0.0)


def test_a_joint_that_moves_fast_and_steadily_is_followed(make_buffer, ros):
    """At 8 rad/s, four times its limit, at 10 Hz: the first step alone is doubtful."""
    buffer = make_buffer()
    show(buffer, ros, NOW)
    refused = []
    for step in range(-500, 1, 100):
        try:
            place = 0.008 * max(step + 300, 0)
            buffer.add_joint_state(joints(NOW + step * MS, a=place, b=0.0))
        except Rejection:
            refused.append(step)
    assert refused == [-200]
    assert buffer.observe(NOW).observation.positions.tolist() == [2.4, 0.0]


def test_a_glitch_is_refused_and_the_joint_goes_on(make_buffer, ros):
    buffer = make_buffer()
    show(buffer, ros, NOW)
    for step in range(-100, 1, 10):
        with suppress(Rejection):
            buffer.add_joint_state(joints(NOW + step * MS, a=3.0 if step == -50 else 0.0, b=0.0))
    assert buffer.observe(NOW).observation.positions.tolist() == [0.0, 0.0]


def test_a_stale_joint_is_named_with_why_its_newer_states_were_refused(make_buffer, ros):
    buffer = make_buffer()
    show(buffer, ros, NOW)
    buffer.add_joint_state(joints(NOW - 700 * MS, a=0.0, b=0.0))
    with pytest.raises(Rejection):
        buffer.add_joint_state(joints(NOW, a=0.0, b=float('nan')))
    with pytest.raises(Rejection, match="joint 'b' is 0.700 s old; .* its position is nan"):
        buffer.observe(NOW)


@pytest.mark.parametrize('size', [(1, 1), (4, 3), (8, 6), (44, 33)])
def test_images_of_a_few_pixels_are_not_judged(make_buffer, ros, size):
    """The model's frames are 96x72."""
    buffer = make_buffer(seen=[(384, 288)] * 2)
    buffer.add_joint_state(joints(NOW, a=0.0, b=0.0))
    for view in ('low', 'high'):
        image = ros.make_image(view, NOW)
        image.width, image.height, image.step = *size, 3 * size[0]
        image.data = bytes(3 * size[0] * size[1])
        buffer.add_image(view, image)
    with pytest.raises(Rejection, match=f'have {size[0]}x{size[1]} pixels; .* 48x36') as refused:
        buffer.observe(NOW)
    assert refused.value.reason is Reason.IMAGE_DATA


def test_samples_are_in_the_order_of_their_stamps():
    samples = Samples(3)
    for stamp, value in ((30, 'c'), (10, 'a'), (20, 'b'), (20, 'again'), (25, 'd'), (5, 'old')):
        samples.add(stamp, value)
    assert samples.stamps == [20, 25, 30] and samples.newest == (30, 'c')
    assert samples.nearest(21) == (20, 'again')
    samples.add(30 - 2 * NANO, 'anew')  # as when a recording starts over
    assert samples.stamps == [30 - 2 * NANO]


def test_an_older_frame_that_comes_late_does_not_displace_newer_ones():
    """By more than a stream's restart, where images may be that old."""
    samples, now = Samples(8), 100 * NANO
    for stamp in (now - NANO // 2, now - NANO // 4):
        assert samples.refuse_reason(stamp, now, 3.0) == ''
        samples.add(stamp, 'new')
    late = now - 2 * NANO
    assert samples.refuse_reason(late, now, 3.0) == ''
    samples.add(late, 'old')
    assert samples.newest == (now - NANO // 4, 'new') and samples.stamps[0] == late
    # a recording that starts over: what is stored is not recent any more
    later = now + 60 * NANO
    samples.refuse_reason(late, later, 3.0)
    samples.add(late, 'anew')
    assert samples.stamps == [late]


def test_steps_of_the_system_clock_are_told_from_its_drift():
    now, steady, simulated = [NOW], [0], [False]
    time = NodeTime(lambda: now[0], lambda: simulated[0], lambda: steady[0])
    assert time.step_s() == 0.0
    for passed, gone, step in ((1000, 1010, 0.0), (1000, -2600, -3.6), (50, 950, 0.9)):
        steady[0] += passed * MS
        now[0] += gone * MS
        assert time.step_s() == pytest.approx(step)
    simulated[0] = True  # rclpy tells of jumps of /clock
    now[0] = 0
    assert time.step_s() == 0.0


@pytest.mark.parametrize('paused', [('now',), ('steady',), ('now', 'steady')])
@pytest.mark.parametrize(
    'interrupted', [1, 2, 3, 10**6], ids=['once', 'twice', 'thrice', 'always']
)
def test_a_pause_between_two_readings_of_clocks_is_no_step(paused, interrupted):
    """The process does not run for .15 or .3 s between them: at times, or always."""
    true, left = [NOW], [0]

    def read(name, offset_ns):
        value = true[0] + offset_ns
        if name in paused and left[0] > 0:
            left[0] -= 1
            true[0] += 150 * MS
        return value

    time = NodeTime(lambda: read('now', 0), lambda: False, lambda: read('steady', -NOW))
    assert time.step_s() == 0.0
    for _ in range(4):
        left[0] = interrupted
        assert time.step_s() == 0.0
    left[0] = 0
    assert time.step_s() == 0.0


def test_a_step_is_believed_once_two_readings_agree_on_it():
    """A clock of one wrong reading did not step; one that stays away did."""
    readings, now = [0, 0, 3600], 0

    def offset_s():
        return readings.pop(0) if readings else now

    time = NodeTime(lambda: NOW + offset_s() * NANO, lambda: False, lambda: 0)
    assert [time.step_s() for _ in range(3)] == [0.0, 0.0, 0.0]
    now = -90
    assert time.step_s() == pytest.approx(-90.0)


def test_joint_states_without_a_stamp_have_the_time_of_receipt(make_buffer):
    buffer = make_buffer(clock=[NOW])
    for _ in range(3):
        buffer.add_joint_state(joints(0, a=0.5, b=0.1))
    assert buffer.ages(NOW)['joint_state_age_s'] == 0
    assert buffer.notes == ['joint states have no stamp: the time of receipt is taken']


def test_images_without_a_stamp_have_the_time_of_receipt(ros, make_buffer):
    buffer = make_buffer(clock=[NOW])
    buffer.add_image('low', shade(ros, 'low', 0, 80))
    assert buffer.ages(NOW)['image_age_s.low'] == 0
    assert "images of view 'low' have no stamp" in buffer.notes[0]


def test_a_gripper_of_two_publishers_is_no_observation():
    robot = load_robot(share_path('config', 'robots', 'franka', 'robot.yaml'))
    buffer = ObservationBuffer(
        cameras=(), robot=robot, width=96, height=72, limits=NodeSettings, time=None
    )
    for k in range(30):
        stamp = NOW + k * 20 * MS
        named = dict.fromkeys(robot.joint_names, 0.0)
        buffer.add_joint_state(joints(stamp, **{**named, 'panda_finger_joint1': 0.03}))
        assert not any('contradict' in text for text in buffer.problems(stamp)) or k > 4
        buffer.add_joint_state(joints(stamp + MS, panda_finger_joint1=0.0))
    (text,) = [text for text in buffer.problems(stamp) if 'contradict' in text]
    assert "'panda_finger_joint1' goes forth and back between 0 and 0.03" in text
