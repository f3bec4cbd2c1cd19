import numpy as np
import pytest

from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.sim.predicates import a_left_of_b
from mtv_world_ros.sim.randomize import draw_scene, instruction_of, start_history
from mtv_world_ros.sim.tasks import task_named, TASKS, tasks_named
from mtv_world_ros.success.describer import objects_from_instruction
from mtv_world_ros.success.palette import PALETTE


def test_unknown_task_names_the_nearest():
    with pytest.raises(SimulatorError, match="did you mean 'stack_blocks_two'"):
        task_named('stack_block_two')


def test_tasks_are_chosen_by_all_or_by_a_list():
    assert [task.name for task in tasks_named('all')] == list(TASKS)
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
        assert all(0.04 <= item.size[0] <= 0.055 for item in scene.objects)
        assert all(item.position[2] == item.size[2] / 2 for item in scene.objects)
        assert not task.succeeds(start_history(items)).any()


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
    history = start_history(items)
    history.positions['a'] = history.positions['b'] + [[-0.13, 0.0, 0.0]]
    assert a_left_of_b(history).all()
