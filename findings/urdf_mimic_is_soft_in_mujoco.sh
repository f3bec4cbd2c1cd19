#!/usr/bin/env bash
# MuJoCo 4.0.0: a <mimic> joint of a URDF gives way under load.
#
# Two slides, the second mimics the first, 20 N on each in opposite directions, bodies of .1 kg.
# Expected: they stay equal, as a mimic joint has no freedom of its own. What happens: both joints
# are free and a soft equality couples them, which millimetres of difference show: more than a
# gripper's two fingers may differ by.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check mujoco==4.0.0
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import mujoco

BODY = '''<inertial><mass value="0.1"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'''
LIMIT = '<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>'
URDF = f'''<robot name="r"><link name="base"/><link name="a">{BODY}</link><link name="b">{BODY}</link>
<joint name="j" type="prismatic"><parent link="base"/><child link="a"/>{LIMIT}</joint>
<joint name="k" type="prismatic"><parent link="base"/><child link="b"/>{LIMIT}
<mimic joint="j" multiplier="1"/></joint></robot>'''
model = mujoco.MjModel.from_xml_string(URDF)
data = mujoco.MjData(model)
model.opt.gravity[:] = 0
for _ in range(500):
    data.qfrc_applied[:] = [-20, 20]
    mujoco.mj_step(model, data)
apart = abs(float(data.qpos[0] - data.qpos[1]))
print(f'coordinates {model.nq}, equalities {model.neq}, apart by {1000 * apart:.2f} mm')
assert model.nq == 2 and model.neq == 1 and 0.004 < apart < 0.02, 'changed'
PYTHON
