"""URDFs and COLLADA files that would end or stop a recursive parser are refused before it.

Deep, long, circular and laughing ones are among the accidents of `robustness`.
"""

from __future__ import annotations

import subprocess
import sys
import time
import tracemalloc
from xml.etree import ElementTree

import pytest

from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.importing.robot_guess import guess_robot
from mtv_world_ros.robot.file import parse_urdf
from mtv_world_ros.robot.mesh_pieces import load_mesh, MissingMeshError
from mtv_world_ros.robot.xml_file import check_xml, parse_xml, root_link
from robustness.accidents import chain, entity_bomb, joint, star, urdf_of

MOST_S, MOST_MB = 1.0, 100


def urdf(text: str) -> str:
    return urdf_of(lambda: text).decode()


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        (urdf(chain(250)), r'a chain of the robot has 201 links; at most 200 .*CHAIN_LINKS'),
        (urdf(joint('root', 'root')), "circle, among them 'root'"),
        (urdf('<x/>' * 250_000), 'has 200001 elements; at most 200000'),
        ('<robot name="r"/>', 'it has no link'),
        ('<robot name="r"><x><child link="l"/></x></robot>', 'it has no link'),
    ],
    ids=lambda value: value[:12] if isinstance(value, str) else None,
)  # fmt: skip
def test_a_description_that_a_parser_would_not_survive_is_refused_in_time(text, reason):
    begin_s = time.process_time()
    with pytest.raises(RobotError, match=reason):
        parse_urdf(text, 'it')
    assert time.process_time() - begin_s < 2 * MOST_S


def test_entities_take_no_memory():
    tracemalloc.start()
    with pytest.raises(ValueError, match='document type'):
        parse_xml(entity_bomb())
    assert tracemalloc.get_traced_memory()[1] < MOST_MB * 2**20
    tracemalloc.stop()


def test_the_deepest_robot_that_is_read_is_far_from_the_end_of_the_stack():
    """A thread's stack may be an eighth of the usual 8 MB."""
    code = (
        'import sys, threading\n'
        'from mtv_world_ros.robot.file import parse_urdf\n'
        'text = sys.stdin.read()\n'
        'threading.stack_size(2**20)\n'
        'thread = threading.Thread(target=lambda: print(parse_urdf(text, "it")[0].nframes))\n'
        'thread.start()\n'
        'thread.join()\n'
    )
    command = [sys.executable, '-c', code]
    text = urdf(chain(199))
    done = subprocess.run(command, input=text, capture_output=True, text=True)
    assert done.returncode == 0 and int(done.stdout) == 400, done.stderr


def test_bundled_robots_are_within_the_limits():
    for path in share_path('config', 'robots').rglob('*.urdf'):
        root = parse_xml(path.read_text())
        assert root_link(root)
        assert ElementTree.tostring(root) == ElementTree.tostring(
            ElementTree.parse(path).getroot()
        )


def test_a_limit_is_raised_by_its_variable(monkeypatch):
    monkeypatch.setenv('MTV_WORLD_MAX_CHAIN_LINKS', '300')
    model, _, base = parse_urdf(urdf(chain(250)), 'it')
    assert base == 'root' and model.existFrame('l249')


def test_followers_in_a_row_are_resolved_in_time():
    count = 1_900
    text = urdf(star(count, '<mimic joint="l{next}" multiplier="1.001"/>', last=''))
    begin_s = time.process_time()
    _, mimics, _ = parse_urdf(text, 'it')
    assert time.process_time() - begin_s < 2 * MOST_S
    assert {mimic.source for mimic in mimics} == {f'l{count - 1}'}
    by_joint = {mimic.joint: mimic.multiplier for mimic in mimics}
    assert by_joint['l0'] == pytest.approx(1.001 ** (count - 1))


@pytest.mark.parametrize(
    ('name', 'content', 'reason'),
    [
        ('a.gltf', b'[' * 100_000, r"of type '\.gltf', which is not read; convert it to one of"),
        ('a.blend', b'BLENDER', r"of type '\.blend'"),
        ('a', b'solid', "of type ''"),
    ],
)
def test_meshes_that_a_reader_would_not_survive_are_not_given_to_it(
    tmp_path, name, content, reason
):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MissingMeshError, match=reason):
        load_mesh(tmp_path / name)


def test_a_mesh_that_is_too_large_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setenv('MTV_WORLD_MAX_MESH_BYTES', '1000')
    (tmp_path / 'a.stl').write_bytes(bytes(1001))
    with pytest.raises(MissingMeshError, match='1001 bytes; at most 1000'):
        load_mesh(tmp_path / 'a.stl')


@pytest.mark.parametrize('text', ['', '<a>', '<a></b>', '<a/><b/>', '\0', '<a b=c/>'])
def test_what_is_no_xml_is_an_error_of_the_parser(text):
    with pytest.raises(Exception, match=r'line 1, column') as error:
        check_xml(text)
    with pytest.raises(ElementTree.ParseError) as expected:
        ElementTree.fromstring(text)
    assert str(error.value) == str(expected.value)


def test_a_robot_of_more_arms_or_fingers_than_one_has_is_not_guessed(tmp_path):
    def branches(depth: int) -> str:
        text, level, count = '', ['root'], 0
        for _ in range(depth):
            ends = []
            for parent in level:
                for _ in range(2):
                    text += f'<link name="t{count}"/>' + joint(
                        parent, f't{count}', kind='revolute'
                    )
                    ends.append(f't{count}')
                    count += 1
            level = ends
        return text

    for depth in (7, 9):
        path = tmp_path / f'{depth}.urdf'
        path.write_text(urdf(branches(depth)))
        begin_s = time.process_time()
        with pytest.raises(RobotError, match='at most (8|24) are guessed. Write its YAML by hand'):
            guess_robot(path)
        assert time.process_time() - begin_s < 3 * MOST_S
