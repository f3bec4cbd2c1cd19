"""Definitions of tasks that are not bundled: in an episode, in its data set, in a user's file."""

import json

import pytest

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_info
from mtv_world_ros.success.own_tasks import (
    bundled_tasks,
    chosen_task,
    named_here,
    own_task,
    own_tasks,
)
from mtv_world_ros.success.task import dump_task, load_task, stored_task
from test.support.own_task import shift_right_episode, write_shift_right


@pytest.fixture
def spec(tmp_path):
    return load_task(write_shift_right(tmp_path))


def write_card(folder, *specs):
    card = {'task_definitions': {spec.name: dump_task(spec) for spec in specs}}
    folder.mkdir(exist_ok=True)
    (folder / 'dataset.json').write_text(json.dumps(card))


@pytest.mark.parametrize('name', [task.name for task in bundled_tasks()])
def test_a_stored_definition_is_the_task_again(name):
    task = chosen_task(name, ())
    assert stored_task(json.dumps(dump_task(task)), 'here') == task


def test_an_episode_defines_its_task(make_episode, tmp_path, spec):
    path = make_episode(tmp_path / 'set' / 'own', **shift_right_episode(tmp_path))
    assert own_task(read_info(path)) == spec
    write_card(tmp_path / 'set', spec)
    assert own_tasks([path]) == {path: spec}


def test_a_data_set_defines_the_task_of_an_episode_that_only_names_it(
    make_episode, tmp_path, spec
):
    data = tmp_path / 'set'
    own = make_episode(data / 'own', task='shift_right')
    bundled = make_episode(data / 'bundled')
    assert own_tasks([own, bundled]) == {}  # a data set of an earlier version
    write_card(data, spec)
    assert own_tasks([own, bundled]) == {own: spec}


def test_two_definitions_of_one_name_are_refused_if_they_differ(make_episode, tmp_path, spec):
    data = tmp_path / 'set'
    near = make_episode(data / 'near', **shift_right_episode(tmp_path))
    same = make_episode(data / 'same', **shift_right_episode(tmp_path))
    assert list(own_tasks([near, same])) == [near, same]
    far = make_episode(data / 'far', **shift_right_episode(tmp_path, distance_m=0.2))
    with pytest.raises(ConfigError, match="near' and '.*far' define the task 'shift_right' diff"):
        own_tasks([near, far])
    write_card(data, spec)
    with pytest.raises(ConfigError, match="far' and '.*dataset.json' define the task"):
        own_task(read_info(far))


@pytest.mark.parametrize(
    ('definition', 'says'),
    [
        ({'name': 'x'}, "dataset.json': task 'shift_right': .*'instruction'"),
        ('text', "'splits', 'episodes' or 'task_definitions' are not as"),
    ],
)
def test_a_definition_of_a_data_set_that_cannot_be_used_is_named(
    make_episode, tmp_path, definition, says
):
    path = make_episode(tmp_path / 'set' / 'own', task='shift_right')
    card = {'task_definitions': {'shift_right': definition}}
    (tmp_path / 'set' / 'dataset.json').write_text(json.dumps(card))
    with pytest.raises(ConfigError, match=says):
        own_tasks([path])


def test_an_episode_that_cannot_be_read_defines_nothing(tmp_path):
    assert own_tasks([tmp_path / 'nothing']) == {}


def test_a_task_is_chosen_by_its_name_or_file(tmp_path, spec, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    assert chosen_task(None, [spec]) is None
    assert chosen_task('put_on', ()).name == 'put_on'
    assert chosen_task('shift_right', [spec]) is spec
    assert chosen_task('~/shift_right.yaml', ()) == spec
    with pytest.raises(ConfigError, match=r"'shift_rigt' is not known \(did you mean 'shift_rig"):
        chosen_task('shift_rigt', [spec])
    with pytest.raises(ConfigError, match="task file 'none.yaml' does not exist"):
        chosen_task('none.yaml', [spec])


def test_a_file_of_another_kind_is_no_task():
    with pytest.raises(ConfigError, match=r"openpi.yaml' is no task: its keys are kind, server"):
        chosen_task(str(share_path('config', 'policies', 'openpi.yaml')), ())


def test_a_bundled_name_that_episodes_define_otherwise_has_no_meaning():
    other = chosen_task('stack_blocks_two', ()).replace(softness_m=0.02)
    with pytest.raises(ConfigError, match="'stack_blocks_two' is a bundled one, and the episodes"):
        chosen_task('stack_blocks_two', [other])


def test_episodes_give_their_names_of_tasks_a_meaning(make_episode, tmp_path, spec):
    path = make_episode(tmp_path / 'own', **shift_right_episode(tmp_path))
    assert named_here('shift_right', [path]) == spec
    assert named_here('stack_blocks_two', [path]) == 'stack_blocks_two'
    assert named_here('any.yaml', [path]) == 'any.yaml'  # its reader says what is wrong
    assert named_here(None, [path]) is None
