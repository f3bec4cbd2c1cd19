import numpy as np
import pytest

from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.sim.shapes import SHAPES
from mtv_world_ros.sim.tasks.tasks import task_named, TASKS, tasks_named
from mtv_world_ros.sim.world.randomize import draw_scene, instruction_of, start_history
from mtv_world_ros.vision.colour_words import PALETTE
from mtv_world_ros.vision.describers.describer import objects_from_instruction


def test_unknown_task_names_the_nearest():
    with pytest.raises(SimulatorError, match="did you mean 'stack_blocks_two'"):
        task_named('stack_block_two')


def test_tasks_are_chosen_by_all_or_by_a_list():
    assert [task.name for task in tasks_named('all')] == [
        name for name, task in TASKS.items() if not task.zero_shot
    ]
    assert [task.name for task in tasks_named('stack_blocks_two')] == ['stack_blocks_two']
    assert len(tasks_named('stack_blocks_two, place_block_a2b_left')) == 2


@pytest.mark.parametrize('name', TASKS)
def test_scenes_start_undone_with_distinct_colours_on_the_table(name):
    task = TASKS[name]
    for seed in range(20):
        scene = draw_scene(task, np.random.default_rng(seed))
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
        assert not task.succeeds(start_history(items, scene.goals)).any()


def test_the_same_seed_draws_the_same_scene_and_another_seed_another():
    task = TASKS['stack_blocks_two']
    first, again, other = (draw_scene(task, np.random.default_rng(s)) for s in (3, 3, 4))
    assert first.objects == again.objects and first.look == again.look
    assert (first.cameras[0].T_mount_camera == again.cameras[0].T_mount_camera).all()
    assert first.objects != other.objects


def test_instruction_names_the_objects_that_it_is_about():
    scene = draw_scene(TASKS['place_block_a2b_left'], np.random.default_rng(0))
    text = instruction_of(TASKS['place_block_a2b_left'], scene)
    assert objects_from_instruction(text) == tuple(item.name for item in scene.objects[:2])


def test_a_scene_that_is_already_done_is_seen_by_its_predicate():
    scene = draw_scene(TASKS['place_block_a2b_left'], np.random.default_rng(0))
    items = {item.role: item for item in scene.objects}
    history = start_history(items, scene.goals)
    history.positions['a'] = history.positions['b'] + [[-0.13, 0.0, 0.0]]
    assert TASKS['place_block_a2b_left'].succeeds(history).all()


def test_there_are_the_papers_15_tasks():
    assert sorted(task.name for task in tasks_named('all')) == [
        'bussing_table', 'collect_food', 'collect_tableware', 'collect_toy', 'move_object_two',
        'move_stack_block_ab', 'move_stack_plate', 'place_block_a2b_left',
        'place_block_a2b_right', 'place_block_ab2c_left', 'place_block_ab2c_right',
        'place_bread_plate', 'place_cup_plate', 'shake_bottle', 'stack_blocks_two',
    ]  # fmt: skip


def test_the_goals_of_a_scene_fulfil_its_task():
    for task in tasks_named('all'):
        if task.name == 'shake_bottle':
            continue
        scene = draw_scene(task, np.random.default_rng(1))
        history = start_history({item.role: item for item in scene.objects}, scene.goals)
        for move, goal in zip(task.moves, scene.goals, strict=True):
            history.positions[move.subject] = np.array([goal])
        assert task.succeeds(history).all(), task.name


def test_both_sides_of_the_table_are_used():
    sides = {
        draw_scene(TASKS['shake_bottle'], np.random.default_rng(seed)).objects[0].position[0] > 0
        for seed in range(12)
    }
    assert sides == {True, False}


def test_things_that_grow_keep_their_colour_and_no_two_objects_share_one():
    grown = {'carrot': 'orange', 'corn': 'yellow', 'eggplant': 'purple'}
    for seed in range(20):
        scene = draw_scene(TASKS['collect_food'], np.random.default_rng(seed))
        names = [item.name for item in scene.objects]
        assert len({name.split()[0] for name in names}) == len(names)
        for name in names:
            word, kind = name.split()
            assert grown.get(kind, word) == word
