"""A policy lives in the node's imagination: no gap in the clock, and a record of every fault."""

import json
import os
from pathlib import Path
import signal
import sys
import time
from typing import NamedTuple

import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.data.bag.messages import deserialize, header_stamp
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.ros.messages.conversions import NANO, values_of

pytestmark = pytest.mark.slow

FRAME_NS, NUM_FRAMES = 200_000_000, 4
START_NS = 1_700_000_000 * NANO
#: of the runner: episode k has seed 200 + 1000 k, and the fake model blocks at 1200 to 1299
SEED = 200
BLOCKED_SEED = 1200
TASKS = ('good', 'blocked', 'nan', 'other_robot', 'late', 'crashes', 'slow', 'good', 'dies')
ENDS = ('done', 'reset', 'policy_failed', 'rejected', 'late', 'policy_failed', 'another_policy',
        'done', 'policy_died')  # fmt: skip
NUM_CHUNKS = (3, 0, 1, 1, 1, 1, 1, 3, 1)
#: a process ends within it on a busy machine, too [s]; the blocked rollout lasts for longer
BUSY_S = 60.0
PREDICTED = [f'/world_model/{view}/predicted/image_raw' for view in ('low', 'high')]


def write_episode(folder, task, ros):
    """One frame of a recorded episode."""
    cameras = load_calibration(ros.make_calibration(folder / 'calibration.yaml'))
    with EpisodeWriter(
        folder / task,
        task=task,
        instruction='stack the red block on the blue block',
        robot='yam_bimanual',
        cameras=list(cameras.values()),
        overwrite=True,
    ) as writer:
        writer.write_instruction(START_NS)
        for view, camera in cameras.items():
            writer.write_camera_info(view, START_NS, camera)
            writer.write_image(view, START_NS, ros.make_pixels(view))
        writer.write_joint_states(START_NS, ros.JOINTS, ros.HOME)
    return folder / task


class Stack:
    """World model, policy and runner as processes, and a client that interferes."""

    def __init__(self, folder, ros, client):
        self.folder, self.client, self.policy = folder, client, None
        ros.make_checkpoint(folder / 'checkpoint')
        self.world = ros.start_node(
            folder, 'pace:=burst', 'mode:=imagine', 'max_trajectory_age_s:=0.001',
            'diagnostics_period_s:=0.2', *ros.FROZEN, remaps=ros.JOINT_STATES,
        )  # fmt: skip
        self.episodes = [write_episode(folder, task, ros) for task in TASKS]
        self.start('out', ros, self.episodes, SEED)
        self.diagnostics = []

    def start(self, out, ros, episodes, seed):
        if self.policy is not None:
            self.policy.stop()
        self.policy = ros.start_policy_process(
            self.folder, 'answer_timeout_s:=1.5', *ros.FROZEN, remaps=ros.JOINT_STATES
        )
        arguments = [self.folder / out, '--views', 'low', 'high', '--seed', seed, '--episodes']
        arguments += [*episodes, '--heartbeat-timeout', '3']
        command = [sys.executable, '-m', 'mtv_world_ros.ros.episodes.episode_runner']
        log = self.folder / f'{out}.log'
        self.runner = ros.NodeProcess([*command, *map(str, arguments)], log)

    def state(self, name):
        found = [s for s in self.client.statuses('/diagnostics') if s.name == name]
        return values_of(found[-1]) if found else {}

    def wait(self, condition, what):
        def is_so():
            assert self.runner.process.poll() is None, self.runner.output()
            return condition()

        self.client.wait(is_so, what, timeout_s=90.0)

    def wait_for_end(self):
        end_s = time.monotonic() + 120.0
        while self.runner.process.poll() is None and time.monotonic() < end_s:
            self.client.executor.spin_once(timeout_sec=0.05)

    def stop(self):
        for process in (self.runner, self.policy, self.world):
            process.stop()


@pytest.fixture(scope='module')
def stack(tmp_path_factory, ros, client):
    """Everything has happened when a test sees it; each looks at one thing."""
    stack = Stack(tmp_path_factory.mktemp('loop'), ros, client)
    try:
        # somebody resets the world model while it imagines the second episode
        stack.wait(
            lambda: (
                stack.state('world_model').get('busy') == 'true'
                and stack.state('policy').get('episode') == '2'
            ),
            'the blocked rollout',
        )
        client.reset()
        # somebody else publishes a trajectory while the policy of the seventh episode thinks
        stack.wait(
            lambda: (
                stack.state('policy').get('episode') == '7'
                and stack.state('policy').get('phase') == 'acting'
                and stack.state('policy').get('num_chunks') == '1'
            ),
            'the slow policy',
        )
        client.send_trajectory()
        stack.wait(lambda: stack.state('policy')['episode'] == '8', 'the next episode')
        stack.wait_for_end()
        yield stack
    finally:
        stack.stop()


@pytest.fixture
def results(stack):
    return json.loads((stack.folder / 'out' / 'episodes.json').read_text())


def stamps_of(bag, topic):
    messages = BagReader(bag).messages({topic})
    return [header_stamp(deserialize(m.msgtype, m.data)) for m in messages]


def test_every_fault_ends_its_episode_under_its_name_and_the_next_one_begins(stack, results):
    assert [result['how'] for result in results] == list(ENDS), stack.runner.output()
    assert [int(result['num_chunks']) for result in results[:-1]] == list(NUM_CHUNKS[:-1])
    texts = dict(zip(TASKS, (result['text'] for result in results), strict=True))
    assert "joint 'left_joint4' is not finite" in texts['nan']
    assert texts['other_robot'].startswith('joint_names: ')
    assert 'a fault of the fake policy' in texts['crashes']
    assert "'/policy' has been silent" in texts['dies']


def test_the_records_of_all_episodes_are_whole(results):
    for result, num_chunks in zip(results, NUM_CHUNKS, strict=True):
        reader = BagReader(result['bag'])
        topics = reader.topics()
        assert (reader.truncated, reader.problems) == ('', [])
        assert topics['/start/low/image_raw'] == 'sensor_msgs/msg/Image'
        for topic in PREDICTED:
            assert len(stamps_of(result['bag'], topic)) >= num_chunks * NUM_FRAMES


def test_predicted_stamps_go_on_without_gap_or_overlap_from_the_start(results):
    for result, num_chunks in zip(results, NUM_CHUNKS, strict=True):
        if result['task'] == 'slow':  # the other policy's rollout is in this record too
            continue
        start = stamps_of(result['bag'], '/start/low/image_raw')[-1]
        expected = [start + (k + 1) * FRAME_NS for k in range(num_chunks * NUM_FRAMES)]
        for topic in [*PREDICTED, '/world_model/predicted/joint_states']:
            assert stamps_of(result['bag'], topic) == expected
        answered = stamps_of(result['bag'], '/joint_trajectory')
        observed = [start, *expected[NUM_FRAMES - 1 :: NUM_FRAMES]]
        assert answered == observed[: len(answered)]


def test_noise_differs_from_chunk_to_chunk(results):
    reports = [
        {pair.key: pair.value for pair in status.values}
        for m in BagReader(results[0]['bag']).messages({'/world_model/report'})
        for status in deserialize(m.msgtype, m.data).status
    ]
    seeds = [int(r['chunk_seed']) for r in reports if r['state'] == 'chunk']
    assert seeds == [SEED, SEED + 1, SEED + 2]


class Said(NamedTuple):
    level: int
    message: str
    values: dict


def diagnostics_in(bag, name):
    statuses = [
        status
        for m in BagReader(bag).messages({'/diagnostics'})
        for status in deserialize(m.msgtype, m.data).status
        if status.name == name
    ]
    return [Said(s.level, s.message, {p.key: p.value for p in s.values}) for s in statuses]


@pytest.mark.parametrize(
    ('task', 'fault'),
    [
        ('blocked', 'reset'),
        ('nan', 'policy_failed'),
        ('other_robot', 'rejected'),
        ('late', 'late'),
        ('crashes', 'policy_failed'),
        ('slow', 'another_policy'),
    ],
)
def test_diagnostics_count_the_fault_and_warn_of_it(results, task, fault):
    bag = next(r['bag'] for r in results if r['task'] == task)
    said = diagnostics_in(bag, 'policy')
    assert int(said[-1].values[f'faults.{fault}']) >= 1
    assert any(level == 1 and text.startswith(f'{fault}: ') for level, text, _ in said)


def test_the_world_model_counts_what_it_refused(results):
    last = diagnostics_in(results[5]['bag'], 'world_model')[-1].values
    assert last['rejected.joint_names'] == '1'


def test_an_answer_that_comes_after_its_episode_is_dropped_and_counted(results):
    """The late policy answers when the next episode runs."""
    after = results[TASKS.index('late') + 1]
    values = diagnostics_in(after['bag'], 'policy')[-1].values
    assert values['faults.late_answer'] == '1'
    late = results[TASKS.index('late')]['bag']
    assert len(stamps_of(late, '/joint_trajectory')) == 1


def test_two_policies_at_once_are_warned_of_by_both_nodes(results):
    bag = next(r['bag'] for r in results if r['task'] == 'slow')
    for name in ('policy', 'world_model'):
        warnings = [text for level, text, values in diagnostics_in(bag, name)
                    if level == 1 and values['policies'] == '2']  # fmt: skip
        assert any('2 publishers of joint trajectories' in text for text in warnings), name


def test_a_dead_policy_ends_the_run_with_its_record_closed(stack, results):
    assert stack.policy.process.wait(BUSY_S) == 3
    assert stack.runner.process.returncode == 1
    values = diagnostics_in(results[-1]['bag'], 'world_model')[-1].values
    assert values['mode'] == 'imagine'
    assert results[-1]['how'] == 'policy_died'


def test_a_dead_recorder_ends_the_run_at_once_and_says_so(stack, ros):
    stack.start('again', ros, stack.episodes[:1], BLOCKED_SEED)
    stack.wait(lambda: stack.state('world_model').get('busy') == 'true', 'the blocked rollout')
    runner = stack.runner.process
    (recorder,) = Path(f'/proc/{runner.pid}/task/{runner.pid}/children').read_text().split()
    os.kill(int(recorder), signal.SIGKILL)
    assert runner.wait(BUSY_S) == 1
    last = stack.runner.output().splitlines()[-1]
    assert last.startswith('EpisodeError: the recorder ended with status -9: ')


def test_an_interrupted_run_lists_the_bag_that_it_closes(stack, ros):
    out = stack.folder / 'stopped'
    stack.start(out.name, ros, stack.episodes[:1], BLOCKED_SEED)
    stack.wait(lambda: any(out.glob('.episode_*')), 'the begin of a bag')
    stack.runner.stop(signal.SIGINT)
    (listed,) = json.loads((out / 'episodes.json').read_text())
    assert listed['how'] == 'interrupted' and listed['success'] is None
    assert [str(bag) for bag in out.glob('episode_*')] == [listed['bag']]
    assert list(BagReader(listed['bag']).messages({'/world_model/success'})) == []
