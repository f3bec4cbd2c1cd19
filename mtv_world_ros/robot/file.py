"""Robot YAML files: a URDF or Denavit-Hartenberg tables become one `RobotModel`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
import os
from pathlib import Path
import re
from typing import Annotated, Any, ClassVar, Literal, Self
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from pydantic import Field, model_validator
import yaml

from mtv_world_ros.core.bounded_input import check_limit, LimitError, read_text
from mtv_world_ros.core.config import ListOf, Metres, Quaternion, read_yaml, Schema, validated
from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import ConfigError, RobotError
from mtv_world_ros.core.files import bundled, is_file, ROBOT_YAML, whole_folder
from mtv_world_ros.core.transforms import denavit_hartenberg, pose
from mtv_world_ros.robot.mesh_pieces import (
    convex_pieces,
    find_mesh,
    load_mesh,
    MissingMeshError,
    write_convex_hull,
)
from mtv_world_ros.robot.model import Mimic, RobotModel, Tool
from mtv_world_ros.robot.shape import grip_links, load_shape, mesh_scale, replaced_meshes
from mtv_world_ros.robot.xml_file import check_xml, NO_XML, parse_xml, root_link

#: a calibrated robot differs from its nominal description by less than this [m], [rad]
_LARGEST_OFFSET = 0.05
_LARGEST_TURN = 0.2
_NUM_CONFIGURATIONS = 64


def robot_path(name: str | Path) -> Path:
    """Return the YAML of a robot given by path or by the name of a bundled one.

    Raises:
        ConfigError: no such file, and no bundled robot of this name.
    """
    path = bundled('robots', name, 'robot_file')
    if not is_file(path):
        problem = 'is no regular file' if os.path.exists(path) else 'does not exist'
        raise ConfigError(
            f"robot file '{path}' {problem}; give another one (--robot, or robot_file of the node)"
        )
    return path


def described_robot(expected: RobotModel, urdf: str) -> tuple[RobotModel, float]:
    """Return an expected robot with the lengths, offsets and limits of its description (URDF).

    With it comes how far its tool points are off the expected ones, at most over the joints'
    range [m].

    Raises:
        RobotError: it is no URDF, or it describes another robot: joints or links are missing, or
            its tools are elsewhere by more than a calibration explains.
    """
    model, mimics, _ = parse_urdf(urdf, 'the robot description')
    followers = {mimic.joint for mimic in mimics}
    mimics += [mimic for mimic in expected.mimics if mimic.joint not in followers]
    try:
        robot = RobotModel(
            name=expected.name,
            model=model,
            joint_names=expected.joint_names,
            tools=expected.tools,
            base_link=expected.base_link,
            mimics=mimics,
            speed_limits=expected.speed_limits,
            file=expected.file,
        )
    except RobotError as error:
        raise RobotError(
            f"the description is of another robot ('{model.name}'), not of '{expected.name}': "
            f'{error}'
        ) from error
    offset_m, turn = _tool_differences(expected, robot)
    if offset_m > _LARGEST_OFFSET or turn > _LARGEST_TURN:
        raise RobotError(
            f"the description is of another robot ('{model.name}'), not of '{expected.name}': "
            f'with the same joint positions its tools are up to {offset_m:.3f} m and {turn:.2f} '
            f'rad elsewhere; a calibration explains {_LARGEST_OFFSET:g} m and {_LARGEST_TURN:g} '
            'rad'
        )
    return robot, offset_m


def _tool_differences(one: RobotModel, other: RobotModel) -> tuple[float, float]:
    """Greatest distance [m] and angle [rad] between the tools of two robots in one posture."""
    positions = _spread_positions(one)
    a, b = one.tool_poses(positions), other.tool_poses(positions)
    distance = np.linalg.norm(a[..., :3, 3] - b[..., :3, 3], axis=-1)
    trace = np.einsum('...ij,...ij->...', a[..., :3, :3], b[..., :3, :3])
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    return float(distance.max()), float(angle.max())


def _spread_positions(robot: RobotModel) -> FloatArray:
    """Return (N, J) positions spread over the joints' range; endless joints over a turn."""
    lower = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
    upper = np.where(np.isfinite(robot.upper), robot.upper, np.pi)
    shares = np.random.default_rng(0).random((_NUM_CONFIGURATIONS, len(lower)))
    return lower + shares * (upper - lower)


_ERROR = re.compile(rb'^Error: *(.+)$', re.MULTILINE)


@contextmanager
def parser_errors() -> Iterator[list[str]]:
    """Capture the parser's errors from stderr; other text on stderr is passed on.

    Yields:
        The errors, filled at the end.
    """
    found: list[str] = []
    try:
        stderr = os.dup(2)
    except OSError:  # a process without stderr prints nothing
        yield found
        return
    with os.fdopen(os.memfd_create('urdfdom'), 'w+b') as taken:
        os.dup2(taken.fileno(), 2)
        try:
            yield found
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            taken.seek(0)
            text = taken.read()
            found += [line.decode(errors='replace').strip() for line in _ERROR.findall(text)]
            os.write(2, _without_errors(text))


def _without_errors(text: bytes) -> bytes:
    """Return the parser's messages without error marks and places in urdfdom's source."""
    return re.sub(rb'^Error: .+\n(?: +at line \d+ in .+\n)?', b'', text, flags=re.MULTILINE)


#: names that an error lists
_MOST_NAMED = 8
#: expanded URDFs may keep xacro in comments, and `$(find ...)` in what is not of the robot
_COMMENT = re.compile(r'<!--.*?-->', re.DOTALL)
_EXPRESSION = re.compile(r'\$[{(]')
_EXPAND = '; expand it first: xacro FILE > robot.urdf'
#: of a joint [rad or m]; many turns, no encoder counts
Position = Annotated[float, Field(ge=-1000, le=1000)]


class PoseEntry(Schema):
    """A pose, by default the identity."""

    position: ListOf[Metres] = Field(default=(0, 0, 0), description='x, y, z [m]')
    quaternion_xyzw: ListOf[Quaternion] = Field(
        default=(0, 0, 0, 1), description='rotation as a quaternion'
    )

    @model_validator(mode='after')
    def _is_a_pose(self) -> Self:
        self.matrix()
        return self

    def matrix(self) -> FloatArray:
        """Return the (4, 4) pose."""
        return pose(self.position, self.quaternion_xyzw)


class JointEntry(Schema):
    """A joint that moves between two limits [rad or m]."""

    joint: str = Field(description='name of the joint')
    lower: Position = Field(description='lower limit [rad or m]')
    upper: Position = Field(description='upper limit [rad or m]')

    @model_validator(mode='after')
    def _limits_are_in_order(self) -> Self:
        if self.lower >= self.upper:
            raise ValueError(f"joint '{self.joint}': lower {self.lower} is not below {self.upper}")
        return self


class DhEntry(JointEntry):
    """A row of a Denavit-Hartenberg table [m, rad]; its link is named `<joint>_link`."""

    a: Metres = Field(description='link length [m]')
    alpha: Position = Field(description='link twist [rad]')
    d: Metres = Field(description='link offset [m]')
    theta: Position = Field(default=0.0, description='joint angle at position 0 [rad]')
    type: Literal['revolute', 'prismatic'] = Field(
        default='revolute', description='whether the joint turns or slides'
    )


class DhArmEntry(PoseEntry):
    """An arm as a Denavit-Hartenberg table; its pose is that of frame 0 in the base."""

    arm: str = Field(description='name of the arm')
    convention: Literal['standard', 'modified'] = Field(
        default='standard', description="`modified` is J. Craig's"
    )
    joints: ListOf[DhEntry] = Field(description='rows of the table, from the base on')
    gripper: JointEntry | None = Field(
        default=None, description="a slide along the last frame's z"
    )


class MimicEntry(Schema):
    """A joint that follows another one."""

    joint: str = Field(description='joint that follows')
    source: str = Field(description='joint that is followed')
    multiplier: Position = Field(default=1.0, description='position per position of `source`')
    offset: Position = Field(default=0.0, description='position where `source` is at 0 [rad or m]')


class ToolEntry(PoseEntry):
    """The tool of an arm; its pose is that of the tool in its link."""

    basic: ClassVar = ('arm', 'link', 'gripper_joint', 'gripper_closed', 'gripper_open')

    arm: str = Field(description='name of the arm')
    link: str = Field(description='link that carries the tool')
    gripper_joint: str | None = Field(
        default=None, description='joint that opens the gripper; null = no gripper'
    )
    gripper_closed: Position = Field(
        default=0.0, description='position of the gripper joint when closed [rad or m]'
    )
    gripper_open: Position = Field(
        default=1.0, description='the same when open [rad or m]; either may be the larger'
    )
    finger_travel_m: float | None = Field(
        default=None, ge=-1, le=1, description='travel of each finger from closed to open [m]'
    )


class RobotFile(Schema):
    """A robot file: `urdf` or `dh`, and the tools."""

    basic: ClassVar = ('name', 'urdf', 'tools')

    name: str = Field(description='name of the robot; episodes and checkpoints name it')
    urdf: str | None = Field(default=None, description='file, relative to the YAML')
    dh: ListOf[DhArmEntry] | None = Field(default=None, description='arms, in place of a URDF')
    base_link: str | None = Field(default=None, description="null = the URDF's root, or `base`")
    joints: ListOf[str] | None = Field(
        default=None, description='order of position vectors; null = all that move by themselves'
    )
    mimic: ListOf[MimicEntry] = Field(default=(), description="added to the URDF's own")
    speed_limits: dict[str, Annotated[float, Field(gt=0, le=1000)]] = Field(
        default_factory=dict,
        description='largest speed by joint, in place of that of the description [rad/s or m/s]',
    )
    tools: ListOf[ToolEntry] = Field(description='one an arm')

    @model_validator(mode='after')
    def _has_one_description(self) -> Self:
        if len({'urdf', 'dh'} & self.model_fields_set) != 1:
            raise ValueError("give either 'urdf' or 'dh'")
        if not self.urdf and not self.dh:
            raise ValueError("'dh' must be a list of arms")
        return self


def load_robot(path: Path | str) -> RobotModel:
    """Read a robot YAML, see `RobotFile`.

    Raises:
        ConfigError: the file is missing, not YAML, or has unknown, missing or wrong values.
        RobotError: the description cannot be used.
    """
    path = Path(path)
    file = validated(RobotFile, read_yaml(path, 'robot file', 'robot_file'), str(path))
    mimics = [Mimic(**dict(entry)) for entry in file.mimic]
    if file.urdf:
        model, own_mimics, base = read_urdf(path.parent / file.urdf)
        mimics += own_mimics
        base = file.base_link or base
    else:
        base = file.base_link or 'base'
        try:
            model = _from_dh(file, base)
        except LimitError as error:
            raise RobotError(f"'{path}': {error}") from error
    joints = file.joints or _movable(model, {mimic.joint for mimic in mimics})
    pose_keys = set(PoseEntry.model_fields)
    return RobotModel(
        name=file.name,
        model=model,
        joint_names=joints,
        tools=[
            Tool(T_link_tool=entry.matrix(), **entry.model_dump(exclude=pose_keys))
            for entry in file.tools
        ],
        base_link=base,
        mimics=mimics,
        speed_limits=file.speed_limits,
        file=path,
    )


def _movable(model: pin.Model, followers: set[str]) -> list[str]:
    """Return the joints of one number that follow no other; floating and planar ones rest."""
    return [
        name
        for name, joint in zip(model.names[1:], list(model.joints)[1:], strict=True)
        if joint.nv == 1 and name not in followers
    ]


#: names in a folder that holds a copy of a robot
_URDF = 'robot.urdf'
_MESHES = 'meshes'
_PIECES = 'pieces'


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedRobot:
    """Copy of a robot file with everything it names.

    Attributes:
        file: YAML of the copy.
        notes: meshes that are missing or cannot be read, and links whose size is doubtful.
    """

    file: Path
    notes: tuple[str, ...] = ()


def save_robot(file: Path, folder: Path) -> SavedRobot:
    """Copy a robot file, its URDF and the shapes in it; the copy can be moved anywhere.

    Meshes are stored as their convex hulls, which is all that drawing a robot uses; what touches
    things in a gripper as convex pieces, made here once. The name of a mesh that is missing or
    cannot be read is kept.

    Args:
        file: robot YAML.
        folder: folder to make; one that is there is replaced.

    Raises:
        ConfigError, RobotError: the robot cannot be used.
    """
    robot = load_robot(file)
    values = read_yaml(file, 'robot file', 'robot_file')
    values['base_link'] = robot.base_link
    missing: list[str] = []
    replaced: tuple[str, ...] = ()
    with whole_folder(folder) as partial:
        if values.get('urdf'):
            urdf = file.parent / values['urdf']
            links = parse_xml(read_text(urdf, 'urdf_bytes')).iter('link')
            replaced = replaced_meshes(links, urdf)
            tree = _with_hulls(urdf, partial, grip_links(robot), missing)
            tree.write(partial / _URDF, encoding='utf-8', xml_declaration=True)
            values['urdf'] = _URDF
        text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, allow_unicode=True)
        (partial / ROBOT_YAML).write_text(text, encoding='utf-8')
        doubts = _size_doubts(partial, file)
    notes = (*(f'mesh {text}' for text in missing), *replaced, *doubts)
    return SavedRobot(file=folder / ROBOT_YAML, notes=notes)


def _size_doubts(copy: Path, file: Path) -> tuple[str, ...]:
    """Return the links of a copied robot whose size is doubtful.

    Raises:
        RobotError: a shape cannot be read; names the file that was copied.
    """
    try:
        return load_shape(load_robot(copy / ROBOT_YAML)).doubts
    except RobotError as error:
        text = str(error).replace(f"'{copy / _URDF}'", f"the URDF of '{file}'")
        raise RobotError(text) from error


def _with_hulls(urdf: Path, folder: Path, grips: set[str], missing: list[str]) -> Any:
    """Return the URDF with stored hulls in place of meshes; add those that are missing."""
    tree = ElementTree.ElementTree(parse_xml(read_text(urdf, 'urdf_bytes')))
    stored: dict[Path, str] = {}
    made: list[str] = []
    for link in tree.iter('link'):
        if link.get('name') in grips:
            made += _split_collisions(link, urdf, folder, len(made))
    for mesh in tree.iter('mesh'):
        name = mesh.get('filename', '')
        if name in made:
            continue
        try:
            file = _present_mesh(name, urdf)
            if file not in stored:
                vertices = load_mesh(file).vertices
                stored[file] = f'{_MESHES}/{len(stored)}_{file.stem}.stl'
                write_convex_hull(vertices, folder / stored[file])
        except MissingMeshError as error:
            if str(error) not in missing:
                missing.append(str(error))
            continue
        mesh.set('filename', stored[file])
    return tree


def _present_mesh(name: str, urdf: Path) -> Path:
    """Return the file of a mesh.

    Raises:
        MissingMeshError: it is not there.
    """
    file = find_mesh(name, urdf)
    if file is None:
        raise MissingMeshError(f"'{name}' is not there")
    return file


def _split_collisions(link: Any, urdf: Path, folder: Path, first: int) -> list[str]:
    """Replace a link's collision meshes by convex pieces, numbered from `first`; their files."""
    made: list[str] = []
    if not link.findall('collision'):  # then what is drawn is what touches
        for drawn in map(deepcopy, link.findall('visual')):
            drawn.tag = 'collision'
            link.append(drawn)
    for element in link.findall('collision'):
        mesh = element.find('geometry/mesh')
        if mesh is None:
            continue
        try:
            file = _present_mesh(mesh.get('filename', ''), urdf)
            pieces = _scaled_pieces(mesh, file, f"'{urdf}': a mesh of link '{link.get('name')}'")
        except MissingMeshError:  # the caller names it, as its name stays
            continue
        link.remove(element)
        for points in pieces:
            made.append(name := f'{_PIECES}/{first + len(made)}_{file.stem}.stl')
            write_convex_hull(points, folder / name)
            piece = ElementTree.SubElement(link, 'collision')
            if (origin := element.find('origin')) is not None:
                piece.append(origin)
            ElementTree.SubElement(
                ElementTree.SubElement(piece, 'geometry'), 'mesh', filename=name
            )
    return made


def _scaled_pieces(mesh: ElementTree.Element, file: Path, what: str) -> list[FloatArray]:
    """Return convex pieces (N, 3) of a mesh, with the scale of the URDF [m].

    Raises:
        MissingMeshError: the file cannot be read.
        RobotError: the scale cannot be read; begins with `what`.
    """
    loaded = load_mesh(file)
    try:
        scale = mesh_scale(mesh)
    except ValueError as error:
        raise RobotError(f'{what}: {error}') from error
    return convex_pieces(loaded.vertices * scale, loaded.edges())


def read_urdf(path: Path) -> tuple[pin.Model, list[Mimic], str]:
    """Return a URDF's model, its mimic joints (kept as joints of their own), and the root link.

    Raises:
        ConfigError: there is no such file.
        RobotError: the file is not a usable URDF.
    """
    try:
        text = read_text(path, 'urdf_bytes')
    except FileNotFoundError as error:
        raise ConfigError(
            f"URDF file '{path}' does not exist; 'urdf' is relative to the YAML"
        ) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"URDF file '{path}' cannot be read: {error}") from error
    return parse_urdf(text, f"URDF '{path}'")


def parse_urdf(text: str, what: str) -> tuple[pin.Model, list[Mimic], str]:
    """Return what `read_urdf` does of a URDF's text; errors begin with `what`.

    Raises:
        RobotError: the file is not a usable URDF.
    """
    written = text
    try:
        check_xml(text)  # first: searches for comments without an end take forever
        written = _COMMENT.sub('', text)
        if '<xacro:' in written:
            raise RobotError(f'{what} is unexpanded xacro{_EXPAND}')
        root = ElementTree.fromstring(text)
        base = root_link(root)
        # Pinocchio must see mimic joints as ordinary ones: RobotModel moves them itself.
        mimics = [mimic for joint in root.iter('joint') for mimic in _take_mimics(joint)]
        model = _build(ElementTree.tostring(root, encoding='unicode'))
    except (*NO_XML, ValueError, KeyError, RuntimeError) as error:
        xacro = f'; it has expressions of xacro{_EXPAND}' if _EXPRESSION.search(written) else ''
        raise RobotError(f'{what} cannot be used: {error}{xacro}') from error
    return model, _resolved(mimics), base


def _build(urdf: str) -> pin.Model:
    """Build the model; why urdfdom refuses one, which it only prints, is in the error.

    Raises:
        ValueError: it is not a usable URDF.
    """
    with parser_errors() as reasons:
        try:
            return pin.buildModelFromXML(urdf)
        except ValueError as error:
            refused = error
    raise ValueError('; '.join(reasons) or str(refused)) from refused


def _resolved(mimics: Sequence[Mimic]) -> list[Mimic]:
    """Resolve chains: followers of followers follow the joint that leads them all.

    Raises:
        RobotError: joints follow each other in a circle.
    """
    leaders = {mimic.joint: mimic for mimic in mimics}
    resolved: dict[str, Mimic] = {}
    for mimic in mimics:
        way, seen = [mimic], {mimic.joint}
        while (leader := leaders.get(way[-1].source)) and leader.joint not in resolved:
            if leader.joint in seen:
                names = sorted(seen)[:_MOST_NAMED]
                raise RobotError(f"joint '{leader.joint}' follows itself, by way of {names}")
            way.append(leader)
            seen.add(leader.joint)
        for one in reversed(way):
            resolved[one.joint] = _behind(one, resolved.get(one.source))
    return [resolved[mimic.joint] for mimic in mimics]


def _behind(mimic: Mimic, leader: Mimic | None) -> Mimic:
    """Return a follower of what its source follows; None = that follows nothing."""
    if leader is None:
        return mimic
    return Mimic(
        joint=mimic.joint,
        source=leader.source,
        multiplier=mimic.multiplier * leader.multiplier,
        offset=mimic.multiplier * leader.offset + mimic.offset,
    )


def _take_mimics(joint: ElementTree.Element) -> list[Mimic]:
    mimics = []
    for tag in joint.findall('mimic'):
        joint.remove(tag)
        mimics.append(
            Mimic(
                joint=joint.attrib['name'],
                source=tag.attrib['joint'],
                multiplier=float(tag.get('multiplier', 1.0)),
                offset=float(tag.get('offset', 0.0)),
            )
        )
    return mimics


def _from_dh(file: RobotFile, base: str) -> pin.Model:
    model = pin.Model()
    model.name = file.name
    model.addFrame(pin.Frame(base, 0, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    check_limit(
        'urdf_links', sum(len(arm.joints) for arm in file.dh or ()), f"robot '{file.name}'"
    )
    for arm in file.dh or ():
        check_limit('chain_links', len(arm.joints), f"arm '{arm.arm}'")
        _add_dh_arm(model, arm)
    return model


def _add_dh_arm(model: pin.Model, arm: DhArmEntry) -> None:
    parent, placement = 0, pin.SE3(arm.matrix())
    for row in arm.joints:
        joint = pin.JointModelRZ() if row.type == 'revolute' else pin.JointModelPZ()
        before, after = _around_joint(row, arm.convention == 'modified')
        parent = _add_joint(model, parent, joint, placement * before, row)
        link = f'{row.joint}_link'
        model.addFrame(pin.Frame(link, parent, 0, after, pin.FrameType.BODY))
        placement = after
    if arm.gripper is not None:
        _add_joint(model, parent, pin.JointModelPZ(), placement, arm.gripper)


def _around_joint(row: DhEntry, modified: bool) -> tuple[pin.SE3, pin.SE3]:
    """Return the transforms before and after the joint's motion along or about its z.

    The standard row is Rz(theta) Tz(d) Tx(a) Rx(alpha), the modified one (J. Craig, Introduction
    to Robotics, 3.4) Rx(alpha) Tx(a) Rz(theta) Tz(d); motions along and about one axis commute.
    """
    turn = pin.SE3(denavit_hartenberg(0.0, 0.0, row.d, row.theta))
    twist = pin.SE3(denavit_hartenberg(row.a, row.alpha, 0.0, 0.0))
    return (twist * turn, pin.SE3.Identity()) if modified else (turn, twist)


def _add_joint(
    model: pin.Model, parent: int, joint: Any, placement: pin.SE3, entry: JointEntry
) -> int:
    free = np.full(1, np.inf)
    limits = np.array([entry.lower]), np.array([entry.upper])
    return model.addJoint(parent, joint, placement, entry.joint, free, free, *limits)
