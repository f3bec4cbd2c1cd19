#!/usr/bin/env bash
# pin 4.1.0: of a robot with mimic joints computeCoriolisMatrix gives another robot's matrix.
#
# A model that was read with mimic=True has fewer velocities; rnea, crba and nonLinearEffects of it
# agree with the full robot's, and algorithms that cannot (aba, computeKineticEnergy, ...) refuse:
# "This algorithm does not support Joint Mimic type". Expected of computeCoriolisMatrix: C v =
# nonLinearEffects - gravity, or that refusal. What happens: a matrix with another product, without
# a word. Locking the joint that is mimicked (buildReducedModel), as a closed gripper is, ends in
# "Should never happen".
#
# Guards mtv_world_ros/physics/arms/mechanics.py, which couples mimic joints itself and asks for
# nonLinearEffects.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check pin==4.1.0 numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import numpy as np
import pinocchio as pin

BODY = '''<inertial><origin xyz=".05 .02 .1"/><mass value="1.2"/>
<inertia ixx=".02" iyy=".03" izz=".025" ixy="0" ixz="0" iyz="0"/></inertial>'''
JOINT = '''<joint name="{}" type="revolute"><origin xyz=".1 .2 .1"/><parent link="{}"/>
<child link="{}"/><axis xyz="{}"/><limit lower="-3" upper="3" effort="9" velocity="1"/>{}</joint>'''
URDF = '<robot name="r">' + ''.join(f'<link name="{n}">{BODY}</link>' for n in ('base', *'abc'))
URDF += JOINT.format('j1', 'base', 'a', '0 1 0', '') + JOINT.format('j2', 'a', 'b', '1 0 0', '')
URDF += JOINT.format('j3', 'b', 'c', '0 0 1', '<mimic joint="j1" multiplier="-2"/>') + '</robot>'

mimic, full = pin.buildModelFromXML(URDF, mimic=True), pin.buildModelFromXML(URDF)
data, of_full = mimic.createData(), full.createData()
q, v = np.array([0.3, -0.4]), np.array([0.5, -0.7])
G = np.array([[1.0, 0.0], [0.0, 1.0], [-2.0, 0.0]])  # velocities of the full robot
expected = G.T @ pin.computeCoriolisMatrix(full, of_full, G @ q, G @ v) @ G @ v
effects = pin.nonLinearEffects(mimic, data, q, v) - pin.computeGeneralizedGravity(mimic, data, q)
found = pin.computeCoriolisMatrix(mimic, data, q, v) @ v
print('of the full robot:               ', expected.round(6))
print('nonLinearEffects - gravity:      ', effects.round(6))
print('computeCoriolisMatrix @ velocity:', found.round(6))
assert np.allclose(expected, effects), 'changed: nonLinearEffects'
assert not np.allclose(found, effects, atol=1e-3), 'changed: computeCoriolisMatrix'
try:
    pin.computeKineticEnergy(mimic, data, q, v)
    raise SystemExit('changed: computeKineticEnergy')
except RuntimeError as error:
    print('computeKineticEnergy:', str(error).strip())
try:
    pin.buildReducedModel(mimic, [mimic.getJointId('j1')], q)
    raise SystemExit('changed: buildReducedModel')
except ValueError as error:
    print('buildReducedModel, j1 locked:', str(error).strip())
PYTHON
