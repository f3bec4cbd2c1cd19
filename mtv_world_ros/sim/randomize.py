"""Draws an episode's scene: which colours and sizes, where, under which light and cameras."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mtv_world_ros.data_types import FloatArray
from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.sim.arm import BASE_POSITIONS
from mtv_world_ros.sim.cameras import camera_model, CameraJitter, CAMERAS, CameraSpec, jittered
from mtv_world_ros.sim.predicates import History
from mtv_world_ros.sim.scene import check_cameras, Scene, SceneLook, SceneObject
from mtv_world_ros.sim.tasks import ObjectRole, PickPlace, Task
from mtv_world_ros.success.palette import PALETTE

#: goals lie within this distance of the table's middle line, in view of both cameras [m]
GOAL_X_M = 0.23


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomizationConfig:
    """Ranges of what an episode draws.

    Attributes:
        width: image width [px].
        height: image height [px].
        cameras: nominal cameras, in the order of the views.
        jitter: half widths of the camera randomisation.
        yaw: half width of the objects' turn about z [rad].
        clearance: least distance between objects, and of goals from other objects [m].
        reach: how far from an arm's base it is sent, top-down, over the table [m].
        reach_on_top: the same for a goal on another object, where the tool is higher [m].
    """

    width: int = 384
    height: int = 288
    cameras: tuple[CameraSpec, ...] = CAMERAS
    jitter: CameraJitter = CameraJitter()
    yaw: float = 0.35
    clearance: float = 0.115
    reach: float = 0.4
    reach_on_top: float = 0.375


def goal_position(
    move: PickPlace, subject: SceneObject, reference: SceneObject
) -> tuple[float, float, float]:
    """Returns where the subject's centre comes to rest, from the objects' start poses [m]."""
    x, y, z = reference.position
    rest = z + (reference.size[2] + subject.size[2]) / 2 if move.on_top else subject.size[2] / 2
    return (x + move.offset[0], y + move.offset[1], rest)


def arm_of(subject: SceneObject) -> str:
    """Returns the arm that handles an object: the one on its side of the table."""
    return 'left' if subject.position[0] < 0 else 'right'


def _draw_object(role: ObjectRole, word: str, yaw: float, rng: np.random.Generator) -> SceneObject:
    size = float(rng.uniform(*role.size_range))
    x, y = float(rng.uniform(*role.x_range)), float(rng.uniform(*role.y_range))
    red, green, blue = (channel / 255 for channel in PALETTE[word])
    return SceneObject(
        role=role.role,
        name=f'{word} {role.shape}',
        shape=role.shape,
        size=(size, size, size),
        rgb=(red, green, blue),
        position=(x, y, size / 2),
        yaw=float(rng.uniform(-yaw, yaw)),
    )


def _draw_look(rng: np.random.Generator) -> SceneLook:
    tint = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.0, 0.1), rng.uniform(0.55, 0.8))
    return SceneLook(
        table_rgb=tint,
        ambient=float(rng.uniform(0.4, 0.5)),
        diffuse=float(rng.uniform(0.35, 0.5)),
        light_direction=(float(rng.uniform(-0.6, 0.6)), float(rng.uniform(-0.8, 0.2)), -1.0),
    )


def _distance(p: ArrayLike, q: ArrayLike) -> float:
    return float(np.linalg.norm((np.asarray(p) - np.asarray(q))[:2]))


def _apart(points: list[FloatArray], clearance: float) -> bool:
    return all(_distance(p, q) >= clearance for i, p in enumerate(points) for q in points[:i])


def _feasible(task: Task, items: dict[str, SceneObject], config: RandomizationConfig) -> bool:
    """Objects apart, goals free and in the arm's reach, and the task not yet done."""
    if not _apart([np.asarray(item.position) for item in items.values()], config.clearance):
        return False
    for move in task.moves:
        subject, reference = items[move.subject], items[move.reference]
        goal = np.asarray(goal_position(move, subject, reference))
        base = np.asarray(BASE_POSITIONS[arm_of(subject)])
        reach = config.reach_on_top if move.on_top else config.reach
        if _distance(goal, base) > reach or _distance(subject.position, base) > config.reach:
            return False
        if abs(goal[0]) > GOAL_X_M:
            return False
        others = [
            np.asarray(item.position)
            for item in items.values()
            if not (move.on_top and item is reference)
        ]
        if not _apart([goal, *others], config.clearance):
            return False
    return not task.succeeds(start_history(items)).any()


def start_history(items: dict[str, SceneObject]) -> History:
    """Returns the one-sample history of the start poses, grippers open."""
    return History(
        positions={role: np.array([item.position]) for role, item in items.items()},
        heights={role: item.size[2] for role, item in items.items()},
        openings=np.ones((2, 1)),
    )


def draw_scene(
    task: Task, rng: np.random.Generator, config: RandomizationConfig | None = None
) -> Scene:
    """Returns a random scene of a task; the same generator state gives the same scene.

    Raises:
        SimulatorError: no feasible placement found, or a camera does not see an object.
    """
    config = config or RandomizationConfig()
    roles = [role for role in task.roles if rng.uniform() < role.probability]
    words = [str(word) for word in rng.permutation(sorted(PALETTE))]
    for _ in range(2000):
        drawn = [
            _draw_object(role, word, config.yaw, rng)
            for role, word in zip(roles, words, strict=False)
        ]
        if _feasible(task, {item.role: item for item in drawn}, config):
            break
    else:
        raise SimulatorError(
            f"no feasible placement for task '{task.name}' in 2000 draws; widen x_range and "
            'y_range of its roles (sim/tasks.py) or lower the clearance (sim/randomize.py)'
        )
    cameras = tuple(
        camera_model(jittered(spec, config.jitter, rng), config.width, config.height)
        for spec in config.cameras
    )
    scene = Scene(objects=tuple(drawn), cameras=cameras, look=_draw_look(rng))
    check_cameras(scene)
    return scene


def instruction_of(task: Task, scene: Scene) -> str:
    """Returns the task's instruction with the scene's object names filled in."""
    return task.instruction.format(**{item.role: item.name for item in scene.objects})
