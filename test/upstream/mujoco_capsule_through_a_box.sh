#!/usr/bin/env bash
# mujoco 4.0.0: a capsule that pierces a box is far from it, and there is no contact.
#
# A robot's link as a capsule stands upright in a table top of 2 cm. Expected of mj_geomDistance
# and of the contacts: the deeper, the more negative, as with the same table top as a mesh. What
# happens: up to 5 cm deep both agree; half through it the box says 0, and with the link's middle
# in the table top +10 cm and no contact: whoever asks whether a pose is free is told yes. (The
# like of it for a sphere in a box, issue 2206, is mended.) Releases 3.3.7 and 3.17.0 do the same.
#
# Guards mtv_world_ros/physics/arms/robot_parts.py, which gives the engine convex hulls in place of
# capsules.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check mujoco==4.0.0 numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import itertools

import mujoco
import numpy as np

HALF = (0.4, 0.3, 0.01)
CORNERS = ' '.join(
    f'{a * HALF[0]} {b * HALF[1]} {c * HALF[2]}' for a, b, c in itertools.product((-1, 1), repeat=3)
)
TOPS = {'box': 'type="box" size=".4 .3 .01"', 'mesh': 'type="mesh" mesh="top"'}


def touch(top, height):
    model = mujoco.MjModel.from_xml_string(f'''<mujoco>
    <asset><mesh name="top" vertex="{CORNERS}"/></asset>
    <worldbody><geom {TOPS[top]}/><body pos=".01 .02 {height}"><freejoint/>
    <geom type="capsule" size=".04 .15"/></body></worldbody></mujoco>''')
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None), data.ncon


for depth in (-0.02, 0.03, 0.05, 0.1, 0.15, 0.2):  # of the link's end below the table's upper face
    height = 0.15 + 0.04 + 0.01 - depth  # of its middle
    (of_box, contacts), (of_mesh, expected) = touch('box', height), touch('mesh', height)
    print(f'{100 * depth:+3.0f} cm deep: box {100 * of_box:+.1f} cm and {contacts} contacts, mesh '
          f'{100 * of_mesh:+.1f} cm and {expected}')
    assert np.isclose(of_mesh, -depth, atol=1e-5), 'changed: the mesh'
    assert np.isclose(of_box, -depth, atol=1e-5) == (depth < 0.08), 'changed: the box'
    if depth > 0.12:
        assert of_box > 0.03 and contacts == 0 and expected > 0, 'changed: a pierced box'
PYTHON
