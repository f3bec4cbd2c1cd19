#!/usr/bin/env bash
# A URDF joint of type planar, whose plane has the normal 1 0 0: four readers, three robots.
#
# URDF says that such a joint moves in the plane perpendicular to its axis. Expected, written down
# before the run: all slide along y and z. What happens: MuJoCo 4.0.0 slides along -z and y and
# turns about x, as said; Pinocchio 4.1.0 and urchin 0.0.30 take no notice of the axis and slide
# along x and y, out of the plane, without a word; yourdfpy 0.0.60 says that the robot has two
# degrees of freedom and then refuses two numbers, as it counts joints.
#
# Guards mtv_world_ros/robot/file.py, in which planar joints rest.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check urchin==0.0.30 \
    yourdfpy==0.0.60 mujoco==4.0.0 pin==4.1.0 numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import mujoco
import numpy as np
import pinocchio
import urchin
import yourdfpy

BODY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
URDF = f'''<robot name="r"><link name="base"/><link name="cart">{BODY}</link>
<joint name="j" type="planar"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/></joint>
</robot>'''
with open('r.urdf', 'w') as file:
    file.write(URDF)

model = mujoco.MjModel.from_xml_string(URDF)
of_mujoco = np.round(model.jnt_axis[:2], 6) + 0.0
kinds = model.jnt_type.tolist()
robot = pinocchio.buildModelFromXML(URDF)
data = robot.createData()
pinocchio.forwardKinematics(robot, data, np.array([0.1, 0.2, 1.0, 0.0]))
of_pinocchio = data.oMi[1].translation.round(6).tolist()
cart = urchin.URDF.load('r.urdf')
of_urchin = cart.link_fk({'j': np.array([0.1, 0.2])})[cart.links[1]][:3, 3].round(6).tolist()
other = yourdfpy.URDF.load('r.urdf')
try:
    other.update_cfg(np.array([0.1, 0.2]))
    of_yourdfpy = 'placed'
except ValueError as error:
    of_yourdfpy = f'refused: {error}'
print('MuJoCo slides along', of_mujoco.tolist(), 'and turns about', model.jnt_axis[2].round(6).tolist())
print('Pinocchio, at .1 and .2:', of_pinocchio)
print('urchin, at .1 and .2:   ', of_urchin)
print('yourdfpy:', other.num_dofs, 'degrees of freedom; two numbers are', of_yourdfpy)
assert kinds == [2, 2, 3] and np.allclose(of_mujoco[:, 0], 0), 'changed: MuJoCo'
assert of_pinocchio == [0.1, 0.2, 0.0], 'changed: Pinocchio'
assert of_urchin == [0.1, 0.2, 0.0], 'changed: urchin'
assert other.num_dofs == 2 and of_yourdfpy.startswith('refused'), 'changed: yourdfpy'
PYTHON
