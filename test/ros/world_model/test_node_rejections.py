"""Everything that "can go wrong" is sent to the running node: refused, counted, and it goes on."""

import time

import numpy as np
import pytest

from mtv_world_ros.data.measured_joints import REACH
from test.support.large_messages import empty_points

OUT_OF_MEMORY, CRASHES, STUCK = 1100, 1300, 1500


@pytest.fixture(scope='module')
def node(tmp_path_factory, ros, client):
    process = ros.start_node(tmp_path_factory.mktemp('node'), 'pace:=burst')
    client.connect_inputs(ros.INPUTS)
    yield process
    code = process.stop()
    assert code == 0, process.output()


def rejections(client, reason):
    return int(client.diagnostic_values().get(f'rejected.{reason}', 0))


def expect_counted(client, reason, before):
    """The count in /diagnostics goes up and the last rejection names the reason."""
    client.wait(lambda: rejections(client, reason) > before, f'{reason} in /diagnostics')
    assert client.diagnostic_values()['last_rejection'].startswith(f'{reason}: ')


def expect_goes_on(client):
    assert client.imagine_one()['state'] == 'done'


def test_refuses_until_everything_was_received_and_says_what_is_missing(node, client, ros):
    assert client.imagine_one(scene='none')['reason'] == 'image_missing'
    client.send_scene(info_low=None, info_high=None, joints=None)
    assert client.imagine_one(scene='none')['reason'] == 'camera_info_missing'
    client.send_scene(joints=None)
    assert client.imagine_one(scene='none')['reason'] == 'joint_state_missing'
    partial = ros.make_joint_state(client.now_ns(), ros.JOINTS[:7], ros.HOME[:7])
    client.send_scene(joints=partial)
    ended = client.imagine_one(scene='none')
    assert ended['reason'] == 'joint_state_missing'
    assert 'right_joint1' in ended['text'] and 'left_joint1' not in ended['text']
    expect_counted(client, 'joint_state_missing', 1)
    expect_goes_on(client)


HOME_ROWS = np.tile([0.0, 1.047, 1.047, 0.0, 0.0, 0.0, 0.03] * 2, (4, 1))


def changed(point, joint, value):
    rows = HOME_ROWS.copy()
    rows[point, joint] = value
    return rows


BAD_TRAJECTORIES = {
    'no joint of the robot': (
        'joint_names',
        "it has no ['lift']",
        lambda ros: {'names': ('lift',), 'positions': np.zeros((4, 1))},
    ),
    'misspelt joint of a partial plan': (
        'joint_names',
        "did you mean 'left_joint6'?",
        lambda ros: {'names': ('left_joint1', 'left_jiont6'), 'positions': np.zeros((4, 2))},
    ),
    'unknown joint': (
        'joint_names',
        "did you mean 'right_gripper'?",
        lambda ros: {'names': (*ros.JOINTS[:-1], 'right_gripperr')},
    ),
    'joint named twice': (
        'joint_names',
        'more than once',
        lambda ros: {'names': (*ros.JOINTS[:-1], 'left_joint1')},
    ),
    'nan': (
        'trajectory_not_finite',
        "'left_joint2' has positions nan at point 1",
        lambda ros: {'positions': changed(1, 1, np.nan)},
    ),
    'infinite': (
        'trajectory_not_finite',
        'inf',
        lambda ros: {'positions': changed(3, 0, np.inf)},
    ),
    'outside the limits': (
        'joint_limits',
        "'left_joint2' is -0.5",
        lambda ros: {'positions': changed(2, 1, -0.5)},
    ),
    'times equal': (
        'trajectory_times',
        'not increasing at point 2',
        lambda ros: {'times': (0.2, 0.4, 0.4, 0.8)},
    ),
    'times falling': (
        'trajectory_times',
        'not increasing at point 3',
        lambda ros: {'times': (0.2, 0.4, 0.6, 0.5)},
    ),
    'no points for another robot': (
        'trajectory_empty',
        '0 points',
        lambda ros: {'names': ('elbow',), 'times': (), 'positions': ()},
    ),
    'no joints': (
        'trajectory_empty',
        '0 joint names',
        lambda ros: {'names': (), 'positions': np.zeros((4, 0))},
    ),
    'short point': (
        'trajectory_malformed',
        'point 0 has 13 positions for 14 joints',
        lambda ros: {'positions': HOME_ROWS[:, :13]},
    ),
    'too long': (
        'trajectory_too_long',
        "'max_horizon_s' allows 60",
        lambda ros: {'times': (1, 2, 3, 1000)},
    ),
}


@pytest.mark.parametrize('case', BAD_TRAJECTORIES)
def test_refuses_the_trajectory_and_imagines_the_next(node, client, ros, case):
    reason, text, fields = BAD_TRAJECTORIES[case]
    before = rejections(client, reason)
    ended = client.imagine_one(**fields(ros))
    assert (ended['state'], ended['reason']) == ('rejected', reason)
    assert text in ended['text']
    expect_counted(client, reason, before)
    expect_goes_on(client)


@pytest.mark.parametrize(
    ('offset_ns', 'reason', 'text'),
    [
        (-3_000_000_000, 'trajectory_stale', "'max_trajectory_age_s' allows 1 s"),
        (10**15, 'trajectory_too_long', 'same clock'),
    ],
)
def test_refuses_a_trajectory_of_another_time(node, client, offset_ns, reason, text):
    ended = client.imagine_one(stamp_ns=client.now_ns() + offset_ns)
    assert ended['reason'] == reason and text in ended['text']
    expect_goes_on(client)


@pytest.mark.parametrize(('transport_s', 'is_said'), [(0.004, False), (2.9, True)])
def test_a_stale_plan_that_was_sent_again_says_so(node, client, ros, transport_s, is_said):
    client.send_scene()
    client.spin_for(0.1)
    since, late_ns = len(client.report_values()), client.now_ns() - 3_000_000_000
    node.node._configured.on_plan(ros.make_trajectory(stamp_ns=late_ns), transport_s)
    ended = client.next_end(since)
    assert ended['reason'] == 'trajectory_stale'
    assert ('2.900 s after it was published: lost and sent again' in ended['text']) == is_said


BAD_IMAGES = {
    'encoding': ('image_encoding', {'encoding': 'yuv420'}),
    'depth': ('image_encoding', {'encoding': '16UC1'}),
    'step too small': ('image_data', {'step': 3 * 96 - 1}),
    'step of another image': ('image_data', {'step': 4 * 96}),
    'short data': ('image_data', {'data': bytes(100)}),
    'no data': ('image_data', {'data': b''}),
    'no pixels': ('image_data', {'width': 0, 'height': 0, 'step': 0, 'data': b''}),
}


@pytest.mark.parametrize('case', BAD_IMAGES)
def test_refuses_the_image_and_keeps_the_one_before(node, client, ros, case):
    reason, fields = BAD_IMAGES[case]
    before = rejections(client, reason)
    client.send_scene()
    client.publish('/low/image_raw', ros.make_image('low', client.now_ns(), **fields))
    expect_counted(client, reason, before)
    expect_goes_on(client)


def test_refuses_images_of_another_size_than_their_camera_info(node, client, ros):
    stamp_ns = client.now_ns()
    pixels = ros.make_pixels('low')[::2]
    small = ros.to_image(pixels, ros.make_header('low', stamp_ns))
    client.send_scene(stamp_ns, image_low=small)
    ended = client.imagine_one(scene='sent')
    assert ended['reason'] == 'camera_info_invalid'
    assert '96x36' in ended['text'] and '96x72' in ended['text']
    expect_goes_on(client)


def test_refuses_changed_camera_info_until_reset_or_restored(node, client, ros):
    before = rejections(client, 'camera_info_changed')
    client.send_scene(info_low=ros.make_info('low', fx=100.0))
    ended = client.imagine_one(scene='sent')
    assert ended['reason'] == 'camera_info_changed'
    assert 'from [90' in ended['text'] and 'to [100' in ended['text']
    expect_counted(client, 'camera_info_changed', before)
    expect_goes_on(client)  # the first info came back

    client.send_scene(info_low=ros.make_info('low', fx=100.0))
    client.wait(lambda: rejections(client, 'camera_info_changed') >= before + 3, 'the change')
    assert client.reset().success
    client.send_scene(info_low=ros.make_info('low', fx=100.0))
    assert client.imagine_one(scene='sent')['state'] == 'done'
    client.send_scene()
    assert client.imagine_one(scene='sent')['reason'] == 'camera_info_changed'
    assert client.reset().success
    expect_goes_on(client)


def test_camera_info_without_calibration_is_the_same_as_none(node, client, ros):
    client.send_scene(info_low=ros.make_info('low', fx=0.0))
    assert client.imagine_one(scene='sent')['state'] == 'done'  # the first one holds
    assert client.reset().success
    expect_goes_on(client)


@pytest.mark.parametrize(
    ('limits', 'age_ns', 'parts', 'reason', 'text'),
    [
        ({'max_image_age_s': 0.02}, 200_000_000, {}, 'image_stale', 'allows 0.02 s'),
        # on a quiet machine the last test's joint state is younger than the limit
        ({'max_joint_state_age_s': 0.02}, 0, {'joints': None}, 'joint_state_stale', ''),
    ],
)
def test_refuses_what_is_too_old(node, client, limits, age_ns, parts, reason, text):
    assert client.set(**limits) == ''
    time.sleep(0.1)
    client.send_scene(client.now_ns() - age_ns, **parts)
    ended = client.imagine_one(scene='sent')
    assert client.set(**dict.fromkeys(limits, 10.0)) == ''
    assert ended['reason'] == reason and text in ended['text']
    expect_goes_on(client)


def test_what_comes_from_the_future_is_refused_and_does_not_blind(node, client, ros):
    before = rejections(client, 'image_stale')
    client.send_scene()
    stamp_ns = client.now_ns() + 3600 * ros.NANO
    for view in ros.VIEWS:
        client.publish(f'/{view}/image_raw', ros.make_image(view, stamp_ns))
    expect_counted(client, 'image_stale', before)
    assert client.imagine_one(scene='sent')['state'] == 'done'


JOINT_STATES = {
    'nan': {'positions': (float('nan'),) * 14},
    'too few': {'positions': (0.0,) * 13},
    'none': {'positions': ()},
    'a joint named twice': {'names': lambda names: (*names[:-1], names[0])},
    'out of reach': {'positions': (0.0, 1e300, *(0.0,) * 12)},
}


@pytest.mark.parametrize('case', JOINT_STATES)
def test_refuses_joint_states_that_cannot_be(node, client, ros, case):
    before = rejections(client, 'joint_state_invalid')
    fields = dict(JOINT_STATES[case])
    if 'names' in fields:
        fields['names'] = fields['names'](ros.JOINTS)
    client.send_scene()
    client.publish('/joint_states', ros.make_joint_state(client.now_ns(), **fields))
    expect_counted(client, 'joint_state_invalid', before)
    expect_goes_on(client)


def send_views_out_of_sync(client, ros):
    stamp_ns = client.now_ns()
    for offset_ns in range(-16_000_000, 0, 2_000_000):  # nothing older is kept
        client.publish('/low/image_raw', ros.make_image('low', stamp_ns + offset_ns))
        high = ros.make_image('high', stamp_ns + offset_ns - 100_000_000)
        client.publish('/high/image_raw', high)
        client.spin_for(0.02)
    client.send_scene(stamp_ns, image_low=None, image_high=None)


def test_refuses_views_that_are_out_of_sync(node, client, ros):
    assert client.set(max_view_skew_s=0.001) == ''
    for _ in range(3):  # on a busy machine a plan may overtake the images
        send_views_out_of_sync(client, ros)
        ended = client.imagine_one(scene='sent')
        if ended['state'] == 'rejected':
            break
    assert client.set(max_view_skew_s=0.05) == ''
    assert ended['reason'] == 'views_out_of_sync'
    assert "'max_view_skew_s' allows 0.001 s" in ended['text']
    expect_goes_on(client)


def test_a_plan_waits_for_images_of_one_moment(node, client, ros):
    assert client.set(max_view_skew_s=0.001) == ''
    send_views_out_of_sync(client, ros)
    since = len(client.report_values())
    client.send_trajectory()
    client.spin_for(0.05)
    client.send_scene()  # both views with one stamp
    ended = client.next_end(since)
    assert client.set(max_view_skew_s=0.05) == ''
    assert ended['state'] == 'done', ended


@pytest.mark.parametrize(
    ('seed', 'reason', 'text'),
    [
        (OUT_OF_MEMORY, 'out_of_memory', 'the device ran out of memory'),
        (CRASHES, 'internal_error', 'RuntimeError: a fault of the fake model'),
    ],
)
def test_outlives_whatever_the_model_raises(node, client, seed, reason, text):
    before = rejections(client, reason)
    assert client.set(seed=seed) == ''
    ended = client.imagine_one()
    assert client.set(seed=0) == ''
    assert (ended['state'], ended['reason']) == ('failed', reason) and text in ended['text']
    expect_counted(client, reason, before)
    expect_goes_on(client)


def test_a_stuck_model_is_given_up_and_another_thread_goes_on(node, client, ros):
    assert client.set(seed=STUCK, stuck_after_s=0.5) == ''
    since = len(client.report_values())
    ended = client.imagine_one()
    assert (ended['state'], ended['reason']) == ('failed', 'worker_stuck')
    assert 'stuck_after_s' in ended['text']
    assert client.set(seed=0, stuck_after_s=600.0) == ''
    expect_goes_on(client)
    client.spin_for(3.0)  # the old thread wakes up, and says nothing more
    ends = ('done', 'preempted', 'rejected', 'failed', 'reset')
    states = [v['state'] for v in client.report_values()[since:] if v['state'] in ends]
    assert states == ['failed', 'done']
    expect_goes_on(client)


def test_measured_joints_that_cannot_be_are_refused(node, client, ros):
    before = rejections(client, 'joint_state_invalid')
    wild = ros.HOME.copy()
    wild[1] = 1e300
    client.send_scene(joints=ros.make_joint_state(client.now_ns(), positions=wild))
    expect_counted(client, 'joint_state_invalid', before)
    send_joints(client, ros, wild)  # longer than a glitch: they are taken as measured
    ended = client.imagine_one(scene='as it is')
    assert ended['reason'] == 'joint_state_invalid'
    send_joints(client, ros, ros.HOME)
    expect_goes_on(client)


def send_joints(client, ros, positions):
    """Publish scenes with these joint states for longer than a glitch may last."""
    end_s = time.monotonic() + REACH.glitch_s + 0.2
    while time.monotonic() < end_s:
        client.send_scene(joints=ros.make_joint_state(client.now_ns(), positions=positions))
        client.spin_for(0.05)


def test_names_of_objects_are_those_of_their_topic_until_it_says_that_there_are_none(
    node, client, ros
):
    for text, names in (
        ('blue block,  red block, blue block', 'blue block, red block'),
        ('', 'red block'),  # of the instruction
    ):
        client.publish('/objects', ros.STRING(data=text))
        client.publish('/instruction', ros.STRING(data='lift the red block'))
        stored = tuple(filter(None, names.split(', '))) if text else ()
        client.wait_until_told(node, instruction='lift the red block', stored_objects=stored)
        expect_goes_on(client)
        found = client.report_values('chunk')[-1]['objects']
        assert found == names


def test_input_that_froze_the_node_is_refused_at_once(node, client, ros):
    since = time.process_time()
    names = [f'joint{n}' for n in range(20_000)]
    ended = client.imagine_one(names=names, positions=np.zeros((1, 20_000)), times=[1.0])
    assert ended['reason'] == 'trajectory_malformed'
    before = rejections(client, 'instruction_too_long')
    client.publish('/instruction', ros.STRING(data='put the ' * 1900))
    expect_counted(client, 'instruction_too_long', before)
    client.publish('/instruction', ros.STRING(data=('put the red ' * 300)))
    before = rejections(client, 'objects_too_long')
    client.publish('/objects', ros.STRING(data='a block, ' * 1900))
    expect_counted(client, 'objects_too_long', before)
    expect_goes_on(client)
    assert time.process_time() - since < 20


@pytest.mark.parametrize(
    'changes', [{'d': [float('nan')] * 5}, {'d': [1e30, 0, 0, 0, 0]}, {'fx': 1e308}]
)
def test_a_camera_that_cannot_be_is_refused(node, client, ros, changes):
    """One that is no number is left out, as the valid one is known; others are changes."""
    before = rejections(client, 'camera_info_invalid')
    info = ros.make_info('low', client.now_ns(), fx=changes.get('fx', 90.0))
    if 'd' in changes:
        info.d = changes['d']
    client.send_scene(info_low=info)
    ended = client.imagine_one(scene='as it is')
    if ended['state'] == 'done':
        expect_counted(client, 'camera_info_invalid', before)
    else:
        assert ended['reason'] in ('camera_info_changed', 'camera_info_invalid')
    client.send_scene()
    expect_goes_on(client)


@pytest.mark.parametrize('count', [200_000, 1_000_000])
def test_a_plan_of_many_points_is_answered_once_before_it_is_decoded(node, client, ros, count):
    expect_goes_on(client)
    stamp_ns, known = client.now_ns(), len(client.reports_of('rejected'))
    before = rejections(client, 'trajectory_malformed')
    client.publish('/joint_trajectory', empty_points(count, stamp_ns))
    client.wait(lambda: len(client.reports_of('rejected')) > known, 'the answer')
    expect_counted(client, 'trajectory_malformed', before)
    assert len(client.reports_of('rejected')) == known + 1
    answer = client.report_values('rejected')[-1]
    assert answer['trajectory_stamp_ns'] == str(stamp_ns)
    assert answer['reason'] == 'trajectory_malformed'
    assert f'has {count} points; at most 20000 are read' in answer['text']
    expect_goes_on(client)


def test_bytes_that_are_no_plan_are_answered(node, client, ros):
    known, stamp_ns = len(client.reports_of('rejected')), client.now_ns()
    client.publish('/joint_trajectory', empty_points(3, stamp_ns)[:-40])
    client.wait(lambda: len(client.reports_of('rejected')) > known, 'the answer')
    answer = client.report_values('rejected')[-1]
    assert answer['trajectory_stamp_ns'] == str(stamp_ns)
    assert 'bytes hold no whole JointTrajectory' in answer['text']
    expect_goes_on(client)


@pytest.mark.parametrize('topic', ['/instruction', '/joint_states', '/low/camera_info'])
def test_large_messages_of_other_topics_are_counted(node, client, topic):
    before = rejections(client, 'message_too_large')
    client.publish(topic, b'\0\1\0\0' + bytes(2**18))
    expect_counted(client, 'message_too_large', before)
    expect_goes_on(client)
