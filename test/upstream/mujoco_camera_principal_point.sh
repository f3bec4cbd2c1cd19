#!/usr/bin/env bash
# mujoco 4.0.0: a camera's principal point: its sensor has none, and its picture has it mirrored.
#
# A camera of 640 x 480 with focalpixel 600 looks at a site at .3 .2 2, right, down and ahead of
# it. Expected with principalpixel="40 30", an offset from the image's centre: pixel 450 330 = 320
# + 40 + 600 * .3 / 2, ..., as of a calibrated camera with cx = 360 and cy = 270; and of the sensor
# camprojection ("projected onto the camera image, in pixel coordinates") the pixel where the
# picture shows the site. What happens: the frustum that pictures are drawn with shows it at 370
# 270 (cx = 320 - 40), and the sensor says 410 300, as if the principal point were in the middle:
# 50 pixels from the picture and 50 from the calibrated camera.
#
# Guards mtv_world_ros/simulation/scenes/cameras.py, which makes MuJoCo cameras of centred principal
# points alone.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check mujoco==4.0.0 numpy==2.4.6
cd "$place"
unset MUJOCO_GL  # nothing is drawn
"$place/env/bin/python" - <<'PYTHON'
import mujoco
import numpy as np

WIDTH, HEIGHT, FOCAL, SITE = 640, 480, 600.0, (0.3, 0.2, 2.0)


def pixels(principal):
    model = mujoco.MjModel.from_xml_string(f'''<mujoco><worldbody>
    <camera name="c" euler="180 0 0" resolution="{WIDTH} {HEIGHT}" sensorsize=".0064 .0048"
    focalpixel="{FOCAL} {FOCAL}" principalpixel="{principal[0]} {principal[1]}"/>
    <site name="s" pos="{SITE[0]} {SITE[1]} {SITE[2]}"/></worldbody>
    <sensor><camprojection site="s" camera="c"/></sensor></mujoco>''')
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    scene, everything = mujoco.MjvScene(model, 10), mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, scene)
    seen = scene.camera[0]  # what the renderer is given
    x, y = (seen.frustum_near * SITE[axis] / SITE[2] for axis in (0, 1))  # right, down
    across = (x - seen.frustum_center + seen.frustum_width) / (2 * seen.frustum_width)
    down = (seen.frustum_top + y) / (seen.frustum_top - seen.frustum_bottom)
    return data.sensordata.copy(), np.array([WIDTH * across, HEIGHT * down])


for principal in ((0, 0), (40, 30)):
    expected = np.array([WIDTH, HEIGHT]) / 2 + principal + FOCAL * np.array(SITE[:2]) / SITE[2]
    sensor, picture = pixels(principal)
    print(f'principalpixel {principal}: expected {expected.round(2).tolist()}, in the picture '
          f'{picture.round(2).tolist()}, of the sensor {sensor.round(2).tolist()}')
    offset = np.array(principal)
    assert np.allclose(sensor, expected - offset, atol=0.01), 'changed: the sensor'
    assert np.allclose(picture, expected - 2 * offset, atol=0.01), 'changed: the frustum'
PYTHON
