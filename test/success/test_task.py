from dataclasses import dataclass, field

import numpy as np
import pytest

from mtv_world_ros.errors import ConfigError
from mtv_world_ros.files import share_path
from mtv_world_ros.sim.tasks.predicates import History
from mtv_world_ros.sim.tasks.tasks import task_named, tasks_named
from mtv_world_ros.sim.world.randomize import draw_scene, instruction_of
from mtv_world_ros.sim.world.scene import rotation_of
from mtv_world_ros.success.task import load_task, load_tasks, match_task
from mtv_world_ros.vision.describers.describer import objects_from_instruction

LEFT = """
name: left
instruction: place the {a} to the left of the {b}
relations: [{kind: left_of, subject: a, target: b, distance_m: [0.08, 0.2]}]
"""


@dataclass
class Known:
    """A situation where everything is known."""

    ends: dict
    starts: dict = field(default_factory=dict)
    height: float = 0.04
    raised: float = 0.0
    reversals: int = 0

    def end(self, role):
        return np.array(self.ends[role], float)

    def start(self, role):
        return np.array(self.starts[role], float)

    def stack_height(self, upper, lower):
        return self.height

    def lift(self, role):
        return self.raised

    def swings(self, role, swing):
        return self.reversals


@pytest.fixture(scope='module')
def bundled():
    return {task.name: task for task in load_tasks(share_path('config', 'tasks'))}


def holds(task, situation):
    """Whether all conditions of all relations hold."""
    return all(m.value > 0 for relation in task.relations for m in relation.margins(situation))


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


@pytest.mark.parametrize('name', [task.name for task in tasks_named('all')])
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_every_task_of_the_simulator_is_known_by_what_it_says(bundled, name, seed):
    task = task_named(name)
    scene = draw_scene(task, np.random.default_rng(seed))
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


def history(scene, positions, up=None):
    """What the simulator's predicate looks at, objects at rest for six samples."""
    roles = {item.role: item for item in scene.objects}
    centres = {
        r: np.repeat(np.array([positions.get(r, i.position)], float), 6, axis=0)
        for r, i in roles.items()
    }
    return History(
        positions=centres,
        rotations={r: np.repeat(rotation_of(i)[None], 6, axis=0) for r, i in roles.items()},
        sizes={r: i.size for r, i in roles.items()},
        openings=np.ones((2, 6)),
        starts={r: np.array(i.position) for r, i in roles.items()},
        goals=tuple(np.asarray(goal) for goal in scene.goals),
    )


@pytest.mark.parametrize('name', [t.name for t in tasks_named('all') if t.name != 'shake_bottle'])
def test_relations_hold_where_the_simulator_sees_a_success(bundled, name):
    task, spec = task_named(name), bundled[name]
    agreed, rng = [], np.random.default_rng(7)
    for seed in range(4):
        scene = draw_scene(task, np.random.default_rng(seed))
        roles = {item.role: item for item in scene.objects}
        starts = {role: np.array(item.position) for role, item in roles.items()}
        goals = {move.subject: goal for move, goal in zip(task.moves, scene.goals, strict=True)}
        for noise in (0.0, 0.0, 0.005, 0.01, 0.03, 0.03, 0.06, 0.1):
            ends = {
                **starts,
                **{
                    r: np.array(g) + noise * rng.normal(size=3) * (1, 1, 0.2)
                    for r, g in goals.items()
                },
            }
            pair = [r for r in spec.relations if r.kind == 'on_top_of']
            height = (roles['a'].size[2] + roles['b'].size[2]) / 2 if pair else 0.0
            truth = bool(task.succeeds(history(scene, ends)).all())
            agreed.append((truth, holds(spec, Known(ends, starts, height))))
        agreed.append(
            (bool(task.succeeds(history(scene, {})).all()), holds(spec, Known(starts, starts)))
        )
    truth, found = np.array(agreed).T
    assert truth.any() and not truth.all()
    assert (truth == found).mean() >= 0.9, agreed


@pytest.mark.parametrize(
    ('delta', 'expected'),
    [
        ((-0.13, 0.0, 0.0), True),
        ((-0.07, 0.0, 0.0), False),
        ((-0.21, 0.0, 0.0), False),
        ((-0.13, 0.06, 0.0), False),
        ((-0.13, 0.0, 0.08), False),
        ((0.13, 0.0, 0.0), False),
    ],
)
def test_left_of_holds_where_the_published_predicate_does(bundled, delta, expected):
    target = np.array([0.1, 0.3, 0.02])
    at = Known({'a': target + delta, 'b': target})
    assert holds(bundled['place_block_a2b_left'], at) == expected


@pytest.mark.parametrize(
    ('delta', 'expected'),
    [
        ((0.0, 0.0, 0.04), True),
        ((0.02, -0.02, 0.05), True),
        ((0.03, 0.0, 0.04), False),
        ((0.0, -0.03, 0.04), False),
        ((0.0, 0.0, 0.0), False),
        ((0.0, 0.0, 0.06), False),
    ],
)
def test_on_holds_where_the_published_predicate_does(bundled, delta, expected):
    target = np.array([0.1, 0.3, 0.02])
    at = Known({'a': target + delta, 'b': target})
    assert holds(bundled['stack_blocks_two'], at) == expected


def test_goal_satisfies_its_own_relation(bundled):
    ends = {'a': (0.0, 0.3, 0.02), 'b': (0.2, 0.3, 0.02), 'c': (0.1, 0.25, 0.02)}
    num_goals = 0
    for task in bundled.values():
        for relation in task.relations:
            goal = relation.goal(Known(ends, ends))
            if goal is None:
                continue
            at = Known({**ends, goal[0]: goal[1]}, ends)
            assert min(margin.value for margin in relation.margins(at)) > 0.01
            num_goals += 1
    assert num_goals > 12


@pytest.mark.parametrize(
    ('lift', 'reversals', 'expected'),
    [(0.075, 2, True), (0.075, 4, True), (0.075, 1, False), (0.02, 3, False)],
)
def test_shaken_needs_both_the_lift_and_the_swings(bundled, lift, reversals, expected):
    at = Known({}, raised=lift, reversals=reversals)
    assert holds(bundled['shake_bottle'], at) == expected


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
        (('name:', 'gripper: shut\nname:'), 'gripper is .shut.; it must be one of open, any'),
        (('name:', 'nouns: {z: [cup]}\nname:'), "about 'z'"),
        (('name:', 'nouns: [cup]\nname:'), "'nouns' is .* expected words by placeholder"),
        (('name:', 'views: low\nname:'), "'views' is 'low'; expected a list of words"),
        (('distance_m', 'distanc_m'), r"unknown key 'distanc_m' \(did you mean 'distance_m'"),
        (('left_of', 'left'), r"relations\[0\]: kind is 'left' \(did you mean 'left_of'"),
        (('[0.08, 0.2]', '0.08'), "'distance_m' is 0.08; expected 2 positive"),
        (('[0.08, 0.2]', '[0.08, -1]'), 'positive length'),
        (('name: left', ''), "key 'name' is missing"),
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
    with pytest.raises(ConfigError, match="'.*none.yaml' does not exist; set 'task'"):
        load_task(tmp_path / 'none.yaml')


def test_two_files_with_one_task_are_refused(tmp_path):
    (tmp_path / 'a.yaml').write_text(LEFT)
    (tmp_path / 'b.yaml').write_text(LEFT)
    with pytest.raises(ConfigError, match='more than one file'):
        load_tasks(tmp_path)
