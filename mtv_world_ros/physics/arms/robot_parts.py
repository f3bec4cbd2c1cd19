"""Collision parts of a robot, and inertias of links that state none.

Shape letters: N points, P parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull, QhullError

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.robot.mesh_pieces import convex_pieces, MissingMeshError
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import (
    element_shapes,
    grip_links,
    LinkShape,
    moving_links,
    replaced_meshes,
    rods,
    shape_origin,
    urdf_links,
)

#: of links that state no inertia: that of water, as MuJoCo takes it [kg/m^3]
DENSITY = 1000.0
#: a hull of less is no body [m^3]
_LEAST_M3 = 1e-9
#: mass of a link that has neither inertia nor shape [kg]
_LEAST_KG = 1e-3
#: radius of gyration of such a link [m]
_LEAST_RADIUS_M = 5e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A convex part of a link.

    Attributes:
        link: name of the link that carries the part.
        kind: `box`, `cylinder`, `sphere` or `hull`.
        size: half extents of a box, radius and half length of a cylinder, radius of a sphere [m].
        pose: (4, 4) pose in the link.
        points: (N, 3) whose convex hull it is, in the link [m].
    """

    link: str
    kind: str
    size: tuple[float, ...]
    pose: FloatArray
    points: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotParts:
    """Convex parts of all links, and assumptions that fill gaps in the description.

    Attributes:
        parts: convex parts of the links, P.
        notes: assumptions, as text.
    """

    parts: tuple[Part, ...]
    notes: tuple[str, ...] = ()


def load_parts(robot: RobotModel) -> RobotParts:
    """Load the convex parts of the links, for contact.

    These are the URDF's collision elements, or the visual ones of a link without collisions. A
    mesh is replaced by its convex hull; a gripper's mesh by convex pieces, so that an object fits
    between its fingers. Links without any shape become rods from joint to joint.

    Raises:
        RobotError: a mesh is missing or cannot be read.
    """
    described = urdf_links(robot)
    if described is None:
        return _rods(robot, f"robot '{robot.name}' has no shapes: rods stand for its links")
    path, links = described
    parts: list[Part] = []
    drawn: list[str] = []
    grips = grip_links(robot)
    for name, link in links.items():
        own = _parts_of(link, 'collision', path, name in grips)
        if not own and (own := _parts_of(link, 'visual', path, name in grips)):
            drawn.append(name)
        parts += own
    if not any(part.link in moving_links(robot) for part in parts):
        return _rods(robot, f"'{path.name}' has no shapes: rods stand for its links")
    note = (
        f'{len(drawn)} links have no collision shapes ({", ".join(drawn[:2])}, ...): what is '
        'drawn of them can be touched'
    )
    notes = (*replaced_meshes(links.values(), path), *((note,) if drawn else ()))
    return RobotParts(parts=tuple(parts), notes=notes)


def with_inertias(robot: RobotModel, parts: Sequence[Part]) -> tuple[RobotModel, tuple[str, ...]]:
    """Return the robot with an inertia for each moving body, and the assumptions as text.

    Links that state none are taken to be filled with water.
    """
    given = robot.pinocchio_model
    lacking = [j for j in range(1, given.njoints) if given.inertias[j].mass <= 0]
    if not lacking:
        return robot, ()
    model = given.copy()
    frames = {f.name: f for f in model.frames if f.type == pin.FrameType.BODY}
    for joint in lacking:
        inertia = pin.Inertia.Zero()
        for part in parts:
            frame = frames[part.link]
            if frame.parentJoint == joint:
                inertia += frame.placement.act(_inertia(part.points))
        if inertia.mass <= 0:
            moment = _LEAST_KG * _LEAST_RADIUS_M**2 * np.eye(3)
            inertia = pin.Inertia(_LEAST_KG, np.zeros(3), moment)
        model.inertias[joint] = inertia
    filled = copy(robot)
    filled.pinocchio_model = model
    mass = sum(model.inertias[j].mass for j in lacking)
    note = (
        f'{len(lacking)} of {given.njoints - 1} bodies state no inertia: those of their shapes '
        f'filled with water are taken, {mass:.2f} kg together'
    )
    return filled, (note,)


def _inertia(points: FloatArray) -> pin.Inertia:
    """Return the inertia of a convex hull; zero if it has no volume."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return pin.Inertia.Zero()
    if hull.volume < _LEAST_M3:
        return pin.Inertia.Zero()
    middle = points[hull.vertices].mean(0)
    corners = points[hull.simplices] - middle
    volumes = np.abs(np.linalg.det(corners)) / 6
    sums = corners.sum(1)
    centre = (volumes[:, None] * sums).sum(0) / 4 / volumes.sum()
    # second moments of tetrahedra with one corner in the origin
    outer = np.einsum('tci,tcj->tij', corners, corners) + np.einsum('ti,tj->tij', sums, sums)
    second = np.einsum('t,tij->ij', volumes / 20, outer)
    second -= volumes.sum() * np.outer(centre, centre)
    moment = DENSITY * (np.trace(second) * np.eye(3) - second)
    return pin.Inertia(float(DENSITY * volumes.sum()), middle + centre, moment)


def _rods(robot: RobotModel, note: str) -> RobotParts:
    found = rods(robot, 'no shapes').parts
    return RobotParts(parts=tuple(map(_hull, found)), notes=(note,))


def _hull(shape: LinkShape) -> Part:
    return Part(link=shape.link, kind='hull', size=(), pose=np.eye(4), points=shape.points)


def _parts_of(link: ElementTree.Element, kind: str, urdf: Path, is_grip: bool) -> list[Part]:
    name, cut = link.attrib['name'], convex_pieces if is_grip else None
    try:
        return [
            _part(element, shape)
            for element in link.findall(kind)
            for shape in element_shapes(element, name, urdf, cut)
        ]
    except MissingMeshError as error:
        raise RobotError(f"'{urdf}': mesh {error}; contact needs it") from error


def _part(element: ElementTree.Element, shape: LinkShape) -> Part:
    values = element.find('geometry')[0]  # type: ignore[index]
    pose = shape_origin(element.find('origin'))
    if values.tag == 'box':
        kind, size = 'box', np.array(values.attrib['size'].split(), float) / 2
    elif values.tag == 'cylinder':
        radius, length = float(values.attrib['radius']), float(values.attrib['length'])
        kind, size = 'cylinder', np.array([radius, length / 2])
    elif values.tag == 'sphere':
        kind, size = 'sphere', np.array([float(values.attrib['radius'])])
    else:
        return _hull(shape)
    sizes = tuple(map(float, size))
    return Part(link=shape.link, kind=kind, size=sizes, pose=pose, points=shape.points)
