"""Shapes of a robot's links: convex parts of its URDF, or rods; parts filled in a view."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
from numpy.typing import NDArray
import pinocchio as pin

from mtv_world_ros.core.bounded_input import parse_yaml, read_text
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.robot.gripper_doubts import gripper_doubts
from mtv_world_ros.robot.mesh_pieces import (
    even_directions,
    find_mesh,
    load_mesh,
    mesh_note,
    MissingMeshError,
    outermost,
    slices,
)
from mtv_world_ros.robot.model import RobotModel, Tool
from mtv_world_ros.robot.xml_file import parse_xml

#: corners of a round shape's rims
_CORNERS = 16
#: radius of the rods that stand for links without a shape [m]
ROD_RADIUS_M = 0.03
#: no vertex of a robot's mesh is further from its link than this [m]
_MOST_M = 1e4
#: size above which a moving link does not fit the arm [arm lengths]
MAX_MOVING_LINK_SIZE = 3.0
#: size above which a resting link does not fit the arm [arm lengths]
MAX_RESTING_LINK_SIZE = 15.0
#: size below which a link does not fit the arm [arm lengths]
_SMALL = 1e-3
_TOO_LARGE = (
    'is its mesh in millimetres or centimetres? Set scale="0.001 0.001 0.001" or '
    '"0.01 0.01 0.01" at the mesh in the URDF'
)
_TOO_SMALL = 'does the URDF scale a mesh that is in metres, or has a <unit> of its own?'
#: links closer together than this get no rod between them [m]
_SHORTEST_ROD_M = 0.01
#: pixels are drawn with this many fractional bits
_SHIFT_BITS = 4
_FAR_PX = 4000
_PACKAGES = (
    ' (source the workspace that has the package, or set'
    ' AMENT_PREFIX_PATH=/path/to/install/PACKAGE)'
)


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
    """Shapes of a robot's links.

    Attributes:
        parts: parts of its links.
        source: origin of the shapes, for reports.
        is_known: False where rods stand for the links.
        missing: meshes that are not there or cannot be read, and why.
        replaced: meshes that are not where the URDF says, and the files that were taken.
        doubts: links whose size does not fit the arm, grippers whose range is no finger's.
    """

    parts: tuple[LinkShape, ...]
    source: str
    is_known: bool = True
    missing: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def urdf_path(robot: RobotModel) -> Path | None:
    """Return where a robot's URDF lies; None = it is given by a table, or made in code."""
    if robot.file is None:
        return None
    urdf = parse_yaml(read_text(robot.file, 'yaml_bytes')).get('urdf')
    return None if urdf is None else robot.file.parent / str(urdf)


def urdf_links(robot: RobotModel) -> tuple[Path, dict[str, ElementTree.Element]] | None:
    """Return the URDF's path and its links by name; None where the robot has none."""
    path = urdf_path(robot)
    if path is None:
        return None
    tree = parse_xml(read_text(path, 'urdf_bytes'))
    return path, {link.attrib['name']: link for link in tree.iter('link')}


def load_shape(robot: RobotModel) -> RobotShape:
    """Return the robot's shape.

    The URDF's visual elements; for links where it has none, or where their meshes are not there
    or cannot be read, its collision elements. Rods from joint to joint where the robot is given
    by a Denavit-Hartenberg table or made in code, and where a link that moves has none of its
    shapes.

    Raises:
        RobotError: a mesh is damaged, or an element has a shape that no URDF has.
    """
    if robot.file is None:
        return rods(robot, 'the robot has no file')
    described = urdf_links(robot)
    if described is None:
        return rods(robot, 'the robot is given by a table')
    path, links = described
    found = {name: link_shapes(link, path, sliced=True) for name, link in links.items()}
    moving = moving_links(robot)
    parts = tuple(part for shapes, _ in found.values() for part in shapes)
    missing = tuple(dict.fromkeys(text for _, texts in found.values() for text in texts))
    bare = [text for name in links if name in moving and not found[name][0]
            for text in found[name][1]]  # fmt: skip
    if bare:
        where = _PACKAGES if 'package://' in bare[0] else ''
        return rods(robot, f'no mesh: {bare[0]}{where}', missing)
    if not any(part.link in moving for part in parts):
        return rods(robot, f"'{path.name}' has no shapes")
    return RobotShape(
        parts=parts,
        source=f"the shapes of '{path.name}'",
        missing=missing,
        replaced=replaced_meshes(links.values(), path),
        doubts=(*size_doubts(robot, parts), *gripper_doubts(robot)),
    )


def replaced_meshes(links: Iterable[ElementTree.Element], urdf: Path) -> tuple[str, ...]:
    """Return the meshes that are not where the URDF says, and the files that were taken."""
    names = (mesh.get('filename', '') for link in links for mesh in link.iter('mesh'))
    notes = (mesh_note(name, urdf) for name in names)
    return tuple(dict.fromkeys(note for note in notes if note))


def size_doubts(robot: RobotModel, parts: Sequence[LinkShape]) -> tuple[str, ...]:
    """Return the links whose shapes are far larger or far smaller than the arm, and the remedy.

    A mesh in millimetres whose URDF gives no scale is 1000 times too large.
    """
    moving = moving_links(robot)
    points: dict[str, list[FloatArray]] = {}
    for part in parts:
        points.setdefault(part.link, []).append(part.points)
    sizes = {
        link: float(np.linalg.norm(np.ptp(np.concatenate(found), axis=0)))
        for link, found in points.items()
    }
    reach = _arm_length(robot)
    doubts = []
    for link, size in sizes.items():
        large = (MAX_MOVING_LINK_SIZE if link in moving else MAX_RESTING_LINK_SIZE) * reach
        if size > large or size < _SMALL * reach:
            advice = _TOO_LARGE if size > large else _TOO_SMALL
            text = f"link '{link}' is {size:.3g} m large and the arm {reach:.3g} m long"
            doubts.append(f'{text}: {advice}')
    return tuple(doubts)


def _arm_length(robot: RobotModel) -> float:
    """Return the length of the longest arm from its first joint to its tool [m]."""
    middle = np.clip(0.0, robot.lower, robot.upper)[None]
    lengths = [
        float(np.linalg.norm(np.diff(points[:, 0], axis=0), axis=-1).sum())
        for points in robot.kinematics(middle).arm_points
    ]
    ranges = (robot.upper - robot.lower)[robot.slides]
    return max(lengths, default=0.0) + float(ranges[np.isfinite(ranges)].sum())


def moving_links(robot: RobotModel) -> set[str]:
    """Return the links that move against the base link, by the robot's kinematics."""
    joints = _joint_frames(robot)
    return {name for name, joint in joints.items() if joint != joints[robot.base_link]}


def grip_links(robot: RobotModel) -> set[str]:
    """Return the links of grippers: those of the tools, and those that gripper joints move."""
    frames = _joint_frames(robot)
    hands = {frames[tool.link] for tool in robot.tools if tool.gripper_joint} - {0}
    moved = {link for tool in robot.tools for link in gripper_links(robot, tool)}
    return moved | {link for link, joint in frames.items() if joint in hands}


def gripper_links(robot: RobotModel, tool: Tool) -> set[str]:
    """Return the links that a tool's gripper joint moves, directly or by mimic joints."""
    model, gripper = robot.pinocchio_model, tool.gripper_joint
    moved = {m.joint for m in robot.mimics if m.source == gripper} | {gripper}
    return {
        link
        for link, joint in _joint_frames(robot).items()
        if any(model.names[j] in moved for j in model.supports[joint])
    }


def arm_links(robot: RobotModel) -> dict[str, set[str]]:
    """Return the links that each arm moves and no other arm does, by the name of the arm."""
    model, frames = robot.pinocchio_model, _joint_frames(robot)
    above = {
        tool.arm: {joint for joint in model.supports[frames[tool.link]] if joint}
        for tool in robot.tools
    }
    own = {}
    for arm, joints in above.items():
        others = {joint for name, each in above.items() if name != arm for joint in each}
        wanted = joints - others
        own[arm] = {
            link for link, joint in frames.items() if not wanted.isdisjoint(model.supports[joint])
        }
    return own


def _joint_frames(robot: RobotModel) -> dict[str, int]:
    """Return the joint that carries each link."""
    return {
        f.name: f.parentJoint for f in robot.pinocchio_model.frames if f.type == pin.FrameType.BODY
    }


def rods(robot: RobotModel, why: str, missing: Sequence[str] = ()) -> RobotShape:
    """Return rods between neighbouring joints, and from the last ones to the tools."""
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
    return RobotShape(
        parts=parts,
        source=f'rods from joint to joint ({why})',
        is_known=False,
        missing=tuple(missing),
        doubts=gripper_doubts(robot),
    )


def _rod(link: str, start: FloatArray, end: FloatArray) -> LinkShape | None:
    length = float(np.linalg.norm(end - start))
    if length < _SHORTEST_ROD_M:
        return None
    T = np.eye(4)
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0, 1]), (end - start) / length)
    T[:3, :3], T[:3, 3] = turn.toRotationMatrix(), (start + end) / 2
    return LinkShape(link=link, points=_moved(T, _cylinder(ROD_RADIUS_M, length)))


def link_shapes(
    link: ElementTree.Element, urdf: Path, *, sliced: bool = False
) -> tuple[list[LinkShape], list[str]]:
    """Return a link's shapes, and meshes that are missing; collisions stand in for visuals.

    With `sliced`, a mesh that is far from convex is given in slices.

    Raises:
        RobotError: see `load_shape`.
    """
    missing: list[str] = []
    name, cut = link.attrib['name'], slices if sliced else None
    for kind in ('visual', 'collision'):
        try:
            found = [element_shapes(one, name, urdf, cut) for one in link.findall(kind)]
            shapes = list(chain.from_iterable(found))
        except MissingMeshError as error:
            missing.append(str(error))
            continue
        if shapes:
            return shapes, missing
    return [], missing


def element_shapes(
    element: ElementTree.Element,
    link: str,
    urdf: Path,
    cut: Callable[[FloatArray, NDArray[np.int64]], list[FloatArray]] | None = None,
) -> Iterator[LinkShape]:
    """Yield the convex parts of a `visual` or `collision`; none if it describes no shape.

    Args:
        element: element of the URDF.
        link: name of its link.
        urdf: file of the URDF; meshes are looked for in its folder.
        cut: splits a mesh's vertices and edges into convex parts, e.g. `convex_pieces`; None =
            the convex hull of the mesh is used.

    Raises:
        MissingMeshError: a mesh is not there or cannot be read.
        RobotError: see `load_shape`.
    """
    geometry = element.find('geometry')
    if geometry is None or len(geometry) == 0:
        return
    try:
        pieces = _pieces(geometry[0], urdf, cut)
        pose = shape_origin(element.find('origin'))
    except KeyError as error:
        raise RobotError(
            f"'{urdf}': a {geometry[0].tag} of link '{link}' lacks {error}"
        ) from error
    except ValueError as error:
        raise RobotError(f"'{urdf}': a {geometry[0].tag} of link '{link}': {error}") from error
    for points in pieces:
        yield LinkShape(link=link, points=_moved(pose, points))


def _pieces(
    shape: ElementTree.Element,
    urdf: Path,
    cut: Callable[[FloatArray, NDArray[np.int64]], list[FloatArray]] | None,
) -> list[FloatArray]:
    """Return the convex parts (N, 3) of a shape, of a mesh as it is cut."""
    if shape.tag != 'mesh':
        return [_points(shape, urdf)]
    scale = mesh_scale(shape)
    file = find_mesh(shape.attrib['filename'], urdf)
    if file is None:
        raise MissingMeshError(f"'{shape.attrib['filename']}' is not there")
    mesh = load_mesh(file)
    vertices = mesh.vertices * scale
    if not (np.abs(vertices) < _MOST_M).all():
        raise RobotError(
            f"'{file}': a vertex is further than {_MOST_M:g} m away or no number; is the file "
            "damaged, or the 'scale' of the mesh in the URDF wrong?"
        )
    return [outermost(vertices)] if cut is None else cut(vertices, mesh.edges())


def _points(shape: ElementTree.Element, urdf: Path) -> FloatArray:
    if shape.tag == 'box':
        corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
        return corners * numbers_of(shape, 'size', 3) / 2
    if shape.tag in ('cylinder', 'capsule'):
        return _cylinder(*(float(numbers_of(shape, key, 1)[0]) for key in ('radius', 'length')))
    if shape.tag == 'sphere':
        return numbers_of(shape, 'radius', 1) * even_directions(64)
    raise RobotError(
        f"'{urdf}' has a shape '{shape.tag}'; known are box, capsule, cylinder, mesh, sphere"
    )


def _cylinder(radius: float, length: float) -> FloatArray:
    angles = np.arange(_CORNERS) * 2 * np.pi / _CORNERS
    rim = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    ends = [np.column_stack([rim, np.full(_CORNERS, z)]) for z in (-length / 2, length / 2)]
    return np.concatenate(ends)


def numbers_of(
    element: ElementTree.Element, attribute: str, count: int, default: str | None = None
) -> FloatArray:
    """Return the (count,) numbers of an attribute.

    Raises:
        KeyError: the element lacks the attribute, and there is no default.
        ValueError: the text is not that many numbers.
    """
    text = element.attrib[attribute] if default is None else element.get(attribute, default)
    try:
        values = np.array(text.split(), float)
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        many = 'a number' if count == 1 else f'{count} numbers separated by spaces'
        raise ValueError(f"'{attribute}' is '{text}', must be {many}")
    return values


def mesh_scale(mesh: ElementTree.Element) -> FloatArray:
    """Return the (3,) scale of a `<mesh>`; one number scales all axes, as Drake has it.

    Raises:
        ValueError: the scale is neither one number nor three.
    """
    count = 1 if len(mesh.get('scale', '1 1 1').split()) == 1 else 3
    return np.broadcast_to(numbers_of(mesh, 'scale', count, '1 1 1'), 3)


def shape_origin(element: ElementTree.Element | None) -> FloatArray:
    """Return the (4, 4) pose of an `<origin>`.

    Raises:
        ValueError: its numbers cannot be read.
    """
    T = np.eye(4)
    if element is not None:
        T[:3, 3] = numbers_of(element, 'xyz', 3, '0 0 0')
        T[:3, :3] = pin.rpy.rpyToMatrix(numbers_of(element, 'rpy', 3, '0 0 0'))
    return T


def _moved(T: FloatArray, points: FloatArray) -> FloatArray:
    return points @ T[:3, :3].T + T[:3, 3]


def fill(parts: Sequence[FloatArray], camera: CameraModel) -> NDArray[np.uint8]:
    """Return (T, H, W) the convex hulls of the parts' pixels.

    Parts behind the camera are left out.
    """
    images = np.zeros((len(parts[0]), camera.height, camera.width), np.uint8)
    size = np.array([camera.width, camera.height])
    corners = np.concatenate(parts, axis=1)
    ends = np.cumsum([part.shape[1] for part in parts])
    starts = np.concatenate([[0], ends[:-1]])
    with np.errstate(invalid='ignore'):
        low, high = (f.reduceat(corners, starts, axis=1) for f in (np.minimum, np.maximum))
        seen = ((high > -1) & (low < size)).all(axis=-1)  # NaN is not seen
    fixed = np.nan_to_num(corners).clip(-_FAR_PX, _FAR_PX) * 2**_SHIFT_BITS
    fixed = np.rint(fixed).astype(np.int32)
    for row, part in np.argwhere(seen):
        hull = cv2.convexHull(fixed[row, starts[part] : ends[part]])
        cv2.fillConvexPoly(images[row], hull, 1, shift=_SHIFT_BITS)
    return images
