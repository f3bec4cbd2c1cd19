"""Lists of policies: what they may hold, and what becomes of a policy that goes wrong."""

import os
from pathlib import Path
import pickle
import sys
import time

import numpy as np
import pytest
import yaml

from test.support.policy_servers import HOME, observe

pytest.importorskip('msgpack', reason='msgpack is not installed (pip install .[policies])')
pytest.importorskip('websockets', reason='websockets is not installed (pip install .[policies])')

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.core.errors import ConfigError, PolicyError, SimulatorError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.ranking.policy_list import (
    check_single_clients,
    check_tasks,
    ListedPolicies,
    load_policy_list,
    tasks_of,
)
from mtv_world_ros.simulation.scenes.tasks import task_named, tasks_named
from test.support.own_task import write_shift_right

#: a websocket server of openpi's protocol whose prompt says what goes wrong
SERVER = Path(__file__).parents[1] / 'support' / 'openpi_server.py'
OPENPI = {
    'name': 'served', 'policy': 'openpi', 'change': {'timeout_s': 2.0},
    'command': [sys.executable, str(SERVER), '--port', '{port}'], 'start_timeout_s': 60.0,
}  # fmt: skip


class Wild:
    """A policy in Python that answers what it is made with."""

    name = 'wild'

    def __init__(self, does=''):
        self.does, self.seeds = does, []

    def reset(self, *, seed):
        self.seeds.append(seed)

    def act(self, observation, instruction):
        if self.does == 'raise':
            raise KeyError('weights')
        if self.does == 'text':
            return 'forward'
        value = np.nan if self.does == 'nan' else 0.0
        names = ('left_joint1',) if self.does != 'foreign' else ('elbow',)
        return JointTrajectory(joint_names=names, times=[0.5], positions=[[value]])


@pytest.fixture
def load(tmp_path, robot):
    def load(*policies, **more):
        path = tmp_path / 'list.yaml'
        path.write_text(yaml.safe_dump({'policies': list(policies), **more}))
        return load_policy_list(path, robot)

    return load


@pytest.fixture
def make(load, tmp_path, expert):
    """Make the one policy of a list."""

    def make(entry):
        made = pickle.loads(pickle.dumps(ListedPolicies(load(entry), tmp_path / 'logs')))  # noqa: S301
        return made(entry['name'], task_named('stack_blocks_two'), 1, expert)

    return make


def wild(does, name='mine'):
    policy = {'kind': 'python', 'factory': 'wild_policies:Wild', 'arguments': {'does': does}}
    return {'name': name, 'policy': policy}


@pytest.fixture
def wild_module(tmp_path, monkeypatch):
    (tmp_path / 'wild_policies.py').write_text(Path(__file__).read_text())
    monkeypatch.syspath_prepend(tmp_path)


def test_the_bundled_example_has_one_of_every_kind(robot):
    listed = load_policy_list(share_path('config', 'rankings', 'example.yaml'), robot)
    assert {policy.config.kind for policy in listed} == {
        'scripted', 'openpi', 'lerobot', 'python',
    }  # fmt: skip
    assert listed[2].config.server == 'ws://localhost:8000'
    act = listed[3]
    assert act.config.policy.path.endswith('100000/pretrained_model')
    assert act.config.policy.type == 'act' and act.command and not listed[2].command
    check_single_clients(listed, workers=2)


def test_a_definition_changes_with_the_policy_and_not_with_patience(load):
    (first,) = load(OPENPI)
    (slow,) = load({**OPENPI, 'change': {'timeout_s': 9.0}, 'start_timeout_s': 5.0})
    (other,) = load({**OPENPI, 'change': {'actions': {'rate_hz': 25}}})
    assert first.definition == slow.definition != other.definition


def test_a_policy_is_ranked_on_its_own_tasks(load):
    mine = {'name': 'mine', 'policy': 'expert', 'tasks': ['shake_bottle']}
    listed = load(mine, {'name': 'any', 'policy': 'expert'})
    others = tasks_named('stack_blocks_two')
    assert tasks_of(listed, others) == tasks_named('shake_bottle,stack_blocks_two')
    assert tasks_of(listed[:1], others) == tasks_named('shake_bottle')
    check_tasks(listed, tasks_named('shake_bottle,place_cup_plate'))
    with pytest.raises(ConfigError, match="'mine' is for the tasks shake_bottle"):
        check_tasks(listed, tasks_named('place_cup_plate'))
    with pytest.raises(SimulatorError, match="'shake_botle' .did you mean 'shake_bottle'"):
        load({**mine, 'tasks': ['shake_botle']})


def test_a_policy_is_ranked_on_task_files_beside_the_list(load, tmp_path):
    path = write_shift_right(tmp_path)
    mine = {'name': 'mine', 'policy': 'expert', 'tasks': ['shift_right.yaml', 'shake_bottle']}
    (listed,) = load(mine)
    tasks = tasks_named(f'{path},shake_bottle')
    assert listed.tasks == tasks == tasks_of([listed], ())
    check_tasks([listed], tasks)
    with pytest.raises(ConfigError, match="'mine' is for a task 'shift_right' that differs from"):
        check_tasks([listed], tasks_named(str(write_shift_right(tmp_path, distance_m=0.15))))


@pytest.mark.parametrize(
    ('entries', 'says'),
    [
        ([], 'policies'),
        ([{'name': 'a', 'policy': 'expert'}] * 2, "two policies have the name 'a'"),
        ([{'name': 'a/b', 'policy': 'expert'}], 'letters, digits'),
        ([{'name': 'a'}], 'policy'),
        ([{'name': 'a', 'policy': 'expert-mis-1'}], "unknown fault 'mis'"),
        ([{'name': 'a', 'policy': 'opnpi'}], "did you mean 'openpi'"),
        ([{'name': 'a', 'policy': {'kind': 'opnpi'}}], "policy 'a': policy kind 'opnpi'"),
        ([{'name': 'a', 'policy': 'openpi', 'changes': {}}], "did you mean 'change'"),
        ([{'name': 'a', 'policy': 'openpi', 'change': {'sever': 1}}], "did you mean 'server'"),
        ([{'name': 'a', 'policy': 'expert', 'command': ['x', '{port}']}], "has a 'command'"),
        ([{'name': 'a', 'policy': 'openpi', 'command': ['serve']}], 'must have {port}'),
    ],
)
def test_a_wrong_list_is_refused(load, entries, says):
    with pytest.raises((ConfigError, PolicyError)) as raised:
        load(*entries)
    assert says in str(raised.value)


def test_a_running_lerobot_server_is_not_shared_by_workers(load):
    listed = load({'name': 'act', 'policy': 'lerobot'})
    check_single_clients(listed, workers=1)
    with pytest.raises(ConfigError, match="'act' would get 2"):
        check_single_clients(listed, workers=2)


@pytest.mark.parametrize(
    ('does', 'says'),
    [
        ('raise', "policy 'mine' raised KeyError: 'weights'"),
        ('text', "policy 'mine' answered with a str"),
        ('nan', "policy 'mine': joint 'left_joint1' is not finite"),
    ],
)
def test_what_goes_wrong_in_a_policy_names_it(make, wild_module, does, says):
    policy = make(wild(does))
    policy.reset(seed=1)
    with pytest.raises(PolicyError) as raised:
        policy.act(observe(), 'go')
    assert says in str(raised.value)


def test_a_server_is_started_restarted_and_ended(make, tmp_path):
    policy = make(OPENPI)
    policy.reset(seed=1)
    answer = policy.act(observe(), 'go')
    np.testing.assert_allclose(answer.positions[0], HOME[: answer.positions.shape[1]], atol=0.03)
    first = policy._server._process
    # it hangs: the next episode gets a new one
    with pytest.raises(PolicyError, match="policy 'served': .* did not answer within 2 s"):
        policy.act(observe(), 'sleep')
    assert first.poll() is not None
    policy.reset(seed=2)
    second = policy._server._process
    assert policy.act(observe(), 'go') is not None
    # NaN is the policy's fault, not the server's
    with pytest.raises(PolicyError, match="policy 'served': action 3 has nan"):
        policy.act(observe(), 'nan')
    # it dies
    second.kill()
    with pytest.raises(PolicyError, match="policy 'served': the policy server .* is gone"):
        policy.act(observe(), 'go')
    policy.reset(seed=3)
    assert policy.act(observe(), 'go') is not None
    third = policy._server._process
    del policy
    deadline = time.monotonic() + 60
    while third.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    assert third.poll() is not None
    assert len(list((tmp_path / 'logs').glob(f'served_{os.getpid()}_*.log'))) == 3


def test_a_server_that_never_starts_is_given_up(make):
    died = [sys.executable, '-c', 'raise SystemExit("no such checkpoint")', '{port}']
    policy = make({**OPENPI, 'command': died})
    for _ in range(3):
        with pytest.raises(PolicyError, match='ended with status 1 .*: no such checkpoint'):
            policy.reset(seed=1)
    with pytest.raises(PolicyError, match="'served' is given up: it was started 3 times"):
        policy.reset(seed=1)
    absent = make({**OPENPI, 'command': ['no_such_program', '{port}'], 'name': 'absent'})
    with pytest.raises(PolicyError, match="the server of policy 'absent'"):
        absent.reset(seed=1)
