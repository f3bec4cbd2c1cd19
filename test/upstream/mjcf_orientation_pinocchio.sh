#!/usr/bin/env bash
# Pinocchio 4.1.0 reads orientations of MJCF otherwise than MuJoCo 4.0.0, without a word.
#
# Expected, written down before the run: a body has the same orientation in both. What happens:
# eulerseq="XYZ" (capitals: about the axes of the parent, says MuJoCo's reference) is read as "xyz",
# 12 degrees off at 10 20 30; with axisangle="0 0 2 30", an axis that MuJoCo normalises, Pinocchio's
# "rotation" is none: its determinant is 3.4, so that all that hangs on the body grows.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check mujoco==4.0.0 pin==4.1.0 scipy==1.17.1
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import mujoco
import numpy as np
import pinocchio
from scipy.spatial.transform import Rotation

MJCF = '''<mujoco><compiler eulerseq="{}"/><worldbody><body name="a" {}><joint name="j"/>
<geom size=".1"/></body></worldbody></mujoco>'''


def orientations(sequence, orientation):
    xml = MJCF.format(sequence, orientation)
    with open('robot.xml', 'w') as file:
        file.write(xml)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    robot = pinocchio.buildModelFromMJCF('robot.xml')
    found = robot.createData()
    pinocchio.framesForwardKinematics(robot, found, np.zeros(1))
    return data.body('a').xmat.reshape(3, 3), found.oMf[robot.getFrameId('a')].rotation


for sequence in ('xyz', 'XYZ'):
    mine, other = orientations(sequence, 'euler="10 20 30"')
    apart = np.degrees(Rotation.from_matrix(mine.T @ other).magnitude())
    print(f'eulerseq="{sequence}": {apart:.2f} degrees apart')
    # scipy has the capitals the other way round
    expected = Rotation.from_euler(sequence.swapcase(), (10, 20, 30), degrees=True).as_matrix()
    assert np.allclose(mine, expected), 'changed: MuJoCo'
    assert (apart > 11) == (sequence == 'XYZ'), 'changed: Pinocchio'
for axis in ('0 0 1', '0 0 2'):
    mine, other = orientations('xyz', f'axisangle="{axis} 30"')
    print(f'axis {axis}: determinants', np.linalg.det(mine).round(3), np.linalg.det(other).round(3))
    assert np.isclose(np.linalg.det(mine), 1), 'changed: MuJoCo'
    assert np.isclose(np.linalg.det(other), 1) == (axis == '0 0 1'), 'changed: Pinocchio'
PYTHON
