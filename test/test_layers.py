"""The node and offline replay need no laboratory; commands are found by entry points."""

from __future__ import annotations

from importlib import metadata
import os
import re
import subprocess
import sys

import grimp
import pytest

from mtv_world_ros import cli
from mtv_world_ros.cli.commands import COMMANDS as COMMANDS_OF_THE_PACKAGE
from mtv_world_ros.cli.commands import REMOVED
from mtv_world_ros.core import entry_points
from mtv_world_ros.core.entry_points import load, POLICIES, registered, ROLLOUTS
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.rollout.assembly import policy_settings

PRODUCT = ('ros.world_model.node', 'ros.policy.node', 'rollout.offline')
LABORATORY = ('training', 'evaluation', 'simulation', 'ranking', 'reports')


@pytest.fixture(scope='module')
def graph():
    """All imports of the package, those inside of functions included."""
    return grimp.build_graph('mtv_world_ros')


@pytest.mark.parametrize('module', PRODUCT)
def test_no_laboratory_is_reached_from(graph, module):
    reached = graph.find_upstream_modules(f'mtv_world_ros.{module}')
    rooms = tuple(f'mtv_world_ros.{room}' for room in LABORATORY)
    assert len(reached) > 20 and not [name for name in reached if name.startswith(rooms)]


@pytest.mark.slow
def test_the_bundled_checkpoint_is_loaded_without_the_simulator():
    code = (
        'import sys\n'
        'from mtv_world_ros.rollout.pipeline import Pipeline\n'
        "Pipeline.load(segmenter='colour', num_threads=1)\n"
        "print([n for n in sys.modules if n.startswith('mtv_world_ros.simulation')])"
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[]'


def test_every_command_of_the_table_is_a_parser_with_its_help():
    found = set()
    for name in COMMANDS_OF_THE_PACKAGE:
        parser = cli.make_parser(name)
        for word in name.split():
            parser = cli._choices(parser)[word]
        found.add(parser.prog)
    assert found == {f'mtv-world {name}' for name in COMMANDS_OF_THE_PACKAGE}


def test_the_overview_imports_no_command():
    code = (
        'import sys\n'
        'from mtv_world_ros import cli\n'
        'cli._overview()\n'
        "print([n for n in sys.modules if n.startswith('mtv_world_ros.cli.')])"
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['mtv_world_ros.cli.commands', 'mtv_world_ros.cli.parser']"


@pytest.mark.parametrize('old', REMOVED)
def test_an_old_name_of_a_command_says_what_to_use(old, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main([old, '--help'])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert f"'{old}' is no longer a command" in said
    use = re.search("use 'mtv-world ([a-z ]+?)( --.*)?'", said)
    assert use is None or use[1] in COMMANDS_OF_THE_PACKAGE


def test_an_import_of_the_package_leaves_the_environment_as_it_is():
    code = (
        'import os\n'
        'before = dict(os.environ)\n'
        'import mtv_world_ros\n'
        'for name in mtv_world_ros.__all__: getattr(mtv_world_ros, name)\n'
        'import mtv_world_ros.cli, mtv_world_ros.ros\n'
        'after = dict(os.environ, LD_LIBRARY_PATH=before.get("LD_LIBRARY_PATH", ""))\n'
        'before.setdefault("LD_LIBRARY_PATH", "")  # OpenCV extends it\n'
        'assert after == before\n'
        'try: mtv_world_ros.cli.main(["--version"])\n'
        'except SystemExit: pass\n'
        'assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"\n'
    )
    environment = {k: v for k, v in os.environ.items()
                   if k not in ('OMP_WAIT_POLICY', 'OPENBLAS_NUM_THREADS')}  # fmt: skip
    subprocess.run([sys.executable, '-c', code], check=True, env=environment)


def registering(monkeypatch, **entries):
    """Replace what is registered: group -> name = module."""
    listed = {
        group: [metadata.EntryPoint(name=n, value=v, group=group) for n, v in pairs.items()]
        for group, pairs in ((getattr(entry_points, key), pairs) for key, pairs in entries.items())
    }
    monkeypatch.setattr(metadata, 'entry_points', lambda group: listed.get(group, []))


def test_a_command_of_another_package_comes_last_and_runs(monkeypatch, tmp_path, capsys):
    (tmp_path / 'of_somebody.py').write_text(
        'def add(commands):\n'
        "    parser = commands.add_parser('mine')\n"
        '    parser.set_defaults(handler=lambda arguments: 7)\n'
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, 'of_somebody', raising=False)
    registering(monkeypatch, COMMANDS={'mine': 'of_somebody'})
    assert cli.main(['mine']) == 7
    assert cli._overview().endswith('Of other packages:\n  mine')


@pytest.mark.parametrize(
    ('text', 'says'),
    [
        ("raise RuntimeError('no such display')", 'no such display'),
        ('def add(:', 'invalid syntax'),
        ('', "no attribute 'add'"),
        ("def add(commands): commands.add_parser('demo')", 'conflicting subparser: demo'),
    ],
)
def test_a_package_with_a_broken_command_is_named(monkeypatch, tmp_path, capsys, text, says):
    (tmp_path / 'of_somebody.py').write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, 'of_somebody', raising=False)
    registering(monkeypatch, COMMANDS={'mine': 'of_somebody'})
    assert cli.main(['mine', '--help']) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "entry point 'mine = of_somebody'" in line and says in line


def test_an_entry_point_that_cannot_be_imported_is_named(monkeypatch, capsys):
    registering(monkeypatch, COMMANDS={'mine': 'no_such_package.commands'})
    assert cli.main(['--help']) == 1
    assert "entry point 'mine = no_such_package.commands'" in capsys.readouterr().err


def test_without_the_simulator_a_scripted_policy_says_what_to_install(monkeypatch):
    robot = load_robot(robot_path('yam_bimanual'))
    assert policy_settings('expert-miss-0.5', robot).variant == 'expert-miss-0.5'
    registering(monkeypatch)
    with pytest.raises(ConfigError, match=r"kind 'scripted'.*mtv_world_ros\[sim\]"):
        policy_settings('expert-miss-0.5', robot)


def test_policies_and_rollouts_of_the_package_are_registered():
    assert load(registered(POLICIES)['scripted']).fault_kinds('expert-miss-0.5') == (
        'grasp_missed',
    )
    assert {load(entry).FILE for entry in registered(ROLLOUTS).values()} >= {
        'ranking.json',
        'metrics.json',
    }
