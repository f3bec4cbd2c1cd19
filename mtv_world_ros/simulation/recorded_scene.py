"""The scene of a recorded episode: stored in its metadata, or drawn again and compared."""

from __future__ import annotations

from dataclasses import asdict
import json
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.bounded_input import parse_json
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.episode import (
    CALIBRATION_FILE,
    Episode,
    NOMINAL,
    PHYSICS,
    TASK_DEFINITION,
)
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.simulation.physics import physics_named
from mtv_world_ros.simulation.scenes.randomize import draw_scene
from mtv_world_ros.simulation.scenes.scene import Place, Scene, SceneLook, SceneObject
from mtv_world_ros.simulation.scenes.tasks import (
    own_definition,
    stored_or_named,
    Task,
)
from mtv_world_ros.simulation.scenes.workcell import Workcell
from mtv_world_ros.simulation.simulator import scene_generator

#: key of the metadata that holds objects, look and goals
SCENE = 'drawn_scene'
#: a scene that is drawn anew has its objects where they were recorded, up to this [m]
_SAME_PLACE_M = 1e-3

_OBJECTS = TypeAdapter(tuple[SceneObject, ...])
_LOOK = TypeAdapter(SceneLook)
_GOALS = TypeAdapter(tuple[Place, ...])


def dump_scene(scene: Scene) -> str:
    """Return objects, look and goals as JSON; the cameras are in the episode's calibration."""
    objects = [asdict(item) for item in scene.objects]
    return json.dumps({'objects': objects, 'look': asdict(scene.look), 'goals': scene.goals})


def dump_task(task: Task) -> dict[str, str]:
    """Return the metadata of a task's definition as JSON; empty for a bundled task."""
    definition = own_definition(task)
    return {TASK_DEFINITION: definition} if definition else {}


def recorded_scene(path: Path, workcell: Workcell) -> tuple[Task, Scene]:
    """Return task and scene of a simulated episode.

    Args:
        path: folder of the episode.
        workcell: workcell of the robot that it was recorded with.

    Raises:
        EpisodeError: it is none of the simulator's, or holds no scene and its seed draws another.
        SimulatorError: there is no such task.
    """
    episode = read_episode(path, with_cameras=False, with_masks=False)
    return recorded_task(episode), scene_of(episode, workcell)


def recorded_task(episode: Episode) -> Task:
    """Return the task of a simulated episode: the stored one, else the bundled one of its name.

    Raises:
        ConfigError: the stored definition cannot be used.
        SimulatorError: there is no such task.
    """
    info = episode.info
    where = f"'{TASK_DEFINITION}' of '{info.path}'"
    return stored_or_named(info.metadata.get(TASK_DEFINITION, ''), info.task, where)


def scene_of(episode: Episode, workcell: Workcell) -> Scene:
    """Return the scene that a simulated episode holds, else the one that its seed draws.

    Args:
        episode: episode of the simulator.
        workcell: workcell of the robot that it was recorded with.

    Raises:
        EpisodeError: it holds no scene, and no seed or one that does not draw its scene any more.
    """
    stored = episode.info.metadata.get(SCENE)
    scene = _drawn(episode, workcell) if stored is None else _parsed(episode, stored)
    names = tuple(item.name for item in scene.objects)
    if names != episode.info.objects:
        raise EpisodeError(
            f"'{episode.info.path}' shows {list(episode.info.objects)}, but its "
            f'{"seed draws" if stored is None else "stored scene has"} {list(names)}; {_AGAIN}'
        )
    return scene


_AGAIN = 'its scene is not known: record it again with mtv-world collect, which stores the scene'


def _parsed(episode: Episode, stored: str) -> Scene:
    path = episode.info.path
    try:
        parts = parse_json(stored, f"'{SCENE}' of '{path}'")
        objects, look = _OBJECTS.validate_python(parts['objects']), parts['look']
        goals = _GOALS.validate_python(parts['goals'])
        calibration = path / CALIBRATION_FILE
        cameras = load_calibration(calibration) if calibration.is_file() else {}
        return Scene(
            objects=objects,
            cameras=tuple(cameras.values()),
            look=_LOOK.validate_python(look),
            goals=goals,
        )
    except (ValueError, LookupError, TypeError) as error:
        reason = ' '.join(str(error).split())
        raise EpisodeError(f"'{path}' has a scene that cannot be used: {reason}") from error


def _drawn(episode: Episode, workcell: Workcell) -> Scene:
    """The scene of an episode from before scenes were stored, held to its first object poses."""
    info, poses = episode.info, episode.object_poses
    if not info.task or info.seed is None:
        raise EpisodeError(f"'{info.path}' names no task and seed; only simulated episodes do")
    if poses is None or not len(poses.stamps_ns):
        raise EpisodeError(
            f"'{info.path}' holds neither its scene nor object poses that would tell whether its "
            f'seed {info.seed} still draws that scene; {_AGAIN}'
        )
    physics = physics_named(info.metadata.get(PHYSICS, NOMINAL))
    workcell = physics.workcell(workcell)
    scene = draw_scene(recorded_task(episode), scene_generator(info.seed), workcell)
    drawn = np.array([item.position for item in scene.objects])
    recorded = poses.T_base_object[0, :, :3, 3]
    if drawn.shape != recorded.shape or np.abs(drawn - recorded).max() > _SAME_PLACE_M:
        raise EpisodeError(
            f"the objects of '{info.path}' begin at {recorded.round(3).tolist()} m, but its seed "
            f'{info.seed} draws them at {drawn.round(3).tolist()}; {_AGAIN}'
        )
    return scene
