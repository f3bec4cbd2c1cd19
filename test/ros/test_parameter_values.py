"""Values of parameters that ROS reads otherwise than it is written, on the line and in files."""

import pytest
from rclpy.node import Node
import yaml

from mtv_world_ros.ros import parameters
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.ros.policy.loop import PolicySettings
from mtv_world_ros.ros.run_node import run
from test.support.in_process import run_to_end

KINDS = {'world_model': Settings, 'policy': PolicySettings}


def run_with(name, *words):
    """Return the exit status of a node that only reads its parameters, and what it said."""

    def make():
        node = Node(name)
        parameters.declare(node, KINDS[name])
        print(parameters.read(node, KINDS[name]).model_dump_json())
        return node

    return run_to_end(lambda: run(make, [name, *words], spin=lambda node: None))


def lists(kind):
    return [name for name, field in kind.model_fields.items() if isinstance(field.default, tuple)]


@pytest.mark.parametrize('in_file', [False, True])
def test_an_empty_list_is_an_empty_list(tmp_path, in_file):
    asked = 0
    for node, kind in KINDS.items():
        for name in lists(kind):
            file = tmp_path / f'{node}.yaml'
            file.write_text(yaml.safe_dump({node: {'ros__parameters': {name: []}}}))
            given = ['--params-file', str(file)] if in_file else ['-p', f'{name}:=[]']
            status, out = run_with(node, '--ros-args', *given)
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
def test_what_cannot_be_a_value_is_one_line_that_says_what_can(given, said):
    status, out = run_with('world_model', '--ros-args', '-p', given)
    assert status == 1
    assert said in out and 'Traceback' not in out
    assert out.splitlines()[-1].startswith('ConfigError: ')
