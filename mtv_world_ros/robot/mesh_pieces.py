"""Meshes as convex parts: hulls, slices for silhouettes, pieces for contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import struct
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from mtv_world_ros.core.bounded_input import placeholder_content, read_bytes
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.robot.xml_file import check_xml, NO_XML

#: number of directions in which a mesh's outermost points are kept
NUM_HULL_DIRECTIONS = 256
#: fraction of its hull's volume below which a mesh is cut into slices for silhouettes
HOLLOW_FRACTION = 0.8
#: number of directions in which a slice's outermost points are kept
NUM_SLICE_DIRECTIONS = 96
#: number of slices of a mesh for silhouettes
NUM_SLICES = 5
#: shortest mesh that is cut into slices [m]
MIN_SLICED_LENGTH_M = 0.12
#: smallest piece, as a fraction of the volume of the mesh's hull
MIN_PIECE_FRACTION = 1e-4
#: largest number of convex pieces of a mesh for contact
MAX_PIECES = 10
#: smallest gain of another piece, as a fraction of the volume of the mesh's hull
MIN_CUT_GAIN = 0.03
#: number of cuts that are tried along an axis
NUM_CUTS = 7
#: number of edges that approximate a mesh while cuts are tried
NUM_CUT_EDGES = 1000
#: number of directions of the hulls while cuts are tried
NUM_CUT_DIRECTIONS = 32


#: folders above a URDF in which a mesh is looked for by the end of its path
_NUM_FOLDERS = 4


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Return where a mesh lies, or None.

    `package://<name>/...` is looked for above the URDF, then in the ROS packages that are
    installed (`AMENT_PREFIX_PATH`). A mesh that is not there is looked for by the end of its path
    in the URDF's folder and those above, whatever the case of letters: paths may be of another
    machine, or of Windows. `mesh_note` tells that.
    """
    return _named_mesh(name, urdf) or _mesh_by_end(name, urdf)


def mesh_note(name: str, urdf: Path) -> str:
    """Return that a mesh was found by the end of its path; empty if it is where its name says."""
    file = None if _named_mesh(name, urdf) else _mesh_by_end(name, urdf)
    return f"mesh '{name}' is not there; '{file}' was taken, which is called alike" if file else ''


def _named_mesh(name: str, urdf: Path) -> Path | None:
    """Return the mesh at the place that its name states."""
    plain = name.removeprefix('file://')
    if not plain.startswith('package://'):
        candidates = [urdf.parent / plain]
    else:
        package, _, inside = plain.removeprefix('package://').partition('/')
        above = urdf.resolve().parents
        candidates = [folder / package / inside for folder in above]
        candidates += [folder / inside for folder in above if folder.name == package]
        installed = filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep))
        candidates += [Path(prefix) / 'share' / package / inside for prefix in installed]
    return next((candidate for candidate in candidates if _is_file(candidate)), None)


def _mesh_by_end(name: str, urdf: Path) -> Path | None:
    """Return the mesh near the URDF whose path ends as the name does; the longest end counts.

    A bare file name is accepted in the URDF's own folder alone, and never for a package's mesh.
    """
    scheme, separator, path = name.rpartition('://')
    text = unquote(path) if separator else path
    parts = [part for part in text.replace('\\', '/').split('/') if part not in ('', '.')]
    if not parts or '..' in parts:
        return None
    folders = urdf.resolve().parents[:_NUM_FOLDERS]
    for start in range(len(parts) - (scheme == 'package')):
        end = parts[start:]
        for folder in folders if len(end) > 1 else folders[:1]:
            if found := _whatever_case(folder, end):
                return found
    return None


def _whatever_case(folder: Path, parts: Sequence[str]) -> Path | None:
    """Return the file of a relative path, whatever the case of letters; None if there is none."""
    at = folder
    for part in parts:
        if _exists(at / part):
            at = at / part
            continue
        try:
            alike = sorted(p.name for p in at.iterdir() if p.name.lower() == part.lower())
        except OSError:
            return None
        if not alike:
            return None
        at = at / alike[0]
    return at if _is_file(at) else None


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no system has
        return False


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that no system has
        return False


class MissingMeshError(RobotError):
    """A mesh that is not there or cannot be read; the text names the file and the reason."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangle mesh of a file, in metres, before the scale that a URDF gives.

    Attributes:
        vertices: (N, 3) [m].
        triangles: Coal's mesh, which has the triangles.
    """

    vertices: FloatArray
    triangles: Any

    def edges(self) -> NDArray[np.int64]:
        """Return (E, 2) vertices that edges of triangles join."""
        mesh = self.triangles
        count = range(mesh.num_tris)
        faces = np.array([[mesh.tri_indices(n)[k] for k in range(3)] for n in count])
        pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        return np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64)


def load_mesh(path: Path) -> Mesh:
    """Read a mesh (STL, DAE, OBJ, PLY); the `<unit meter>` of a DAE file is applied.

    Raises:
        MissingMeshError: the file cannot be read as a mesh, or nothing here reads meshes.
    """
    try:
        import coal  # comes with Pinocchio, but not with every build of it
    except ImportError as error:
        raise MissingMeshError(f"'{path.name}' needs the module coal") from error
    if problem := _not_a_mesh(path):
        raise MissingMeshError(f"'{path}' {problem}")
    unit = _collada_unit_m(path) if path.suffix.lower() == '.dae' else 1.0
    try:
        mesh = coal.MeshLoader().load(str(path), np.ones(3))
        vertices = np.asarray(mesh.vertices(), np.float64)
    except (ValueError, RuntimeError) as error:
        raise MissingMeshError(f"'{path}' cannot be read: {_short_reason(error)}") from error
    if not mesh.num_tris or not vertices.size:
        raise MissingMeshError(f"'{path}' holds no triangles")
    return Mesh(vertices * unit, mesh)


#: types of mesh files; Assimp knows forty more, whose readers nobody has looked at here
MESH_SUFFIXES = ('.stl', '.dae', '.obj', '.ply')
_SUFFIXES = ', '.join(MESH_SUFFIXES)


def _not_a_mesh(path: Path) -> str:
    """Return what a file is that takes a mesh's place, and the remedy; empty if it may be one."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        return f"is of type '{suffix}', which is not read; convert it to one of {_SUFFIXES}"
    try:
        content = read_bytes(path, 'mesh_bytes')
    except OSError as error:
        return f'cannot be read: {error.strerror or error}'
    except ValueError as error:
        return f'is too large: {error}'
    if not content.strip():
        return 'is empty'
    if problem := placeholder_content(content):
        return problem
    return _unreadable_xml(content) if suffix == '.dae' else ''


def _unreadable_xml(content: bytes) -> str:
    """Return why the reader of COLLADA is not given a file; empty if it is."""
    try:
        check_xml(content)
    except (*NO_XML, ValueError) as error:
        return f'cannot be read: {error}'
    return ''


def _short_reason(error: Exception) -> str:
    """Return the reason that Coal's message of several lines states."""
    lines = [line.strip() for line in str(error).splitlines()]
    kept = [line.removeprefix('message: ') for line in lines if line]
    dropped = ('From file:', 'in function:', 'at line:', 'Hint:', 'Could not load resource')
    return '; '.join(line for line in kept if not line.startswith(dropped)) or 'unknown reason'


def _collada_unit_m(path: Path) -> float:
    """Return the length of a DAE file's unit [m], which Coal does not apply.

    URDF tools apply the unit and take no notice of `<up_axis>` (rviz#853).

    Raises:
        MissingMeshError: the unit is no positive number.
    """
    try:
        for _, element in ElementTree.iterparse(path, events=('start',)):
            tag = element.tag.rpartition('}')[2]
            if tag == 'unit':
                unit = float(element.get('meter', '1'))
                break
            if tag.startswith('library_') or tag == 'scene':
                return 1.0
        else:
            return 1.0
    except (ElementTree.ParseError, ValueError, OSError) as error:
        raise MissingMeshError(f"'{path}': its <unit> cannot be read: {error}") from error
    if not 0 < unit < np.inf:
        raise MissingMeshError(f"'{path}': <unit meter> is {unit:g}, must be positive")
    return unit


def outermost(points: FloatArray, directions: int = NUM_HULL_DIRECTIONS) -> FloatArray:
    """Return the points (M, 3) of (N, 3) that are outermost in one of some directions."""
    return points[np.unique((points @ even_directions(directions).T).argmax(axis=0))]


def slices(vertices: FloatArray, edges: NDArray[np.int64]) -> list[FloatArray]:
    """Return the hull's points, or those of slices across its longest axis if far smaller."""
    whole = outermost(vertices)
    middle = vertices - vertices.mean(axis=0)
    axis = np.linalg.svd(middle[:: max(1, len(middle) // 2000)], full_matrices=False)[2][0]
    along = vertices @ axis
    cuts = np.linspace(along.min(), along.max(), NUM_SLICES + 1)
    between = [_slice(vertices, edges, along, *ends) for ends in zip(cuts, cuts[1:], strict=False)]
    # a mesh of several bodies, as letters of a logo, has slices between them that hold nothing
    slices = [outermost(points, NUM_SLICE_DIRECTIONS) for points in between if len(points)]
    try:
        volumes = [float(ConvexHull(points).volume) for points in (whole, *slices)]
    except (QhullError, ValueError):  # flat
        return [whole]
    hollow = sum(volumes[1:]) < HOLLOW_FRACTION * volumes[0]
    return slices if hollow and np.ptp(along) > MIN_SLICED_LENGTH_M else [whole]


def convex_pieces(vertices: FloatArray, edges: NDArray[np.int64]) -> list[FloatArray]:
    """Return convex parts (N, 3) of a mesh, with the room that a hand has between its jaws.

    The piece that holds most empty space is cut where its halves' hulls hold least, along one of
    its principal axes, until no cut gains much.

    Args:
        vertices: (N, 3) vertices of the mesh, which need not be closed [m].
        edges: (E, 2) edges of its triangles.
    """
    if _is_convex(vertices):
        return [outermost(vertices)]
    whole = vertices[edges]
    pieces = [(whole, *_best_cut(whole))]
    least = MIN_CUT_GAIN * _hull_volume(whole)
    while len(pieces) < MAX_PIECES:
        number = int(np.argmax([gain for _, gain, _ in pieces]))
        _, gain, halves = pieces[number]
        if gain <= least:
            break
        pieces[number : number + 1] = [(half, *_best_cut(half)) for half in halves]
    flat = MIN_PIECE_FRACTION * _hull_volume(whole)
    bodies = [piece for piece, _, _ in pieces if _hull_volume(piece) > flat]
    return [outermost(points.reshape(-1, 3)) for points in bodies or [whole]]


def write_convex_hull(points: FloatArray, out: Path) -> None:
    """Write the convex hull of the outermost of points (N, 3) as a binary STL.

    Raises:
        RobotError: they have no volume.
    """
    import coal

    hull = coal.BVHModelOBBRSS()
    points = outermost(points)
    hull.beginModel(0, len(points))
    for point in points:
        hull.addVertex(point)
    hull.endModel()
    try:
        hull.buildConvexHull(True, 'Qt')
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"the mesh of '{out.name}' has no volume: {error}") from error
    faces = [hull.convex.polygons(i) for i in range(hull.convex.num_polygons)]
    corners = np.array(hull.convex.points())[[[face[k] for k in range(3)] for face in faces]]
    rows = [struct.pack('<12fH', 0, 0, 0, *face.ravel(), 0) for face in corners]
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, bytes(80) + struct.pack('<I', len(rows)) + b''.join(rows))


def _is_convex(vertices: FloatArray) -> bool:
    """Return whether all vertices are corners of their convex hull."""
    points = np.unique(vertices, axis=0)
    try:
        return len(points) < NUM_CUT_EDGES and len(ConvexHull(points).vertices) == len(points)
    except (QhullError, ValueError):
        return True


def _best_cut(segments: FloatArray) -> tuple[float, list[FloatArray]]:
    """Return the reduction of the hulls' volume by a cut [m^3], and the two parts (E, 2, 3)."""
    whole = segments
    segments = segments[:: max(1, len(segments) // NUM_CUT_EDGES)]  # enough to choose a cut by
    points = segments.reshape(-1, 3)
    volume, best = _hull_volume(segments), (0.0, np.zeros(3), 0.0)
    if not volume:
        return 0.0, [whole]
    middle = points - points.mean(axis=0)
    for axis in np.linalg.svd(middle, full_matrices=False)[2]:
        along = points @ axis
        for at in np.linspace(along.min(), along.max(), NUM_CUTS + 2)[1:-1]:
            halves = [_half(segments, axis, at), _half(segments, -axis, -at)]
            gain = volume - sum(map(_hull_volume, halves))
            if gain > best[0]:
                best = gain, axis, at
    gain, axis, at = best
    return gain, [_half(whole, axis, at), _half(whole, -axis, -at)] if gain else [whole]


def _half(segments: FloatArray, axis: FloatArray, at: float) -> FloatArray:
    """Return the parts of segments (E, 2, 3) below a plane."""
    along = segments @ axis
    order = np.argsort(along, axis=1)
    segments = np.take_along_axis(segments, order[..., None], axis=1)[along.min(axis=1) < at]
    low, high = np.sort(along, axis=1)[along.min(axis=1) < at].T
    share = np.where(high > at, (at - low) / np.maximum(high - low, 1e-12), 1.0)[:, None]
    ends = segments[:, 0] + share * (segments[:, 1] - segments[:, 0])
    return np.stack([segments[:, 0], ends], axis=1)


def _hull_volume(segments: FloatArray) -> float:
    """Return the volume of the convex hull [m^3]; 0 if it is flat."""
    points = segments.reshape(-1, 3)
    if len(points) < 4:
        return 0.0
    try:
        return float(
            ConvexHull(outermost(points, NUM_CUT_DIRECTIONS), qhull_options='Qt Pp').volume
        )
    except (QhullError, ValueError):
        return 0.0


def _slice(
    vertices: FloatArray, edges: NDArray[np.int64], along: FloatArray, low: float, high: float
) -> FloatArray:
    """Return the points (N, 3) between two planes, with where the planes cut edges."""
    inside = vertices[(along >= low) & (along <= high)]
    start, end = along[edges].T
    found = [inside]
    for cut in (low, high):
        crossed = (start - cut) * (end - cut) < 0
        share = ((cut - start[crossed]) / (end - start)[crossed])[:, None]
        a, b = vertices[edges[crossed, 0]], vertices[edges[crossed, 1]]
        found.append(a + share * (b - a))
    return np.concatenate(found)


def even_directions(count: int) -> FloatArray:
    """Return (count, 3) unit vectors spread evenly (a Fibonacci sphere)."""
    n = np.arange(count) + 0.5
    up, turn = 1 - 2 * n / count, n * np.pi * (1 + 5**0.5)
    across = np.sqrt(1 - up**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), up], axis=-1)
