from dataclasses import replace

import numpy as np
from pydantic import TypeAdapter, ValidationError
import pytest

from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.randomize import draw_scene, instruction_of, start_situation
from mtv_world_ros.simulation.shapes import SHAPES
from mtv_world_ros.simulation.tasks import Task, task_named, TASKS, tasks_named
from mtv_world_ros.simulation.workcell import workcell_of
from mtv_world_ros.vision.describers.describer import objects_from_instruction
from mtv_world_ros.vision.segmenters.colour import PALETTE
from test.support.tiers import rest_slow

WORKCELL = workcell_of(load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml')))


def test_unknown_task_names_the_nearest():
    with pytest.raises(SimulatorError, match="did you mean 'stack_blocks_two'"):
        task_named('stack_block_two')


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
        assert len(items) >= 2
        words = [item.name.split()[0] for item in scene.objects]
        assert len(set(words)) == len(words) and set(words) <= set(PALETTE)
        for item in scene.objects:
            shape = SHAPES[item.shape]
            assert (np.asarray(shape.smallest) <= np.asarray(item.size) + 1e-12).all()
            assert (np.asarray(item.size) <= np.asarray(shape.largest) + 1e-12).all()
            assert item.position[2] == item.size[2] / 2
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


def test_every_task_has_a_definition_of_its_roles():
    files = share_path('config', 'tasks').rglob('*.yaml')
    assert {path.stem for path in files} == set(TASKS)
    for name, task in TASKS.items():
        spec = task.definition
        assert spec.name == name
        assert set(spec.roles) <= {role.role for role in task.roles}
        assert set(spec.movers) == {move.subject for move in task.moves}


def test_there_are_the_papers_15_tasks():
    assert sorted(task.name for task in tasks_named('all')) == [
        'bussing_table', 'collect_food', 'collect_tableware', 'collect_toy', 'move_object_two',
        'move_stack_block_ab', 'move_stack_plate', 'place_block_a2b_left',
        'place_block_a2b_right', 'place_block_ab2c_left', 'place_block_ab2c_right',
        'place_bread_plate', 'place_cup_plate', 'shake_bottle', 'stack_blocks_two',
    ]  # fmt: skip


def test_the_goals_of_a_scene_fulfil_its_task():
    for task in TASKS.values():
        if task.name == 'shake_bottle':
            continue
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


def test_a_mistyped_key_of_a_scene_is_refused():
    role = {'role': 'a', 'shapes': ['block']}
    scene = {'name': 'x', 'roles': [role], 'moves': [{'subject': 'a', 'reference': 'table'}]}
    assert TypeAdapter(Task).validate_python(scene).roles[0].shapes == ('block',)
    for wrong in ({**scene, 'mirored': True}, {**scene, 'roles': [{**role, 'shape': 'cup'}]}):
        with pytest.raises(ValidationError, match='mirored|shape'):
            TypeAdapter(Task).validate_python(wrong)
