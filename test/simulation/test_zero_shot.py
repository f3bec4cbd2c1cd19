from dataclasses import replace
import json

import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode, read_info
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.simulation.collect.collect_dataset import collect
from mtv_world_ros.simulation.collect.episode_jobs import episode_seed, jobs_of, zero_shot_jobs
from mtv_world_ros.simulation.collect.episode_maker import cameras_of, CollectConfig
from mtv_world_ros.simulation.scenes.cameras import camera_model, CameraJitter, CameraMoves
from mtv_world_ros.simulation.scenes.randomize import draw_scene, RandomizationConfig
from mtv_world_ros.simulation.scenes.shapes import SHAPES
from mtv_world_ros.simulation.scenes.tasks import task_named, TASKS, tasks_named
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.simulation.zero_shot import kinds_named, tasks_of, UNSEEN_SHAPES, variant

WORKCELL = workcell_of(load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml')))
CAMERAS = WORKCELL.cameras
PLAIN, CONFIG = RandomizationConfig().of(WORKCELL), CameraMoves()
ALL = tasks_named('all')


def _scene(kind, task, seed):
    drawn, randomization = variant(kind, task, seed, PLAIN, CONFIG)
    return draw_scene(drawn, np.random.default_rng(seed), WORKCELL, randomization)


def _turn(one, other):
    """Angle between the optical axes [deg]."""
    return np.rad2deg(np.arccos(np.clip(one[:3, 2] @ other[:3, 2], -1, 1)))


def test_new_views_are_far_from_every_view_of_training_and_see_all_objects():
    trained = [camera_model(spec, 384, 288).T_mount_camera for spec in CAMERAS]
    seen = 0
    for seed in range(60):
        try:
            scene = _scene('view', ALL[seed % len(ALL)], seed)  # refused where it sees not all
        except SimulatorError as error:
            assert 'does not see' in str(error)
            continue
        seen += 1
        assert [camera.view for camera in scene.cameras] == ['low', 'high']
        for camera, pose in zip(scene.cameras, trained, strict=True):
            # 25 degrees about the vertical, less the jitter, of a camera that looks down
            assert _turn(camera.T_mount_camera, pose) > 9
            assert np.linalg.norm(camera.T_mount_camera[:3, 3] - pose[:3, 3]) > 0.2
    assert seen >= 58


def test_half_of_the_movable_objects_are_of_shapes_that_no_task_uses():
    used = {shape for task in ALL for role in task.roles for shape in role.shapes}
    assert not used & set(UNSEEN_SHAPES)
    shares = []
    for number, task in enumerate(tasks_of('object', ALL)):
        for seed in range(4 * number, 4 * number + 4):
            shapes = [item.shape for item in _scene('object', task, seed).objects]
            movable = [shape for shape in shapes if SHAPES[shape].grasp is not None]
            unseen = [shape in UNSEEN_SHAPES for shape in movable]
            assert 0 < sum(unseen) < len(unseen)
            shares.append(np.mean(unseen))
    assert np.mean(shares) == pytest.approx(0.5, abs=0.02)


def test_the_unseen_task_moves_an_object_to_a_free_place():
    (task,) = tasks_of('task', ALL)
    assert task.zero_shot and task not in ALL
    goals = []
    for seed in range(20):
        scene = _scene('task', task, seed)
        goal, (subject, *others) = np.array(scene.goals[0]), scene.objects
        goals.append(goal[:2])
        assert np.linalg.norm(goal[:2] - subject.position[:2]) >= 0.08
        for other in others:
            reach = (max(subject.size[:2]) + max(other.size[:2])) / 2
            assert np.linalg.norm(goal[:2] - other.position[:2]) > reach
    assert (np.std(goals, axis=0) > 0.02).all()


def test_full_size_shares_395_episodes_between_the_kinds_and_their_tasks(tmp_path):
    jobs = zero_shot_jobs(('view', 'task', 'object'), ALL, 395, 0, tmp_path)
    kinds = [job.zero_shot for job in jobs]
    assert [kinds.count(kind) for kind in ('view', 'task', 'object')] == [132, 132, 131]
    assert len({job.path for job in jobs}) == 395
    views = [job.task.name for job in jobs if job.zero_shot == 'view']
    counts = [views.count(task.name) for task in ALL]
    assert sum(counts) == 132 and max(counts) - min(counts) <= 1
    # two of ten miss, per kind and task
    assert 0.1 < np.mean([job.miss for job in jobs]) < 0.3
    # a larger set contains the smaller one
    assert jobs[:30] == zero_shot_jobs(('view', 'task', 'object'), ALL, 30, 0, tmp_path)
    plain = {episode_seed(0, j.task.name, j.index, 0) for j in jobs_of(ALL, 10, 0, tmp_path)}
    shot = {episode_seed(0, j.task.name, j.index, 0, j.zero_shot) for j in jobs}
    assert not plain & shot


def test_unknown_kinds_and_tasks_that_cannot_be_varied_are_refused():
    assert kinds_named('object, view,object') == ('object', 'view')
    assert kinds_named('') == ()
    with pytest.raises(SimulatorError, match=r"'views'.*did you mean 'view'"):
        kinds_named('views')
    with pytest.raises(SimulatorError, match='no object of move_stack_plate can be exchanged'):
        tasks_of('object', [TASKS['move_stack_plate']])


@pytest.mark.slow
@pytest.mark.usefixtures('opengl')
def test_a_zero_shot_set_is_for_testing_and_names_its_kinds(tmp_path):
    config = CollectConfig(randomization=RandomizationConfig(width=96, height=72))
    out = tmp_path / 'set'
    collect(
        'place_cup_plate', 3, 1, out, zero_shot='view,task,object', config=config, progress=False
    )
    names = {
        'view': 'view_place_cup_plate_00000',
        'task': 'task_random_pick_place_00000',
        'object': 'object_place_cup_plate_00000',
    }
    card = json.loads((out / 'dataset.json').read_text())
    assert card['kind'] == 'zero_shot'
    assert card['splits'] == {'train': [], 'test': sorted(names.values())}
    assert {
        kind: counts['episodes'] for kind, counts in card['zero_shot'].items()
    } == dict.fromkeys(sorted(names), 1)
    for kind, name in names.items():
        info = read_info(out / name)
        assert info.metadata['zero_shot'] == kind
    seen = {item.split()[-1] for item in read_info(out / names['object']).objects[:2]}
    assert len(seen & set(UNSEEN_SHAPES)) == 1
    azimuths = []
    for kind in ('view', 'object'):
        x, y, _ = read_episode(out / names[kind]).cameras['low'].T_mount_camera[:3, 3]
        azimuths.append(np.rad2deg(np.arctan2(x, y - CAMERAS[0].target[1])))
    assert abs(azimuths[1] - CAMERAS[0].azimuth) < 4 and abs(azimuths[0] - azimuths[1]) > 20
    text = (out / 'README.md').read_text()
    assert 'mtv-world collect --zero-shot object,task,view --episodes 3 --seed 1' in text
    assert task_named(info.task).name in text


def test_moved_cameras_of_training_leave_the_angles_of_zero_shot_views_unseen(tmp_path):
    config = CollectConfig(
        randomization=RandomizationConfig(width=96, height=72, cameras=CAMERAS[:1]),
        moved_share=0.6,
    )
    turns = []
    for seed in range(200):
        cameras = cameras_of(seed, config).cameras
        assert cameras is not None
        (spec,) = cameras
        turns.append(abs(spec.azimuth - CAMERAS[0].azimuth))
    turns = np.array(turns)
    assert (turns > 0).mean() == pytest.approx(0.6, abs=0.1)
    low, high = CameraMoves().azimuth
    jitter = CameraJitter().angle_deg
    assert not ((turns > low - jitter) & (turns < high + jitter)).any()
    assert (turns > high).any() and ((turns > 5) & (turns < low)).any()

    out = tmp_path / 'set'
    small = replace(config, randomization=RandomizationConfig(width=96, height=72), moved_share=1)
    collect('place_cup_plate', 1, 1, out, config=small, progress=False)
    x, y, _ = read_episode(out / 'place_cup_plate_00000').cameras['low'].T_mount_camera[:3, 3]
    azimuth = np.rad2deg(np.arctan2(x, y - CAMERAS[0].target[1]))
    assert abs(azimuth - CAMERAS[0].azimuth) > 2 * jitter
    text = (out / 'README.md').read_text()
    assert '--width 96 --height 72 --moved-cameras 1' in text and 'stand elsewhere' in text


@pytest.mark.parametrize(
    ('options', 'reason'),
    [
        (['--moved-cameras', '1.5'], 'moved cameras is 1.5; it must be in [0, 1]'),
        (['--zero-shot', 'views'], "unknown zero-shot set 'views' (did you mean 'view'?)"),
        (['--task', 'stack_block_two'], "unknown task 'stack_block_two' (did you mean"),
        (['--episodes', '0'], 'both must be at least 1'),
    ],
)
def test_the_command_says_what_is_wrong_and_makes_nothing(options, reason, tmp_path, capsys):
    out = tmp_path / 'set'
    assert main(['collect', '--episodes', '1', '--out', str(out), *options]) == 1
    assert reason in capsys.readouterr().err
    assert not out.exists()
