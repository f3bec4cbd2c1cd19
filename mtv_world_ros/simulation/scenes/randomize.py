"""Draws a random scene: objects, colours, sizes, places, light and cameras."""

from __future__ import annotations

from collections.abc import Sequence
import colorsys
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.core.bounded_input import fill_template
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.simulation.scenes.cameras import (
    AnyCameraSpec,
    camera_model,
    CameraJitter,
    jittered,
)
from mtv_world_ros.simulation.scenes.placement import goals_of, is_feasible
from mtv_world_ros.simulation.scenes.scene import (
    check_cameras,
    Place,
    rotation_of,
    Scene,
    SceneLook,
    SceneObject,
)
from mtv_world_ros.simulation.scenes.shapes import SHAPES
from mtv_world_ros.simulation.scenes.tasks import ObjectRole, Task
from mtv_world_ros.simulation.scenes.workcell import NOMINAL_SIZE, PlacementConfig, Workcell
from mtv_world_ros.success.situation import TruePoses
from mtv_world_ros.vision.segmenters.colour import PALETTE

MAX_DRAWS = 4000
Rng = np.random.Generator


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomizationConfig:
    """Ranges of the random draws of an episode.

    Attributes:
        width: image width [px].
        height: image height [px].
        cameras: nominal cameras, in the order of the views; None = those of the workcell.
        jitter: half widths of the camera randomisation.
        placement: limits of the places of objects and goals; None = the workcell's.
    """

    width: int = NOMINAL_SIZE[0]
    height: int = NOMINAL_SIZE[1]
    cameras: tuple[AnyCameraSpec, ...] | None = None
    jitter: CameraJitter = CameraJitter()
    placement: PlacementConfig | None = None

    def of(self, workcell: Workcell) -> RandomizationConfig:
        """Return the configuration; missing cameras and limits come from the workcell."""
        return replace(
            self,
            cameras=self.cameras or workcell.cameras,
            placement=self.placement or workcell.placement,
        )


def _draw_object(
    role: ObjectRole, side: float, taken: set[str], rng: Rng, scale: float
) -> SceneObject:
    """Draw an object of a role in a free colour; `side` -1 exchanges left and right."""
    free = [shape for shape in role.shapes if SHAPES[shape].free(taken)]
    if not free:
        raise SimulatorError(
            f"no colour is left for role '{role.role}' ({', '.join(role.shapes)}): the other "
            f"objects are {', '.join(sorted(taken))}; give scene.roles of the task's file fewer "
            'roles or other shapes'
        )
    name = str(rng.choice(free))
    shape = SHAPES[name]
    word = str(rng.choice([word for word in shape.colours if word not in taken]))
    x, y, z = shape.size(float(rng.uniform(*role.size_share)))
    size = (x * scale, y * scale, z * scale)
    red, green, blue = (channel / 255 for channel in PALETTE[word])
    x, y = side * float(rng.uniform(*role.x_range)), float(rng.uniform(*role.y_range))
    return SceneObject(
        role=role.role,
        name=f'{word} {name}',
        shape=name,
        size=size,
        rgb=(red, green, blue),
        position=(x, y, size[2] / 2),
        yaw=float(rng.uniform(*role.yaw_range)),
    )


def _draw_objects(
    task: Task, roles: Sequence[ObjectRole], rng: Rng, scale: float
) -> dict[str, SceneObject]:
    side = float(rng.choice((-1.0, 1.0))) if task.mirrored else 1.0
    items: dict[str, SceneObject] = {}
    # what comes in few colours chooses first
    for role in sorted(roles, key=lambda role: _num_colours(role)):
        taken = {item.name.split()[0] for item in items.values()}
        items[role.role] = _draw_object(role, side, taken, rng, scale)
    return {role.role: items[role.role] for role in roles}


def _num_colours(role: ObjectRole) -> int:
    return min(len(SHAPES[shape].colours) for shape in role.shapes)


def _draw_look(rng: np.random.Generator) -> SceneLook:
    tint = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.0, 0.1), rng.uniform(0.55, 0.8))
    return SceneLook(
        table_rgb=tint,
        ambient=float(rng.uniform(0.4, 0.5)),
        diffuse=float(rng.uniform(0.35, 0.5)),
        light_direction=(float(rng.uniform(-0.6, 0.6)), float(rng.uniform(-0.8, 0.2)), -1.0),
    )


def start_situation(
    task: Task, items: dict[str, SceneObject], goals: Sequence[Place]
) -> TruePoses:
    """Return the start poses (T = 1), grippers open."""
    return TruePoses(
        positions={role: np.array([item.position]) for role, item in items.items()},
        rotations={role: rotation_of(item)[None] for role, item in items.items()},
        sizes={role: item.size for role, item in items.items()},
        openings=np.ones((1, 1)),
        goals=task.goals(goals),
    )


def draw_scene(
    task: Task,
    rng: np.random.Generator,
    workcell: Workcell,
    config: RandomizationConfig | None = None,
) -> Scene:
    """Return a random scene of a task; the same generator state gives the same scene.

    Raises:
        SimulatorError: no feasible placement found, or a fixed camera does not see an object.
    """
    config = (config or RandomizationConfig()).of(workcell)
    assert config.cameras is not None and config.placement is not None
    roles = [role for role in task.roles if rng.uniform() < role.probability]
    for _ in range(MAX_DRAWS):
        items = _draw_objects(task, roles, rng, workcell.object_size)
        shifts = [(float(x), float(y)) for x, y in rng.uniform(-1, 1, (len(task.moves), 2))]
        goals = goals_of(task, items, shifts)
        if not is_feasible(task, items, goals, config.placement, workcell):
            continue
        if not task.succeeds(start_situation(task, items, goals)).any():
            break
    else:
        raise SimulatorError(
            f"no feasible placement for task '{task.name}' in {MAX_DRAWS} draws; widen x_range "
            "and y_range of its roles (scene.roles of the task's file) or lower the clearance "
            '(workcell.yaml)'
        )
    cameras = tuple(
        camera_model(
            jittered(spec, config.jitter, rng), config.width, config.height, workcell.base_link
        )
        for spec in config.cameras
    )
    table_m = workcell.table_m
    scene = Scene(
        objects=tuple(
            replace(item, position=_raised(item.position, table_m)) for item in items.values()
        ),
        cameras=cameras,
        look=_draw_look(rng),
        goals=tuple(_raised(goal, table_m) for goal in goals),
        table_m=table_m,
    )
    check_cameras(scene, workcell.base_link)
    return scene


def _raised(place: Place, height: float) -> Place:
    return (place[0], place[1], place[2] + height)


def instruction_of(task: Task, scene: Scene) -> str:
    """Return the task's instruction with the scene's object names filled in."""
    return fill_template(task.instruction, {item.role: item.name for item in scene.objects})
