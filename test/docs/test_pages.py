"""The README is a door, and the pages build into a site without a warning."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
import yaml

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.control.registry import CONTROLS
from mtv_world_ros.data.bag_mapping import load_source
from mtv_world_ros.importing.object_boxes import load_object_boxes
from mtv_world_ros.policies.kinds import load_policy_config, POLICY_KINDS
from mtv_world_ros.policies.policy import EpisodeOrigin
from mtv_world_ros.ranking.policy_list import load_policy_list
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.rollout.assembly import policy_settings
from mtv_world_ros.simulation.scenes.tasks import Task
from mtv_world_ros.success.relations import KINDS
from mtv_world_ros.success.task import load_task
from mtv_world_ros.vision.segmenters.registry import SEGMENTERS
from test.support.pages import generator
from test.support.tables import table

ROOT = Path(__file__).resolve().parents[2]
#: of the robot that docs/robots.md describes
URDF = """
<robot name="my_robot">
  <link name="base"/><link name="link_1"/><link name="link_2"/><link name="finger"/>
  <joint name="joint1" type="revolute"><parent link="base"/><child link="link_1"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="joint2" type="revolute"><parent link="link_1"/><child link="link_2"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="gripper" type="prismatic"><parent link="link_2"/><child link="finger"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.04" effort="1" velocity="1"/></joint>
</robot>
"""


def results_page(name):
    return (ROOT / 'experiments' / 'results' / f'{name}.md').read_text()


def test_the_four_numbers_of_the_readme_are_those_of_the_results_pages():
    text = ' '.join((ROOT / 'README.md').read_text().split())
    pictures = results_page('bundled_paper_cpu2_2026-11-28').partition('## Both checkpoints')[2]
    imagined = re.search(r'\| bundled \| (\.\d+)', pictures)[1]
    held = re.search(r'\| first frame held \| (\.\d+)', pictures)[1]
    assert f'overlap with the real ones by {float(imagined):.2f} (J;' in text
    assert f'those of a still picture by {float(held):.2f},' in text
    faults = results_page('unseen_faults_cpu2_2026-11-29')
    row = re.search(r'\| \*\*both\*\* \| (\d+) of (\d+) \| (\d+) of \d+.*?; (\d+) of \d+', faults)
    given, plans, successes, failures = map(int, row.groups())
    assert (
        f'in {successes + failures} of {given} cases; it gives one for {given} of {plans}' in text
    )
    row = re.search(r'\| foreseen motions alone \|.*?\| (\d+) of (1\d+) \|', faults)
    given, plans = map(int, row.groups())
    assert f'{plans - given} of {plans} plans get no verdict' in text
    speed = results_page('foresight_cpu2_2026-11-29')
    numbers = r' \| '.join([r'([\d.]+)'] * 3)
    row = re.search(
        rf'\| this \| realtime \| 1 \| 3.2 \|.*?\| 10 \| 10 \| 10 \| {numbers} \|', speed
    )
    first, delay, lead = map(float, row.groups())
    assert f'comes {delay:.1f} s after a plan**, {lead:.1f} s before the motion ends' in text
    assert f'without pictures, after {first:.1f} s' in text


#: a visitor reads the README in two minutes
README_WORDS = 450


def test_the_readme_is_short_and_names_the_limits():
    text = (ROOT / 'README.md').read_text()
    assert len(re.findall(r'[^\s|]*\w[^\s|]*', text)) <= README_WORDS
    for word in ('no VAE', 'no CLIP', 'no umT5', 'FID', 'FVD', 'RealSource-World', 'never run'):
        assert word in text


#: letters and words that a reader cannot guess
TERMS = re.compile(
    r'\b(MMRV|AUROC|ECE|FVD|contact flips?)\b'
    r'|(?<![\w.`|-] )(?<![\w.`,])J(?= (of|per|beside|with)\b)'
)


@table('page', sorted((ROOT / 'docs').glob('*.md')))
def test_terms_are_linked_to_the_glossary_where_a_page_uses_them_first(page):
    if page.stem in ('glossary', 'parameters', 'commands', 'configuration'):
        return
    text = re.sub(r'```.*?```|<!--.*?-->', '', page.read_text(), flags=re.S)
    used = TERMS.search(text)
    if used is not None:
        line_end = text.find('\n', used.end())
        assert 'glossary.md' in text[:line_end], f'{used[0]} is not explained'


def test_every_page_is_linked_from_the_index():
    index = (ROOT / 'docs' / 'index.md').read_text()
    for page in (ROOT / 'docs').glob('*.md'):
        assert f'({page.name})' in index or page.name == 'index.md', page.name


@table(
    'name, page',
    [
        ('command_pages', 'commands'),
        ('configuration_page', 'configuration'),
    ],
)
def test_generated_pages_are_what_the_code_says(name, page):
    written = (ROOT / 'docs' / f'{page}.md').read_text()
    assert written == generator(name).page(), f'write it again: python docs/{name}.py'


def test_every_key_of_a_configuration_file_has_a_meaning():
    rows = re.findall(r'^\| `.*\|$', (ROOT / 'docs' / 'configuration.md').read_text(), re.M)
    assert len(rows) > 200
    assert not [row for row in rows if row.endswith('|  |') or 'see the guide' in row]


TABLES = generator('bundled_tables')


@table('page', TABLES.PAGES)
def test_tables_of_what_is_bundled_are_those_of_folders_and_registries(page):
    text = (ROOT / 'docs' / page).read_text()
    assert '<!-- bundled: ' in text
    assert text == TABLES.written_page(text), 'write it again: python docs/bundled_tables.py'


@table(
    'page, names',
    [
        ('tasks.md', sorted(p.stem for p in (ROOT / 'config' / 'tasks').rglob('*.yaml'))),
        ('robots.md', sorted(p.parent.name for p in ROOT.glob('config/robots/*/robot.yaml'))),
        ('training.md', CONTROLS),
        ('objects.md', SEGMENTERS),
        ('policies.md', POLICY_KINDS),
    ],
)
def test_every_bundled_name_has_a_row(page, names):
    rows = re.findall(r'^\| \[?`(\w+)`.*\|$', (ROOT / 'docs' / page).read_text(), re.M)
    assert set(names) <= set(rows)


def test_the_index_of_benchmarks_has_every_page():
    index = (ROOT / 'docs' / 'experiments.md').read_text()
    for page in (ROOT / 'experiments' / 'results').glob('*.md'):
        assert f'(../experiments/results/{page.name})' in index, page.name


def test_every_example_is_run():
    page = (ROOT / 'docs' / 'python_api.md').read_text()
    for script in (ROOT / 'examples').glob('*.py'):
        assert f'\npython examples/{script.name}' in page, script.name


def test_the_page_of_tasks_has_every_relation():
    page = (ROOT / 'docs' / 'tasks.md').read_text()
    assert not [kind for kind in KINDS if f'`{kind}`' not in page and f'kind: {kind}' not in page]


YAML_BLOCK = re.compile(r'^```yaml\n(.*?)^```', re.M | re.S)
YAML_BLOCKS = [
    pytest.param(block, id=f'{page.name}-{number}')
    for page in sorted((ROOT / 'docs').glob('*.md'))
    for number, block in enumerate(
        re.findall(r'^```yaml\n(.*?)^```', page.read_text(), re.M | re.S)
    )
]


def has_boxes(file, values):
    return 'boxes' in values and load_object_boxes(file).names('first_bag') == ('blue block',)


@pytest.mark.parametrize('block', YAML_BLOCKS)
def test_yaml_in_the_pages_can_be_used(block, tmp_path, monkeypatch):
    file = tmp_path / 'block.yaml'
    file.write_text(block)
    values = yaml.safe_load(block)
    if 'relations' in values:
        for name in re.findall(r'\w+\.png', block):
            cv2.imwrite(str(tmp_path / name), np.full((72, 96, 3), 255, np.uint8))
        task = load_task(file)
        assert task.scene is None or Task.of(task, block).name == task.name
    elif 'dh' in values or 'urdf' in values:
        (tmp_path / 'my_robot.urdf').write_text(URDF)
        load_robot(file)
    elif ':' in values.get('kind', ''):  # a client that the page shows above it
        page = (ROOT / 'docs' / 'policies.md').read_text()
        name = values['kind'].partition(':')[0]
        code = re.search(rf'```python\n(# {name}.py.*?)```', page, re.S)
        assert code is not None
        (tmp_path / f'{name}.py').write_text(code[1])
        monkeypatch.syspath_prepend(tmp_path)
        robot = load_robot(robot_path('yam_bimanual'))
        assert policy_settings(file, robot).make(EpisodeOrigin(), robot).name == name
        sys.modules.pop(name)
    elif 'kind' in values:
        robot = load_robot(ROOT / 'config' / 'robots' / 'yam_bimanual' / 'robot.yaml')
        load_policy_config(file, robot)
    elif 'joint_states' in values:
        assert load_source(file, None).mapping is not None
    elif 'views' in values:
        load_calibration(file)
    elif 'policies' in values:  # beside those of the same page
        mine = tmp_path / 'my_policy.yaml'
        mine.write_text('kind: scripted\nvariant: expert\n')
        robot = load_robot(ROOT / 'config' / 'robots' / 'yam_bimanual' / 'robot.yaml')
        assert len(load_policy_list(file, robot)) == len(values['policies'])
    else:
        assert 'qos_overrides' in values or has_boxes(file, values)


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec('material') is None, reason='mkdocs-material is not installed'
)
def test_the_site_builds_without_a_warning(tmp_path):
    done = subprocess.run(
        [sys.executable, '-m', 'mkdocs', 'build', '--strict', '--site-dir', str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, 'NO_MKDOCS_2_WARNING': '1'},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / 'training.html').is_file()
    assert (tmp_path / 'repository' / 'config' / 'node.yaml').is_file()
    # nothing is loaded from elsewhere
    assert 'src="http' not in (tmp_path / 'index.html').read_text()
