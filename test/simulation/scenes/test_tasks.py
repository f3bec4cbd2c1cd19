from dataclasses import replace
import shutil

import numpy as np
import pytest
import yaml

from mtv_world_ros.core.errors import ConfigError, SimulatorError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.scenes import tasks
from mtv_world_ros.simulation.scenes.randomize import draw_scene, instruction_of, start_situation
from mtv_world_ros.simulation.scenes.shapes import SHAPES
from mtv_world_ros.simulation.scenes.tasks import (
    _check_old_table,
    own_definition,
    Shake,
    stored_or_named,
    Task,
    task_named,
    TASKS,
    tasks_named,
)
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.success.task import load_task, TaskSpec
from mtv_world_ros.vision.describers.describer import objects_from_instruction
from mtv_world_ros.vision.segmenters.colour import PALETTE
from test.support.tables import table
from test.support.tiers import rest_slow

WORKCELL = workcell_of(load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml')))


#: the tasks of the paper, in the order in which `--task all` has always had them
PAPER = (
    'bussing_table', 'collect_food', 'collect_tableware', 'collect_toy', 'move_stack_block_ab',
    'move_stack_plate', 'move_object_two', 'place_block_a2b_left', 'place_block_a2b_right',
    'place_block_ab2c_left', 'place_block_ab2c_right', 'place_bread_plate', 'place_cup_plate',
    'shake_bottle', 'stack_blocks_two',
)  # fmt: skip


def test_unknown_task_names_the_nearest():
    with pytest.raises(SimulatorError, match="did you mean 'stack_blocks_two'"):
        task_named('stack_block_two')


def test_a_bundled_task_that_is_only_judged_says_so():
    with pytest.raises(SimulatorError, match="task 'put_on' has no scene: it can be judged, but"):
        tasks_named('put_on')


def test_tasks_are_chosen_by_all_or_by_a_list():
    assert [task.name for task in tasks_named('all')] == [
        name for name, task in TASKS.items() if not task.zero_shot
    ]
    assert [task.name for task in tasks_named('stack_blocks_two')] == ['stack_blocks_two']
    assert len(tasks_named('stack_blocks_two, place_block_a2b_left')) == 2


@pytest.mark.parametrize(
    'name', rest_slow(TASKS, [name for name in TASKS if not name.startswith('place_block_ab2c')])
)
def test_scenes_start_undone_with_distinct_colours_on_the_table(name):
    task = TASKS[name]
    for seed in range(20):
        scene = draw_scene(task, np.random.default_rng(seed), WORKCELL)
        items = {item.role: item for item in scene.objects}
        assert set(items) >= {role.role for role in task.roles if role.probability == 1}
        words = [item.name.split()[0] for item in scene.objects]
        assert len(set(words)) == len(words) and set(words) <= set(PALETTE)
        for item in scene.objects:
            shape = SHAPES[item.shape]
            assert (np.asarray(shape.smallest) <= np.asarray(item.size) + 1e-12).all()
            assert (np.asarray(item.size) <= np.asarray(shape.largest) + 1e-12).all()
            assert item.position[2] == item.size[2] / 2
        if name in PAPER:  # policies may take a wrong object
            assert sum(SHAPES[item.shape].grasp is not None for item in scene.objects) >= 2
        assert not task.succeeds(start_situation(task, items, scene.goals)).any()


def test_the_same_seed_draws_the_same_scene_and_another_seed_another():
    task = TASKS['stack_blocks_two']
    first, again, other = (draw_scene(task, np.random.default_rng(s), WORKCELL) for s in (3, 3, 4))
    assert first.objects == again.objects and first.look == again.look
    assert (first.cameras[0].T_mount_camera == again.cameras[0].T_mount_camera).all()
    assert first.objects != other.objects


def test_instruction_names_the_objects_that_it_is_about():
    scene = draw_scene(TASKS['place_block_a2b_left'], np.random.default_rng(0), WORKCELL)
    text = instruction_of(TASKS['place_block_a2b_left'], scene)
    assert objects_from_instruction(text) == tuple(item.name for item in scene.objects[:2])


def then(task, scene, positions):
    """The start, and objects of some roles elsewhere after it; grippers open."""
    start = start_situation(task, {item.role: item for item in scene.objects}, scene.goals)
    return replace(
        start,
        positions={
            role: np.concatenate([at, [positions.get(role, at[0])]])
            for role, at in start.positions.items()
        },
        rotations={role: np.repeat(at, 2, axis=0) for role, at in start.rotations.items()},
        openings=np.ones((2, 2)),
    )


def test_a_scene_that_is_done_is_a_success():
    task = TASKS['place_block_a2b_left']
    scene = draw_scene(task, np.random.default_rng(0), WORKCELL)
    target = next(np.array(item.position) for item in scene.objects if item.role == 'b')
    done = then(task, scene, {'a': target + [-0.13, 0.0, 0.0]})
    assert task.succeeds(done).tolist() == [False, True]


def test_every_file_with_a_scene_is_a_task_of_its_name():
    folder = share_path('config', 'tasks')
    files = {path: yaml.safe_load(path.read_text()) for path in folder.rglob('*.yaml')}
    with_scene = {path for path, values in files.items() if 'scene' in values}
    assert {path.stem for path in with_scene} == set(TASKS)
    for path in with_scene:
        assert files[path]['name'] == path.stem
        assert TASKS[path.stem].zero_shot == (path.parent.name == 'zero_shot')


@pytest.mark.parametrize('place', ['copy.yaml', 'zero_shot/copy.yaml'])
def test_two_files_of_one_task_are_refused(place, tmp_path, monkeypatch):
    folder = tmp_path / 'config' / 'tasks'
    shutil.copytree(share_path('config', 'tasks'), folder)
    shutil.copy(folder / 'shake_bottle.yaml', folder / place)
    monkeypatch.setattr(tasks, 'share_path', lambda *parts: tmp_path.joinpath(*parts))
    with pytest.raises(ConfigError, match="holds a task 'shake_bottle', too"):
        tasks._read_tasks()


def test_the_papers_15_tasks_are_there_in_their_order():
    assert tuple(t.name for t in tasks_named('all') if t.name in PAPER) == PAPER


def test_the_goals_of_a_scene_fulfil_its_task():
    for task in TASKS.values():
        if any(isinstance(move, Shake) for move in task.moves):
            continue  # it ends where it began
        scene = draw_scene(task, np.random.default_rng(1), WORKCELL)
        goals = {move.subject: goal for move, goal in zip(task.moves, scene.goals, strict=True)}
        assert task.succeeds(then(task, scene, goals))[-1], task.name


def test_both_sides_of_the_table_are_used():
    sides = {
        drawn.objects[0].position[0] > 0
        for drawn in (
            draw_scene(TASKS['shake_bottle'], np.random.default_rng(seed), WORKCELL)
            for seed in range(12)
        )
    }
    assert sides == {True, False}


def test_things_that_grow_keep_their_colour_and_no_two_objects_share_one():
    grown = {'carrot': 'orange', 'corn': 'yellow', 'eggplant': 'purple'}
    for seed in range(20):
        scene = draw_scene(TASKS['collect_food'], np.random.default_rng(seed), WORKCELL)
        names = [item.name for item in scene.objects]
        assert len({name.split()[0] for name in names}) == len(names)
        for name in names:
            word, kind = name.split()
            assert grown.get(kind, word) == word


OWN = {
    'name': 'own', 'instruction': 'put the {a} on the {b}',
    'relations': [{'kind': 'on_top_of', 'subject': 'a', 'target': 'b'}],
}  # fmt: skip
ROLES = [{'role': 'a'}, {'role': 'b'}]
MOVES = [{'subject': 'a', 'reference': 'b', 'rest': 'on'}]
SCENE = {'roles': ROLES, 'moves': MOVES}
A_BOWL = {'role': 'a', 'shapes': ['bowl', 'tray']}


@table(
    'scene, reason',
    [
        ({'mirored': True}, "scene: unknown key 'mirored' (did you mean 'mirrored'?)"),
        ({'roles': 3}, "scene: 'roles' is 3; 'roles' must be a list"),
        ({'roles': [{'role': 'a', 'shape': 'cup'}]}, "roles[0]: unknown key 'shape' (did you"),
        ({'roles': [{'role': 'A b'}]}, "'role' is 'A b', must be small letters"),
        ({'roles': [{'role': 'a', 'shapes': ['blok']}]}, "'blok' (did you mean 'block'?); known"),
        ({'roles': [{'role': 'a', 'shapes': []}]}, 'roles[0].shapes: no shape is given; known'),
        ({'roles': [{'role': 'a', 'x_range': [1, 0]}]}, 'a list of 2 numbers, the smaller one'),
        ({'roles': [*ROLES, {'role': 'a'}]}, "scene.roles has 'a' more than once"),
        ({'roles': [*ROLES, {'role': 'table'}]}, "scene.roles has 'table', which a move's"),
        ({'roles': ROLES[:1]}, "instruction has {b}, but scene.roles has no 'b' of probability 1"),
        ({'roles': [*ROLES[:1], {'role': 'b', 'probability': 0.5}]}, "no 'b' of probability 1"),
        ({'moves': []}, "scene.moves has none of 'a', which the relations want to be moved"),
        ({'moves': [3]}, 'moves[0]: expected keys and values, got 3'),
        ({'moves': [{'subject': 'a', 'refrence': 'b'}]}, "'refrence' (did you mean 'reference'?)"),
        (
            {'moves': [{'subject': 'a', 'num_swings': 2}]},
            "'num_swings' is gone: the expert shakes all",
        ),
        ({'moves': [{'subject': 'c', 'reference': 'b'}]}, "moves[0].subject is 'c'; it must be"),
        ({'moves': [{'subject': 'a', 'reference': 'tabel'}]}, "'tabel' (did you mean 'table'?)"),
        ({'moves': [{'subject': 'a', 'reference': 'b', 'rest': 'up'}]}, 'valid are table, on, in'),
        ({'moves': [{'subject': 'a', 'reference': 'start', 'rest': 'on'}]}, 'needs an object as'),
        ({'roles': [A_BOWL, ROLES[1]]}, "subject 'a' may be a tray, which no gripper can hold"),
    ],
)
def test_a_fault_in_a_scene_is_named_with_file_key_and_valid_values(scene, reason):
    values = {**OWN, 'scene': {**SCENE, **scene}}
    with pytest.raises(ConfigError) as failed:
        Task.of(TaskSpec.model_validate(values), 'own.yaml')
    assert str(failed.value).startswith('own.yaml: ')
    assert reason in str(failed.value)


def written(folder, scene):
    path = folder / 'own.yaml'
    path.write_text(yaml.safe_dump({**OWN, 'scene': scene}))
    return path


def test_a_task_of_ones_own_is_chosen_by_its_file(tmp_path):
    path = written(tmp_path, SCENE)
    own, bundled = tasks_named(f'{path}, stack_blocks_two')
    assert (own.name, own.zero_shot) == ('own', False)
    assert bundled is TASKS['stack_blocks_two']
    assert [move.rest for move in own.moves] == ['on']


def test_a_task_of_ones_own_is_found_in_a_folder_that_paths_begin_in(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, SCENE).rename(tmp_path / 'there.yaml')
    other = tmp_path / 'other'
    other.mkdir()
    assert tasks_named('../there.yaml', other) == tasks_named('there.yaml')
    assert tasks_named(str(tmp_path / 'there.yaml'), other) == tasks_named('there.yaml')


def test_the_definition_of_a_task_of_ones_own_gives_the_same_task_again(tmp_path):
    (own,) = tasks_named(str(written(tmp_path, SCENE)))
    text = own_definition(own)
    assert stored_or_named(text, 'own', 'here') == own
    turned = {key: OWN[key] for key in reversed(OWN)}
    again = Task.of(TaskSpec.model_validate({'scene': SCENE, **turned}), 'here')
    assert own_definition(again) == text  # whatever the order of the keys
    bundled = task_named('stack_blocks_two')
    assert own_definition(bundled) == ''
    assert stored_or_named('', 'stack_blocks_two', 'here') is bundled
    with pytest.raises(SimulatorError, match="unknown task 'own'"):
        stored_or_named('', 'own', 'here')
    with pytest.raises(ConfigError, match='^here.*cannot be used'):
        stored_or_named('{', 'own', 'here')


def test_a_task_without_a_scene_can_be_judged_but_not_simulated(tmp_path):
    path = written(tmp_path, None)
    assert load_task(path).name == 'own'
    with pytest.raises(SimulatorError, match=r"own.yaml: task 'own' has no scene: it can be judg"):
        tasks_named(str(path))


def test_a_name_that_is_no_part_of_a_file_name_can_be_judged_but_not_simulated(tmp_path):
    path = tmp_path / 'up.yaml'
    path.write_text(yaml.safe_dump({**OWN, 'name': '../up', 'scene': SCENE}))
    assert load_task(path).name == '../up'
    with pytest.raises(ConfigError, match=r"name is '../up'; it must be letters, digits"):
        tasks_named(str(path))


def test_two_different_tasks_of_one_name_are_refused(tmp_path):
    path = tmp_path / 'other.yaml'
    path.write_text(yaml.safe_dump({**OWN, 'name': 'stack_blocks_two', 'scene': SCENE}))
    with pytest.raises(ConfigError, match="two different tasks of the name 'stack_blocks_two'"):
        tasks_named(f'stack_blocks_two,{path}')


def old_table():
    """The table of scenes of version 0.1.0."""
    table = {name: dict(task.definition.scene or {}) for name, task in TASKS.items()}
    for scene in table.values():
        scene.pop('after', None)
    table['random_pick_place']['zero_shot'] = True
    return table


def test_a_table_of_scenes_from_before_is_refused_with_what_replaced_it(tmp_path):
    path = tmp_path / 'scenes.yaml'
    path.write_text(yaml.safe_dump(old_table()))
    with pytest.raises(ConfigError, match=r"'config/tasks/NAME.yaml' or your own.*key 'scene'"):
        tasks_named(str(path))


def test_a_table_that_an_older_installation_left_behind_matters_only_if_it_was_changed(tmp_path):
    path = tmp_path / 'scenes.yaml'
    _check_old_table(path, TASKS)  # there is none
    path.write_text(yaml.safe_dump(old_table()))
    _check_old_table(path, TASKS)
    for name, scene in (('mine', SCENE), ('shake_bottle', {**SCENE, 'mirrored': True})):
        path.write_text(yaml.safe_dump({**old_table(), name: scene}))
        with pytest.raises(ConfigError, match=rf"scene of '{name}': scenes are no longer read"):
            _check_old_table(path, TASKS)


def test_more_objects_than_colours_are_refused():
    roles = [{'role': 'a'}, {'role': 'b'}, *({'role': f'r{k}'} for k in range(len(PALETTE)))]
    values = {**OWN, 'scene': {'roles': roles, 'moves': MOVES}}
    task = Task.of(TaskSpec.model_validate(values), 'own.yaml')
    with pytest.raises(SimulatorError, match=r"no colour is left for role 'r\d+' \(block\)"):
        draw_scene(task, np.random.default_rng(0), WORKCELL)
