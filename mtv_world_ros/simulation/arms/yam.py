"""The YAM arms as MJCF: `config/mjcf/yam_arm.xml`, their fingers and gains."""

from __future__ import annotations

from mtv_world_ros.core.files import share_path
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.simulation.arms.actuator import Actuator

#: name of the robot that this is
YAM = 'yam_bimanual'
ARMS = ('left', 'right')
#: arm bases in the base frame [m]; both are turned +90 degrees about z, so they reach to +y
_BASE_POSITIONS = {'left': (-0.28, 0.0, 0.0), 'right': (0.28, 0.0, 0.0)}
#: width of a finger [m]
FINGER_WIDTH_M = 0.015
#: thickness of a finger, along its travel [m]
FINGER_THICKNESS_M = 0.01

#: RGBA colour of the light parts
_LIGHT = '0.62 0.62 0.63 1'
#: RGBA colour of the dark parts
_DARK = '0.16 0.16 0.17 1'
#: kp [N m/rad], kv [N m s/rad] and largest torque [N m] of joints 1 to 3
_SHOULDER = (40, 2.5, 28)
#: the same quantities of joints 4 and 5
_ELBOW = (20, 1.0, 10)
#: the same quantities of the last joint
_WRIST = (10, 0.5, 10)
#: the same quantities by joint, 1 to 6
_GAINS = (_SHOULDER, _SHOULDER, _SHOULDER, _ELBOW, _ELBOW, _WRIST)
#: mass of a finger [kg]
FINGER_MASS = 0.118
#: position gain of a finger's drive [N/m]
FINGER_KP = 100.0
#: velocity gain of a finger's drive [N s/m]
FINGER_KV = 10.0
#: largest force of a finger's drive [N]
FINGER_FORCE = 20.0
#: limits of the finger joint [m]
_FINGER_RANGE = (-0.00205, 0.037524)
_FINGER_BASES = {'left': (-0.037, 0.0392, 0.0605), 'right': (0.037, -0.0392, 0.0605)}


def _finger_xml(arm: str, side: str, closed: float) -> str:
    """Return one finger; its pad's inner face meets the tool axis at the joint value `closed`."""
    x, y, z = _FINGER_BASES[side]
    sign = 1.0 if side == 'left' else -1.0
    closes_upwards = closed > sum(_FINGER_RANGE) / 2
    # finger axes in link_6: x is -z, y is y, z is x
    face = -(x + sign * closed)
    outward = -sign if closes_upwards else sign
    thickness = FINGER_THICKNESS_M / 2
    low, high = _FINGER_RANGE if side == 'left' else (-_FINGER_RANGE[1], -_FINGER_RANGE[0])
    pad = f'{z - 0.110:.4f} {-y:.4f} {face + outward * thickness:.5f}'
    rail = f'{z - 0.074:.4f} {-y:.4f} {face + outward * 0.008:.5f}'
    return f"""
      <body name="{arm}_{side}_finger" pos="{x} {y} {z}" quat="1 0 1 0" gravcomp="1">
        <joint name="{arm}_{side}_finger" type="slide" axis="0 0 1" range="{low} {high}"
               armature="0.05"/>
        <geom class="{arm}_pad" mass="{FINGER_MASS}" type="box" pos="{pad}"
              size="0.035 {FINGER_WIDTH_M / 2} {thickness}" rgba="{_LIGHT}"/>
        <geom class="{arm}_arm" mass="0" type="box" pos="{rail}" size="0.008 0.014 0.008"
              rgba="{_DARK}"/>
      </body>"""


def arm_xml(arm: str, robot: RobotModel) -> str:
    """Return the MJCF body tree of one arm (`left` or `right`), base included.

    The finger pads are placed so that they meet at the robot's closed gripper value.
    """
    tool = next(tool for tool in robot.tools if tool.arm == arm)
    x, y, z = _BASE_POSITIONS[arm]
    fingers = ''.join(_finger_xml(arm, side, tool.gripper_closed) for side in ('left', 'right'))
    text = share_path('config', 'mjcf', 'yam_arm.xml').read_text(encoding='utf-8')
    return text.format(arm=arm, base=f'{x} {y} {z}', fingers=fingers)


def actuators() -> tuple[Actuator, ...]:
    """Return the actuators of both arms: joints 1-6, left finger, right finger."""
    return tuple(
        actuator for number, arm in enumerate(ARMS) for actuator in _actuators(arm, 7 * number)
    )


def _actuators(arm: str, first: int) -> list[Actuator]:
    joints = [
        Actuator(
            joint=f'{arm}_joint{number + 1}',
            column=first + number,
            kp=kp,
            kv=kv,
            max_force=max_torque,
        )
        for number, (kp, kv, max_torque) in enumerate(_GAINS)
    ]
    fingers = [
        Actuator(
            joint=f'{arm}_{side}_finger',
            column=first + len(_GAINS),
            multiplier=sign,
            kp=FINGER_KP,
            kv=FINGER_KV,
            max_force=FINGER_FORCE,
        )
        for side, sign in (('left', 1.0), ('right', -1.0))
    ]
    return [*joints, *fingers]
