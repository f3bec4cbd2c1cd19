"""The second engine as a scene's truth: its bodies and drives, with the numbers of the first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TYPE_CHECKING

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.core.errors import SimulatorError
from mtv_world_ros.core.extras import needs_text
from mtv_world_ros.physics.arms.arm_response import ArmResponse
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.arms.actuator import Actuator
from mtv_world_ros.simulation.scenes.scene import Scene, SceneObject
from mtv_world_ros.simulation.scenes.shapes import CONTAINER_KG, RIM_M, shape_named, WALL_M

if TYPE_CHECKING:
    from mtv_world_ros.simulation.dart.stepped_world import SteppedWorld

#: stiffness of finger tips [N/m]
_PAD_STIFFNESS_N_M = 1e4
#: density of solids without a stated mass [kg/m3]
_DENSITY_KG_M3 = 300.0
#: shapes with equal length and width that are not round
_SQUARE = frozenset({'block'})


def second_engine(
    model: Any,
    scene: Scene,
    robot: RobotModel,
    actuators: Sequence[Actuator],
    home: FloatArray,
) -> SteppedWorld:
    """Return a scene as rigid bodies of DART.

    Args:
        model: the compiled `MjModel` of the scene, whose gains, masses and friction these are.
        scene: whose objects these are.
        robot: robot from a URDF with inertias.
        actuators: actuators of its joints.
        home: (J,) rest positions of the joints [rad or m].

    Raises:
        SimulatorError: DART is not installed.
        RobotError: the robot cannot be a tree of rigid bodies.
    """
    try:
        from mtv_world_ros.simulation.dart.stepped_world import SteppedWorld
    except ImportError as error:
        raise SimulatorError(
            needs_text('the engine dart', 'dartpy', instead='choose another --physics')
        ) from error
    masses = [float(model.body(item.role).mass[0]) for item in scene.objects]
    solids = [_solid(item) for item in scene.objects]
    settings = _settings(model, scene, robot, actuators)
    return SteppedWorld(robot, _response(model, robot, actuators), settings, solids, masses, home)


def _solid(item: SceneObject) -> Solid:
    """Return a box or an upright cylinder in place of an object, as long, wide and high."""
    x, y, _ = item.size
    return Solid(
        centre=np.array(item.position),
        size=np.array(item.size),
        yaw=item.yaw,
        is_round=x == y and item.shape not in _SQUARE,
        is_open=shape_named(item.shape).hollow or item.shape == 'cup',
    )


def _response(model: Any, robot: RobotModel, actuators: Sequence[Actuator]) -> ArmResponse:
    """Response of the joints by their gains; gains of the fingers of one joint add up."""
    gain, armature, damping, lead = np.zeros((4, len(robot.joint_names)))
    for number, actuator in enumerate(actuators):
        column, share = actuator.column, actuator.multiplier**2
        dof = int(model.joint(actuator.joint).dofadr[0])
        kv = -float(model.actuator_biasprm[number, 2])
        gain[column] += share * float(model.actuator_gainprm[number, 0])
        armature[column] += share * float(model.dof_armature[dof])
        damping[column] += share * (kv + float(model.dof_damping[dof]))
        # as `SimEpisode.advance` feeds velocities forward
        lead[column] = actuator.kv / actuator.kp
    return ArmResponse(
        joint_names=robot.joint_names,
        compliance=1 / gain,
        armature=armature / gain,
        damping=damping / gain,
        lead=lead,
    )


def _settings(
    model: Any, scene: Scene, robot: RobotModel, actuators: Sequence[Actuator]
) -> ContactSettings:
    grippers = {tool.gripper_joint for tool in robot.tools}
    number = next(
        n for n, one in enumerate(actuators) if robot.joint_names[one.column] in grippers
    )
    joint = model.joint(actuators[number].joint)
    pads = model.geom_bodyid == int(joint.bodyid[0])
    return ContactSettings(
        finger_stiffness=float(model.actuator_gainprm[number, 0]),
        finger_damping=-float(model.actuator_biasprm[number, 2]),
        finger_mass_kg=float(model.dof_armature[int(joint.dofadr[0])]),
        fingers_swing=True,
        pad_stiffness=_PAD_STIFFNESS_N_M,
        grip_friction=float(model.geom_friction[pads, 0].max()),
        table_friction=float(model.geom('table').friction[0]),
        density=_DENSITY_KG_M3,
        tray_kg=CONTAINER_KG,
        rim_m=RIM_M,
        wall_m=WALL_M,
        table_m=scene.table_m,
    )
