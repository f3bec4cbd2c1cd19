"""The scene of a recording is the one that was simulated, or it is refused."""

from dataclasses import replace
import json

import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.transforms import rotation
from mtv_world_ros.data.episode import ObjectPoses
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.policies.policy import EpisodeOrigin
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.simulation.recorded_scene import recorded_scene, SCENE, scene_of
from mtv_world_ros.simulation.scenes.randomize import draw_scene
from mtv_world_ros.simulation.scenes.tasks import task_named
from mtv_world_ros.simulation.scenes.workcell import workcell_of
from mtv_world_ros.simulation.simulator import scene_generator

ROBOT = load_robot(robot_path('yam_bimanual'))
WORKCELL = workcell_of(ROBOT)
DEMO = share_path('resource', 'demo_episode')
SEED = 5


@pytest.fixture
def demo():
    return read_episode(DEMO)


def without_scene(episode, **changes):
    """An episode from before scenes were stored."""
    rest = {key: text for key, text in episode.info.metadata.items() if key != SCENE}
    return replace(episode, info=replace(episode.info, metadata=rest, **changes))


@pytest.mark.slow
def test_the_demos_objects_are_where_its_object_poses_say(demo):
    task, scene = recorded_scene(DEMO, WORKCELL)
    assert task.name == demo.info.task
    first = demo.object_poses.T_base_object[0]
    for item, T in zip(scene.objects, first, strict=True):
        np.testing.assert_allclose(item.position, T[:3, 3], atol=1e-6)
        turned = rotation([0, 0, np.sin(item.yaw / 2), np.cos(item.yaw / 2)])
        np.testing.assert_allclose(turned, T[:3, :3], atol=1e-6)
    assert [camera.view for camera in scene.cameras] == list(demo.views)


def recorded(demo, drawn, offset_m=0.0):
    """An episode whose scene was not stored, its objects this far from where they are drawn."""
    poses = np.tile(np.eye(4), (1, len(drawn.objects), 1, 1))
    poses[0, :, :3, 3] = [item.position for item in drawn.objects]
    poses[0, -1, 0, 3] += offset_m
    names = tuple(item.name for item in drawn.objects)
    return replace(
        without_scene(demo, seed=SEED, objects=names),
        object_poses=ObjectPoses(demo.object_poses.stamps_ns[:1], poses),
    )


def test_an_older_recording_is_drawn_again_where_its_seed_still_draws_it(demo):
    drawn = draw_scene(task_named(demo.info.task), scene_generator(SEED), WORKCELL)
    assert scene_of(recorded(demo, drawn), WORKCELL).objects == drawn.objects


def test_one_whose_seed_draws_other_places_is_refused_with_both(demo):
    drawn = draw_scene(task_named(demo.info.task), scene_generator(SEED), WORKCELL)
    with pytest.raises(EpisodeError, match=r'begin at \[\[.* draws them at .* record it again'):
        scene_of(recorded(demo, drawn, 0.01), WORKCELL)
    other = draw_scene(task_named(demo.info.task), scene_generator(SEED + 1), WORKCELL)
    with pytest.raises(EpisodeError, match='record it again'):
        scene_of(recorded(demo, other), WORKCELL)


def test_one_without_scene_and_poses_is_refused(demo):
    bare = without_scene(replace(demo, object_poses=None), seed=SEED)
    with pytest.raises(EpisodeError, match='neither its scene nor object poses'):
        scene_of(bare, WORKCELL)
    with pytest.raises(EpisodeError, match='names no task and seed'):
        scene_of(without_scene(demo, seed=None), WORKCELL)


@pytest.mark.parametrize('text', ('{', '{}', '[1]', json.dumps({'objects': [], 'look': {}})))
def test_a_damaged_scene_is_refused(demo, text):
    metadata = {**demo.info.metadata, SCENE: text}
    damaged = replace(demo, info=replace(demo.info, metadata=metadata))
    with pytest.raises(EpisodeError, match='scene that cannot be used'):
        scene_of(damaged, WORKCELL)


def test_unknown_keys_of_a_stored_scene_are_refused(demo):
    stored = json.loads(demo.info.metadata[SCENE])
    for part in (stored['look'], stored['objects'][0]):
        part['colour'] = 1
        metadata = {**demo.info.metadata, SCENE: json.dumps(stored)}
        with pytest.raises(EpisodeError, match='colour'):
            scene_of(replace(demo, info=replace(demo.info, metadata=metadata)), WORKCELL)
        del part['colour']
    metadata = {**demo.info.metadata, SCENE: json.dumps(stored)}
    whole = replace(demo, info=replace(demo.info, metadata=metadata))
    assert scene_of(whole, WORKCELL).objects == scene_of(demo, WORKCELL).objects


def test_the_expert_of_a_recording_commands_what_was_recorded(demo):
    """The same plan: commands of the expert in a scene of its own differ by much more."""
    from mtv_world_ros.rollout.assembly import assemble_policy

    make = assemble_policy('expert', ROBOT)
    policy = make(EpisodeOrigin(task='shake_bottle', scene_seed=3, recording=str(DEMO)))
    policy.reset(seed=0)
    reached = {}
    for name, commands in (('expert', policy.plan), ('recorded', demo.trajectories[1][1])):
        columns = [commands.joint_names.index(n) for n in ROBOT.joint_names]
        tools = ROBOT.tool_poses(commands.positions[:, columns])[..., :3, 3]
        reached[name] = tools.reshape(-1, 3)
    # heights and tempo are drawn anew; where it puts the block is not
    put_down = demo.object_poses.T_base_object[-1, 0, :2, 3]
    for tools in reached.values():
        assert np.linalg.norm(tools[:, :2] - put_down, axis=1).min() < 0.01
