"""One episode's scene as data, and its MJCF: table, light, cameras, arms, free objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ConfigDict

from mtv_world_ros.bench.shapes import shape_named, Size
from mtv_world_ros.bench.world.arm import actuators_of, bodies_xml
from mtv_world_ros.bench.world.cameras import camera_xml
from mtv_world_ros.data_types import CameraModel, FloatArray
from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.geometry.camera import project
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.geometry.transforms import rotation

TIMESTEP_S = 0.002

Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneObject:
    """A free object on the table.

    Attributes:
        role: its part in the task, e.g. `a`.
        name: what the instruction calls it, e.g. `red block`.
        shape: key of `SHAPES`.
        size: full extents (x, y, z) of its bounding box [m].
        rgb: (3,) in 0..1.
        position: (x, y, z) of its centre in the base frame [m].
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
        cameras: in the order of the views.
        look: table and light.
        goals: where the subject of each of the task's moves should come to rest [m].
        table_m: height of the table [m].
    """

    objects: tuple[SceneObject, ...]
    cameras: tuple[CameraModel, ...]
    look: SceneLook
    goals: tuple[Place, ...] = ()
    table_m: float = 0.0


def _numbers(values: tuple[float, ...]) -> str:
    return ' '.join(f'{value:.9g}' for value in values)


def _object_xml(item: SceneObject) -> str:
    geoms = shape_named(item.shape).geoms(item.size, item.rgb)
    turn = _numbers((float(np.cos(item.yaw / 2)), 0, 0, float(np.sin(item.yaw / 2))))
    return (
        f'<body name="{item.role}" pos="{_numbers(item.position)}" quat="{turn}">'
        f'<freejoint name="{item.role}"/>{geoms}</body>'
    )


def _classes_xml(names: Sequence[str]) -> str:
    """Arms collide with objects, the table and each other, but no arm with itself."""
    bits = [2 << number for number in range(len(names))]
    arms = ''.join(
        f'<default class="{arm}_arm"><geom contype="{own}" conaffinity="{1 + sum(bits) - own}" '
        f'friction="0.6"/><default class="{arm}_pad"><geom friction="1.6 0.02 0.0005" condim="4" '
        'solref="0.008 1" priority="1"/></default></default>'
        for arm, own in zip(names, bits, strict=True)
    )
    return (
        '<default><geom solref="0.006 1"/>'
        '<default class="object"><geom friction="0.9 0.01 0.0005" condim="4"/></default>'
        f'{arms}</default>'
    )


def scene_xml(scene: Scene, robot: RobotModel) -> str:
    """Returns the MJCF document of a scene with the arms at the origin pose of all joints.

    Without a GPU, triangles cost more than pixels: half the stacks and undivided boxes take a
    third off the time of an image, and outlines stay as they are.
    """
    look = scene.look
    fixed = [camera for camera in scene.cameras if camera.mount_link == robot.base_link]
    moving = [camera for camera in scene.cameras if camera.mount_link != robot.base_link]
    width = max(camera.width for camera in scene.cameras)
    height = max(camera.height for camera in scene.cameras)
    return f"""<mujoco model="bimanual_table">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{TIMESTEP_S}" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <visual>
    <global offwidth="{width}" offheight="{height}"/>
    <quality shadowsize="0" offsamples="0" numstacks="8" numquads="1"/>
    <map znear="0.05" zfar="20"/>
    <headlight ambient="{look.ambient} {look.ambient} {look.ambient}" diffuse="0.15 0.15 0.15"
               specular="0 0 0"/>
  </visual>
  <asset><material name="matte" specular="0" shininess="0"/></asset>
  {_classes_xml([tool.arm for tool in robot.tools])}
  <worldbody>
    <light type="directional" dir="{_numbers(look.light_direction)}" pos="0 0 2" castshadow="false"
           diffuse="{look.diffuse} {look.diffuse} {look.diffuse}" ambient="0 0 0"
           specular="0 0 0"/>
    <geom name="table" type="plane" pos="0 0 {scene.table_m:.9g}" size="3 3 0.1"
          rgba="{_numbers(look.table_rgb)} 1" friction="0.9 0.01 0.0005" condim="4"/>
    {''.join(camera_xml(camera, camera.T_mount_camera) for camera in fixed)}
    {bodies_xml(robot, moving)}
    {''.join(_object_xml(item) for item in scene.objects)}
  </worldbody>
  <actuator>{''.join(actuator.xml() for actuator in actuators_of(robot))}</actuator>
</mujoco>"""


def rotation_of(item: SceneObject) -> FloatArray:
    """Returns the (3, 3) rotation of an object as it is placed."""
    return rotation((0.0, 0.0, np.sin(item.yaw / 2), np.cos(item.yaw / 2)))


def corners(item: SceneObject) -> FloatArray:
    """Returns the (8, 3) corners of the object's bounding box in the base frame [m]."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    local = signs * np.asarray(item.size) / 2
    return local @ rotation_of(item).T + np.asarray(item.position)


def check_cameras(scene: Scene, base_link: str) -> None:
    """Refuses a scene in which a fixed camera does not see every object as a whole.

    Args:
        scene: the scene, with its cameras.
        base_link: link that carries the fixed cameras.

    Raises:
        SimulatorError: names the camera and the objects outside its image.
    """
    for camera in (one for one in scene.cameras if one.mount_link == base_link):
        hidden = [item.name for item in scene.objects if not _inside(camera, corners(item))]
        if hidden:
            raise SimulatorError(
                f"camera '{camera.view}' does not see {', '.join(hidden)} as a whole; move its "
                'target or widen visible_width (config/workcells), or narrow the region of '
                'the objects (config/scenes.yaml)'
            )


def _inside(camera: CameraModel, points: FloatArray) -> bool:
    pixels, _ = project(camera, np.asarray(camera.T_mount_camera), points)
    limits = (camera.width - 1, camera.height - 1)
    return bool(np.isfinite(pixels).all() and (pixels >= 0).all() and (pixels <= limits).all())
