#!/usr/bin/env bash
# coal 3.0.3: a sphere that sinks into the end of a cylinder is pushed out of its side.
#
# Expected of coal.distance, written down before the run: minus the shortest way out, as its
# documentation and issue 779 define penetration, as MuJoCo 4.0.0 has it and as Coal has it for the
# same cylinder as a convex mesh. What happens: as soon as the sphere's centre is inside of the
# cylinder, the way out is always the one through the round side. On a plate of 30 cm radius
# a ball whose centre is 1 mm below the face is "34 cm deep" instead of 5.1 cm, its normal lies
# in the plane of the plate, and the distance jumps by 29 cm where the centre passes the face.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check coal==3.0.3 mujoco==4.0.0 numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import coal
import mujoco
import numpy as np

RADIUS, HALF_HEIGHT, BALL = 0.3, 0.02, 0.05
angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
circle = RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=1)
corners = coal.StdVec_Vec3s()
for x, y in circle:
    for z in (-HALF_HEIGHT, HALF_HEIGHT):
        corners.append(np.array([x, y, z]))
plate = coal.Cylinder(RADIUS, 2 * HALF_HEIGHT)
convex = coal.ConvexBase.convexHull(corners, True, None)
model = mujoco.MjModel.from_xml_string(f'''<mujoco><worldbody>
<geom type="cylinder" size="{RADIUS} {HALF_HEIGHT}"/>
<body><freejoint/><geom size="{BALL}"/></body></worldbody></mujoco>''')
data = mujoco.MjData(model)


def coal_distance(shape, centre):
    result = coal.DistanceResult()
    there = coal.Transform3s(np.eye(3), centre)
    ball = coal.Sphere(BALL)
    found = coal.distance(shape, coal.Transform3s(), ball, there, coal.DistanceRequest(), result)
    return found, result.normal


for depth in (-0.001, 0.001):  # of the ball's centre below the face
    centre = np.array([0.01, 0.0, HALF_HEIGHT - depth])
    data.qpos[:3] = centre
    mujoco.mj_kinematics(model, data)
    expected = -(BALL + depth)
    of_mujoco = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None)
    of_convex, _ = coal_distance(convex, centre)
    of_cylinder, normal = coal_distance(plate, centre)
    print(f'centre {1000 * depth:+.0f} mm below the face: expected {expected:.3f}, MuJoCo '
          f'{of_mujoco:.3f}, convex mesh {of_convex:.3f}, cylinder {of_cylinder:.3f}, normal '
          f'{(normal.round(3) + 0.0).tolist()}')
    assert np.isclose(of_mujoco, expected) and np.isclose(of_convex, expected), 'changed'
    wrong = -(BALL + RADIUS - 0.01)
    assert np.isclose(of_cylinder, wrong if depth > 0 else expected), 'changed: the cylinder'
PYTHON
