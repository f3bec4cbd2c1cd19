"""The policy node in the node's imagination: no gap in the clock, and a name for every fault."""

from dataclasses import dataclass, field
from itertools import chain

import pytest

from mtv_world_ros.ros.messages.conversions import NANO, to_ns, values_of

pytestmark = pytest.mark.slow

FRAME_NS, NUM_FRAMES = 200_000_000, 4
SEED = 200
#: the fake model blocks at seeds 1200 to 1299
BLOCKED_SEED = 1200
#: by task of the fake policy: end of the episode, and its number of chunks
EPISODES = {
    'good': ('done', 3),
    'blocked': ('reset', 0),
    'nan': ('policy_failed', 1),
    'other_robot': ('rejected', 1),
    'late': ('late', 1),
    'crashes': ('policy_failed', 1),
    'slow': ('another_policy', 1),
    'good_again': ('done', 3),
}
PREDICTED = [f'/world_model/{view}/predicted/image_raw' for view in ('low', 'high')]
PREDICTED_JOINTS = '/world_model/predicted/joint_states'


@dataclass
class Episode:
    """What a client saw of an episode."""

    start_ns: int = 0
    end: dict = field(default_factory=dict)
    messages: dict = field(default_factory=dict)

    def stamps(self, topic):
        return [to_ns(message.header.stamp) for message in self.messages[topic]]

    def statuses(self, topic, name):
        found = chain.from_iterable(message.status for message in self.messages[topic])
        return [status for status in found if status.name == name]


class Stack:
    """World model and policy in this process, and a client that shows scenes and interferes."""

    def __init__(self, folder, ros, client):
        self.ros, self.client = ros, client
        ros.make_checkpoint(folder / 'checkpoint')
        ages = ('max_image_age_s:=3600.0', 'max_joint_state_age_s:=3600.0')
        self.world = ros.start_node(
            folder, 'pace:=burst', 'mode:=imagine', 'max_trajectory_age_s:=0.001', *ages
        )
        self.policy = ros.start_policy(folder, 'answer_timeout_s:=4.5', *ages)
        client.subscribe(ros.REPORT, '/policy/report', 100)
        client.subscribe(ros.PLAN, '/joint_trajectory', 10)
        client.connect_outputs(
            {**dict.fromkeys(PREDICTED, ros.IMAGE), PREDICTED_JOINTS: ros.JOINT_STATE}, depth=50
        )
        client.connect_inputs(ros.INPUTS)

    def state(self, name):
        found = [s for s in self.client.statuses('/diagnostics') if s.name == name]
        return values_of(found[-1]) if found else {}

    def run(self, task, seed, interfere):
        """Live an episode; `interfere` is called once it was begun."""
        client, ros, episode = self.client, self.ros, Episode()
        client.received.clear()
        for node, values in {
            '/world_model': {'seed': seed},
            '/policy': {'seed': seed, 'task': task.removesuffix('_again')},
        }.items():
            assert client.set_on(node, **values) == ''
        client.reset()
        begun = client.call(ros.TRIGGER, '/policy/start', ros.TRIGGER.Request())
        number = begun.message.split()[-1]
        episode.start_ns = client.send_scene()
        interfere()

        def has_ended():
            reports = map(values_of, client.statuses('/policy/report'))
            episode.end = next(
                (v for v in reports if v['state'] == 'ended' and v['episode'] == number), {}
            )
            return bool(episode.end)

        client.wait(has_ended, f"the end of '{task}'")
        # the last frames and the diagnostics of its end
        since = len(client.received['/diagnostics'])
        client.wait(lambda: len(client.received['/diagnostics']) > since + 2, 'the diagnostics')
        episode.messages = {topic: list(found) for topic, found in client.received.items()}
        return episode

    def reset_while_busy(self):
        """Somebody resets the world model while it imagines."""
        self.client.wait(lambda: self.state('world_model').get('busy') == 'true', 'the rollout')
        self.client.reset()

    def send_another_plan(self):
        """Somebody else publishes a trajectory while the policy thinks."""

        def is_thinking():
            state = self.state('policy')
            return state.get('phase') == 'acting' and state.get('num_chunks') == '1'

        self.client.wait(is_thinking, 'the slow policy')
        self.client.send_trajectory()

    def stop(self):
        return [process.stop() for process in (self.policy, self.world)]


@pytest.fixture(scope='module')
def episodes(tmp_path_factory, ros, client):
    """Everything has happened when a test sees it; each looks at one thing."""
    stack = Stack(tmp_path_factory.mktemp('loop'), ros, client)
    interferences = {'blocked': stack.reset_while_busy, 'slow': stack.send_another_plan}
    try:
        yield {
            task: stack.run(
                task,
                BLOCKED_SEED if task == 'blocked' else SEED,
                interferences.get(task, lambda: None),
            )
            for task in EPISODES
        }
    finally:
        assert stack.stop() == [0, 0]


def test_every_fault_ends_its_episode_under_its_name_and_the_next_one_begins(episodes):
    ends = {task: (e.end['how'], int(e.end['num_chunks'])) for task, e in episodes.items()}
    assert ends == EPISODES
    texts = {task: episode.end['text'] for task, episode in episodes.items()}
    assert "joint 'left_joint4' is not finite" in texts['nan']
    assert texts['other_robot'].startswith('joint_names: ')
    assert 'a fault of the fake policy' in texts['crashes']


def test_predicted_stamps_go_on_without_gap_or_overlap_from_the_start(episodes):
    for task, (_, num_chunks) in EPISODES.items():
        if task == 'slow':  # the other policy's rollout was seen too
            continue
        episode = episodes[task]
        expected = [episode.start_ns + (k + 1) * FRAME_NS for k in range(num_chunks * NUM_FRAMES)]
        for topic in [*PREDICTED, PREDICTED_JOINTS] if num_chunks else []:
            assert episode.stamps(topic) == expected, (task, topic)
        observed = [episode.start_ns, *expected[NUM_FRAMES - 1 :: NUM_FRAMES]]
        answered = episode.stamps('/joint_trajectory')
        assert answered == observed[: len(answered)]


def test_noise_differs_from_chunk_to_chunk(episodes):
    reports = [
        values_of(status)
        for message in episodes['good'].messages['/world_model/report']
        for status in message.status
    ]
    seeds = [int(r['chunk_seed']) for r in reports if r['state'] == 'chunk']
    assert seeds == [SEED, SEED + 1, SEED + 2]


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
def test_diagnostics_count_the_fault_and_warn_of_it(episodes, task, fault):
    said = episodes[task].statuses('/diagnostics', 'policy')
    assert int(values_of(said[-1])[f'faults.{fault}']) >= 1
    assert any(s.level == b'\x01' and s.message.startswith(f'{fault}: ') for s in said)


def test_the_world_model_counts_what_it_refused(episodes):
    said = episodes['crashes'].statuses('/diagnostics', 'world_model')
    assert values_of(said[-1])['rejected.joint_names'] == '1'


def test_an_answer_that_comes_after_its_episode_is_dropped_and_counted(episodes):
    """The late policy answers when the next episode runs."""
    said = episodes['crashes'].statuses('/diagnostics', 'policy')
    assert values_of(said[-1])['faults.late_answer'] == '1'
    assert len(episodes['late'].stamps('/joint_trajectory')) == 1


def test_two_policies_at_once_are_warned_of_by_both_nodes(episodes):
    for name in ('policy', 'world_model'):
        said = episodes['slow'].statuses('/diagnostics', name)
        warnings = [s.message for s in said if s.level == b'\x01']
        assert any('2 publishers of joint trajectories' in text for text in warnings), name


def test_start_stamps_are_of_this_time(episodes):
    """What the nodes answer is the scene that was shown, not one of the episode before."""
    starts = [episode.start_ns for episode in episodes.values()]
    assert starts == sorted(starts) and starts[0] > 1.7e9 * NANO
