#!/usr/bin/env bash
# open3d 0.20.0: a depth image cast with a camera, turned to points with the same camera, is off.
#
# RaycastingScene.create_rays_pinhole and PointCloud.create_from_depth_image take the same matrix K.
# Expected, written down before the run: depths cast on a wall come back as points of that wall.
# What happens: rays go through x + 1/2, y + 1/2 and points are placed at x, y (pixel centres at
# integers, as OpenCV has them); at 2 m and f = 200 all points are 5 mm to the upper left, and those
# of a wall at 45 degrees 3.5 mm behind it. With K's centre less 1/2 for the points they lie on it.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check open3d==0.20.0 numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import numpy as np
import open3d

WIDTH, HEIGHT = 64, 48
K = np.array([[200.0, 0, 32], [0, 200, 24], [0, 0, 1]])
# the wall z = 2 + x, 4 m by 4 m, seen from the origin along z
corners = np.array([[x, y, 2 + x] for x in (-1, 2) for y in (-2, 2)], np.float32)
wall = open3d.t.geometry.TriangleMesh(corners, np.array([[0, 1, 2], [1, 3, 2]], np.int32))
scene = open3d.t.geometry.RaycastingScene()
scene.add_triangles(wall)
pose = open3d.core.Tensor(np.eye(4))
rays = scene.create_rays_pinhole(open3d.core.Tensor(K), pose, WIDTH, HEIGHT)
depth = scene.cast_rays(rays)['t_hit'].numpy()  # along z: the rays' directions have z = 1
assert np.allclose(rays.numpy()[..., 5], 1), 'changed: the rays'


def points(K):
    image = open3d.t.geometry.Image(open3d.core.Tensor(depth[..., None]))
    cloud = open3d.t.geometry.PointCloud.create_from_depth_image(
        image, open3d.core.Tensor(K), pose, depth_scale=1.0, depth_max=10.0
    )
    return cloud.point.positions.numpy()


def off_the_wall(points):  # [mm]
    return 1000 * float(np.mean((points[:, 2] - points[:, 0] - 2) / np.sqrt(2)))


along = rays.numpy()[..., 3:].reshape(-1, 3) * depth.reshape(-1, 1)
moved = K.copy()
moved[:2, 2] -= 0.5
print(f'rays times depth: {off_the_wall(along):.2f} mm behind the wall')
print(f'points with K: {off_the_wall(points(K)):.2f} mm behind the wall')
print(f'points with the centre less 1/2: {off_the_wall(points(moved)):.2f} mm behind it')
shift = np.mean((points(K) - along)[:, :2], axis=0) * 1000
print('points with K, against the rays, right and down [mm]:', shift.round(2))
assert abs(off_the_wall(along)) < 0.01 and abs(off_the_wall(points(moved))) < 0.01, 'changed'
assert off_the_wall(points(K)) > 3 and (shift < -4).all(), 'changed: half a pixel'
PYTHON
