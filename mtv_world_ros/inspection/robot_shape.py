"""What a robot's links look like: points on surfaces (URDF, or rods), silhouettes in a view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
from numpy.typing import NDArray
import pinocchio as pin
import yaml

from mtv_world_ros.data_types import CameraModel, FloatArray
from mtv_world_ros.errors import RobotError
from mtv_world_ros.geometry.camera import camera_poses, project
from mtv_world_ros.geometry.robot import RobotModel

#: corners of a round shape's rims, and directions in which a mesh's outermost points are kept
_CORNERS, _DIRECTIONS = 16, 256
#: radius of the rods that stand for links of which nothing is known [m]
ROD_RADIUS_M = 0.03
#: links closer together than this get no rod between them [m]
_SHORTEST_ROD_M = 0.01
#: pixels are drawn with this many fractional bits
_SHIFT_BITS = 4
_FAR_PX = 4000


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkShape:
    """A convex part of a link.

    Attributes:
        link: the link that carries it.
        points: (N, 3) points whose convex hull it is, in the link's frame [m].
    """

    link: str
    points: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotShape:
    """What a robot looks like.

    Attributes:
        parts: of its links.
        source: where they are from, in words.
        is_known: False where rods stand for the links.
    """

    parts: tuple[LinkShape, ...]
    source: str
    is_known: bool = True


def load_shape(robot_file: Path, robot: RobotModel) -> RobotShape:
    """Returns the robot's shape.

    The URDF's visual elements, or where a link has none its collision elements. Rods from joint
    to joint where the robot is given by a Denavit-Hartenberg table, or its meshes are not there.

    Raises:
        RobotError: a mesh cannot be read, or an element has a shape that no URDF has.
    """
    urdf = yaml.safe_load(robot_file.read_text(encoding='utf-8')).get('urdf')
    if urdf is None:
        return rods(robot, 'the robot is given by a table')
    path = robot_file.parent / str(urdf)
    try:
        parts = tuple(_urdf_shapes(path))
    except FileNotFoundError as error:
        return rods(robot, f'there is no mesh {error}')
    if not {part.link for part in parts} - {robot.base_link}:
        return rods(robot, f"'{path.name}' has no shapes")
    return RobotShape(parts=parts, source=f"the shapes of '{path.name}'")


def rods(robot: RobotModel, why: str) -> RobotShape:
    """Returns rods between neighbouring joints, and from the last ones to the tools."""
    model, neutral = robot.pinocchio_model, pin.neutral(robot.pinocchio_model)
    data = model.createData()
    pin.framesForwardKinematics(model, data, neutral)
    first: dict[int, Any] = {}
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            first.setdefault(frame.parentJoint, frame)
    found = []
    for joint, frame in first.items():
        T_link_joint = frame.placement.inverse()
        children = [c for c in range(1, model.njoints) if model.parents[c] == joint and joint]
        found += [
            _rod(frame.name, T_link_joint.translation,
                 (T_link_joint * model.jointPlacements[child]).translation)
            for child in children
        ]  # fmt: skip
    found += [_rod(tool.link, np.zeros(3), tool.T_link_tool[:3, 3]) for tool in robot.tools]
    parts = tuple(rod for rod in found if rod is not None)
    return RobotShape(parts=parts, source=f'rods from joint to joint ({why})', is_known=False)


def _rod(link: str, start: FloatArray, end: FloatArray) -> LinkShape | None:
    length = float(np.linalg.norm(end - start))
    if length < _SHORTEST_ROD_M:
        return None
    T = np.eye(4)
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0, 1]), (end - start) / length)
    T[:3, :3], T[:3, 3] = turn.toRotationMatrix(), (start + end) / 2
    return LinkShape(link=link, points=_moved(T, _cylinder(ROD_RADIUS_M, length)))


def _urdf_shapes(path: Path) -> Iterator[LinkShape]:
    root = ElementTree.fromstring(path.read_text(encoding='utf-8'))
    for link in root.iter('link'):
        for element in link.findall('visual') or link.findall('collision'):
            geometry = element.find('geometry')
            if geometry is None or len(geometry) == 0:
                continue
            points = _points(geometry[0], path)
            pose = _origin(element.find('origin'))
            yield LinkShape(link=link.attrib['name'], points=_moved(pose, points))


def _points(shape: ElementTree.Element, urdf: Path) -> FloatArray:
    values = shape.attrib
    if shape.tag == 'box':
        corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
        return corners * np.array(values['size'].split(), float) / 2
    if shape.tag in ('cylinder', 'capsule'):
        return _cylinder(float(values['radius']), float(values['length']))
    if shape.tag == 'sphere':
        return float(values['radius']) * _directions(64)
    if shape.tag == 'mesh':
        scale = np.array(values.get('scale', '1 1 1').split(), float)
        return _mesh(_mesh_file(values['filename'], urdf)) * scale
    raise RobotError(
        f"'{urdf}' has a shape '{shape.tag}'; known are box, capsule, cylinder, mesh, sphere"
    )


def _cylinder(radius: float, length: float) -> FloatArray:
    angles = np.arange(_CORNERS) * 2 * np.pi / _CORNERS
    rim = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    ends = [np.column_stack([rim, np.full(_CORNERS, z)]) for z in (-length / 2, length / 2)]
    return np.concatenate(ends)


def _directions(count: int) -> FloatArray:
    """(count, 3) unit vectors spread evenly (a Fibonacci sphere)."""
    n = np.arange(count) + 0.5
    up, turn = 1 - 2 * n / count, n * np.pi * (1 + 5**0.5)
    across = np.sqrt(1 - up**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), up], axis=-1)


def _mesh_file(name: str, urdf: Path) -> Path:
    """Where a mesh lies: `package://<name>/...` is looked for above the URDF."""
    plain = name.removeprefix('file://')
    if not plain.startswith('package://'):
        candidates = [urdf.parent / plain]
    else:
        package, _, inside = plain.removeprefix('package://').partition('/')
        above = urdf.resolve().parents
        candidates = [folder / package / inside for folder in above]
        candidates += [folder / inside for folder in above if folder.name == package]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(f"'{name}'")


def _mesh(path: Path) -> FloatArray:
    """Outermost points of a mesh file (STL, DAE, OBJ)."""
    try:
        import coal  # comes with Pinocchio, but not with every build of it
    except ImportError as error:
        raise FileNotFoundError(f"reader: '{path.name}' needs the module coal") from error
    try:
        mesh = coal.MeshLoader().load(str(path), np.ones(3))
        points = np.array([mesh.vertex(i) for i in range(mesh.num_vertices)])
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"mesh '{path}' cannot be read: {error}") from error
    return points[np.unique((points @ _directions(_DIRECTIONS).T).argmax(axis=0))]


def _origin(element: ElementTree.Element | None) -> FloatArray:
    T = np.eye(4)
    if element is not None:
        T[:3, 3] = np.array(element.get('xyz', '0 0 0').split(), float)
        T[:3, :3] = pin.rpy.rpyToMatrix(np.array(element.get('rpy', '0 0 0').split(), float))
    return T


def _moved(T: FloatArray, points: FloatArray) -> FloatArray:
    return points @ T[:3, :3].T + T[:3, 3]


def draw_silhouettes(
    shapes: Sequence[LinkShape], camera: CameraModel, robot: RobotModel, positions: FloatArray
) -> NDArray[np.uint8]:
    """(T, H, W) 1 where the robot is in the image, for positions (T, J)."""
    poses = robot.forward_kinematics(positions)
    T_base_camera = camera_poses(camera, robot, positions)
    parts = [project_part(part, poses[part.link], camera, T_base_camera) for part in shapes]
    return fill(parts, camera)


def project_part(
    part: LinkShape, poses: FloatArray, camera: CameraModel, T_base_camera: FloatArray
) -> FloatArray:
    """(T, N, 2) pixels of its points."""
    points = np.einsum('tij,nj->tni', poses[:, :3, :3], part.points) + poses[:, None, :3, 3]
    return project(camera, T_base_camera[:, None], points)[0]


def fill(parts: Sequence[FloatArray], camera: CameraModel) -> NDArray[np.uint8]:
    """(T, H, W) the convex hulls of the parts' pixels; parts that reach behind are left out."""
    images = np.zeros((len(parts[0]), camera.height, camera.width), np.uint8)
    for part in parts:
        for image, pixels in zip(images, part, strict=True):
            if np.isfinite(pixels).all():
                fixed = np.rint(pixels.clip(-_FAR_PX, _FAR_PX) * 2**_SHIFT_BITS).astype(np.int32)
                cv2.fillConvexPoly(image, cv2.convexHull(fixed), 1, shift=_SHIFT_BITS)
    return images
