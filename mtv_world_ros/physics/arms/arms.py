"""A robot's arms as bodies of MuJoCo, and the drives that follow commands.

Shape letters: J joints of the robot, D degrees of freedom of the arms, A arms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.physics.arms.arm_response import ArmResponse
from mtv_world_ros.physics.arms.robot_parts import load_parts, Part, with_inertias
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.mujoco_import import mujoco
from mtv_world_ros.robot.model import RobotModel

#: what can touch what: solids are bit 0, each arm has a bit of its own
SOLIDS = 1
#: bit of solids that arms pass through
PASSED = 1 << 30
#: natural frequency of the drive of a joint that was not fitted [rad/s]
DEFAULT_FREQUENCY_RAD_S = 40.0
#: damping time of the drive of a joint that was not fitted [s]
DEFAULT_DAMPING_S = 0.05
#: largest stiffness of the drive of a finger that was not fitted [N/m]
MAX_FINGER_STIFFNESS_N_M = 1000.0
#: smallest travel of a gripping finger per unit of its joint [m]
MIN_FINGER_TRAVEL_M = 1e-4
#: radius of the patch in which a finger touches; it resists turning [m]
PATCH_M = 0.01
_SHAPES = {
    'box': mujoco.mjtGeom.mjGEOM_BOX,
    'cylinder': mujoco.mjtGeom.mjGEOM_CYLINDER,
    'sphere': mujoco.mjtGeom.mjGEOM_SPHERE,
    'hull': mujoco.mjtGeom.mjGEOM_MESH,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Drives:
    """Coupling of D degrees of freedom to joints: each is `multiplier * joint + offset`.

    Attributes:
        names: names of the degrees of freedom.
        columns: (D,) indices of the robot's joints that they follow.
        multipliers: (D,) factors of those joints.
        offsets: (D,) offsets [rad or m].
        fingers: (D,) whether they move a finger.
        travels: (D,) travel of a finger's tip for a unit of the degree of freedom [m per rad or
            m]; 0 = no finger.
        stiffness: (D,) stiffness [N m/rad or N/m].
        damping: (D,) damping [N m s/rad or N s/m].
        armature: (D,) armature [kg m^2 or kg].
        lead: (D,) time of the velocity feed-forward [s].
    """

    names: tuple[str, ...]
    columns: np.ndarray
    multipliers: FloatArray
    offsets: FloatArray
    fingers: BoolArray
    travels: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    armature: FloatArray
    lead: FloatArray

    def spread(self, positions: FloatArray) -> FloatArray:
        """Return the degrees of freedom (..., D) that belong to joint positions (..., J)."""
        return positions[..., self.columns] * self.multipliers + self.offsets

    def joints(self, values: FloatArray, count: int) -> FloatArray:
        """Return joint positions (..., J), the means over their degrees of freedom (..., D)."""
        single = (values - self.offsets) / self.multipliers
        sums = np.zeros((*values.shape[:-1], count))
        np.add.at(np.moveaxis(sums, -1, 0), self.columns, np.moveaxis(single, -1, 0))
        return sums / np.bincount(self.columns, minlength=count)


class Arms:
    """Bodies, shapes and drives of a robot, for MuJoCo scenes.

    Args:
        robot: robot with any number of arms; its base stands still.
        response: fitted response of the joints to their commands; None = not fitted yet.

    Attributes:
        robot: robot with inertias for all of its bodies.
        response: response of the joints.
        notes: assumptions about the robot, as text.
        drives: drives of its joints, with the numbers of free air.

    Raises:
        RobotError: the robot is no tree of bodies on a fixed base.
    """

    def __init__(self, robot: RobotModel, response: ArmResponse | None) -> None:
        found = load_parts(robot)
        self.robot, assumed = with_inertias(robot, found.parts)
        self.response = response
        self._model = self.robot.pinocchio_model
        self._frames = {f.name: f for f in self._model.frames if f.type == pin.FrameType.BODY}
        base = self._frames[robot.base_link]
        if base.parentJoint:
            raise RobotError(
                f"base link '{robot.base_link}' of robot '{robot.name}' is moved by a joint; "
                'contact needs one that stands still'
            )
        self._T_base_world = base.placement.inverse()
        self._parts: dict[int, list[Part]] = {}
        for part in found.parts:
            self._parts.setdefault(self._frames[part.link].parentJoint, []).append(part)
        self._check_grippers()
        self.drives, unknown = self._drives(response)
        self.notes = (*found.notes, *assumed, *unknown)

    @property
    def arm_of(self) -> dict[int, int]:
        """Pinocchio joint -> number of its arm: what hangs on the same first joint is one."""
        supports = {j: list(self._model.supports[j]) for j in range(1, self._model.njoints)}
        firsts = sorted({chain[1] for chain in supports.values() if self._moves_any(chain)})
        return {j: firsts.index(c[1]) for j, c in supports.items() if c[1] in firsts}

    def add_to(self, spec: Any) -> None:
        """Add bodies, shapes and drives to an `MjSpec` whose world is the robot's base link."""
        arm_of = self.arm_of
        bits = [2 << arm for arm in range(len(set(arm_of.values())))]
        bodies = {0: spec.worldbody}
        for joint in range(1, self._model.njoints):
            parent = self._model.parents[joint]
            placement = self._model.jointPlacements[joint]
            if parent == 0:
                placement = self._T_base_world * placement
            body = bodies[joint] = bodies[parent].add_body(name=self._model.names[joint])
            _place(body, placement.homogeneous)
            self._add_joint(body, joint)
            _add_inertia(body, self._model.inertias[joint])
        for joint, parts in self._parts.items():
            arm = arm_of.get(joint)
            # what stands still touches solids alone
            own, touches = (0, SOLIDS | PASSED) if arm is None else (
                bits[arm], SOLIDS + sum(bits) - bits[arm]
            )  # fmt: skip
            for number, part in enumerate(parts):
                geom = self._add_part(spec, bodies[joint], part)
                geom.name = f'{part.link}/{number}'
                geom.contype, geom.conaffinity = own, touches
                if self._is_finger(joint, part.link):
                    geom.priority, geom.condim = 1, 4
        for name in self.drives.names:
            actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_position(kp=1.0, kv=1.0)
        self._add_gears(spec)

    def finger_dofs(self) -> list[list[int]]:
        """Return the degrees of freedom that move the fingers of each arm's tool, as indices."""
        names, found = self.robot.joint_names, []
        for tool in self.robot.tools:
            column = -1 if tool.gripper_joint is None else names.index(tool.gripper_joint)
            found.append(list(np.flatnonzero(self.drives.columns == column)))
        return found

    def _moves_any(self, chain: Sequence[int]) -> bool:
        return any(self._model.names[j] in self._followers for j in chain[1:])

    @property
    def _followers(self) -> dict[str, tuple[str, float, float]]:
        """Joint of the description -> joint of the robot that it follows, and how."""
        robot = self.robot
        found = {name: (name, 1.0, 0.0) for name in robot.joint_names}
        return found | {m.joint: (m.source, m.multiplier, m.offset) for m in robot.mimics}

    def _add_joint(self, body: Any, number: int) -> None:
        name = self._model.names[number]
        if name not in self._followers:
            return  # it rests
        joint = self._model.joints[number]
        data = joint.createData()
        joint.calc(data, pin.neutral(self._model), np.ones(self._model.nv))
        slides = bool(np.any(data.v.linear))
        kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
        axis = data.v.linear if slides else data.v.angular
        added = body.add_joint(name=name, type=kind, axis=axis)
        source = self._followers[name][0]
        if source in finger_travels(self.robot) and joint.nq == 1:
            model = self._model
            low, high = (
                model.lowerPositionLimit[joint.idx_q],
                model.upperPositionLimit[joint.idx_q],
            )
            if np.isfinite([low, high]).all() and low < high:
                added.range, added.limited = (low, high), mujoco.mjtLimited.mjLIMITED_TRUE

    def _add_part(self, spec: Any, body: Any, part: Part) -> Any:
        frame = self._frames[part.link]
        placement = frame.placement
        if frame.parentJoint == 0:
            placement = self._T_base_world * placement
        geom = body.add_geom(type=_SHAPES[part.kind], density=0.0)
        _place(geom, placement.homogeneous @ part.pose)
        if part.kind != 'hull':
            geom.size[: len(part.size)] = part.size
            return geom
        name = f'hull {len(spec.meshes)}'
        mesh = spec.add_mesh(name=name, uservert=np.ravel(part.points))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        geom.meshname = name
        return geom

    def _is_finger(self, joint: int, link: str) -> bool:
        """Return whether a part touches with the friction of grips.

        Those that a gripper's joints move; of a gripper that moves one jaw the hand is the other.
        """
        for tool, dofs in zip(self.robot.tools, self.finger_dofs(), strict=True):
            moved = {self.drives.names[dof] for dof in dofs}
            if any(self._model.names[j] in moved for j in self._model.supports[joint]):
                return True
            if len(moved) == 1 and self._frames[tool.link].parentJoint == joint and joint:
                return True
        return False

    def _add_gears(self, spec: Any) -> None:
        """Hold the fingers that follow one joint together; left out where they swing."""
        drives = self.drives
        for column in np.unique(drives.columns[drives.fingers]):
            first, *others = np.flatnonzero(drives.columns == column)
            for other in others:
                ratio = drives.multipliers[other] / drives.multipliers[first]
                offset = drives.offsets[other] - ratio * drives.offsets[first]
                equality = spec.add_equality(
                    type=mujoco.mjtEq.mjEQ_JOINT,
                    name1=drives.names[other],
                    name2=drives.names[first],
                )
                equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
                equality.data[:5] = offset, ratio, 0.0, 0.0, 0.0

    def _check_grippers(self) -> None:
        for tool in self.robot.tools:
            if tool.gripper_joint is None:
                continue
            moved = {tool.gripper_joint}
            moved |= {m.joint for m in self.robot.mimics if m.source == tool.gripper_joint}
            joints = [self._model.getJointId(name) for name in moved]
            shown = [j for j in self._parts if set(self._model.supports[j]) & set(joints)]
            if not shown:
                raise RobotError(
                    f"the gripper of arm '{tool.arm}' of robot '{self.robot.name}' has no part "
                    f"that its joint '{tool.gripper_joint}' moves; give its fingers collision "
                    "shapes in the URDF, or name the right 'gripper_joint' in the robot's file"
                )

    def _drives(self, response: ArmResponse | None) -> tuple[Drives, tuple[str, ...]]:
        robot, model = self.robot, self._model
        mass = np.diag(self._mass())
        followers, travels = self._followers, finger_travels(robot)
        names = [n for n in model.names[1:] if n in followers]
        columns = np.array([robot.joint_names.index(followers[n][0]) for n in names])
        count = np.bincount(columns, minlength=len(robot.joint_names))
        multipliers = np.array([followers[n][1] for n in names])
        unit = {
            'stiffness': DEFAULT_FREQUENCY_RAD_S**2 * mass,
            'damping': DEFAULT_FREQUENCY_RAD_S**2 * mass * DEFAULT_DAMPING_S,
            'armature': np.zeros(len(mass)),
            'lead': np.full(len(mass), DEFAULT_DAMPING_S),
        }
        for joint, way in travels.items():
            column = robot.joint_names.index(joint)
            effort = model.effortLimit[model.joints[model.getJointId(joint)].idx_v]
            stiffness = 2 * effort / (robot.upper[column] - robot.lower[column])
            if np.isfinite(stiffness) and stiffness > 0:  # largest force at half the travel
                stiffness = min(stiffness, 2 * MAX_FINGER_STIFFNESS_N_M * way**2)
                unit['stiffness'][column] = stiffness
                unit['damping'][column] = stiffness * DEFAULT_DAMPING_S
                unit['armature'][column] = stiffness / DEFAULT_FREQUENCY_RAD_S**2
        known = np.zeros(len(mass), np.bool_)
        if response is not None:
            known = response.compliance > 0
            stiffness = 1 / np.where(known, response.compliance, 1.0)
            found = {
                'stiffness': stiffness,
                'damping': stiffness * response.damping,
                'armature': stiffness * response.armature,
                'lead': response.lead,
            }
            unit = {key: np.where(known, found[key], unit[key]) for key in unit}
        share = 1 / count[columns] / multipliers**2
        numbers = {
            key: values[columns] * (1.0 if key == 'lead' else share)
            for key, values in unit.items()
        }
        way = np.array([travels.get(followers[n][0], 0.0) for n in names]) / multipliers
        drives = Drives(
            names=tuple(names),
            columns=columns,
            multipliers=multipliers,
            offsets=np.array([followers[n][2] for n in names]),
            fingers=np.abs(way) > MIN_FINGER_TRAVEL_M,
            travels=way,
            **numbers,
        )
        unknown = [robot.joint_names[j] for j in np.flatnonzero(~known)]
        note = (
            f'how {len(unknown)} joints follow commands was not found '
            f'({", ".join(unknown[:2])}, ...): they are taken to follow within '
            f'{DEFAULT_DAMPING_S:g} s'
        )
        return drives, (note,) if unknown else ()

    def _mass(self) -> FloatArray:
        """Return (J, J) mass matrix in the middle of the joints' ranges."""
        robot, model = self.robot, self._model
        ends = np.stack([robot.lower, robot.upper])
        middle = np.where(np.isfinite(ends).all(0), ends, 0.0).mean(0)
        q = robot.configurations(middle[None])[0]
        follows = robot.joint_motions
        return follows.T @ pin.crba(model, model.createData(), q) @ follows


def set_drives(
    model: Any, drives: Drives, settings: ContactSettings, rows: np.ndarray, dofs: np.ndarray
) -> None:
    """Write drive parameters into a model; fingers get their fitted ones.

    Args:
        model: model of a scene with these drives.
        drives: drives of the D degrees of freedom.
        settings: settings of contact.
        rows: (D,) indices of the actuators.
        dofs: (D,) indices of the velocities in qvel.
    """
    way = drives.travels**2
    count = np.bincount(drives.columns)[drives.columns]
    # of a finger of several joints each has its share
    share = way * 2 / np.maximum(count, 2)
    fingers = drives.fingers
    stiffness = np.where(fingers, settings.finger_stiffness * share, drives.stiffness)
    damping = np.where(fingers, settings.finger_damping * share, drives.damping)
    armature = np.where(fingers, settings.finger_mass_kg * share, drives.armature)
    model.actuator_gainprm[rows, 0] = stiffness
    model.actuator_biasprm[rows, 1] = -stiffness
    model.actuator_biasprm[rows, 2] = -damping
    model.dof_armature[dofs] = armature


def finger_travels(robot: RobotModel) -> dict[str, float]:
    """Return the travel of a finger per unit of its gripper joint, by joint [m / m or m / rad]."""
    ends = np.zeros((2, len(robot.joint_names)))
    travels = {}
    for tool, name in enumerate(tool.gripper_joint for tool in robot.tools):
        if name is None:
            continue
        column = robot.joint_names.index(name)
        ends[:, column] = robot.tools[tool].gripper_closed, robot.tools[tool].gripper_open
        shut, wide = robot.finger_gaps(ends)[:, tool]
        travels[name] = float((wide - shut) / (ends[1, column] - ends[0, column]))
    return travels


def _place(item: Any, pose: FloatArray) -> None:
    x, y, z, w = pin.Quaternion(np.ascontiguousarray(pose[:3, :3])).coeffs()
    item.pos, item.quat = pose[:3, 3], (w, x, y, z)


def _add_inertia(body: Any, inertia: pin.Inertia) -> None:
    moment = inertia.inertia
    body.explicitinertial, body.gravcomp = True, 1.0
    body.mass, body.ipos = max(inertia.mass, 1e-6), inertia.lever
    body.fullinertia = [
        moment[0, 0], moment[1, 1], moment[2, 2], moment[0, 1], moment[0, 2], moment[1, 2]
    ]  # fmt: skip
