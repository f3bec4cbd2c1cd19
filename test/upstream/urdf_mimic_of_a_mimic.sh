#!/usr/bin/env bash
# A URDF joint that mimics a joint which itself mimics another: four readers, four answers.
#
# j2 = 3 j1 + 0.01, and j3 = 2 j2 + 0.1 (URDF's <mimic> names any joint; grippers of several
# links are written so). Expected at j1 = 0.2, written down before the run: j2 = 0.61 and j3 = 1.32
# from all. What happens: urchin 0.0.30 leaves j3 at 0 without a word, not even its offset is
# there; yourdfpy 0.0.60 takes j2 for 0, so that j3 = 0.1, and logs a warning; Pinocchio 4.1.0
# refuses the robot (mimic=True); only MuJoCo 4.0.0 keeps both equations.
#
# Guards mtv_world_ros/robot/file.py, which resolves chains of mimic joints itself.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check urchin==0.0.30 \
    yourdfpy==0.0.60 mujoco==4.0.0 pin==4.1.0 numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import mujoco
import pinocchio
import urchin
import yourdfpy

BODY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
JOINT = '''<joint name="{name}" type="prismatic"><parent link="base"/><child link="{link}"/>
<axis xyz="0 0 1"/><limit lower="-9" upper="9" effort="1" velocity="1"/>{mimic}</joint>'''
MIMIC = '<mimic joint="{}" multiplier="{}" offset="{}"/>'
URDF = '<robot name="r">' + ''.join(f'<link name="{n}">{BODY}</link>' for n in ('base', *'abc'))
URDF += JOINT.format(name='j1', link='a', mimic='')
URDF += JOINT.format(name='j2', link='b', mimic=MIMIC.format('j1', 3, 0.01))
URDF += JOINT.format(name='j3', link='c', mimic=MIMIC.format('j2', 2, 0.1)) + '</robot>'
with open('r.urdf', 'w') as file:
    file.write(URDF)

found = urchin.URDF.load('r.urdf').link_fk(cfg={'j1': 0.2})
of_urchin = {link.name: round(float(pose[2, 3]), 6) for link, pose in found.items()}
robot = yourdfpy.URDF.load('r.urdf')
robot.update_cfg({'j1': 0.2})
of_yourdfpy = {n: round(float(robot.get_transform(n)[2, 3]), 6) for n in 'abc'}
try:
    pinocchio.buildModelFromXML(URDF, mimic=True)
    of_pinocchio = 'read'
except ValueError:
    of_pinocchio = 'refused'
model = mujoco.MjModel.from_xml_string(URDF)
of_mujoco = [model.eq_data[k, :2].tolist() for k in range(model.neq)]
print('expected:  ', {'a': 0.2, 'b': 0.61, 'c': 1.32})
print('urchin:    ', {name: of_urchin[name] for name in 'abc'})
print('yourdfpy:  ', of_yourdfpy)
print('Pinocchio: ', of_pinocchio)
print('MuJoCo:    ', of_mujoco, 'offsets and multipliers of its equations')
assert of_urchin['b'] == of_yourdfpy['b'] == 0.61, 'changed'
assert of_urchin['c'] == 0.0 and of_yourdfpy['c'] == 0.1 and of_pinocchio == 'refused', 'changed'
assert sorted(of_mujoco) == [[0.01, 3.0], [0.1, 2.0]], 'changed'
PYTHON
