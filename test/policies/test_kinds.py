"""A kind of policies is one file: settings that make a policy, chosen by `kind`."""

from importlib.metadata import EntryPoint
import pickle
import sys

import numpy as np
import pytest
import yaml

from mtv_world_ros.core import registry
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.policies.kinds import load_policy_config, POLICY_KINDS, settings_class
from mtv_world_ros.policies.policy import EpisodeOrigin, PolicySettings
from mtv_world_ros.ranking.policy_list import (
    check_single_clients,
    ListedPolicies,
    load_policy_list,
)
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.rollout.assembly import assemble_policy
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.scenes.tasks import task_named
from test.support.policy_servers import observe

ROBOT = load_robot(robot_path('yam_bimanual'))
CLIENT = """
from typing import ClassVar

import numpy as np

from mtv_world_ros import JointTrajectory
from mtv_world_ros.core.errors import PolicyError
from mtv_world_ros.policies.policy import PolicySettings


class Shift(PolicySettings):
    server_address: ClassVar[str] = 'tcp://127.0.0.1:{port}'
    serves_one_client: ClassVar[bool] = True
    kind: str
    server: str = ''
    by: float = 0.1

    def check(self):
        if self.by == 0.5:
            raise PolicyError('a shift of 0.5 is refused')

    def make(self, origin, robot):
        return Shifting(self.by, robot.joint_names)


class PerEpisode(Shift):
    is_made_for_episode: ClassVar[bool] = True

    def make(self, origin, robot):
        return Shifting(origin.scene_seed, robot.joint_names)


class Shifting:
    name = 'shift'

    def __init__(self, by, names):
        self.by, self.names = by, names

    def reset(self, *, seed): ...

    def act(self, observation, instruction):
        return JointTrajectory(
            joint_names=self.names, times=np.array([0.1]),
            positions=observation.positions[None] + self.by,
        )
"""


@pytest.fixture(autouse=True)
def client(tmp_path, monkeypatch):
    sys.modules.pop('my_client', None)  # the one of docs/policies.md has the same name
    (tmp_path / 'my_client.py').write_text(CLIENT)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop('my_client', None)


def written(folder, **values):
    path = folder / 'policy.yaml'
    path.write_text(yaml.safe_dump(values))
    return path


def moved(policy):
    observation = observe()
    policy.reset(seed=0)
    return policy.act(observation, '').positions[0] - observation.positions


def test_a_client_of_ones_own_is_chosen_by_module_and_class(tmp_path):
    path = written(tmp_path, kind='my_client:Shift', by=0.3)
    make = assemble_policy(path, ROBOT)
    np.testing.assert_allclose(moved(make(EpisodeOrigin())), 0.3)
    assert make(EpisodeOrigin()) is make(EpisodeOrigin(scene_seed=4))  # one for all episodes


def test_a_policy_that_depends_on_its_episode_is_made_for_each(tmp_path):
    make = assemble_policy(written(tmp_path, kind='my_client:PerEpisode'), ROBOT)
    for seed in (3, 4):
        np.testing.assert_allclose(moved(make(EpisodeOrigin(scene_seed=seed))), seed)


def test_an_entry_point_registers_a_kind(tmp_path, monkeypatch):
    point = EntryPoint('shift', 'my_client:Shift', 'mtv_world.policies')
    monkeypatch.setattr(registry, 'registered', lambda group: {'shift': point})
    path = written(tmp_path, kind='shift')
    assert load_policy_config(path, ROBOT).kind == 'shift'
    with pytest.raises(ConfigError, match=r"kind 'shfit' is not.*did you mean 'shift'"):
        load_policy_config(written(tmp_path, kind='shfit'), ROBOT)


def test_a_ranking_takes_it_with_its_server_in_every_worker(tmp_path):
    (tmp_path / 'mine.yaml').write_text(
        'policies:\n'
        '- {name: ours, policy: {kind: "my_client:Shift", by: 0.2}}\n'
        '- {name: served, policy: {kind: "my_client:Shift"}, command: [serve, "{port}"]}\n'
        '- {name: each, policy: {kind: "my_client:PerEpisode"}}\n'
    )
    listed = load_policy_list(tmp_path / 'mine.yaml', ROBOT)
    assert listed[1].config.server == 'tcp://127.0.0.1:0'
    with pytest.raises(ConfigError, match="kind 'my_client:Shift' serves one client.*'ours'"):
        check_single_clients(listed[:1], 2)
    check_single_clients(listed[1:2], 2)
    make = pickle.loads(pickle.dumps(ListedPolicies(listed, tmp_path)))  # noqa: S301
    expert, task = Expert(ROBOT), task_named('shake_bottle')
    np.testing.assert_allclose(moved(make('ours', task, 3, expert)), 0.2)
    np.testing.assert_allclose(moved(make('each', task, 3, expert)), 3)


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        ({}, "policy.yaml: expected a key 'kind', a text: openpi, "),
        ({'kind': 3}, "policy.yaml: expected a key 'kind', a text"),
        (
            {'kind': 'opnpi'},
            r"policy kind 'opnpi' is not registered \(did you mean 'openpi'",
        ),
        ({'kind': 'nowhere_at_all:Mine'}, "No module named 'nowhere_at_all'; install the package"),
        ({'kind': 'my_client:Shifting'}, 'lacks make, check, model_validate; see mtv_world_ros.'),
        ({'kind': 'my_client:Shift', 'bye': 1}, r"unknown key 'bye' \(did you mean 'by'"),
        ({'kind': 'my_client:Shift', 'by': 'x'}, "'by' is 'x', must be a finite number"),
    ],
)
def test_a_file_that_names_no_kind_is_refused_with_what_is_valid(values, said, tmp_path):
    with pytest.raises(ConfigError, match=said):
        load_policy_config(written(tmp_path, **values), ROBOT)


def test_settings_are_checked_before_anything_is_made(tmp_path):
    path = written(tmp_path, kind='my_client:Shift', by=0.5)
    with pytest.raises(Exception, match=r'a shift of 0.5 is refused'):
        assemble_policy(path, ROBOT)


def test_every_kind_of_the_package_has_settings_and_every_bundled_file_one_of_them():
    for name in POLICY_KINDS:
        kind = settings_class({'kind': name}, '')
        assert issubclass(kind, PolicySettings)
        assert 'kind' in kind.model_fields
        assert kind.make is not PolicySettings.make, f'{name} makes no policy'
        assert not kind.server_address or 'server' in kind.model_fields
    for path in share_path('config', 'policies').glob('*.yaml'):
        assert yaml.safe_load(path.read_text())['kind'] in POLICY_KINDS
