"""Parameter file, its page, viewer layout, middleware profile and launch files fit the node."""

import ast
import json
from xml.etree import ElementTree

import pytest
import yaml

from mtv_world_ros.files import share_path
from mtv_world_ros.ros.parameters import Settings, TABLE


def test_parameter_file_holds_every_parameter_with_its_default():
    held = yaml.safe_load(share_path('config', 'node.yaml').read_text())['/**']['ros__parameters']
    assert held == {entry.name: entry.default for entry in TABLE}
    assert list(Settings.__dataclass_fields__) == [entry.name for entry in TABLE]


def test_every_parameter_says_what_it_means_and_where_it_ends():
    for entry in TABLE:
        assert entry.description.endswith('.')
        assert entry.check(entry.default) == ''
        is_number = isinstance(entry.default, (int, float)) and not isinstance(entry.default, bool)
        assert is_number == (entry.bounds is not None), entry.name
        described = entry.descriptor()
        assert is_number == bool(described.integer_range or described.floating_point_range)


def test_the_page_lists_every_parameter_with_its_default_and_what_is_valid():
    page = share_path('docs', 'parameters.md').read_text()
    for entry in TABLE:
        row = next((r for r in page.splitlines() if r.startswith(f'| `{entry.name}`')), None)
        assert row, f'{entry.name} is not in docs/parameters.md'
        default, valid = (cell.strip() for cell in row.split('|')[2:4])
        assert default.strip('`') == _shown(entry.default), entry.name
        assert valid == _valid(entry), entry.name


def _valid(entry):
    if entry.choices:
        return ', '.join(f'`{choice}`' for choice in entry.choices)
    return '' if entry.bounds is None else '{:.10g} … {:.10g}'.format(*entry.bounds)


def _shown(value):
    if value in ('', ['']):
        return 'empty'
    if isinstance(value, bool):
        return str(value).lower()
    return f'{value:g}' if isinstance(value, float) else str(value)


def _panels(layout):
    if isinstance(layout, str):
        return [layout]
    assert layout['direction'] in ('row', 'column')
    return _panels(layout['first']) + _panels(layout['second'])


def test_viewer_layout_shows_topics_of_the_node():
    layout = json.loads(share_path('config', 'foxglove_layout.json').read_text())
    panels = layout['configById']
    assert sorted(_panels(layout['layout'])) == sorted(panels)
    images = [panel['imageMode'] for name, panel in panels.items() if name.startswith('Image!')]
    assert len(images) == 6
    for image in images:
        stem = image['imageTopic'].split('/image_raw')[0]
        assert image['calibrationTopic'] == f'{stem}/camera_info'


def test_middleware_profile_enlarges_the_shared_memory():
    root = ElementTree.parse(share_path('config', 'fastdds_profile.xml')).getroot()
    space = {'dds': root.tag.split('}')[0].strip('{')}
    assert root.find('.//dds:segment_size', space).text == str(32 * 1024**2)
    assert root.find('.//dds:participant', space).get('is_default_profile') == 'true'


@pytest.mark.parametrize('name', ['world_model.launch.py', 'replay.launch.py'])
def test_launch_arguments_name_parameters_that_exist(name):
    tree = ast.parse(share_path('launch', name).read_text())
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert 'generate_launch_description' in functions
    known = {entry.name for entry in TABLE} | {'use_sim_time'}
    for node in tree.body:
        if isinstance(node, ast.Assign) and node.targets[0].id == 'PARAMETERS':
            assert {key.value for key in node.value.keys} <= known
