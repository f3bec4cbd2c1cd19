"""Parameter file, its page, viewer layout, middleware profile and launch files fit the node."""

from importlib.util import find_spec
from pathlib import Path
import re
import runpy
from xml.etree import ElementTree

import pytest
import yaml

from mtv_world_ros.core.files import share_path
from mtv_world_ros.ros.parameters import descriptor, Settings
from mtv_world_ros.ros.policy.loop import PolicySettings


def test_parameter_file_holds_every_parameter_with_its_default():
    held = yaml.safe_load(share_path('config', 'node.yaml').read_text())['/**']['ros__parameters']
    assert sorted(held) == sorted(Settings.model_fields)
    assert Settings(**held) == Settings() and held['objects'] == ['']


@pytest.mark.parametrize('kind', [Settings, PolicySettings])
def test_every_parameter_says_what_it_means_and_where_it_ends(kind):
    for name, field in kind.model_fields.items():
        assert field.description.endswith('.')
        is_number = isinstance(field.default, (int, float)) and not isinstance(field.default, bool)
        described = descriptor(field)
        assert is_number == bool(described.integer_range or described.floating_point_range), name
        for limits in [*described.integer_range, *described.floating_point_range]:
            assert limits.from_value <= field.default <= limits.to_value
        if described.additional_constraints:
            assert str(field.default) in described.additional_constraints
    assert kind() == kind(**{name: field.default for name, field in kind.model_fields.items()})


@pytest.mark.parametrize(
    ('name', 'kind'), [('parameters.md', Settings), ('policies.md', PolicySettings)]
)
def test_a_page_lists_every_parameter_with_its_default_and_what_is_valid(name, kind):
    page = share_path('docs', name).read_text()
    for parameter, field in kind.model_fields.items():
        row = next((r for r in page.splitlines() if r.startswith(f'| `{parameter}`')), None)
        assert row, f'{parameter} is not in docs/{name}'
        default, valid = (cell.strip() for cell in row.split('|')[2:4])
        value = '' if field.default == () else field.default
        assert ('' if default == 'empty' else yaml.safe_load(default)) == value, parameter
        assert valid == _valid(descriptor(field)), parameter


def test_the_tables_of_parameters_are_those_of_the_settings():
    tables = runpy.run_path(str(share_path('docs', 'parameter_tables.py')))
    for name in tables['PAGES']:
        page = share_path('docs', name).read_text(encoding='utf-8')
        assert tables['filled'](page) == page, 'run: python docs/parameter_tables.py'


def _valid(described):
    for limits in [*described.integer_range, *described.floating_point_range]:
        return f'{limits.from_value:.10g} … {limits.to_value:.10g}'
    return described.additional_constraints.removeprefix('one of: ')


def test_middleware_profile_enlarges_the_shared_memory():
    root = ElementTree.parse(share_path('config', 'fastdds_profile.xml')).getroot()
    space = {'dds': root.tag.split('}')[0].strip('{')}
    assert root.find('.//dds:segment_size', space).text == str(32 * 1024**2)
    assert root.find('.//dds:participant', space).get('is_default_profile') == 'true'
    heartbeats = [
        ElementTree.parse(share_path('config', name)).find('.//dds:heartbeatPeriod/*', space).text
        for name in ('fastdds_profile.xml', 'fastdds_heartbeat.xml')
    ]
    assert heartbeats == ['100000000'] * 2


def test_modules_that_are_started_as_processes_exist():
    started = [
        re.findall(r"module_command\(\s*'([\w.]+)'", path.read_text(encoding='utf-8'))
        for path in Path(find_spec('mtv_world_ros').origin).parent.rglob('*.py')
    ]
    names = sorted({name for found in started for name in found})
    assert len(names) >= 3
    assert [name for name in names if find_spec(f'mtv_world_ros.ros.{name}') is None] == []
