"""The bundled robot; skips of what cannot run here, counted; no module leaves traces behind."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
import os
from pathlib import Path
import shutil
import signal
import sys
import tempfile
import warnings

import pytest

from mtv_world_ros.core.files import share_path
from mtv_world_ros.model.checkpoint import checkpoint_folder
from mtv_world_ros.physics.arms.arm_response import ArmResponse
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.opengl import missing_opengl
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from test.support.left_behind import left, restore, state
from test.support.ros_domain import claim_domain
from test.support.tiers import file_seconds, tier_lines


def _no_gpu() -> str:
    if find_spec('torch') is None:
        return 'torch is not installed'
    import torch

    return '' if torch.cuda.is_available() else 'no CUDA device'


def _no_weights() -> str:
    folder = os.environ.get('MTV_WORLD_WEIGHTS', '')
    if not folder:
        return 'MTV_WORLD_WEIGHTS is not set'
    return '' if Path(folder).is_dir() else f'MTV_WORLD_WEIGHTS={folder} is no folder'


def _no_native_ros() -> str:
    if shutil.which('ros2') and find_spec('launch_ros') is not None:
        return ''
    return 'no `ros2` command with launch_ros: no native ROS 2 is sourced'


def _no_control_msgs() -> str:
    return '' if find_spec('control_msgs') is not None else 'not built (make fast-tests)'


def _no_tf2_msgs() -> str:
    return '' if find_spec('tf2_msgs') is not None else 'not built (make fast-tests)'


#: marker -> why its tests cannot run here; an empty text where they can
OBSTACLES = {
    'gpu': _no_gpu,
    'weights': _no_weights,
    'native_ros': _no_native_ros,
    'control_msgs': _no_control_msgs,
    'tf2_msgs': _no_tf2_msgs,
}
#: tests in the wrong tier that a run lists; `make tiers` lists all
MOST_LISTED = 5


#: Python modules of control_msgs and tf2_msgs where they are built, see test/support/interfaces.py
INTERFACES = Path(sys.prefix) / 'interfaces'
if INTERFACES.is_dir():
    sys.path.append(str(INTERFACES))


# nodes that tests and commands start meet no node of another test process
os.environ['ROS_DOMAIN_ID'] = str(claim_domain())
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


@pytest.fixture(scope='session')
def robot() -> RobotModel:
    """The bundled robot with two arms."""
    return load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))


@pytest.fixture(scope='session')
def yam() -> RobotModel:
    return load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))


@pytest.fixture(scope='session')
def workcell(robot):
    return workcell_of(robot)


@pytest.fixture(scope='session')
def expert(robot):
    return Expert(robot)


@pytest.fixture
def opengl():
    reason = missing_opengl()
    if reason:
        pytest.skip(reason)


@pytest.fixture(scope='session')
def response(robot: RobotModel) -> ArmResponse:
    """How it follows commands, as the bundled checkpoint found."""
    from mtv_world_ros.physics.checkpoint_files import load_response

    found = load_response(checkpoint_folder('bundled') / 'object_motion', robot)
    assert found is not None
    return found


@pytest.fixture(scope='session')
def exported_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled episode as a LeRobot data set of 5 frames a second; it must not be changed."""
    pytest.importorskip('pyarrow', reason='pyarrow is not installed (pip install .[import])')
    from mtv_world_ros.cli import main

    demo = str(share_path('resource', 'demo_episode'))
    out = tmp_path_factory.mktemp('exported') / 'dataset'
    assert main(['export', 'lerobot', demo, '--out', str(out), '--fps', '5']) == 0
    return out


@pytest.fixture(scope='session')
def imported_demo(exported_demo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the episode that comes of that data set; it must not be changed."""
    from mtv_world_ros.cli import main

    out, mapping = tmp_path_factory.mktemp('imported'), exported_demo / 'meta' / 'mapping.yaml'
    words = ['import', 'lerobot', str(exported_demo), '--mapping', str(mapping)]
    assert main([*words, '--out', str(out)]) == 0
    return out


@pytest.fixture(autouse=True, scope='session')
def no_loading_line() -> Iterator[None]:
    """A command in this process does not say that it is loading, however busy the machine is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('mtv_world_ros.cli._FIRST_LINE_S', 3600.0)
        yield


@pytest.fixture(autouse=True, scope='module')
def nothing_left_behind() -> Iterator[None]:
    """The next file of tests of the process finds it as this one did, whichever that is.

    ROS's default context must be ended. Other traces are a warning, and with
    MTV_WORLD_LEFT_BEHIND=error an error.
    """
    before = state()
    yield
    restore(before)
    found = left(before)
    rclpy = sys.modules.get('rclpy')
    assert rclpy is None or not rclpy.ok(), 'rclpy.shutdown() is missing'
    said = f'these tests leave behind: {"; ".join(found)}'
    assert not found or os.environ.get('MTV_WORLD_LEFT_BEHIND') != 'error', said
    if found:
        warnings.warn(said, stacklevel=1)


@pytest.fixture(scope='module')
def own_ray() -> Iterator[None]:
    """Folder of Ray for this process alone, and what Ray changes in the process is given back.

    By default Ray joins the last cluster of the machine, which may be that of another test
    process. Paths of Ray's sockets are long: the folder cannot lie in a test's own.
    """
    environment, handler = dict(os.environ), signal.getsignal(signal.SIGTERM)
    with tempfile.TemporaryDirectory(prefix='ray_', ignore_cleanup_errors=True) as folder:
        os.environ['RAY_TMPDIR'] = folder
        yield
        os.environ.clear()
        os.environ.update(environment)
        signal.signal(signal.SIGTERM, handler)


@pytest.fixture
def failing_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """`MODULE:NAME` of a policy whose answers have a wrong shape; child processes find it, too."""
    module = f'failing_{tmp_path.name}'
    (tmp_path / f'{module}.py').write_text(
        """
class Failing:
    name = 'failing'

    def reset(self, *, seed):
        pass

    def act(self, observation, instruction):
        raise ValueError('actions have shape (7,), expected (50, 14)')
"""
    )
    monkeypatch.setenv('PYTHONPATH', str(tmp_path), prepend=':')
    monkeypatch.syspath_prepend(str(tmp_path))
    return f'{module}:Failing'


#: key of pytest's cache: seconds that each file of tests took last, set-up included
FILE_SECONDS = 'mtv_world_ros/file_seconds'


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    # files that took longest go first, so that no worker has one of them alone at the end
    cache = getattr(config, 'cache', None)
    seconds = cache.get(FILE_SECONDS, {}) if cache else {}
    items.sort(key=lambda item: -seconds.get(item.nodeid.partition('::')[0], 0.0))
    for marker, obstacle in OBSTACLES.items():
        marked = [item for item in items if item.get_closest_marker(marker)]
        reason = obstacle() if marked else ''
        if reason:
            for item in marked:
                item.add_marker(pytest.mark.skip(reason=f'{marker}: {reason}'))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption('--tiers', action='store_true', help='list all tests in the wrong tier')


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    counted: Counter[str] = Counter()
    for report in terminalreporter.stats.get('skipped', ()):
        reason = str(report.longrepr[-1]).removeprefix('Skipped: ')
        if reason.partition(':')[0] in OBSTACLES:
            counted[reason] += 1
    for reason, count in counted.most_common():
        terminalreporter.write_line(f'skipped for want of {reason}: {count}')
    reports = [one for kind in ('', 'passed') for one in terminalreporter.stats.get(kind, ())]
    if (cache := getattr(config, 'cache', None)) is not None:
        cache.set(FILE_SECONDS, file_seconds(reports, cache.get(FILE_SECONDS, {})))
    for line in tier_lines(reports, most=None if config.getoption('tiers') else MOST_LISTED):
        terminalreporter.write_line(line)
