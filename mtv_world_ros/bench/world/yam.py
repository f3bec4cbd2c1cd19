"""The YAM arms as MJCF: primitive geoms on the published kinematics, masses and gains."""

from __future__ import annotations

from dataclasses import dataclass

from mtv_world_ros.bench.world.actuator import Actuator
from mtv_world_ros.geometry.robot.model import RobotModel

#: name of the robot that this is
YAM = 'yam_bimanual'
ARMS = ('left', 'right')
#: arm bases in the base frame [m]; both are turned +90 degrees about z, so they reach to +y
_BASE_POSITIONS = {'left': (-0.28, 0.0, 0.0), 'right': (0.28, 0.0, 0.0)}
FINGER_WIDTH_M, FINGER_THICKNESS_M = 0.015, 0.01

_LIGHT, _MID, _DARK = '0.62 0.62 0.63 1', '0.36 0.36 0.38 1', '0.16 0.16 0.17 1'


@dataclass(frozen=True, slots=True)
class Link:
    """One moving body of the arm: frame in its parent, joint, mass and drawn/colliding geoms."""

    position: str
    quaternion: str
    joint_range: tuple[float, float]
    mass: float
    kp: float
    kv: float
    max_torque: float
    geoms: tuple[str, ...]


def _capsule(start: str, end: str, radius: float, rgba: str) -> str:
    return f'type="capsule" fromto="{start} {end}" size="{radius}" rgba="{rgba}"'


def _cylinder(start: str, end: str, radius: float, rgba: str) -> str:
    return f'type="cylinder" fromto="{start} {end}" size="{radius}" rgba="{rgba}"'


def _box(center: str, half_sizes: str, rgba: str) -> str:
    return f'type="box" pos="{center}" size="{half_sizes}" rgba="{rgba}"'


#: kp [N m/rad], kv [N m s/rad] and largest torque [N m] of the joints
_SHOULDER, _ELBOW, _WRIST = (40, 2.5, 28), (20, 1.0, 10), (10, 0.5, 10)

#: links 1-6, wxyz quaternions as published (not normalised); the first geom carries the mass
LINKS = (
    Link('0 0 0.0631', '1 0 0 1', (-2.61799, 3.05433), 0.124, *_SHOULDER,
         geoms=(_cylinder('0 0 -0.02', '0 0 0.03', 0.036, _DARK),)),
    Link('0.000025 -0.02 0.0409', '1 1 1 1', (0, 3.66519), 1.244, *_SHOULDER,
         geoms=(_capsule('0.02 0 0', '0.24 0 0', 0.032, _LIGHT),
                _cylinder('0 0 -0.04', '0 0 0.04', 0.036, _DARK),
                _cylinder('0.264 0 -0.04', '0.264 0 0.04', 0.034, _DARK))),
    Link('0.264 0 0', '0 1 0 0', (0, 3.66519), 0.854, *_SHOULDER,
         geoms=(_capsule('-0.26 -0.06 0', '-0.02 -0.06 0', 0.034, _LIGHT),
                _capsule('0 0 0', '-0.03 -0.06 0', 0.03, _MID))),
    Link('-0.245 -0.06 0', '1 0 0 0', (-1.5708, 1.5708), 0.464, *_ELBOW,
         geoms=(_capsule('0 0 0', '-0.074 -0.0395 0', 0.029, _MID),)),
    Link('-0.074 -0.0395 0.000025', '1 -1 1 1', (-1.5708, 1.5708), 0.351, *_ELBOW,
         geoms=(_capsule('0 0 0', '0 0.0353 0.0395', 0.028, _DARK),)),
    Link('0 0.0353 0.0395', '1 -1 0 0', (-2.0944, 2.0944), 0.367, *_WRIST,
         geoms=(_cylinder('0 0 0', '0 0 0.05', 0.03, _MID),
                _box('0 0 0.06', '0.05 0.02 0.014', _DARK))),
)  # fmt: skip
FINGER_MASS, FINGER_KP, FINGER_KV, FINGER_FORCE = 0.118, 100.0, 10.0, 20.0
_FINGER_RANGE = (-0.00205, 0.037524)
_FINGER_BASES = {'left': (-0.037, 0.0392, 0.0605), 'right': (0.037, -0.0392, 0.0605)}


def _finger_xml(arm: str, side: str, closed: float) -> str:
    """One finger; its pad's inner face meets the tool axis at the joint value `closed`."""
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
        <geom class="{arm}_pad" mass="{FINGER_MASS}"
              {_box(pad, f'0.035 {FINGER_WIDTH_M / 2} {thickness}', _LIGHT)}/>
        <geom class="{arm}_arm" mass="0" {_box(rail, '0.008 0.014 0.008', _DARK)}/>
      </body>"""


def arm_xml(arm: str, robot: RobotModel) -> str:
    """Returns the MJCF body tree of one arm (`left` or `right`), base included.

    The finger pads are placed so that they meet at the robot's closed gripper value.
    """
    tool = next(tool for tool in robot.tools if tool.arm == arm)
    x, y, z = _BASE_POSITIONS[arm]
    pedestal = f'<geom class="{arm}_arm" {_cylinder("0 0 0", "0 0 0.045", 0.05, _DARK)}/>'
    opening = [f'<body name="{arm}_base" pos="{x} {y} {z}" quat="1 0 0 1">{pedestal}']
    for number, link in enumerate(LINKS, 1):
        low, high = link.joint_range
        geoms = ''.join(
            f'<geom class="{arm}_arm" mass="{link.mass if i == 0 else 0}" {geom}/>'
            for i, geom in enumerate(link.geoms)
        )
        opening.append(
            f'<body name="{arm}_link_{number}" pos="{link.position}" quat="{link.quaternion}" '
            f'gravcomp="1"><joint name="{arm}_joint{number}" axis="0 0 1" range="{low} {high}" '
            f'armature="0.03" damping="0.05"/>{geoms}'
        )
    fingers = ''.join(_finger_xml(arm, side, tool.gripper_closed) for side in ('left', 'right'))
    site = f'<site name="{arm}_tool" pos="0 0 0.1347" quat="1 0 0 -1" size="0.002" group="5"/>'
    return ''.join(opening) + site + fingers + '</body>' * len(opening)


def actuators() -> tuple[Actuator, ...]:
    """Returns the actuators of both arms: joints 1-6, left finger, right finger."""
    return tuple(
        actuator for number, arm in enumerate(ARMS) for actuator in _actuators(arm, 7 * number)
    )


def _actuators(arm: str, first: int) -> list[Actuator]:
    joints = [
        Actuator(
            joint=f'{arm}_joint{number + 1}',
            column=first + number,
            kp=link.kp,
            kv=link.kv,
            max_force=link.max_torque,
        )
        for number, link in enumerate(LINKS)
    ]
    fingers = [
        Actuator(
            joint=f'{arm}_{side}_finger',
            column=first + len(LINKS),
            multiplier=sign,
            kp=FINGER_KP,
            kv=FINGER_KV,
            max_force=FINGER_FORCE,
        )
        for side, sign in (('left', 1.0), ('right', -1.0))
    ]
    return [*joints, *fingers]
