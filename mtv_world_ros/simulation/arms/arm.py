"""A robot's arms as MJCF, from its URDF; the YAM has a description of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from mtv_world_ros.core.bounded_input import read_text
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import urdf_path
from mtv_world_ros.simulation.arms import yam
from mtv_world_ros.simulation.arms.actuator import Actuator
from mtv_world_ros.simulation.scenes.cameras import camera_xml


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """Position drives and armatures of joints whose URDF states none.

    Attributes:
        revolute_gain: position gain of a revolute joint, divided by its largest torque [1/rad].
        prismatic_gain: position gain of a prismatic joint, divided by its largest force [1/m].
        damping_s: velocity gain divided by the position gain [s].
        revolute_armature: armature of a revolute joint [kg m2].
        prismatic_armature: armature of a prismatic joint [kg].
    """

    revolute_gain: float = 25.0
    prismatic_gain: float = 10.0
    damping_s: float = 0.1
    revolute_armature: float = 0.1
    prismatic_armature: float = 0.05


_DRIVE = DriveSettings()


def bodies_xml(robot: RobotModel, cameras: Sequence[CameraModel]) -> str:
    """Return the MJCF body trees of all arms, bases and cameras on links included.

    A site `<arm>_tool` stands at each tool centre point.

    Raises:
        SimulatorError: the robot has no URDF, or shapes other than box, cylinder and sphere.
    """
    if robot.name == yam.YAM:
        return ''.join(yam.arm_xml(arm, robot) for arm in yam.ARMS)
    return _UrdfBodies(robot, cameras).xml()


@lru_cache(maxsize=8)
def actuators_of(robot: RobotModel) -> tuple[Actuator, ...]:
    """Return the position actuators of all joints, in the order of the robot's joints.

    Gains follow from the torque and force limits of the URDF; damping is critical or above.
    """
    if robot.name == yam.YAM:
        return yam.actuators()
    model, found = robot.pinocchio_model, []
    for column, name in enumerate(robot.joint_names):
        own = [(name, 1.0, 0.0)]
        followers = [(m.joint, m.multiplier, m.offset) for m in robot.mimics if m.source == name]
        force = float(model.effortLimit[model.joints[model.getJointId(name)].idx_v])
        kp = force * (
            _DRIVE.prismatic_gain
            if _slides(model, model.getJointId(name))
            else _DRIVE.revolute_gain
        )
        found += [
            Actuator(
                joint=joint,
                column=column,
                multiplier=multiplier,
                offset=offset,
                kp=kp,
                kv=kp * _DRIVE.damping_s,
                max_force=force,
            )
            for joint, multiplier, offset in own + followers
        ]
    return tuple(found)


def _slides(model: pin.Model, joint: int) -> bool:
    return model.joints[joint].shortname().startswith('JointModelP')


class _UrdfBodies:
    """One body for each joint of the URDF; links that are fixed to one another are one body."""

    def __init__(self, robot: RobotModel, cameras: Sequence[CameraModel]) -> None:
        self._robot, self._model = robot, robot.pinocchio_model
        self._inside: dict[int, str] = {}
        base = self._model.frames[self._frame(robot.base_link)]
        if base.parentJoint or not base.placement.isIdentity(1e-9):
            raise SimulatorError(
                f"base link '{robot.base_link}' of robot '{robot.name}' must be its URDF's root"
            )
        self._add_shapes()
        for camera in cameras:
            joint, pose = self._placed(camera.mount_link, camera.T_mount_camera)
            self._add(joint, camera_xml(camera, pose))
        for tool in robot.tools:
            joint, pose = self._placed(tool.link, tool.T_link_tool)
            self._add(joint, f'<site name="{tool.arm}_tool" {_at(pose)} size="0.002" group="5"/>')

    def xml(self) -> str:
        """Return what is fixed to the base, and the bodies of its joints."""
        return self._inside.get(0, '') + self._children(0)

    def _children(self, parent: int) -> str:
        joints = range(1, self._model.njoints)
        return ''.join(
            self._body(joint) for joint in joints if self._model.parents[joint] == parent
        )

    def _body(self, number: int) -> str:
        model = self._model
        name, joint = model.names[number], model.joints[number]
        slides = _slides(model, number)
        limits = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
        inside = self._inside.get(number, '') + self._children(number)
        return (
            f'<body name="{name}" {_at(model.jointPlacements[number].homogeneous)} gravcomp="1">'
            f'<joint name="{name}" type="{"slide" if slides else "hinge"}" '
            f'axis="{_axis(model, joint)}" range="{_numbers(limits)}" '
            f'armature="{_DRIVE.prismatic_armature if slides else _DRIVE.revolute_armature}" '
            'damping="0.05"/>'
            f'{inside}</body>'
        )

    def _add_shapes(self) -> None:
        path = urdf_path(self._robot)
        if path is None:
            raise SimulatorError(f"robot '{self._robot.name}' has no URDF to be simulated with")
        text = read_text(path, 'urdf_bytes')
        shapes = pin.buildGeomFromUrdfString(self._model, text, pin.GeometryType.VISUAL)
        for shape in shapes.geometryObjects:
            joint = int(shape.parentJoint)
            colour = _numbers(shape.meshColor)
            self._add(
                joint,
                f'<geom {self._collides(joint)} {_geometry(shape)} '
                f'{_at(shape.placement.homogeneous)} rgba="{colour}"/>',
            )

    def _collides(self, joint: int) -> str:
        """Return the class of a body's geoms; what stands still touches objects alone."""
        if joint == 0:
            return 'contype="0" conaffinity="1"'
        robot, first = self._robot, self._model.supports[joint][1]
        tool = next((t for t in robot.tools if self._first_joint(t.link) == first), robot.tools[0])
        grippers = {tool.gripper_joint} | {
            m.joint for m in robot.mimics if m.source == tool.gripper_joint
        }
        return f'class="{tool.arm}_{"pad" if self._model.names[joint] in grippers else "arm"}"'

    def _first_joint(self, link: str) -> int:
        """Return the number of the joint nearest to the base among those that carry a link."""
        chain = list(self._model.supports[self._placed(link, np.eye(4))[0]])
        return chain[1] if len(chain) > 1 else 0

    def _placed(self, link: str, pose: FloatArray) -> tuple[int, FloatArray]:
        """Return the joint that carries a link, and a pose in the link as one in its body."""
        frame = self._model.frames[self._frame(link)]
        return int(frame.parentJoint), frame.placement.homogeneous @ np.asarray(pose)

    def _frame(self, link: str) -> int:
        return self._model.getFrameId(link, pin.FrameType.BODY)

    def _add(self, joint: int, xml: str) -> None:
        self._inside[joint] = self._inside.get(joint, '') + xml


def _numbers(values: Any) -> str:
    return ' '.join(f'{float(value):.12g}' for value in values)


def _at(pose: FloatArray) -> str:
    x, y, z, w = pin.Quaternion(np.asarray(pose)[:3, :3]).coeffs()
    return f'pos="{_numbers(np.asarray(pose)[:3, 3])}" quat="{_numbers((w, x, y, z))}"'


def _axis(model: pin.Model, joint: pin.JointModel) -> str:
    """Return the joint's own axis, found by moving it."""
    data = joint.createData()
    joint.calc(data, pin.neutral(model), np.ones(model.nv))
    velocity = data.v
    return _numbers(velocity.linear if np.any(velocity.linear) else velocity.angular)


def _geometry(shape: Any) -> str:
    form = shape.geometry
    if isinstance(form, coal.Box):
        return f'type="box" size="{_numbers(form.halfSide)}"'
    if isinstance(form, coal.Cylinder):
        return f'type="cylinder" size="{_numbers((form.radius, form.halfLength))}"'
    if isinstance(form, coal.Sphere):
        return f'type="sphere" size="{_numbers((form.radius,))}"'
    raise SimulatorError(
        f"shape '{shape.name}' is a {type(form).__name__}; the simulator draws box, cylinder and "
        'sphere'
    )
