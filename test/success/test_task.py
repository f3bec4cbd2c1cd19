import numpy as np
import pytest

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.resources import share_path
from mtv_world_ros.success.task import load_task, load_tasks, match_task

LEFT = """
name: left
instruction: place the {a} to the left of the {b}
relation: {kind: left_of, subject: a, target: b, distance_m: [0.08, 0.2]}
"""


@pytest.fixture
def bundled():
    return load_tasks(share_path('config', 'tasks'))


def write(tmp_path, text):
    path = tmp_path / 'task.yaml'
    path.write_text(text)
    return path


def test_bundled_tasks_are_matched_from_the_instruction(bundled):
    left = match_task(bundled, 'Place the red block to the  left of the blue block.')
    stack = match_task(bundled, 'stack the green block on the pink block')
    assert left and stack
    task, bound = left
    assert task.name == 'place_block_a2b_left'
    assert bound == {'a': 'red block', 'b': 'blue block'}
    task, bound = stack
    assert task.name == 'stack_blocks_two'
    assert bound == {'a': 'green block', 'b': 'pink block'}
    assert match_task(bundled, 'shake the bottle') is None


@pytest.mark.parametrize(
    ('delta', 'holds'),
    [
        ((-0.13, 0.0, 0.0), True),
        ((-0.07, 0.0, 0.0), False),
        ((-0.21, 0.0, 0.0), False),
        ((-0.13, 0.06, 0.0), False),
        ((-0.13, 0.0, 0.08), False),
        ((0.13, 0.0, 0.0), False),
    ],
)
def test_left_of_holds_where_the_published_predicate_does(bundled, delta, holds):
    target = np.array([0.1, 0.3, 0.02])
    margins = bundled[0].relation.margins(target + delta, target, 0.04)
    assert (min(margins.values()) > 0) == holds


@pytest.mark.parametrize(
    ('delta', 'holds'),
    [
        ((0.0, 0.0, 0.04), True),
        ((0.02, -0.02, 0.05), True),
        ((0.03, 0.0, 0.04), False),
        ((0.0, -0.03, 0.04), False),
        ((0.0, 0.0, 0.0), False),
        ((0.0, 0.0, 0.06), False),
    ],
)
def test_on_holds_where_the_published_predicate_does(bundled, delta, holds):
    target = np.array([0.1, 0.3, 0.02])
    margins = bundled[1].relation.margins(target + delta, target, 0.04)
    assert (min(margins.values()) > 0) == holds


def test_goal_satisfies_its_own_relation(bundled):
    target = np.array([0.1, 0.3, 0.02])
    for task in bundled:
        goal = task.relation.goal(target, 0.04)
        assert min(task.relation.margins(goal, target, 0.04).values()) > 0.01


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (('relation:', 'relashion:'), r"unknown key 'relashion' \(did you mean 'relation'"),
        (('distance_m', 'distanc_m'), r"unknown key 'distanc_m' \(did you mean 'distance_m'"),
        (('left_of', 'left'), r"relation.kind is 'left' \(did you mean 'left_of'"),
        (('[0.08, 0.2]', '0.08'), "'distance_m' is 0.08; expected 2 positive"),
        (('[0.08, 0.2]', '[0.08, -1]'), 'positive length'),
        (('name: left', ''), r"missing \['name'\]"),
        (('subject: a', 'subject: c'), "about 'c'"),
    ],
)
def test_wrong_task_files_say_what_is_wrong(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        load_task(write(tmp_path, LEFT.replace(*change)))


@pytest.mark.parametrize('text', ['', '[1, 2]', 'name: [unclosed'])
def test_file_that_is_no_mapping_is_a_config_error(tmp_path, text):
    with pytest.raises(ConfigError):
        load_task(write(tmp_path, text))


def test_missing_file_is_a_config_error(tmp_path):
    with pytest.raises(ConfigError, match='cannot be read'):
        load_task(tmp_path / 'none.yaml')


def test_two_files_with_one_task_are_refused(tmp_path):
    (tmp_path / 'a.yaml').write_text(LEFT)
    (tmp_path / 'b.yaml').write_text(LEFT)
    with pytest.raises(ConfigError, match='more than one file'):
        load_tasks(tmp_path)
