from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.scenes.randomize import draw_scene, instruction_of
from mtv_world_ros.simulation.scenes.tasks import Shake, task_named, tasks_named
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.success.situation import TruePoses
from mtv_world_ros.success.task import load_task, load_tasks, match_task, object_called
from mtv_world_ros.vision.describers.describer import objects_from_instruction
from test.support.tables import table

WORKCELL = workcell_of(load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml')))
LEFT = """
name: left
instruction: place the {a} to the left of the {b}
relations: [{kind: left_of, subject: a, target: b, distance_m: [0.08, 0.2]}]
"""


def poses(ends, starts=None, size=(0.04, 0.04, 0.04)):
    """Objects of one size at their starts and then at their ends, upright; grippers open."""
    starts = ends if starts is None else starts
    return TruePoses(
        positions={role: np.array([starts[role], ends[role]], float) for role in ends},
        rotations={role: np.repeat(np.eye(3)[None], 2, axis=0) for role in ends},
        sizes=dict.fromkeys(ends, size),
        openings=np.ones((2, 2)),
    )


@pytest.fixture(scope='module')
def bundled():
    return {task.name: task for task in load_tasks(share_path('config', 'tasks'))}


def holds(task, situation):
    """Whether all conditions of all relations hold at the end."""
    return all(m.end > 0 for relation in task.relations for m in relation.margins(situation))


def write(tmp_path, text):
    path = tmp_path / 'task.yaml'
    path.write_text(text)
    return path


def test_bundled_tasks_are_matched_from_the_instruction(bundled):
    tasks = bundled.values()
    left = match_task(tasks, 'Place the red block to the  left of the blue block.')
    stack = match_task(tasks, 'stack the green block on the pink block')
    assert left and stack
    task, bound = left
    assert task.name == 'place_block_a2b_left'
    assert bound == {'a': 'red block', 'b': 'blue block'}
    task, bound = stack
    assert task.name == 'stack_blocks_two'
    assert bound == {'a': 'green block', 'b': 'pink block'}
    assert match_task(tasks, 'polish the bottle') is None


@table('name, seed', product([task.name for task in tasks_named('all')], (1, 2, 3)))
def test_every_task_of_the_simulator_is_known_by_what_it_says(bundled, name, seed):
    task = task_named(name)
    scene = draw_scene(task, np.random.default_rng(seed), WORKCELL)
    instruction = instruction_of(task, scene)
    matched = match_task(bundled.values(), instruction)
    assert matched is not None, instruction
    spec, bound = matched
    assert spec.name == name
    said = {
        item.role: item.name for item in scene.objects if f'{{{item.role}}}' in task.instruction
    }
    assert bound == said
    assert set(bound.values()) <= set(objects_from_instruction(instruction))
    assert spec.movers == tuple(dict.fromkeys(spec.movers))
    assert set(spec.movers) == {move.subject for move in task.moves}


@pytest.mark.parametrize(
    'name',
    [t.name for t in tasks_named('all') if not any(isinstance(m, Shake) for m in t.moves)],
)
def test_usual_sizes_serve_in_place_of_exact_ones(bundled, name):
    """The estimator takes the sizes of the task file, and measures those of blocks."""
    task, spec = task_named(name), bundled[name]
    agreed, rng = [], np.random.default_rng(7)
    for seed in range(4):
        scene = draw_scene(task, np.random.default_rng(seed), WORKCELL)
        starts = {item.role: np.array(item.position) for item in scene.objects}
        goals = {move.subject: goal for move, goal in zip(task.moves, scene.goals, strict=True)}
        sizes = {item.role: item.size for item in scene.objects}
        for noise in (None, 0.0, 0.0, 0.005, 0.01, 0.03, 0.03, 0.06, 0.1):
            ends = starts if noise is None else starts | {
                role: np.array(goal) + noise * rng.normal(size=3) * (1, 1, 0.2)
                for role, goal in goals.items()
            }  # fmt: skip
            exact = replace(poses(ends, starts), sizes=sizes)
            usual = replace(exact, sizes=sizes | dict(spec.sizes_m))
            agreed.append((bool(task.succeeds(exact)[-1]), holds(spec, usual)))
    truth, found = np.array(agreed).T
    assert truth.any() and not truth.all()
    assert (truth == found).mean() >= 0.9, agreed


def test_goal_satisfies_its_own_relation(bundled):
    ends = {'a': (0.0, 0.3, 0.02), 'b': (0.2, 0.3, 0.02), 'c': (0.1, 0.25, 0.02)}
    num_goals = 0
    for task in bundled.values():
        for relation in task.relations:
            given = replace(poses(ends), goals={'a': np.array([0.1, 0.1, 0.02])})
            goal = relation.goal(given)
            if goal is None:
                continue
            at = replace(poses({**ends, goal[0]: goal[1]}, ends), goals=given.goals)
            assert min(margin.end for margin in relation.margins(at)) > 0.01
            num_goals += 1
    assert num_goals > 12


@pytest.mark.parametrize(
    ('instruction', 'name'),
    [
        ('stack the red plate on the blue plate', 'move_stack_plate'),
        ('stack the red block on the blue block', 'stack_blocks_two'),
        ('place the red cup on the blue plate', 'place_cup_plate'),
        ('place the orange bread on the blue plate', 'place_bread_plate'),
        ('place the red block on the blue plate', None),
    ],
)
def test_nouns_tell_tasks_of_one_template_apart(bundled, instruction, name):
    matched = match_task(bundled.values(), instruction)
    assert (matched and matched[0].name) == name


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (('relations:', 'relashions:'), r"unknown key 'relashions' \(did you mean 'relations'"),
        (
            ('name:', 'gripper: shut\nname:'),
            'gripper is .shut.; it must be one of open, released, any',
        ),
        (('name:', 'nouns: {z: [cup]}\nname:'), "about 'z'"),
        (('name:', 'nouns: [cup]\nname:'), "'nouns' is .* expected words by placeholder"),
        (('name:', 'views: low\nname:'), "'views' is 'low'; expected a list of words"),
        (('distance_m', 'distanc_m'), r"unknown key 'distanc_m' \(did you mean 'distance_m'"),
        (('left_of', 'left'), r"relations\[0\]: kind is 'left' \(did you mean 'left_of'"),
        (('[0.08, 0.2]', '0.08'), "'distance_m' is 0.08; expected 2 positive"),
        (('[0.08, 0.2]', '[0.08, -1]'), 'positive length'),
        (('name: left', ''), "key 'name' is missing"),
        (('subject: a', 'subject: c'), "about 'c'"),
        (('name:', 'sizes_m: {z: [1, 1, 1]}\nname:'), "about 'z'"),
        (('name:', 'sizes_m: {a: [1, 1]}\nname:'), "'sizes_m.a' is .* expected 3 positive"),
        (('name:', 'sizes_m: [1]\nname:'), "'sizes_m' is .* expected lengths by placeholder"),
        (('left_of', 'inside'), r"unknown key 'distance_m'"),
        (
            (
                'left_of, subject: a, target: b, distance_m: [0.08, 0.2]',
                'inside, subject: a, target: b, whole: 1',
            ),
            "'whole' is 1; expected true or false",
        ),
    ],
)
def test_wrong_task_files_say_what_is_wrong(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        load_task(write(tmp_path, LEFT.replace(*change)))


@pytest.mark.parametrize('text', ['', '[1, 2]', 'name: [unclosed'])
def test_files_that_cannot_be_used_are_config_errors(tmp_path, text):
    with pytest.raises(ConfigError):
        load_task(write(tmp_path, text))
    with pytest.raises(ConfigError, match="'.*none.yaml' does not exist; set 'task'"):
        load_task(tmp_path / 'none.yaml')
    for name in ('task.yaml', 'other.yaml'):
        (tmp_path / name).write_text(LEFT)
    with pytest.raises(ConfigError, match='more than one file'):
        load_tasks(tmp_path)


@pytest.fixture(scope='module')
def put_on():
    (task,) = load_tasks(share_path('config', 'tasks', 'any_size'))
    return task


@pytest.mark.parametrize(
    ('said', 'subject', 'target'),
    [
        ('pick the blue block and place it in plate', 'blue block', 'plate'),
        ('Pick up a blue block and put it on the white plate.', 'blue block', 'white plate'),
        ('stack blue block on red block', 'blue block', 'red block'),
        ('put the cup into the box', 'cup', 'box'),
    ],
)
def test_things_of_any_size_are_put_on_others_in_many_words(put_on, said, subject, target):
    assert put_on.bind(said) == {'a': subject, 'b': target}


@pytest.mark.parametrize(
    'said', ['put the red block and the green block on the plate', 'fold the towel', 'put it on']
)
def test_other_instructions_are_not_about_putting_one_thing_on_another(put_on, said):
    assert put_on.bind(said) is None


def test_benchmark_decides_what_it_knows(bundled, put_on):
    tasks = [*bundled.values(), put_on]
    names = {
        said: matched and matched[0].name
        for said in ('stack the red block on the blue block', 'stack red block on blue block')
        for matched in [match_task(tasks, said)]
    }
    assert list(names.values()) == ['stack_blocks_two', 'put_on']


def test_articles_do_not_count_where_no_task_has_them_as_said(tmp_path):
    task = load_task(write(tmp_path, LEFT))
    for said in ('place cup to the left of the plate', 'Place a cup to left of plate.'):
        matched = match_task([task], said)
        assert matched is not None and matched[1] == {'a': 'cup', 'b': 'plate'}
    assert match_task([task], 'fold the towel') is None


@pytest.mark.parametrize(
    ('name', 'meant'),
    [
        ('green towel', 'green towel'),
        ('towel', 'green towel'),
        ('the towel', 'green towel'),
        ('block', None),
        ('blue block', 'blue block'),
        ('cup', None),
        ('the', None),
    ],
)
def test_objects_are_called_by_the_words_that_tell_them_apart(name, meant):
    assert object_called(name, ('green towel', 'blue block', 'red block')) == meant


def test_phrasings_need_all_placeholders(tmp_path):
    text = LEFT.replace('name:', 'phrasings: ["move {a} left"]\nname:')
    with pytest.raises(ConfigError, match="'move .a. left' does not hold as .b."):
        load_task(write(tmp_path, text))
