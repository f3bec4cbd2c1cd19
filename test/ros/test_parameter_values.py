"""Values of parameters that ROS reads otherwise than it is written, on the line and in files."""

import pytest
import yaml

NODE = """
from rclpy.node import Node
from mtv_world_ros.ros import parameters
from mtv_world_ros.ros.policy.loop import PolicySettings
from mtv_world_ros.ros.run_node import run


def start(words):
    kind = {'world_model': parameters.Settings, 'policy': PolicySettings}[words[0]]

    def make():
        node = Node(words[0])
        parameters.declare(node, kind)
        print(parameters.read(node, kind).model_dump_json())
        return node

    return run(make, words, spin=lambda node: None)
"""


@pytest.fixture(scope='module')
def forks(ros):
    forks = ros.Forks(NODE)
    yield forks
    forks.close()


def lists(kind):
    return [name for name, field in kind.model_fields.items() if isinstance(field.default, tuple)]


@pytest.mark.parametrize('in_file', [False, True])
def test_an_empty_list_is_an_empty_list(forks, tmp_path, in_file):
    from mtv_world_ros.ros.parameters import Settings
    from mtv_world_ros.ros.policy.loop import PolicySettings

    asked = 0
    for node, kind in (('world_model', Settings), ('policy', PolicySettings)):
        for name in lists(kind):
            file = tmp_path / f'{node}.yaml'
            file.write_text(yaml.safe_dump({node: {'ros__parameters': {name: []}}}))
            given = ['--params-file', str(file)] if in_file else ['-p', f'{name}:=[]']
            status, out = forks.run(tmp_path, node, '--ros-args', *given)
            assert status == 0 and f'"{name}":[]' in out, out
            asked += 1
    assert asked


@pytest.mark.parametrize(
    ('given', 'said'),
    [
        ('seed:=[]', "'seed' is given without a value, or as []; it must be of type int in [0,"),
        ('pace:=[]', "'pace' is given without a value"),
        ('objects:=[1.0, 2]', 'all items of a list must be of one type'),
        ('objects:=[a, 1]', 'all items of a list must be of one type'),
        ('objects:=[1, 2]', "'objects' must be of type list"),
        ('objects:=red', "'objects' must be of type list"),
        ('instruction:=', 'expected -p NAME:=VALUE'),
        ('seed:={a: 1}', 'expected -p NAME:=VALUE'),
    ],
)
def test_what_cannot_be_a_value_is_one_line_that_says_what_can(forks, tmp_path, given, said):
    status, out = forks.run(tmp_path, 'world_model', '--ros-args', '-p', given)
    assert status == 1
    assert said in out and 'Traceback' not in out
    assert out.splitlines()[-1].startswith('ConfigError: ')
