"""Any robot is a scene, or is named with what it lacks."""

from __future__ import annotations

from itertools import product
import struct

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.core.files import bundled_names, share_path
from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.arms.robot_parts import load_parts
from mtv_world_ros.physics.engine.engine import Engine
from mtv_world_ros.physics.engine.futures import draw_futures
from mtv_world_ros.physics.solids import Solid
from mtv_world_ros.robot.file import load_robot, save_robot
from test.support.small_scene import batch_of, SETTINGS

MESH = """<robot name="mesh"><link name="base"/>
  <link name="arm"><collision><geometry><mesh filename="{file}" scale="2 2 2"/></geometry>
  </collision></link>
  <joint name="turn" type="revolute"><origin xyz="0 0 0.12"/>
    <parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""
TOOL = 'tools:\n  - {arm: arm, link: arm}\n'


def write_cube(file, half: float) -> None:
    """A cube that is not closed: its top is missing."""
    corners = np.array(list(product((-half, half), repeat=3)))
    faces = [(0, 1, 3), (0, 3, 2), (0, 4, 5), (0, 5, 1), (0, 2, 6), (0, 6, 4), (7, 5, 4)]
    rows = [struct.pack('<12fH', 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces]
    file.write_bytes(bytes(80) + struct.pack('<I', len(rows)) + b''.join(rows))


def mesh_robot(folder, file='cube.stl'):
    (folder / 'mesh.urdf').write_text(MESH.format(file=file))
    (folder / 'mesh.yaml').write_text(f'name: mesh\nurdf: mesh.urdf\n{TOOL}')
    return load_robot(folder / 'mesh.yaml')


def test_a_mesh_that_is_not_closed_counts_as_its_hull_filled_with_water(tmp_path):
    write_cube(tmp_path / 'cube.stl', 0.05)
    arms = Arms(mesh_robot(tmp_path), None)
    assert '1 of 1 bodies state no inertia' in arms.notes[0]
    inertia = arms.robot.pinocchio_model.inertias[1]
    assert inertia.mass == pytest.approx(0.2**3 * 1000, rel=1e-6)  # scaled by 2
    np.testing.assert_allclose(np.diag(inertia.inertia), 8 * 0.2**2 / 6, rtol=1e-6)
    # a corner sweeps over what stands beside it
    block = Solid(centre=np.array([0.12, -0.02, 0.02]), size=np.array([0.02, 0.02, 0.04]))
    engine = Engine(arms)
    batch = engine.begin(draw_futures(SETTINGS, (block,), engine.arms.drives))
    turn = np.linspace(0, 0.8, 51)[:, None]
    points = batch.advance(turn, 5)[0].points[0, :, 0]
    assert np.linalg.norm(points[-1] - points[0]) > 0.01


def fork(folder):
    """A gripper of two meshes: a U that is one hull if nobody looks, and a jaw that turns."""
    boxes = [((0, 0, 0), (0.01, 0.04, 0.01)), ((0, 0.035, 0.04), (0.01, 0.005, 0.04)),
             ((0, -0.035, 0.04), (0.01, 0.005, 0.04))]  # fmt: skip
    faces = []
    for centre, half in boxes:
        corners = np.array(list(product((-1, 1), repeat=3))) * half + centre
        faces += [corners[list(face)] for face in (
            (0, 1, 3), (0, 3, 2), (0, 4, 5), (0, 5, 1), (0, 2, 6), (0, 6, 4), (7, 5, 4), (7, 4, 6),
            (7, 3, 1), (7, 1, 5), (7, 6, 2), (7, 2, 3))]  # fmt: skip
    rows = [struct.pack('<12fH', 0, 0, 0, *face.ravel(), 0) for face in faces]
    (folder / 'fork.stl').write_bytes(bytes(80) + struct.pack('<I', len(rows)) + b''.join(rows))
    (folder / 'fork.urdf').write_text("""<robot name="fork"><link name="base"/>
      <link name="hand">
      <collision><geometry><mesh filename="fork.stl"/></geometry></collision></link>
      <joint name="lift" type="prismatic"><parent link="base"/><child link="hand"/>
        <axis xyz="0 0 1"/><limit lower="0" upper="1" effort="9" velocity="1"/></joint>
      <link name="jaw">
      <collision><geometry><box size="0.02 0.01 0.06"/></geometry></collision></link>
      <joint name="jaw" type="revolute"><origin xyz="0.02 0 0"/><parent link="hand"/>
        <child link="jaw"/><axis xyz="1 0 0"/>
        <limit lower="0" upper="1" effort="9" velocity="1"/></joint></robot>""")
    (folder / 'fork.yaml').write_text(
        'name: fork\nurdf: fork.urdf\ntools:\n  - {arm: arm, link: hand, gripper_joint: jaw, '
        'gripper_closed: 0.0, gripper_open: 1.0, finger_travel_m: 0.03}\n'
    )
    return load_robot(folder / 'fork.yaml')


def test_there_is_room_between_the_prongs_of_a_gripper_that_is_one_mesh(tmp_path):
    parts = [part for part in load_parts(fork(tmp_path)).parts if part.link == 'hand']
    volume = sum(ConvexHull(part.points).volume for part in parts)
    # prongs and the palm that joins them: the hull of all has more than twice as much
    assert volume < 0.6 * ConvexHull(np.concatenate([part.points for part in parts])).volume
    assert all(Delaunay(part.points).find_simplex([[0, 0, 0.06]])[0] < 0 for part in parts)


def test_fingers_that_turn_go_from_one_end_of_their_joint_to_the_other(tmp_path):
    batch = batch_of(fork(tmp_path))
    np.testing.assert_allclose(batch.model.joint('jaw').range, [0.0, 1.0])
    times = np.arange(0, 2.0, 0.02)
    commands = np.stack([np.full(len(times), 0.3), np.where(times < 0.1, 0.0, 0.9)], -1)
    joints = batch.advance(commands, 1)[0].joints[0, :, 1]
    assert joints[0] == pytest.approx(0.0, abs=0.01)
    assert joints[-1] == pytest.approx(0.9, abs=0.01)


def test_a_copy_of_a_robot_keeps_the_pieces_of_its_gripper(tmp_path):
    robot = fork(tmp_path)
    parts = [part for part in load_parts(robot).parts if part.link == 'hand']
    copy = load_robot(save_robot(robot.file, tmp_path / 'copy').file)
    kept = [part for part in load_parts(copy).parts if part.link == 'hand']
    assert len(kept) == len(parts) > 1
    for part, again in zip(parts, kept, strict=True):
        np.testing.assert_allclose(again.points.min(0), part.points.min(0), atol=1e-6)
        np.testing.assert_allclose(again.points.max(0), part.points.max(0), atol=1e-6)


def test_a_mesh_that_is_missing_is_named(tmp_path):
    with pytest.raises(RobotError, match="mesh 'nowhere.stl' is not there; contact needs it"):
        load_parts(mesh_robot(tmp_path, 'nowhere.stl'))


@pytest.mark.parametrize('name', bundled_names('robots'))
def test_bundled_robots_stay_where_they_are_told_to_be(name):
    robot = load_robot(share_path('config', 'robots', name, 'robot.yaml'))
    away = Solid(centre=np.array([1.5, 1.5, 0.02]), size=np.full(3, 0.04))
    batch = batch_of(robot, away)
    middle = np.where(np.isfinite(robot.lower + robot.upper), robot.lower + robot.upper, 0) / 2
    motion, state = batch.advance(np.repeat(middle[None], 26, 0), 5)
    assert not state.lost
    np.testing.assert_allclose(motion.joints[0, -1], middle, atol=1e-3)


@pytest.mark.parametrize(('swing', 'apart_m'), [(False, (0.0, 0.0005)), (True, (0.003, 0.0118))])
def test_fingers_that_follow_one_joint_are_kept_together_unless_they_swing(lift, swing, apart_m):
    """A heavy block off the middle stops one finger first, by 4.7 N at most, which are 11.8 mm."""
    block = Solid(centre=np.array([0.0, 0.01, 0.02]), size=np.array([0.02, 0.03, 0.04]))
    batch = batch_of(lift, block, fingers_swing=swing, density=20000.0, table_friction=1.0)
    times = np.arange(0, 0.8, 0.02)
    commands = np.stack([np.full(len(times), 0.02), np.where(times < 0.05, 0.04, 0.0)], -1)
    _, state = batch.advance(commands, 1)
    qpos = state.physics[0, 1 : 1 + batch.model.nq]
    fingers = qpos[batch._scene.arm_qpos][batch._scene.arms.drives.fingers]
    assert apart_m[0] <= abs(fingers[0] - fingers[1]) < apart_m[1]


def test_a_gripper_whose_joint_moves_nothing_is_named(tmp_path):
    robot = share_path('config', 'robots', 'franka', 'franka.urdf').read_text()
    bare = robot
    for link in ('panda_leftfinger', 'panda_rightfinger'):
        first = bare.index(f'<link name="{link}">')
        bare = f'{bare[:first]}<link name="{link}"/>{bare[bare.index("</link>", first) + 7 :]}'
    (tmp_path / 'franka.urdf').write_text(bare)
    text = share_path('config', 'robots', 'franka', 'robot.yaml').read_text()
    (tmp_path / 'franka.yaml').write_text(text)
    with pytest.raises(
        RobotError, match="'panda' .* no part that its joint 'panda_finger_joint1'"
    ):
        Arms(load_robot(tmp_path / 'franka.yaml'), None)
