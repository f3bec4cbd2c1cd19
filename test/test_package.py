"""The package as it is installed, and the rules that hold for every file of it."""

from __future__ import annotations

import ast
import graphlib
from importlib import metadata
import importlib.util
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
import setuptools

ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted((ROOT / 'mtv_world_ros').rglob('*.py'))

#: imported name -> the distribution that setup.py asks for, where they differ
DISTRIBUTIONS = {
    'PIL': 'pillow',
    'coal': 'pin',  # which requires it
    'cv2': 'opencv-python-headless',
    'google': 'mcap-protobuf-support',  # which requires protobuf
    'grpc': 'grpcio',
    'markupsafe': 'Jinja2',  # which requires it
    'mcap_protobuf': 'mcap-protobuf-support',
    'mcap_ros2': 'mcap-ros2-support',
    'pinocchio': 'pin',
    'rerun': 'rerun-sdk',
    'pydantic_core': 'pydantic',  # which requires it
    'yaml': 'PyYAML',
}
#: ROS packages, which package.xml and the `ros` extra bring
ROS_PACKAGES = {
    'ament_index_python',
    'builtin_interfaces',
    'diagnostic_msgs',
    'geometry_msgs',
    'lifecycle_msgs',
    'rcl_interfaces',
    'rclpy',
    'rosgraph_msgs',
    'rosidl_parser',
    'sensor_msgs',
    'std_msgs',
    'std_srvs',
    'trajectory_msgs',
}


@pytest.fixture(scope='module')
def setup_arguments() -> dict:
    """What setup.py passes to setuptools."""
    passed = {}
    original = setuptools.setup
    setuptools.setup = lambda **arguments: passed.update(arguments)
    folder = Path.cwd()
    os.chdir(ROOT)
    try:
        spec = importlib.util.spec_from_file_location('package_setup', ROOT / 'setup.py')
        assert spec is not None and spec.loader is not None
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
    finally:
        setuptools.setup = original
        os.chdir(folder)
    return passed


@pytest.fixture(scope='module')
def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / 'package.xml').getroot()


@pytest.fixture(scope='module')
def prefix(tmp_path_factory) -> Path:
    """A copy of the package, installed into a prefix of its own the way colcon does it."""
    source, prefix = tmp_path_factory.mktemp('source'), tmp_path_factory.mktemp('prefix')
    for name in ('setup.py', 'setup.cfg', 'package.xml'):
        shutil.copy(ROOT / name, source)
    for name in ('config', 'launch', 'resource', 'mtv_world_ros'):
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, source / name, ignore=shutil.ignore_patterns('__pycache__')
            )
    install = ['install', '--prefix', str(prefix), '--record', str(source / 'installed.txt')]
    finished = subprocess.run(
        [sys.executable, 'setup.py', '-q', *install, '--single-version-externally-managed'],
        cwd=source,
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    return prefix


def _run_installed(prefix: Path, *command: str) -> str:
    """Run python on the installed copy, away from the source folder; return what it printed."""
    packages = next(prefix.glob('lib/python3*/site-packages'))
    finished = subprocess.run(
        [sys.executable, *command],
        cwd=prefix,
        env={**os.environ, 'PYTHONPATH': str(packages), 'AMENT_PREFIX_PATH': str(prefix)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def _imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return {name.partition('.')[0] for name in names}


def _tracked_files() -> list[Path]:
    listed = subprocess.run(
        ['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip('not a git checkout: the list of files is not known')
    paths = [ROOT / name for name in listed.stdout.split('\0') if name]
    return [path for path in paths if path.is_file()]


def _tracked_text_files() -> list[Path]:
    return [path for path in _tracked_files() if b'\0' not in path.read_bytes()[:8192]]


def _text(element: ElementTree.Element, name: str) -> str:
    return (element.findtext(name) or '').strip()


def test_manifest_is_format_3_of_an_ament_python_package(manifest):
    assert manifest.attrib['format'] == '3'
    assert _text(manifest, 'name') == 'mtv_world_ros'
    assert _text(manifest, 'license') == 'Apache-2.0'
    assert manifest.findtext('export/build_type') == 'ament_python'


def test_version_is_the_same_everywhere(manifest, setup_arguments):
    version = setup_arguments['version']
    assert _text(manifest, 'version') == version
    assert re.search(rf'^{re.escape(version)} \(', (ROOT / 'CHANGELOG.rst').read_text(), re.M)
    try:
        assert metadata.version('mtv_world_ros') == version
    except metadata.PackageNotFoundError:
        pytest.skip('the package is run from its source folder, not installed')


def test_data_files_exist_and_hold_the_ament_marker(setup_arguments):
    installed = dict(setup_arguments['data_files'])
    assert installed['share/ament_index/resource_index/packages'] == ['resource/mtv_world_ros']
    assert installed['share/mtv_world_ros'] == ['package.xml']
    for files in installed.values():
        for name in files:
            assert (ROOT / name).is_file(), name


def test_every_tracked_config_launch_and_resource_file_is_installed(setup_arguments):
    installed = {name for _, files in setup_arguments['data_files'] for name in files}
    tracked = {str(path.relative_to(ROOT)) for path in _tracked_files()}
    wanted = {name for name in tracked if name.startswith(('config/', 'launch/', 'resource/'))}
    assert not wanted - installed


def test_entry_points_import(setup_arguments):
    scripts = setup_arguments['entry_points']['console_scripts']
    assert {script.partition(' = ')[0] for script in scripts} == {
        'mtv-world',
        'policy_node',
        'world_model',
    }
    for script in scripts:
        module, _, function = script.partition(' = ')[2].partition(':')
        if importlib.util.find_spec('rclpy') is None and '.ros.' in module:
            continue
        assert callable(getattr(importlib.import_module(module), function)), script


def test_installed_like_colcon_the_commands_lie_where_ros2_run_looks(prefix):
    scripts = prefix / 'lib' / 'mtv_world_ros'
    assert {path.name for path in scripts.iterdir()} == {
        'mtv-world',
        'policy_node',
        'world_model',
    }
    assert 'replay' in _run_installed(prefix, str(scripts / 'mtv-world'), '--help')


def test_installed_like_colcon_the_bundled_files_are_found(prefix):
    pytest.importorskip('ament_index_python')
    code = "from mtv_world_ros.core.files import share_path; print(share_path('config', 'robots'))"
    found = Path(_run_installed(prefix, '-c', code).strip())
    assert found == prefix / 'share' / 'mtv_world_ros' / 'config' / 'robots'


def test_help_starts_without_torch_and_diffusers():
    code = (
        'import sys, mtv_world_ros.cli\n'
        "print(sorted({'torch', 'diffusers', 'transformers', 'mujoco'} & set(sys.modules)))"
    )
    shown = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    )
    assert shown.stdout.strip() == '[]'


def test_the_page_of_installation_has_every_extra(setup_arguments):
    table = (ROOT / 'docs' / 'installation.md').read_text().partition('## Extras')[2]
    rows = re.findall(r'^\| ((?:`[\w-]+`(?:, )?)+) \|', table, re.M)
    named = [name for row in rows for name in re.findall(r'`([\w-]+)`', row)]
    assert sorted(named) == sorted(setup_arguments['extras_require'])


@pytest.mark.slow
def test_imports_are_declared(setup_arguments, manifest):
    extras = [name for names in setup_arguments['extras_require'].values() for name in names]
    requirements = setup_arguments['install_requires'] + extras
    declared = {re.split(r'[\[<>=;~ ]', name)[0].lower() for name in requirements}
    depends = {element.text for element in manifest.findall('exec_depend')}
    missing = set()
    for path in MODULES:
        for name in _imports(path) - sys.stdlib_module_names - {'mtv_world_ros'}:
            if name in ROS_PACKAGES:
                found = name in depends
            else:
                distribution = DISTRIBUTIONS.get(name, name)
                found = distribution.lower() in declared
            if not found:
                missing.add(f'{path.relative_to(ROOT)}: {name}')
    assert not missing


def test_versions_of_what_is_asked_for_are_pinned(setup_arguments):
    lines = (ROOT / 'requirements' / 'constraints.txt').read_text().splitlines()
    pinned = {line.partition('==')[0].lower() for line in lines if '==' in line}
    extras = [name for names in setup_arguments['extras_require'].values() for name in names]
    for name in setup_arguments['install_requires'] + extras:
        assert re.split(r'[\[<>=;~ ]', name)[0].lower() in pinned, name


def _loads_a_pickle(call: ast.Call) -> bool:
    name = ast.unparse(call.func)
    keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
    if name == 'torch.load':
        return keywords.get('weights_only') != 'True'
    if name in ('np.load', 'numpy.load'):
        return keywords.get('allow_pickle', 'False') != 'False'
    if name == 'pickle.dumps':  # LeRobot's servers take nothing else
        return False
    return name.partition('.')[0] in ('pickle', 'joblib', 'dill', 'cloudpickle', 'shelve')


@pytest.mark.slow
def test_no_pickle_is_loaded():
    found = []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and _loads_a_pickle(node):
                found.append(f'{path.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node.func)}')
            if isinstance(node, ast.ClassDef):
                found += [ast.unparse(b) for b in node.bases if 'Unpickler' in ast.unparse(b)]
    assert not found


def test_no_file_names_a_path_of_one_machine():
    home = re.compile(r'(?<![\w.$~}])/(?:home|root|Users|work)/[\w.-]+')
    found = []
    for path in _tracked_text_files():
        for number, line in enumerate(path.read_text(errors='replace').splitlines(), start=1):
            if home.search(line) and path != Path(__file__).resolve():
                found.append(f'{path.relative_to(ROOT)}:{number}: {line.strip()[:80]}')
    assert not found


def test_no_large_file_is_tracked():
    assert not [str(path) for path in _tracked_files() if path.stat().st_size > 12_000_000]


def test_no_modules_import_each_other_in_a_circle():
    """Circles of `TYPE_CHECKING` and of imports within functions count, too."""
    grimp = pytest.importorskip('grimp', reason='import-linter is not installed')
    graph = grimp.build_graph('mtv_world_ros', cache_dir=None)
    imported = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    assert len(imported) > 300
    order = list(graphlib.TopologicalSorter(imported).static_order())  # raises at a circle
    assert order.index('mtv_world_ros.core.errors') < order.index('mtv_world_ros.cli')


def test_readme_has_no_open_ends_and_its_links_lead_somewhere():
    text = (ROOT / 'README.md').read_text()
    assert 'TODO' not in text
    links = re.findall(r'\]\((?!https?://|#)([^)#]+)', text)
    assert links
    assert not [link for link in links if not (ROOT / link).exists()]
