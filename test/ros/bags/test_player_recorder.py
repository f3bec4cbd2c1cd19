"""An episode is played into the node and what the node publishes is recorded."""

from contextlib import suppress
from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
import pytest
import rclpy
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import CompressedImage, JointState
from std_msgs.msg import Float32MultiArray, String
from trajectory_msgs.msg import JointTrajectory

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.data_types import JointTrajectory as Trajectory
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode import PLACE
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.importing.recover import find_damaged, recover
from mtv_world_ros.ros.messages.conversions import NANO, to_ns
from test.support.in_process import PATIENCE_S

START_NS = 1_700_000_000 * NANO
STEP_NS = 100_000_000
NUM_STEPS = 9
PLANS = (0, 4)
IMAGE = '/low/image_raw/compressed'
FIDELITY = '/world_model/fidelity'
PREDICTED = '/world_model/low/predicted/image_raw'
RECORDED = (PREDICTED, '/world_model/low/predicted/camera_info', '/world_model/report',
            '/world_model/success', FIDELITY)  # fmt: skip


@pytest.fixture(scope='module')
def episode(tmp_path_factory, ros):
    """Nine frames of two views at 10 Hz, a plan at 0 s and one at 0.4 s."""
    return write_episode(tmp_path_factory.mktemp('episodes'), ros)


@pytest.fixture(scope='module')
def bare_episode(tmp_path_factory, ros):
    """The same with a calibration, but without CameraInfo."""
    return write_episode(tmp_path_factory.mktemp('bare'), ros, has_infos=False)


def write_episode(folder, ros, *, has_infos=True, others=()):
    """Write an episode; `others` are further topics with its plans."""
    cameras = load_calibration(ros.make_calibration(folder / 'calibration.yaml'))
    with EpisodeWriter(
        folder / 'episode',
        task='stack_blocks_two',
        instruction='stack the red block on the blue block',
        robot='yam_bimanual',
        objects=('red block', 'blue block'),
        cameras=list(cameras.values()),
        metadata={PLACE: 'bench'},
    ) as writer:
        writer.write_instruction(START_NS)
        for step in range(NUM_STEPS):
            stamp_ns = START_NS + step * STEP_NS
            if step in PLANS:  # written first: the player still plays it after the images
                times = np.array([0.2, 0.4, 0.6, 0.8])
                rows = np.repeat(ros.HOME[None], 4, axis=0)
                plan = Trajectory(joint_names=ros.JOINTS, times=times, positions=rows)
                writer.write_trajectory(stamp_ns, plan)
                for topic in others:
                    message = messages.make_joint_trajectory(stamp_ns + 1, plan)
                    writer.write_message(topic, messages.JOINT_TRAJECTORY, stamp_ns, message)
            for view, camera in cameras.items():
                if has_infos:
                    writer.write_camera_info(view, stamp_ns, camera)
                writer.write_image(view, stamp_ns, ros.make_pixels(view))
            writer.write_joint_states(stamp_ns, ros.JOINTS, ros.HOME)
    return folder / 'episode'


@pytest.fixture
def launch(ros):
    """Start `python -m mtv_world_ros.ros.bags.<module>`; what still runs is stopped."""
    started = []

    def launch(module, *arguments):
        command = [sys.executable, '-m', f'mtv_world_ros.ros.bags.{module}', *map(str, arguments)]
        process = subprocess.Popen(
            command, env=ros.ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True,
        )  # fmt: skip
        started.append(process)
        return process

    yield launch
    for process in started:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.wait(timeout=PATIENCE_S)


@pytest.fixture
def node(tmp_path, ros):
    process = ros.start_node(
        tmp_path, 'pace:=burst', 'compressed_input:=true', 'use_sim_time:=true'
    )
    yield process
    assert process.stop() == 0, process.output()


def finish(process, number=None):
    if number is not None:
        process.send_signal(number)
    output, _ = process.communicate(timeout=PATIENCE_S)
    return process.returncode, output


@pytest.mark.slow
def test_episode_is_imagined_in_lock_step_and_recorded(node, episode, launch, client, tmp_path):
    out = tmp_path / 'predictions'
    compared = client.received[FIDELITY]
    compared.clear()
    client.connect_outputs({FIDELITY: Float32MultiArray})
    recorder = launch('recorder', out, *RECORDED, '--stamp', 'header')
    everybody = ('--wait-for', '/joint_trajectory', *RECORDED)
    player = launch('player', episode, '--clock', '--lock-step', '--rate', '4', *everybody)
    code, said = finish(player)
    assert code == 0, said
    assert '2 trajectories, 2 done' in said
    client.wait(lambda: compared, 'the fidelity, which comes after the frames')
    assert not out.exists()  # it gets its name when it is complete
    code, said = finish(recorder, signal.SIGINT)
    assert code == 0, said
    assert 'Traceback' not in said

    expected = [
        START_NS + plan * STEP_NS + (k + 1) * 2 * STEP_NS for plan in PLANS for k in range(4)
    ]
    reader = BagReader(out)
    stamps = [m.stamp_ns for m in reader.messages((PREDICTED,))]
    assert stamps == expected
    assert sorted(reader.topics()) == sorted(RECORDED)
    with AnyReader([out]) as bag:  # an independent reader
        frames = [
            bag.deserialize(data, connection.msgtype)
            for connection, _, data in bag.messages()
            if connection.topic == PREDICTED
        ]
    assert sorted(f.header.stamp.sec * NANO + f.header.stamp.nanosec for f in frames) == sorted(
        expected
    )
    assert {(f.width, f.height, f.encoding) for f in frames} == {(48, 36, 'rgb8')}
    check_fidelity(out)


def check_fidelity(out):
    """The first plan's frames at 0.2 and 0.4 s came true before the second plan.

    The fake model moves the picture by a pixel a frame, the real blocks, 6 px wide, stand still:
    J is 5/7 and then 4/8 in every view, give or take edges that are half covered. The bag ends
    before the second plan's frames.
    """
    with AnyReader([out]) as bag:
        messages = [
            (connection.topic, bag.deserialize(data, connection.msgtype))
            for connection, _, data in bag.messages()
        ]
    (fidelity,) = [message for topic, message in messages if topic == FIDELITY]
    assert [(d.label, d.size) for d in fidelity.layout.dim] == [('view', 2), ('object', 2)]
    reports = [
        {pair.key: pair.value for pair in message.status[0].values}
        for topic, message in messages
        if topic == '/world_model/report'
    ]
    (said,) = [values for values in reports if values['state'] == 'fidelity']
    assert (said['rollout'], said['chunk']) == ('1', '0')
    # a camera's images come at depth 1: a busy node may miss the first of the two
    expected = {'2': (5 / 7 + 4 / 8) / 2, '1': 4 / 8}[said['frames_compared']]
    np.testing.assert_allclose(fidelity.data, expected, atol=0.07)
    assert float(said['fidelity_copy.low.red_block']) == 1.0
    chunks = [values for values in reports if values['state'] == 'chunk']
    assert {values['trusted'] for values in chunks} == {'not measured'}
    assert {values['success_num_seeds'] for values in chunks} == {'1'}


def test_stamps_are_moved_to_now_but_stay_in_step(episode, launch, ros):
    client = ros.Client()
    try:
        client.subscribe(CompressedImage, IMAGE, depth=100)
        client.subscribe(CompressedImage, IMAGE.replace('low', 'high'), depth=100)
        client.subscribe(JointState, '/joint_states', depth=100)
        client.subscribe(JointTrajectory, '/plan', depth=100)
        client.subscribe(String, '/instruction', depth=1)
        client.subscribe(String, '/objects', depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        begin_ns = time.time_ns()
        player = launch(
            'player', episode, '--rate', '2', '--ros-args', '-r', '/joint_trajectory:=/plan'
        )
        client.wait(lambda: len(client.received['/plan']) == 2, 'two plans')
        client.wait(lambda: len(client.received['/joint_states']) == NUM_STEPS, 'joint states')
        client.wait(lambda: len(client.received[IMAGE]) == NUM_STEPS, 'images')
        client.wait(lambda: client.received['/objects'], 'the names of objects')
        code, said = finish(player)
        assert code == 0, said
        assert "the objects of this episode are on '/objects': red block, blue block" in said
        assert client.received['/objects'][-1].data == 'red block, blue block'
        assert 'world_model takes them with -p calibration_file:=FILE' in said
        assert "world_model is told with -p 'place:=bench'" in said
        stamps = {
            topic: np.array([to_ns(m.header.stamp) for m in messages])
            for topic, messages in client.received.items()
            if messages and hasattr(messages[0], 'header')
        }
        low = stamps[IMAGE]
        assert begin_ns < low[0] < time.time_ns()
        np.testing.assert_allclose(np.diff(low), STEP_NS / 2, atol=2)
        np.testing.assert_array_equal(stamps['/joint_states'], low)
        np.testing.assert_array_equal(stamps['/plan'], low[list(PLANS)])
        assert client.received['/instruction'][0].data.startswith('stack')
    finally:
        client.close()


def test_loop_with_a_clock_starts_over_and_the_node_goes_on(node, episode, launch, ros):
    client = ros.Client()
    try:
        player = launch('player', episode, '--clock', '--loop', '--lock-step', '--rate', '4')
        client.wait(lambda: len(client.report_values('done')) >= 5, 'three rounds')
        plans = [r['trajectory_stamp_ns'] for r in client.report_values('done')]
        assert len(set(plans)) == 2
        client.wait(
            lambda: int(client.diagnostic_values().get('clock_jumps_back', 0)) >= 1, 'the jump'
        )
        code, said = finish(player, signal.SIGINT)
        assert code == 0 and 'Traceback' not in said
    finally:
        client.close()


@pytest.mark.slow
def test_plans_that_a_node_rejects_are_a_failure_that_says_which_and_why(
    node, bare_episode, launch
):
    for options in (('--lock-step',), ()):
        code, said = finish(launch('player', bare_episode, '--clock', *options))
        assert code == 1, said
        assert '2 of 2 plans were not imagined' in said
        assert '2 rejected, at 0.00, 0.40 s: camera_info_missing: no camera_info of view' in said
        mending = f'mtv-world fit camera {bare_episode} --view low,high --apply'
        assert said.rstrip().endswith(f'{mending} writes it'), said
        assert 'Traceback' not in said


@pytest.mark.slow
def test_plans_that_the_next_one_preempts_are_no_failure(node, episode, launch, client):
    # at this rate a busy machine handles the plans when they are a minute old by the clock
    ages = ('max_image_age_s', 'max_joint_state_age_s', 'max_trajectory_age_s')
    assert client.set(**dict.fromkeys(ages, 3600.0)) == ''
    code, said = finish(launch('player', episode, '--clock', '--rate', '50'))
    assert code == 0, said
    assert '2 trajectories' in said and ('1 preempted' in said or '2 done' in said)


@pytest.mark.slow
@pytest.mark.parametrize('stops', [False, True])
def test_a_plan_without_an_answer_is_a_failure_unless_the_player_is_stopped(
    stops, episode, launch, client, ros
):
    """Somebody reports, takes plans, and never answers."""
    client.subscribe(JointTrajectory, '/joint_trajectory', depth=10)
    reports = client.node.create_publisher(ros.REPORT, '/world_model/report', 10)
    taken = client.received['/joint_trajectory']
    taken.clear()
    timeout = '60' if stops else '0.5'
    player = launch('player', episode, '--rate', '4', '--answer-timeout', timeout)
    client.wait(lambda: len(taken) >= len(PLANS), 'both plans')
    code, said = finish(player, signal.SIGINT if stops else None)
    client.node.destroy_publisher(reports)
    assert 'Traceback' not in said
    if stops:
        assert code == 0, said
    else:
        assert code == 1, said
        assert '2 unanswered, at 0.00, 0.40 s: no answer within 0.5 s' in said


@pytest.mark.slow
def test_plans_of_a_node_that_ended_meanwhile_are_a_failure(episode, launch, client, ros):
    reports = client.node.create_publisher(ros.REPORT, '/ended/report', 10)
    options = ('--rate', '0.2', '--answer-timeout', '60', '--report-topic', '/ended/report')
    remap = ('--ros-args', '-r', '/joint_trajectory:=/ended/plan')
    player = launch('player', episode, *options, *remap)
    # it knows the publisher before it plays, on a busy machine, too: an acknowledgement comes from
    # a reader that knows its writer, and nobody reads the plans until then
    client.wait(lambda: reports.get_subscription_count() > 0, 'the player to read reports')
    reports.publish(ros.REPORT())
    assert reports.wait_for_all_acked(Duration(seconds=PATIENCE_S))
    client.subscribe(JointTrajectory, '/ended/plan', depth=10)
    taken = client.received['/ended/plan']
    client.wait(lambda: len(taken) >= len(PLANS), 'both plans')
    client.node.destroy_publisher(reports)
    code, said = finish(player)
    assert code == 1, said
    assert "2 unanswered, at 0.00, 0.40 s: no answer, and nobody publishes '/ended/report'" in said
    assert 'Traceback' not in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ('key', 'before', 'after'),
    [(f'publishers.{IMAGE}', '0', '1'), ('lifecycle', 'configuring', 'active')],
)
@pytest.mark.parametrize('lock_step', [True, False])
def test_a_node_that_loads_or_does_not_hear_the_cameras_yet_is_waited_for(
    key, before, after, lock_step, episode, launch, client
):
    """A publisher counts subscribers that do not know it yet: what it then sends is lost.

    A node that loads reads plans already, to keep the last one, but no images.
    """
    model = rclpy.create_node('deaf', context=client.context)
    reports = model.create_publisher(DiagnosticArray, '/deaf/report', 10)
    diagnostics = model.create_publisher(DiagnosticArray, '/diagnostics', 10)
    heard, plans = False, []

    def publish(publisher, **values):
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        publisher.publish(DiagnosticArray(status=[DiagnosticStatus(name='deaf', values=pairs)]))

    def answer(plan):
        plans.append(heard)
        publish(reports, state='done', trajectory_stamp_ns=str(to_ns(plan.header.stamp)))

    def tell():
        publish(diagnostics, **{key: after if heard else before})

    inputs = [
        model.create_subscription(JointTrajectory, '/joint_trajectory', answer, 10),
        model.create_subscription(CompressedImage, IMAGE, lambda image: None, 10),
    ]
    model.create_timer(0.05, tell)
    client.executor.add_node(model)
    try:
        options = ['--rate', '4', '--report-topic', '/deaf/report']
        player = launch('player', episode, *options, *(['--lock-step'] if lock_step else []))
        client.wait(lambda: all(i.get_publisher_count() for i in inputs), 'the player')
        until_s = time.monotonic() + 5
        while time.monotonic() < until_s:  # longer than connections take to settle
            client.executor.spin_once(timeout_sec=0.05)
        heard = True
        client.wait(lambda: player.poll() is not None, 'the end of the player')
        code, said = finish(player)
    finally:
        client.executor.remove_node(model)
        model.destroy_node()
    assert code == 0, said
    assert plans == [True] * len(PLANS)


@pytest.mark.slow
@pytest.mark.parametrize('options', [('--lock-step',), ()])
def test_only_plans_that_the_reporting_node_reads_are_to_be_answered(
    options, tmp_path, launch, client, ros
):
    """A recording of two arms with a topic each, and a recorder that listens to both."""
    path = write_episode(tmp_path, ros, others=['/left/plan'])
    model, listener = (rclpy.create_node(n, context=client.context) for n in ('fake', 'listener'))
    reports = model.create_publisher(DiagnosticArray, '/fake/report', 10)
    diagnostics = model.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish(publisher, **values):
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        publisher.publish(DiagnosticArray(status=[DiagnosticStatus(name='fake', values=pairs)]))

    def answer(plan):
        stamp_ns = str(to_ns(plan.header.stamp))
        publish(reports, state='done', trajectory_stamp_ns=stamp_ns)

    model.create_subscription(JointTrajectory, '/joint_trajectory', answer, 10)
    model.create_timer(0.1, lambda: publish(diagnostics, state='active'))
    listener.create_subscription(JointTrajectory, '/left/plan', lambda plan: None, 10)
    client.executor.add_node(model)
    client.executor.add_node(listener)
    try:
        options = ('--answer-timeout', '5', '--report-topic', '/fake/report', *options)
        player = launch('player', path, *options)
        client.wait(lambda: player.poll() is not None, 'the end of the player')
        code, said = finish(player)
    finally:
        for one in (model, listener):
            client.executor.remove_node(one)
            one.destroy_node()
    assert code == 0, said
    assert '2 done' in said and '2 not read' in said, said
    assert "no answer is expected on '/left/plan' (2 plans): the node reads /joint_traj" in said
    assert 'Traceback' not in said


def test_truncated_bag_is_played_up_to_the_cut_and_says_so(episode, launch, tmp_path, ros):
    cut = tmp_path / 'cut'
    cut.mkdir()
    whole = next(episode.glob('*.mcap')).read_bytes()
    (cut / 'cut_0.mcap').write_bytes(whole[: len(whole) // 3])
    code, said = finish(launch('player', cut, '--no-wait', '--rate', '100'))
    assert code == 0, said
    assert 'played up to the cut' in said


def test_nobody_listening_is_an_error_that_says_what_to_do(episode, launch):
    code, said = finish(launch('player', episode, '--wait-timeout', '0.2'))
    assert code == 1
    assert "without a subscriber of ['/joint_trajectory']" in said and '--no-wait' in said
    assert 'Traceback' not in said


def test_missing_episode_and_topic_are_clear_errors(episode, launch, tmp_path):
    code, said = finish(launch('player', tmp_path / 'none'))
    assert code == 1 and 'there is no episode' in said and 'Traceback' not in said
    code, said = finish(launch('player', episode, '--topics', '/middle/image_raw'))
    assert code == 1 and 'it has' in said and 'Traceback' not in said


def test_recorder_leaves_no_half_written_folder(launch, tmp_path):
    out = tmp_path / 'record'
    code, said = finish(launch('recorder', out, '/silence', '--wait-timeout', '0.2'))
    assert code == 1
    assert "nobody publishes ['/silence']" in said
    assert list(tmp_path.iterdir()) == []
    out.mkdir()
    (out / 'mine').touch()
    code, said = finish(launch('recorder', out, '/silence'))
    assert code == 1 and 'exists already' in said and 'Traceback' not in said


@pytest.mark.slow
def test_a_recorder_whose_parent_is_killed_closes_its_bag_and_ends(tmp_path, ros):
    client = ros.Client()
    out = tmp_path / 'bag'
    parent = (
        'import sys, time\n'
        'from pathlib import Path\n'
        'from mtv_world_ros.core.processes import module_command, start_process\n'
        "command = module_command('bags.recorder', sys.argv[1], '/said')\n"
        "child = start_process('recorder', command, Path(sys.argv[1]).parent)\n"
        'print(child.pid, flush=True)\n'
        'time.sleep(100)\n'
    )
    process = subprocess.Popen(
        [sys.executable, '-c', parent, str(out)], env=ros.ENVIRONMENT, stdout=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    try:
        child = int(process.stdout.readline())
        publisher = client.node.create_publisher(String, '/said', 10)
        client.wait(publisher.get_subscription_count, 'the recorder')
        log = tmp_path / 'recorder.log'
        client.wait(lambda: ': recording' in log.read_text(), 'the recorder')
        for text in ('a', 'b', 'c'):
            publisher.publish(String(data=text))
        publisher.wait_for_all_acked()
        process.kill()
        process.wait()
        client.wait(out.is_dir, 'the closed bag')
        assert len(list(BagReader(out).messages())) == 3
        client.wait(lambda: not is_alive(child), 'the end of the recorder')
    finally:
        process.kill()
        client.close()


def starved_s(pid):
    """The longest that a thread of a process has waited for a processor so far [s]."""
    waits = [0]
    for file in Path(f'/proc/{pid}/task').glob('*/schedstat'):
        with suppress(OSError):  # it ended
            waits.append(int(file.read_text().split()[1]))
    return max(waits) / NANO


@pytest.fixture
def recorded(launch, tmp_path, ros):
    """A recorder of joint states that are published all the time, at 100 Hz; its folder."""
    client = ros.Client()
    recorder = launch('recorder', tmp_path / 'bag', '/joints', '--stamp', 'receive')
    publisher = client.node.create_publisher(JointState, '/joints', 100)
    sent = []

    def publish():
        sent.append(time.monotonic())
        publisher.publish(ros.make_joint_state(client.now_ns()))

    timer = client.node.create_timer(0.01, publish)
    client.wait(publisher.get_subscription_count, 'the recorder')
    client.spin_for(0.5)
    sent.clear()
    client.spin_for(2.0)
    yield recorder, client, sent
    timer.cancel()
    client.close()


@pytest.mark.slow
def test_a_recorder_stops_soon_though_publishers_go_on(recorded, tmp_path):
    recorder, client, sent = recorded
    num_sent = len(sent)  # a busy machine sends fewer than 100 a second
    assert num_sent > 10
    recorder.send_signal(signal.SIGINT)
    # it would wait for a silence that never comes; no shorter limit holds on a busy machine
    client.wait(lambda: recorder.poll() is not None, 'the end of the recorder', 30.0)
    assert recorder.returncode == 0
    with AnyReader([tmp_path / 'bag']) as bag:
        assert bag.message_count > 0.75 * num_sent


def test_a_recorder_that_is_stopped_before_it_records_says_so(launch, tmp_path):
    recorder = launch('recorder', tmp_path / 'bag', '/nobody_publishes_this')
    time.sleep(0.5)
    while recorder.poll() is None and not list(tmp_path.glob('.bag.*.tmp')):
        time.sleep(0.02)  # it waits for the publisher from here on
    time.sleep(0.5)
    code, said = finish(recorder, signal.SIGINT)
    assert (code, 'Traceback' in said) == (1, False), said
    assert "stopped before recording began, '" in said
    assert '/nobody_publishes_this had not been connected yet' in said
    assert not list(tmp_path.iterdir())


def test_a_killed_recorder_loses_no_more_than_a_second(recorded, tmp_path):
    recorder, client, sent = recorded
    before_s = starved_s(recorder.pid)
    client.spin_for(1.0)
    starved = starved_s(recorder.pid) - before_s
    recorder.kill()
    recorder.wait()
    killed = time.monotonic()
    (bag,) = [recover(source) for source in find_damaged(tmp_path)]
    stamps = [message.stamp_ns for message in BagReader(bag.path).messages()]
    assert len(stamps) >= len([at for at in sent if at < killed - 1.0 - starved])
    age_s = (time.time_ns() - stamps[-1]) / NANO - (time.monotonic() - killed)
    # nothing was there to record while the sender did not run either
    pauses_s = np.diff([at for at in sent if at > killed - 2.0 - starved] + [killed])
    assert age_s < 1.0 + starved + max(pauses_s)
    with AnyReader([tmp_path / 'bag']) as read:
        assert read.message_count == len(stamps)


def test_a_topic_that_brings_nothing_is_named_and_so_is_its_beginning(launch, tmp_path, client):
    out = tmp_path / 'bag'
    talks, mute, late = (
        client.node.create_publisher(String, f'/{name}', 10) for name in ('talks', 'mute', 'late')
    )
    recorder = launch('recorder', out, '/talks', '/mute', '/late')
    for publisher in (talks, mute, late):
        client.wait(publisher.get_subscription_count, 'the recorder')
    lines = []

    def read():
        for line in recorder.stdout:
            lines.append(line)

    reader = threading.Thread(target=read)
    reader.start()

    def line_with(text):
        talks.publish(String(data='a'))
        client.spin_for(0.1)
        return next((line for line in lines if text in line), '')

    client.wait(lambda: line_with('nothing came of'), 'the topics that bring nothing')
    named = re.search(r'nothing came of /late, /mute in the (\d+\.\d) s', ''.join(lines))
    assert named and float(named[1]) >= 2.0, lines
    late.publish(String(data='b'))
    client.wait(lambda: line_with("s after 'recording'"), 'the beginning')
    recorder.send_signal(signal.SIGINT)
    assert recorder.wait(PATIENCE_S) == 0
    reader.join()
    said = ''.join(lines)
    assert re.search(r"/late began \d+\.\d s after 'recording'", said), said
    assert re.search(r'/late 1, /mute 0, /talks \d+$', said.strip()), said


def is_alive(pid):
    stat = Path(f'/proc/{pid}/stat')
    try:
        return stat.read_text().rsplit(')', 1)[1].split()[0] != 'Z'
    except OSError:
        return False


@pytest.mark.slow
def test_two_robots_and_two_players_do_not_meet(episode, launch, tmp_path, ros, client):
    """Each in a namespace of its own, with its own clock, on one machine."""
    heard = {}
    for name in ('one', 'two'):
        folder = tmp_path / name
        folder.mkdir()
        heard[name] = ros.start_node(
            folder, 'pace:=burst', 'compressed_input:=true', 'use_sim_time:=true',
            f'seed:={100 + len(heard)}', remaps=(f'__ns:=/{name}', '/clock:=clock'),
        )  # fmt: skip
    try:
        for name in heard:
            client.hear(heard[name], ros.REPORT, f'/{name}/world_model/report')
        for name in heard:
            client.hear(heard[name], ros.REPORT, '/diagnostics')
        spaces = [('--ros-args', '-r', f'__ns:=/{name}') for name in heard]
        first, second = (
            launch('player', episode, '--clock', '--lock-step', '--rate', rate, *space)
            for rate, space in zip(('4', '2'), spaces, strict=True)
        )
        for player in (first, second):
            client.wait(lambda p=player: p.poll() is not None, 'a player')
            code, said = finish(player)
            assert code == 0, said
            assert '2 trajectories, 2 done' in said
        client.spin_for(1.0)
        for number, name in enumerate(heard):
            told = client.statuses(f'/{name}/world_model/report')
            values = [{pair.key: pair.value for pair in status.values} for status in told]
            assert {status.name for status in told} == {f'{name}/world_model: rollout'}
            assert {status.hardware_id for status in told} == {f'{name}/yam_bimanual'}
            assert [v['seed'] for v in values if v['state'] == 'done'] == [str(100 + number)] * 2
        names = {s.name for s in client.statuses('/diagnostics')}
        assert {'one/world_model', 'two/world_model'} <= names
    finally:
        for process in heard.values():
            assert process.stop() == 0, process.output()
