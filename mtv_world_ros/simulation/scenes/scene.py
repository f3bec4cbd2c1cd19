"""One episode's scene as data, and its MJCF: table, light, cameras, arms, free objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import ConfigDict

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.transforms import rotation
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.arms.arm import actuators_of, bodies_xml
from mtv_world_ros.simulation.scenes.cameras import camera_xml
from mtv_world_ros.simulation.scenes.mjcf import template
from mtv_world_ros.simulation.scenes.shapes import shape_named, Size

TIMESTEP_S = 0.002

Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneObject:
    """A free object on the table.

    Attributes:
        role: placeholder of the object in the task, e.g. `a`.
        name: name in the instruction, e.g. `red block`.
        shape: key of `SHAPES`.
        size: full extents (x, y, z) of its bounding box [m].
        rgb: (3,) rgb in 0..1.
        position: centre (x, y, z) of the object in the base frame [m].
        yaw: about z [rad].
    """

    __pydantic_config__ = ConfigDict(extra='forbid')

    role: str
    name: str
    shape: str
    size: Size
    rgb: tuple[float, float, float]
    position: Place
    yaw: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneLook:
    """Table and light of an episode; colours (3,) in 0..1, light direction (3,)."""

    __pydantic_config__ = ConfigDict(extra='forbid')

    table_rgb: tuple[float, float, float] = (0.7, 0.68, 0.64)
    ambient: float = 0.45
    diffuse: float = 0.5
    light_direction: tuple[float, float, float] = (-0.3, -0.4, -1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Everything that is drawn and simulated.

    Attributes:
        objects: the instance id of `objects[i]` is i + 1.
        cameras: cameras in the order of the views.
        look: table and light.
        goals: goal position of the subject of each of the task's moves [m].
        table_m: height of the table [m].
    """

    objects: tuple[SceneObject, ...]
    cameras: tuple[CameraModel, ...]
    look: SceneLook
    goals: tuple[Place, ...] = ()
    table_m: float = 0.0


def scene_xml(scene: Scene, robot: RobotModel) -> str:
    """Return the MJCF document of a scene with the arms at the origin pose of all joints."""
    fixed = [camera for camera in scene.cameras if camera.mount_link == robot.base_link]
    moving = [camera for camera in scene.cameras if camera.mount_link != robot.base_link]
    return template('scene').render(
        scene=scene,
        timestep_s=TIMESTEP_S,
        arms=[tool.arm for tool in robot.tools],
        cameras=''.join(camera_xml(camera, camera.T_mount_camera) for camera in fixed),
        bodies=bodies_xml(robot, moving),
        geoms=[shape_named(item.shape).xml(item.size, item.rgb) for item in scene.objects],
        actuators=actuators_of(robot),
    )


def rotation_of(item: SceneObject) -> FloatArray:
    """Return the (3, 3) rotation of an object as it is placed."""
    return rotation((0.0, 0.0, np.sin(item.yaw / 2), np.cos(item.yaw / 2)))


def box_corners(item: SceneObject) -> FloatArray:
    """Return the (8, 3) corners of the object's bounding box in the base frame [m]."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    local = signs * np.asarray(item.size) / 2
    return local @ rotation_of(item).T + np.asarray(item.position)


def check_cameras(scene: Scene, base_link: str) -> None:
    """Refuse a scene in which a fixed camera does not see every object as a whole.

    Args:
        scene: the scene, with its cameras.
        base_link: link that carries the fixed cameras.

    Raises:
        SimulatorError: names the camera and the objects outside its image.
    """
    for camera in (one for one in scene.cameras if one.mount_link == base_link):
        hidden = [item.name for item in scene.objects if not _inside(camera, box_corners(item))]
        if hidden:
            raise SimulatorError(
                f"camera '{camera.view}' does not see {', '.join(hidden)} as a whole; move its "
                'target or widen visible_width (workcell.yaml), or narrow the region of '
                "the objects (scene.roles of the task's file)"
            )


def _inside(camera: CameraModel, points: FloatArray) -> bool:
    pixels, _ = project(camera, np.asarray(camera.T_mount_camera), points)
    limits = (camera.width - 1, camera.height - 1)
    return bool(np.isfinite(pixels).all() and (pixels >= 0).all() and (pixels <= limits).all())
