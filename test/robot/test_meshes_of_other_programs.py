"""Meshes as programs and repositories leave them: units, files that are no mesh, wrong scales."""

import struct

import numpy as np
import pytest

from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.core.files import bundled_names
from mtv_world_ros.physics.arms.robot_parts import load_parts
from mtv_world_ros.robot.file import load_robot, save_robot
from mtv_world_ros.robot.mesh_pieces import load_mesh, MissingMeshError
from mtv_world_ros.robot.shape import load_shape, ROD_RADIUS_M

#: box of the upper link [m]
SIZE = np.array([0.06, 0.04, 0.3])
FACES = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6),
         (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
LFS = (b'version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22e'
       b'adbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n')  # fmt: skip
HTML = b'\n<!DOCTYPE html>\n<html><head><title>Page not found</title></head></html>\n'
BOX = '<geometry><box size="0.05 0.05 0.3"/></geometry>'
URDF = """<robot name="r"><link name="base"><visual>{base}</visual></link>
<link name="upper"><visual>{upper}</visual>{collision}</link>
<link name="lower"><visual>{box}</visual></link>
<joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="5" velocity="{speed}"/></joint>
<joint name="b" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.3"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="5" velocity="2"/></joint></robot>"""


def corners(size):
    signs = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    return np.array(signs) * size


def collada(size, asset):
    """A box as COLLADA 1.4.1 writes it."""
    numbers = ' '.join(f'{v:.6f}' for v in corners(size).ravel())
    triangles = ' '.join(str(i) for face in FACES for i in face)
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset>{asset}</asset><library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="24">{numbers}</float_array><technique_common>
<accessor source="#pa" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common>
</source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{triangles}</p>
</triangles></mesh></geometry></library_geometries><library_visual_scenes>
<visual_scene id="s"><node id="n"><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def stl(size):
    points = corners(size)
    rows = [struct.pack('<12fH', 0, 0, 0, *points[list(face)].ravel(), 0) for face in FACES]
    return bytes(80) + struct.pack('<I', len(rows)) + b''.join(rows)


def mesh(name, scale=''):
    return f'<geometry><mesh filename="{name}" {scale}/></geometry>'


def robot(folder, *, upper=BOX, base=BOX, collision='', speed=2):
    urdf = URDF.format(upper=upper, base=base, collision=collision, box=BOX, speed=speed)
    (folder / 'r.urdf').write_text(urdf)
    (folder / 'r.yaml').write_text(
        'name: r\nurdf: r.urdf\ntools: [{arm: only, link: lower, position: [0, 0, 0.3]}]\n'
    )
    return load_robot(folder / 'r.yaml')


def extent(parts, link='upper'):
    return np.ptp(np.concatenate([p.points for p in parts if p.link == link]), axis=0)


@pytest.mark.parametrize(
    ('asset', 'unit', 'scale', 'factor'),
    [
        ('<unit name="centimeter" meter="0.01"/><up_axis>Z_UP</up_axis>', 0.01, '', 1),
        ('<unit name="inch" meter="0.0254"/>', 0.0254, '', 1),
        ('<unit name="millimeter" meter="1e-3"/>', 0.001, '', 1),
        ('<contributor/><created>2024-01-01</created><unit meter="0.01"/>', 0.01,
         'scale="2 2 2"', 2),
        ('<unit name="meter" meter="1"/>', 1.0, '', 1),
        ('<unit name="meter" meter="1"/><up_axis>Y_UP</up_axis>', 1.0, '', 1),  # as rviz has it
        ('', 1.0, '', 1),
    ],
)  # fmt: skip
def test_the_unit_of_a_collada_file_scales_it_wherever_meshes_are_read(
    tmp_path, asset, unit, scale, factor
):
    (tmp_path / 'arm.dae').write_text(collada(SIZE / unit / factor, asset))
    np.testing.assert_allclose(
        np.ptp(load_mesh(tmp_path / 'arm.dae').vertices, axis=0), SIZE / factor, atol=1e-6
    )
    collision = f'<collision>{mesh("arm.dae", scale)}</collision>'
    made = robot(tmp_path, upper=mesh('arm.dae', scale), collision=collision)
    np.testing.assert_allclose(extent(load_shape(made).parts), SIZE, atol=1e-6)
    np.testing.assert_allclose(extent(load_parts(made).parts), SIZE, atol=1e-6)
    saved = save_robot(made.file, tmp_path / 'copy')
    assert saved.notes == ()
    np.testing.assert_allclose(extent(load_shape(load_robot(saved.file)).parts), SIZE, atol=1e-6)


@pytest.mark.parametrize('meter', ['0', '-1', 'x', 'nan'])
def test_a_unit_that_is_no_length_is_named(tmp_path, meter):
    (tmp_path / 'arm.dae').write_text(collada(SIZE, f'<unit meter="{meter}"/>'))
    with pytest.raises(MissingMeshError, match=r"arm.dae'.*<unit"):
        load_mesh(tmp_path / 'arm.dae')


@pytest.mark.parametrize('suffix', ['stl', 'dae', 'obj'])
@pytest.mark.parametrize(
    ('content', 'said'),
    [
        (b'', 'is empty'),
        (LFS, "is a pointer of Git LFS, not the file: run 'git lfs pull'"),
        (HTML, 'is an HTML page, not the file'),
        (b'404: Not Found', 'cannot be read: '),
    ],
    ids=['empty', 'git_lfs', 'html', 'text'],
)
def test_a_file_that_is_no_mesh_counts_as_a_missing_one_and_is_named(
    tmp_path, suffix, content, said
):
    name = f'arm.{suffix}'
    (tmp_path / name).write_bytes(content)
    shape = load_shape(robot(tmp_path, upper=mesh(name)))
    assert not shape.is_known and len(shape.missing) == 1
    assert f"{name}' {said}" in shape.missing[0] and shape.missing[0] in shape.source
    assert '\n' not in shape.source
    assert {part.link for part in shape.parts} == {'upper', 'lower'}  # rods
    assert extent(shape.parts)[0] == pytest.approx(2 * ROD_RADIUS_M)
    saved = save_robot(tmp_path / 'r.yaml', tmp_path / 'copy')
    assert len(saved.notes) == 1 and said in saved.notes[0]
    with pytest.raises(RobotError, match='contact needs it'):
        load_parts(robot(tmp_path, upper=mesh(name)))


def test_the_collision_shape_stands_in_for_a_mesh_that_cannot_be_read_and_it_is_named(tmp_path):
    (tmp_path / 'arm.stl').write_bytes(LFS)
    shape = load_shape(
        robot(tmp_path, upper=mesh('arm.stl'), collision=f'<collision>{BOX}</collision>')
    )
    assert shape.is_known and 'pointer of Git LFS' in shape.missing[0]
    np.testing.assert_allclose(extent(shape.parts), [0.05, 0.05, 0.3])


def test_a_mesh_of_the_base_that_cannot_be_read_is_named_and_the_arm_keeps_its_shapes(tmp_path):
    (tmp_path / 'table.stl').write_bytes(b'')
    shape = load_shape(robot(tmp_path, base=mesh('table.stl')))
    assert shape.is_known and 'is empty' in shape.missing[0]
    assert {part.link for part in shape.parts} == {'upper', 'lower'}


@pytest.mark.parametrize('factor', [1000, 100])
def test_a_link_that_is_far_larger_than_the_arm_is_named(tmp_path, factor):
    (tmp_path / 'arm.stl').write_bytes(stl(SIZE * factor))
    large = float(np.linalg.norm(SIZE)) * factor
    said = f"link 'upper' is {large:.3g} m large and the arm 0.6 m long: is its mesh in millim"
    doubts = load_shape(robot(tmp_path, upper=mesh('arm.stl'))).doubts
    assert len(doubts) == 1 and said in doubts[0]
    assert said in save_robot(tmp_path / 'r.yaml', tmp_path / 'copy').notes[0]
    scale = f'scale="{1 / factor} {1 / factor} {1 / factor}"'
    assert load_shape(robot(tmp_path, upper=mesh('arm.stl', scale))).doubts == ()


def test_a_link_that_is_scaled_twice_is_named(tmp_path):
    (tmp_path / 'arm.dae').write_text(collada(SIZE * 1000, '<unit meter="0.001"/>'))
    made = robot(tmp_path, upper=mesh('arm.dae', 'scale="0.001 0.001 0.001"'))
    assert "link 'upper' is 0.000309 m large" in load_shape(made).doubts[0]


@pytest.mark.parametrize('name', bundled_names('robots'))
def test_bundled_robots_have_no_doubtful_links(name):
    from mtv_world_ros.robot.file import robot_path

    assert load_shape(load_robot(robot_path(name))).doubts == ()


@pytest.mark.parametrize(
    ('shape', 'said'),
    [
        (mesh('arm.stl', 'scale="0.001,0.001,0.001"'), "'scale' is '0.001,0.001,0.001', must be"),
        (mesh('arm.stl', 'scale="1 1"'), "'scale' is '1 1', must be 3 numbers"),
        (mesh('arm.stl', 'scale=""'), "'scale' is '', must be 3 numbers"),
        ('<geometry><box size="0.1 0.1"/></geometry>', "'size' is '0.1 0.1', must be 3 numbers"),
        ('<geometry><box size="0,1 0,1 0,1"/></geometry>', "'size' is '0,1 0,1 0,1'"),
        ('<geometry><cylinder radius="" length="1"/></geometry>', "'radius' is '', must be a"),
        ('<geometry><sphere radius="nan"/></geometry>', "'radius' is 'nan', must be a number"),
    ],
    ids=['commas', 'two', 'none', 'box', 'decimal_commas', 'empty', 'nan'],
)
def test_numbers_of_shapes_that_cannot_be_read_are_named_everywhere(tmp_path, shape, said):
    (tmp_path / 'arm.stl').write_bytes(stl(SIZE))
    made = robot(tmp_path, upper=shape)
    for read in (load_shape, load_parts, lambda it: save_robot(it.file, tmp_path / 'copy')):
        with pytest.raises(RobotError, match=f"link 'upper': {said}"):
            read(made)
    assert not (tmp_path / 'copy').exists()


def test_one_number_scales_all_axes(tmp_path):
    (tmp_path / 'arm.stl').write_bytes(stl(SIZE / 2))
    made = robot(tmp_path, upper=mesh('arm.stl', 'scale="2"'))
    np.testing.assert_allclose(extent(load_shape(made).parts), SIZE, atol=1e-6)


@pytest.mark.parametrize(
    'name',
    [
        '/mnt/someone/ws/src/r_description/meshes/my arm.stl',
        'file:///mnt/someone/ws/src/r_description/meshes/my%20arm.stl',
        'file://$(find r_description)/meshes/my arm.stl',
        'package://r_description\\meshes\\my arm.stl',
        'C:\\Users\\someone\\r\\meshes\\my arm.stl',
        'meshes/MY ARM.STL',
    ],
    ids=['absolute', 'uri', 'find', 'backslashes', 'windows', 'case'],
)
def test_a_mesh_with_a_path_of_another_machine_is_found_by_its_end_and_named(tmp_path, name):
    folder = tmp_path / 'r' / 'urdf'
    (tmp_path / 'r' / 'meshes').mkdir(parents=True)
    folder.mkdir()
    (tmp_path / 'r' / 'meshes' / 'my arm.stl').write_bytes(stl(SIZE))
    made = robot(folder, upper=mesh(name))
    shape = load_shape(made)
    assert shape.is_known and not shape.missing
    np.testing.assert_allclose(extent(shape.parts), SIZE, atol=1e-6)
    assert len(shape.replaced) == 1 and "my arm.stl' was taken" in shape.replaced[0]
    assert save_robot(made.file, tmp_path / 'copy').notes == shape.replaced
    assert shape.replaced[0] in load_parts(made).notes


def test_a_file_name_alone_counts_beside_the_urdf_but_not_for_a_package(tmp_path):
    (tmp_path / 'arm.stl').write_bytes(stl(SIZE))
    assert load_shape(robot(tmp_path, upper=mesh('/elsewhere/arm.stl'))).replaced
    shape = load_shape(robot(tmp_path, upper=mesh('package://elsewhere/arm.stl')))
    assert not shape.is_known and not shape.replaced


@pytest.mark.parametrize('name', ['/elsewhere/other.stl', '/elsewhere/arm.stl', '../../arm.stl'])
def test_a_mesh_that_only_has_a_known_file_name_is_not_taken(tmp_path, name):
    folder = tmp_path / 'a' / 'b' / 'urdf'
    folder.mkdir(parents=True)
    (tmp_path / 'a' / 'arm.stl').write_bytes(stl(SIZE))
    shape = load_shape(robot(folder, upper=mesh(name)))
    taken = name == '../../arm.stl'  # it is there
    assert shape.is_known == taken and not shape.replaced


def test_a_mesh_of_bodies_with_gaps_between_them_keeps_each(tmp_path):
    """Letters of a logo: slices between them hold nothing."""
    one = stl(np.array([0.02, 0.02, 0.02]))
    ends = [np.array([0, 0, z]) for z in (-0.2, 0.2)]
    triangles = b''
    for offset in ends:
        for face in FACES:
            points = corners(np.array([0.02, 0.02, 0.02]))[list(face)] + offset
            triangles += struct.pack('<12fH', 0, 0, 0, *points.ravel(), 0)
    (tmp_path / 'logo.stl').write_bytes(one[:80] + struct.pack('<I', 24) + triangles)
    shape = load_shape(robot(tmp_path, upper=mesh('logo.stl')))
    parts = [part for part in shape.parts if part.link == 'upper']
    assert len(parts) == 2
    heights = sorted(float(part.points[:, 2].mean()) for part in parts)
    np.testing.assert_allclose(heights, [-0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose(extent(shape.parts), [0.02, 0.02, 0.42], atol=1e-6)
