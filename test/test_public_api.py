"""The names at the top of the package: complete, imported when asked for, old ones warn."""

from __future__ import annotations

import ast
from pathlib import Path
import subprocess
import sys

import pytest

import mtv_world_ros


def test_the_public_names_are_listed_and_imported_when_they_are_asked_for():
    assert {*mtv_world_ros.__all__} <= {*dir(mtv_world_ros)}
    code = (
        'import sys, mtv_world_ros\n'
        "assert not [n for n in sys.modules if n.startswith('mtv_world_ros.')]\n"
        "assert 'numpy' not in sys.modules\n"
        'for name in mtv_world_ros.__all__: assert callable(getattr(mtv_world_ros, name)), name\n'
        'from mtv_world_ros import *\n'
        'assert judge is mtv_world_ros.judge\n'
    )
    subprocess.run([sys.executable, '-W', 'error', '-c', code], check=True)


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'juge'"):
        _ = mtv_world_ros.juge


EXAMPLES = sorted((Path(__file__).parents[1] / 'examples').glob('*.py'))


@pytest.mark.parametrize('example', EXAMPLES, ids=lambda path: path.stem)
def test_examples_import_public_names_from_the_top_alone(example):
    imports = [
        node for node in ast.walk(ast.parse(example.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith('mtv_world_ros')
    ]  # fmt: skip
    assert {node.module for node in imports} == {'mtv_world_ros'}
    public = {*mtv_world_ros.__all__, 'WorldEnv'}
    assert {alias.name for node in imports for alias in node.names} <= public
