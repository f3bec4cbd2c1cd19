#!/usr/bin/env bash
# MuJoCo 4.0.0 and Pinocchio 4.1.0 read a URDF joint without stops as opposites.
#
# A revolute joint whose <limit> has effort and velocity only (lower and upper are optional and
# mean 0). Expected: the same joint from both. What happens: Pinocchio holds it at 0 .. 0, so that
# a check of limits refuses every motion; MuJoCo makes it turn without end.
#
# Guards mtv_world_ros/robot/file.py, which reads joints without stops itself.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check mujoco==4.0.0 pin==4.1.0
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import mujoco
import pinocchio

URDF = '''<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit effort="1" velocity="1"/></joint></robot>'''
of_mujoco = bool(mujoco.MjModel.from_xml_string(URDF).jnt_limited[0])
model = pinocchio.buildModelFromXML(URDF)
of_pinocchio = (float(model.lowerPositionLimit[0]), float(model.upperPositionLimit[0]))
print('MuJoCo: limited =', of_mujoco, '| Pinocchio: limits =', of_pinocchio)
assert not of_mujoco and of_pinocchio == (0.0, 0.0), 'changed'
PYTHON
