"""A table, a robot and solids as rigid bodies of the engine DART (dartsim.github.io).

Friction is Coulomb's, with the lower one of two bodies' coefficients. Everything is made of boxes
and balls, because the engine's own detector finds the contacts of these shapes best.

Shape letters: J joints, D degrees of freedom of the description, O solids, A tools.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import copy
from dataclasses import dataclass
from itertools import chain, combinations, product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import dartpy as dart
import numpy as np
from scipy.optimize import nnls

from mtv_world_ros.core.bounded_input import read_text
from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.core.transforms import about_z
from mtv_world_ros.physics.arms.arm_response import ArmResponse
from mtv_world_ros.physics.arms.arms import finger_travels
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import urdf_path
from mtv_world_ros.robot.xml_file import parse_xml
from mtv_world_ros.simulation.dart.finger_swing import FingerDrives

#: minimum width of a hollow solid, for example a dish or a tray [m]
_MIN_HOLLOW_WIDTH_M = 0.06
#: minimum ratio of width to height of a hollow solid
_MIN_HOLLOW_ASPECT = 1.5
#: thickness of the floor of a hollow solid [m]
_FLOOR_M = 0.006
#: gap between the bottom of a hollow solid and its walls, so that walls never touch the table [m]
_LIFT_M = 0.0005
#: number of sides of the prism that stands for a round solid: flat fingers touch a cylinder along
#: a line only
_NUM_PRISM_SIDES = 16
#: side of the square that has the area of a circle [radii]
_SQUARE_SIDE = np.sqrt(np.pi)
#: length of the cylinder that has the volume of a capsule's two caps [radii]
_CAPS_LENGTH = 4 / 3
#: maximum velocity of a solid at rest: three angular [rad/s], then three linear components [m/s]
_MAX_REST_VELOCITY = np.array([0.02, 0.02, 0.02, 0.002, 0.002, 0.002])
#: maximum deviation of an arm from its motion in free air [rad or m]
_FREE_MOTION_TOLERANCE = 5e-4
#: maximum difference of its speed from that motion [rad/s or m/s]
_FREE_MOTION_SPEED_TOLERANCE = 0.01
#: minimum mass of a solid [kg]
_MIN_MASS_KG = 0.01
#: time constant of the compliance of finger pads [s]
_PAD_S = 0.02
#: actuator of a compliant pad
_COMPLIANT_PAD = dart.dynamics.ActuatorType.FORCE
#: actuator of a rigid pad
_RIGID_PAD = dart.dynamics.ActuatorType.LOCKED
#: minimum vertical component of a contact normal for a finger to press; below it the finger pushes
_MIN_PRESS_SLOPE = 0.5
#: minimum distance of two fingers from their middle when they hold a solid that both touch [m]
_GRIP_M = 0.002
#: iterations of the friction solver while fingers touch a solid
_FRICTION_ITERATIONS = 50
#: relative error at which the friction solver stops
_FRICTION_TOLERANCE = 1e-5
#: half extents of the table [m]
_TABLE_M = (1.5, 1.5, 0.1)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Part:
    """A box of a solid, by its half extents."""

    size: tuple[float, float, float]
    pose: FloatArray
    mass: float

    @property
    def inertia(self) -> FloatArray:
        """(3, 3) about its centre."""
        x, y, z = (4 * extent**2 for extent in self.size)
        return self.mass / 12 * np.diag([y + z, x + z, x + y])


class RigidBodies:
    """A world that is stepped.

    Args:
        robot: robot from a URDF whose base link is its root.
        response: response of the joints; all have a compliance.
        solids: the O solids on the table.
        settings: settings of contact.
        step_s: step of the engine.
        pose: (J,) near which the arms work [rad or m].
        masses: (O,) masses of the solids [kg].

    Raises:
        RobotError: the robot cannot be a tree of rigid bodies, or its drives are too stiff.
    """

    def __init__(
        self,
        robot: RobotModel,
        response: ArmResponse,
        solids: Sequence[Solid],
        settings: ContactSettings,
        step_s: float,
        pose: FloatArray,
        masses: Sequence[float],
    ) -> None:
        self._world = dart.simulation.World()
        self._world.setTimeStep(step_s)
        still = self._world.getDeactivationOptions()
        still.mEnabled = False  # what sleeps is not woken by fingers that close gently
        self._world.setDeactivationOptions(still)
        self._settings = settings
        self._solids = [
            _body(number, solid, settings, mass)
            for number, (solid, mass) in enumerate(zip(solids, masses, strict=True))
        ]
        self.arms = DrivenArms(robot, response, settings, pose)
        self.arms.check_stable(step_s)
        detector = dart.collision.DARTCollisionDetector()
        solver = self._world.getConstraintSolver()
        solver.setCollisionDetector(detector)
        self._option = solver.getCollisionOption()
        for pair in _same_arm(self.arms.skeleton):
            self._option.collisionFilter.addBodyNodePairToBlackList(*pair)
        self._touched = np.zeros(len(solids), np.bool_)
        self._pyramid, self._cone = solver.getBoxedLcpSolver(), _cone()
        groups = [detector.createCollisionGroup() for _ in range(1 + len(solids))]
        self._others, *self._of_solids = groups
        tools = self.arms.finger_nodes
        self._of_arms = _group(detector, _moving_nodes(self.arms.skeleton))
        self._of_fingers = _group(detector, chain.from_iterable(chain.from_iterable(tools)))
        self._of_tools = [[_group(detector, nodes) for nodes in fingers] for fingers in tools]
        for group, solid in zip(self._of_solids, self._solids, strict=True):
            group.addShapeFramesOf(solid)
        table = _table(settings)
        self._of_table = detector.createCollisionGroup()
        self._of_table.addShapeFramesOf(table)
        self._of_pads = [detector.createCollisionGroup() for _ in self.arms.pads]
        for group, pad in zip(self._of_pads, self.arms.pads, strict=True):
            group.addShapeFramesOf(pad.getChildBodyNode())
        for skeleton in (table, *self._solids):
            self._others.addShapeFramesOf(skeleton)
            self._world.addSkeleton(skeleton)
        self._world.addSkeleton(self.arms.skeleton)

    @property
    def is_at_rest(self) -> bool:
        """True if no solid moves."""
        return all(
            (np.abs(solid.getVelocities()) < _MAX_REST_VELOCITY).all() for solid in self._solids
        )

    def passes(self, way: FloatArray, velocity: FloatArray) -> bool:
        """Move the arms along their way (D,) unless they would touch something."""
        skeleton = self.arms.skeleton
        before = np.array(skeleton.getPositions())
        skeleton.setPositions(way)
        if self._of_arms.collide(self._others) or self._of_arms.collide(self._option):
            skeleton.setPositions(before)
            return False
        skeleton.setVelocities(velocity)
        return True

    def notice_touch(self) -> None:
        """Set the friction of solids that fingers touch to that of grips, else to the table's.

        So what is gripped holds to fingers and slides on others. Friction of what is held or
        pushed is solved as a cone; else as a pyramid along x and y, which is quicker, and exact
        where fingers press on what is light. Its friction is bounded by forces that would do
        without any, and of those an object that slides ahead of a finger needs none. And pads
        give way, so that both fingers press on what lies below them; but not on the table.
        """
        slopes = [self._slopes(one) for one in self._of_solids]
        touched = np.array([len(found) > 0 for found in slopes], np.bool_)
        for number in np.flatnonzero(touched != self._touched):
            grip, table = self._settings.grip_friction, self._settings.table_friction
            body = self._solids[number].getBodyNode(0)
            for node in map(body.getShapeNode, range(body.getNumShapeNodes())):
                node.getDynamicsAspect().setFrictionCoeff(grip if touched[number] else table)
        is_pushed = max(chain.from_iterable(slopes), default=1.0) < _MIN_PRESS_SLOPE
        self.solve_friction(as_cone=is_pushed or self._holds(touched))
        self._touched = touched
        for group, pad in zip(self._of_pads, self.arms.pads, strict=True):
            is_soft = bool(touched.any()) and not group.collide(self._of_table)
            if not is_soft:
                pad.setPosition(0, 0.0)
                pad.setVelocity(0, 0.0)
            pad.setActuatorType(_COMPLIANT_PAD if is_soft else _RIGID_PAD)

    def solve_friction(self, *, as_cone: bool) -> None:
        """Solve friction from here on as a cone or as a pyramid, see `notice_touch`."""
        solver = self._cone if as_cone else self._pyramid
        self._world.getConstraintSolver().setBoxedLcpSolver(solver)

    @property
    def is_lost(self) -> bool:
        """True if the pose of a solid or a joint position of an arm is not finite."""
        return not (np.isfinite(self.poses()).all() and np.isfinite(self.arms.joints).all())

    def _slopes(self, solid: Any) -> list[float]:
        """Return the vertical components of contact normals of fingers with a solid, 0 to 1."""
        found = dart.collision.CollisionResult()
        self._of_fingers.collide(solid, dart.collision.CollisionOption(), found)
        return [abs(found.getContact(k).normal[2]) for k in range(found.getNumContacts())]

    def _holds(self, touched: BoolArray) -> bool:
        """Return True if a tool has one of the touched solids (O,) between its fingers."""
        tools = zip(self._of_tools, self.arms.finger_gaps, strict=True)
        wide = [fingers for fingers, gap in tools if gap > _GRIP_M]
        solids = [self._of_solids[number] for number in np.flatnonzero(touched)]
        return any(
            sum(map(solid.collide, fingers)) > 1 for fingers, solid in product(wide, solids)
        )

    def step(self, forces: FloatArray) -> None:
        """Advance the world by one step, with forces (D,) on the arms [N m or N]."""
        self.arms.skeleton.setForces(forces)
        self._world.step()

    def poses(self) -> FloatArray:
        """Return T_base_solid (O, 4, 4) [m]."""
        found = [solid.getBodyNode(0).getWorldTransform().matrix() for solid in self._solids]
        return np.array(found).reshape(-1, 4, 4)

    @property
    def state(self) -> list[tuple[FloatArray, FloatArray]]:
        """Positions and velocities of everything that moves, in the engine's order."""
        moving = (*self._solids, self.arms.skeleton)
        return [(np.array(one.getPositions()), np.array(one.getVelocities())) for one in moving]

    @state.setter
    def state(self, state: list[tuple[FloatArray, FloatArray]]) -> None:
        moving = (*self._solids, self.arms.skeleton)
        for one, (positions, velocities) in zip(moving, state, strict=True):
            one.setPositions(positions)
            one.setVelocities(velocities)


class DrivenArms:
    """The robot's skeleton, and the forces that drive it.

    In free air a joint goes just as `ArmResponse` expects it; what touches the arm moves it off
    that way against the joint's stiffness and damping.
    """

    def __init__(
        self,
        robot: RobotModel,
        response: ArmResponse,
        settings: ContactSettings,
        pose: FloatArray,
    ) -> None:
        followers = {name: (name, 1.0, 0.0) for name in robot.joint_names}
        followers |= {m.joint: (m.source, m.multiplier, m.offset) for m in robot.mimics}
        travels = finger_travels(robot)
        grips = {name for name, (source, *_) in followers.items() if source in travels}
        path = urdf_path(robot)
        if path is None:
            raise RobotError(f"robot '{robot.name}' has no URDF; contact needs one")
        tree = _described(path)
        pads = _add_pads(tree, robot, grips) if settings.pad_stiffness else set[str]()
        self.skeleton, described = _skeleton(robot, path, tree)
        self.pads = [_pad(self.skeleton, name, settings) for name in sorted(pads)]
        self._ghost = self.skeleton.clone('expected')
        names = [self.skeleton.getDof(i).getName() for i in range(self.skeleton.getNumDofs())]
        moves = [followers[name][0] if name in followers else '' for name in names]
        self.fingers = [row for row, source in enumerate(moves) if source in travels]
        self._of_tools = [
            [names[row] for row in self.fingers if moves[row] == tool.gripper_joint]
            for tool in robot.tools
        ]
        self._robot = robot
        self._follows = np.zeros((len(names), len(robot.joint_names)))
        self._offsets = np.zeros(len(names))
        self._stiffness, self._damping = np.zeros(len(names)), np.zeros(len(names))
        self._armature = np.zeros(len(names))
        count = {
            s: sum(s == source for source, *_ in followers.values()) for s in robot.joint_names
        }
        for row, name in enumerate(names):
            if name not in followers:
                continue
            source, multiplier, self._offsets[row] = followers[name]
            column = robot.joint_names.index(source)
            self._follows[row, column] = multiplier
            stiffness = 1 / response.compliance[column] / count[source]
            damping = stiffness * response.damping[column]
            armature = stiffness * response.armature[column]
            if source in travels:
                way = travels[source] ** 2
                stiffness, damping = settings.finger_stiffness * way, settings.finger_damping * way
                armature = settings.finger_mass_kg * way
            self._stiffness[row], self._damping[row] = stiffness, damping
            self._armature[row] = armature
        self._means = np.asarray(np.linalg.pinv(self._follows), np.float64)
        self._driven = self._stiffness > 0
        self._finger_joints = {names[row] for row in self.fingers} | pads
        for skeleton in (self.skeleton, self._ghost):
            _settle(skeleton, described, self._finger_joints, settings)
        self.skeleton.setPositions(self.ways(pose[None])[0])
        rotors = _rotors(self.skeleton, self._armature, self.fingers)
        for row in np.flatnonzero(self._driven):
            for skeleton in (self.skeleton, self._ghost):
                joint = skeleton.getJoint(names[row])
                _add_drive(joint, float(rotors[row]), is_finger=names[row] in self._finger_joints)

    @property
    def finger_nodes(self) -> list[list[list[Any]]]:
        """Shapes of each finger of each of A tools, those of its pad among them."""
        pads = {pad.getName() for pad in self.pads}
        found: dict[str, list[Any]] = {}
        for node in _moving_nodes(self.skeleton):
            joint = node.getBodyNodePtr().getParentJoint()
            if joint.getName() in pads:
                joint = joint.getParentBodyNode().getParentJoint()
            found.setdefault(joint.getName(), []).append(node)
        return [[found.get(name, []) for name in fingers] for fingers in self._of_tools]

    @property
    def finger_gaps(self) -> FloatArray:
        """(A,) how far the fingers of each tool are from its middle [m]."""
        return self._robot.finger_gaps(self.joints[None])[0]

    @property
    def finger_drives(self) -> FingerDrives:
        """Drives of the fingers."""
        dofs = [self.skeleton.getDof(number) for number in self.fingers]
        return FingerDrives(
            stiffness=self._stiffness[self.fingers],
            damping=self._damping[self.fingers],
            mass=np.diag(self.skeleton.getMassMatrix())[self.fingers],
            lower=np.array([dof.getPositionLowerLimit() for dof in dofs]),
            upper=np.array([dof.getPositionUpperLimit() for dof in dofs]),
        )

    @property
    def joints(self) -> FloatArray:
        """(J,) where the robot's joints are [rad or m]."""
        return self._means @ (self.skeleton.getPositions() - self._offsets)

    def check_stable(self, step_s: float) -> None:
        """Refuse drives that the engine's explicit steps would excite.

        Args:
            step_s: step of the engine [s].

        Raises:
            RobotError: names the joint.
        """
        inertia = np.diag(self.skeleton.getMassMatrix())
        excited = 2 * self._damping * step_s + self._stiffness * step_s**2 > 4 * inertia
        for row in np.flatnonzero(excited & self._driven):
            raise RobotError(
                f"robot '{self._robot.name}': the drive of joint "
                f"'{self.skeleton.getDof(row).getName()}' is too stiff for the engine dart; "
                'choose another --physics'
            )

    def is_on(self, way: FloatArray, velocity: FloatArray) -> bool:
        """Return True if the arms follow their motion in free air, (D,) each."""
        off = np.abs(self.skeleton.getPositions() - way)[self._driven]
        slow = np.abs(self.skeleton.getVelocities() - velocity)[self._driven]
        return bool(
            (off < _FREE_MOTION_TOLERANCE).all() and (slow < _FREE_MOTION_SPEED_TOLERANCE).all()
        )

    def ways(self, positions: FloatArray) -> FloatArray:
        """Return positions (T, D) of the degrees of freedom at joints (T, J)."""
        return positions @ self._follows.T + self._offsets

    def carried(
        self, ways: FloatArray, velocities: FloatArray, accelerations: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the forces that move the arms along their motion in free air, (T, D) each.

        Returns:
            Forces (T, D) of the drives and forces (T, F) of the hands on their fingers [N m or N].
        """
        forces, own = np.zeros_like(ways), accelerations[:, self.fingers]
        for row, acceleration in enumerate(accelerations):
            self._ghost.setPositions(ways[row])
            self._ghost.setVelocities(velocities[row])
            acceleration = acceleration.copy()
            acceleration[self.fingers] = 0.0
            self._ghost.setAccelerations(acceleration)
            self._ghost.computeInverseDynamics(False, False, False)
            forces[row] = self._ghost.getForces()
        forces *= self._driven
        pulls, mass = -forces[:, self.fingers], self.finger_drives.mass
        added = (
            self._armature[self.fingers] / mass
        )  # a moving hand does not pull what a drive adds
        forces[:, self.fingers] = mass * own - added * pulls
        return forces, (1 - added) * pulls

    def forces(self, carried: FloatArray, way: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the forces (D,) of the drives: gravity compensation and tracking."""
        off = way - self.skeleton.getPositions()
        slow = velocity - self.skeleton.getVelocities()
        return carried + self._stiffness * off + self._damping * slow


def _rotors(arms: Any, armature: FloatArray, fingers: Sequence[int]) -> FloatArray:
    """Inertias (D,) of bodies about their joints that come nearest to an armature (D,) of these.

    The engine has no rotors, which turn by their own joint alone: what turns with a body is felt
    by all joints before it. What slides and what grips has the armature itself.
    """
    count = arms.getNumDofs()
    rotors, mass = armature.copy(), arms.getMassMatrix()
    scale = 1 / np.sqrt(np.diag(mass) + armature)
    felt, rows = [], []
    for row in range(count):
        joint = arms.getJoint(arms.getDof(row).getName())
        if row in fingers or armature[row] == 0 or 'Prismatic' in joint.getType():
            continue
        turns = np.asarray(joint.getAxis()) @ arms.getJacobian(joint.getChildBodyNode())[:3]
        felt.append(np.outer(turns * scale, turns * scale))
        rows.append(row)
    if rows:
        wanted = np.zeros(count)
        wanted[rows] = armature[rows]
        all_felt = np.stack(felt, axis=-1).reshape(-1, len(rows))
        rotors[rows] = nnls(all_felt, np.diag(wanted * scale**2).ravel())[0]
    return rotors


def _moving_nodes(arms: Any) -> list[Any]:
    """Return the shapes of bodies that joints move."""
    bodies = map(arms.getBodyNode, range(arms.getNumBodyNodes()))
    moving = [body for body in bodies if body.getNumDependentGenCoords()]
    return [body.getShapeNode(k) for body in moving for k in range(body.getNumShapeNodes())]


def _group(detector: Any, nodes: Iterable[Any]) -> Any:
    """Return the shapes that are asked together what they touch."""
    group = detector.createCollisionGroup()
    for node in nodes:
        group.addShapeFrame(node)
    return group


def _same_arm(arms: Any) -> list[tuple[Any, Any]]:
    """Pairs of bodies that a joint moves both: an arm does not hit itself, but another arm."""
    arms.enableSelfCollisionCheck()
    bodies = [arms.getBodyNode(number) for number in range(arms.getNumBodyNodes())]
    movers = [
        {one.getDependentGenCoordIndex(k) for k in range(one.getNumDependentGenCoords())}
        for one in bodies
    ]
    return [
        (bodies[one], bodies[other])
        for one, other in combinations(range(len(bodies)), 2)
        if movers[one] & movers[other]
    ]


def _cone() -> Any:
    """Return a solver of contacts whose friction is the same in all directions."""
    options = dart.constraint.NsgsFrictionSolver.Options()
    options.maxSweeps, options.tolerance = _FRICTION_ITERATIONS, _FRICTION_TOLERANCE
    return dart.constraint.NsgsFrictionSolver(options)


def _boxed(shape: Any) -> Any:
    """Return a box in place of a cylinder or capsule; other shapes as they are."""
    caps = {'CylinderShape': 0.0, 'CapsuleShape': _CAPS_LENGTH}.get(shape.getType())
    if caps is None:
        return shape
    radius = shape.getRadius()
    side, length = _SQUARE_SIDE * radius, shape.getHeight() + caps * radius
    return dart.dynamics.BoxShape(np.array([side, side, length]))


def _add_pads(tree: ElementTree.Element, robot: RobotModel, grips: set[str]) -> set[str]:
    """Give fingers pads to touch with, in a robot's description; return the pads' joints.

    A pad is what a finger of a joint of `grips` touches with. It has half of its mass, and gives
    way along the tool's z axis.
    """
    pads = set[str]()
    poses = robot.forward_kinematics(np.clip(0.0, robot.lower, robot.upper)[None])
    tools = np.stack([poses[tool.link][0] @ tool.T_link_tool for tool in robot.tools])
    for joint in [one for one in tree.iterfind('joint') if one.attrib['name'] in grips]:
        name = joint.find('child').attrib['link']  # type: ignore[union-attr]
        link = next(one for one in tree.iterfind('link') if one.attrib['name'] == name)
        shapes, mass = link.findall('collision'), link.find('inertial/mass')
        if not shapes or mass is None:
            continue
        pad, pose = f'{name}_pad', poses[name][0]
        tool = tools[np.linalg.norm(tools[:, :3, 3] - pose[:3, 3], axis=-1).argmin()]
        mass.set('value', str(float(mass.attrib['value']) / 2))
        body = ElementTree.SubElement(tree, 'link', name=pad)
        body.append(copy.deepcopy(link.find('inertial')))  # type: ignore[arg-type]
        for shape in shapes:
            link.remove(shape)
            body.append(shape)
        slide = ElementTree.SubElement(tree, 'joint', name=pad, type='prismatic')
        axis = ' '.join(map(str, pose[:3, :3].T @ tool[:3, 2]))
        for tag, given in (
            ('parent', {'link': name}),
            ('child', {'link': pad}),
            ('axis', {'xyz': axis}),
            ('limit', {'lower': '-1', 'upper': '1', 'effort': '1e9', 'velocity': '1e9'}),
        ):
            ElementTree.SubElement(slide, tag, given)
        pads.add(pad)
    return pads


def _pad(arms: Any, name: str, settings: ContactSettings) -> Any:
    """Return the joint of a pad, which does not give way yet."""
    joint, stiffness = arms.getJoint(name), settings.pad_stiffness or 0.0
    joint.setLimitEnforcement(False)
    joint.setSpringStiffness(0, stiffness)
    joint.setDampingCoefficient(0, stiffness * _PAD_S)
    joint.setActuatorType(_RIGID_PAD)
    return joint


def _skeleton(robot: RobotModel, path: Path, tree: ElementTree.Element) -> tuple[Any, set[str]]:
    """Return robot's bodies, and the links that have an inertia in its description, of a file."""
    loader = dart.utils.DartLoader()
    options = loader.getOptions()
    options.mDefaultRootJointType = dart.utils.DartLoaderRootJointType.FIXED
    loader.setOptions(options)
    for joint in tree.iterfind('joint/mimic/..'):  # each finger swings by itself
        joint.remove(joint.find('mimic'))  # type: ignore[arg-type]
    text = ElementTree.tostring(tree, encoding='unicode')
    skeleton = loader.parseSkeletonString(text, dart.common.Uri(path.resolve().as_uri()))
    if skeleton is None:
        raise RobotError(f"'{path}' cannot be read as rigid bodies; see the lines before")
    if skeleton.getRootBodyNode().getName() != robot.base_link:
        raise RobotError(
            f"base link '{robot.base_link}' of robot '{robot.name}' must be its URDF's root "
            f"'{skeleton.getRootBodyNode().getName()}' for contact to be computed"
        )
    described = tree.iterfind('link/inertial/..')
    return skeleton, {link.attrib['name'] for link in described}


def _described(path: Path) -> ElementTree.Element:
    """Return a URDF without its visual shapes.

    Raises:
        RobotError: it has collision meshes; the engine finds no contacts of meshes.
    """
    tree = parse_xml(read_text(path, 'urdf_bytes'))
    for link in tree.iterfind('link'):
        for look in link.findall('visual'):
            link.remove(look)
    mesh = tree.find('link/collision/geometry/mesh')
    if mesh is not None:
        raise RobotError(
            f"'{path}': '{mesh.get('filename')}' is a mesh; the engine dart takes box, cylinder, "
            'capsule and sphere as collision shapes'
        )
    return tree


def _add_drive(joint: Any, armature: float, *, is_finger: bool) -> None:
    """Give a joint's body the inertia of its drive; only fingers have stops."""
    body = joint.getChildBodyNode()
    if 'Prismatic' in joint.getType():
        body.setMass(body.getMass() + armature)
    else:
        axis = np.asarray(joint.getAxis())
        inertia = np.asarray(body.getInertia().getMoment()) + armature * np.outer(axis, axis)
        _set_inertia(body, inertia)
    joint.setVelocityLowerLimit(0, -np.inf)
    joint.setVelocityUpperLimit(0, np.inf)
    joint.setForceLowerLimit(0, -np.inf)
    joint.setForceUpperLimit(0, np.inf)
    joint.setLimitEnforcement(is_finger)


def _settle(
    skeleton: Any, described: set[str], fingers: set[str], settings: ContactSettings
) -> None:
    """Remove the weight of all links, which drives carry, and set their friction."""
    for number in range(skeleton.getNumBodyNodes()):
        body = skeleton.getBodyNode(number)
        body.setGravityMode(False)
        if body.getName() not in described:
            body.setMass(1e-4)
            body.setMomentOfInertia(1e-7, 1e-7, 1e-7)
        is_finger = body.getParentJoint().getName() in fingers
        friction = settings.grip_friction if is_finger else settings.table_friction
        for node in map(body.getShapeNode, range(body.getNumShapeNodes())):
            node.setShape(_boxed(node.getShape()))
            if not body.getNumDependentGenCoords() and node.getCollisionAspect():
                node.removeCollisionAspect()  # it stands on the table
            aspect = node.getDynamicsAspect()
            if aspect is not None:
                aspect.setFrictionCoeff(friction)


def _table(settings: ContactSettings) -> Any:
    skeleton = dart.dynamics.Skeleton('table')
    _, body = skeleton.createWeldJointAndBodyNodePair()
    pose = np.eye(4)
    pose[2, 3] = settings.table_m - _TABLE_M[2]
    _add_part(body, _Part(size=_TABLE_M, pose=pose, mass=1.0), settings.table_friction)
    return skeleton


def _body(number: int, solid: Solid, settings: ContactSettings, given: float) -> Any:
    """Return a solid of a mass [kg], as it stands."""
    skeleton = dart.dynamics.Skeleton(f'object {number}')
    joint, body = skeleton.createFreeJointAndBodyNodePair()
    parts = _parts(solid, settings)
    mass = sum(part.mass for part in parts)
    middle = sum(part.mass * part.pose[:3, 3] for part in parts) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        _add_part(body, part, settings.table_friction)
        turn, arm = part.pose[:3, :3], part.pose[:3, 3] - middle
        inertia += turn @ part.inertia @ turn.T
        inertia += part.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    share = given / mass
    body.setMass(share * mass)
    body.setLocalCOM(middle)
    _set_inertia(body, share * inertia)
    pose = _turned(solid.yaw)
    pose[:3, 3] = solid.centre
    skeleton.setPositions(dart.dynamics.FreeJoint.convertToPositions(dart.math.Isometry3(pose)))
    return skeleton


def _add_part(body: Any, part: _Part, friction: float) -> None:
    node = body.createShapeNode(dart.dynamics.BoxShape(2 * np.array(part.size)))
    node.createCollisionAspect()
    node.createDynamicsAspect().setFrictionCoeff(friction)
    node.setRelativeTransform(dart.math.Isometry3(part.pose))


def _set_inertia(body: Any, inertia: FloatArray) -> None:
    I = inertia  # noqa: E741
    body.setMomentOfInertia(I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2])


def _parts(solid: Solid, settings: ContactSettings) -> list[_Part]:
    wide, long, high = map(float, solid.size)
    across = min(wide, long)
    if across > _MIN_HOLLOW_WIDTH_M and across > _MIN_HOLLOW_ASPECT * high:
        if not solid.is_round:
            return _tray(wide, long, high, settings)
        return _vessel(wide, high, settings.rim_m, settings.density)
    if solid.is_open and solid.is_round:
        return _vessel(wide, high, settings.wall_m, settings.density)
    volume = wide * long * high * (np.pi / 4 if solid.is_round else 1.0)
    mass = max(volume * settings.density, _MIN_MASS_KG)
    if not solid.is_round:
        return [_Part(size=(wide / 2, long / 2, high / 2), pose=np.eye(4), mass=mass)]
    return _prism(wide, high, 0.0, mass)


def _prism(wide: float, high: float, middle: float, mass: float) -> list[_Part]:
    """Return the boxes through one axis, which are round together; at a height of their middle.

    They stand on one box within the round, which makes few contacts.
    """
    sides, within = _NUM_PRISM_SIDES // 2, wide / 2 * np.sqrt(0.5)
    size = (wide / 2, wide / 2 * float(np.tan(np.pi / _NUM_PRISM_SIDES)), high / 2 - _LIFT_M)
    turns = [_turned(k * np.pi / sides) for k in range(sides)]
    at = _shifted(0.0, 0.0, middle)
    return [
        _Part(size=(within, within, high / 2), pose=at, mass=mass / 2),
        *(_Part(size=size, pose=turn @ at, mass=mass / 2 / sides) for turn in turns),
    ]


def _vessel(wide: float, high: float, rim: float, density: float) -> list[_Part]:
    """Round and open at the top."""
    middle, half = (wide - rim) / 2, (high - _LIFT_M) / 2
    length = middle * np.tan(np.pi / _NUM_PRISM_SIDES) * 1.02
    mass = np.pi * middle**2 * _FLOOR_M * density
    wall = (rim / 2, float(length), half)
    wall_mass = 8 * float(np.prod(wall)) * density
    turns = [_turned(k * 2 * np.pi / _NUM_PRISM_SIDES) for k in range(_NUM_PRISM_SIDES)]
    return [
        *_prism(2 * middle, _FLOOR_M, (_FLOOR_M - high) / 2, mass),
        *(
            _Part(size=wall, pose=turn @ _shifted(middle, 0.0, _LIFT_M / 2), mass=wall_mass)
            for turn in turns
        ),
    ]


def _tray(wide: float, long: float, high: float, settings: ContactSettings) -> list[_Part]:
    """Return a box without a lid; it is heavy below."""
    x, y, half, wall = wide / 2, long / 2, (high - _LIFT_M) / 2, settings.wall_m / 2
    walls = (
        ((wall, y, half), (x - wall, 0.0)),
        ((wall, y, half), (wall - x, 0.0)),
        ((x, wall, half), (0.0, y - wall)),
        ((x, wall, half), (0.0, wall - y)),
    )
    floor = _shifted(0.0, 0.0, (_FLOOR_M - high) / 2)
    return [
        _Part(size=(x, y, _FLOOR_M / 2), pose=floor, mass=0.9 * settings.tray_kg),
        *(
            _Part(size=size, pose=_shifted(*at, _LIFT_M / 2), mass=0.025 * settings.tray_kg)
            for size, at in walls
        ),
    ]


def _turned(yaw: float) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = about_z(yaw)
    return pose


def _shifted(x: float, y: float, z: float) -> FloatArray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose
