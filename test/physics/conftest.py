"""A hand that slides up and down, with two fingers that are geared or swing."""

from __future__ import annotations

from pathlib import Path

import pytest

from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel

FINGER = """
  <link name="{name}">
    <inertial><mass value="0.05"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5"
      ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 {face} 0"/><geometry><box size="0.02 0.01 0.03"/></geometry>
    </collision>
  </link>
  <joint name="{name}" type="prismatic">
    <parent link="hand"/><child link="{name}"/><axis xyz="0 {side} 0"/>
    <limit lower="0" upper="0.04" effort="10" velocity="1"/>{mimic}
  </joint>"""
LIFT = """<robot name="lift">
  <link name="base"/>
  <link name="hand">
    <inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01"
      ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.1"/><geometry><box size="0.05 0.1 0.02"/></geometry></collision>
  </link>
  <joint name="lift" type="prismatic">
    <parent link="base"/><child link="hand"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.5" effort="100" velocity="1"/>
  </joint>{fingers}
</robot>"""
ROBOT = """name: lift
urdf: lift.urdf
base_link: base
joints: [lift, left]
tools:
  - {arm: arm, link: hand, gripper_joint: left, gripper_closed: 0.0, gripper_open: 0.04,
     finger_travel_m: 0.04}
"""


def write_lift(folder: Path) -> Path:
    """Write the robot; return its file."""
    mimic = '<mimic joint="left" multiplier="1"/>'
    fingers = FINGER.format(name='left', side=1, face=0.005, mimic='') + FINGER.format(
        name='right', side=-1, face=-0.005, mimic=mimic
    )
    (folder / 'lift.urdf').write_text(LIFT.format(fingers=fingers))
    (folder / 'lift.yaml').write_text(ROBOT)
    return folder / 'lift.yaml'


@pytest.fixture(scope='session')
def lift(tmp_path_factory) -> RobotModel:
    return load_robot(write_lift(tmp_path_factory.mktemp('lift')))
