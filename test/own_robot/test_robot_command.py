"""`mtv-world robot`: what is guessed from a URDF against robot files that people wrote."""

from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import RobotError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.importing.robot_guess import guess_robot
from mtv_world_ros.robot.file import load_robot
from test.support.crane import load, URDF, write_robot


@pytest.fixture
def crane(tmp_path):
    return write_robot(tmp_path)


def test_a_urdf_becomes_a_robot_file_with_a_picture(crane, tmp_path, capsys):
    urdf, out = crane.with_name('crane.urdf'), tmp_path / 'mine' / 'guessed.yaml'
    picture = tmp_path / 'crane.png'
    command = ['robot', str(urdf), '--out', str(out), '--picture', str(picture)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert 'joint roll: turns without end' in printed
    assert 'gripper jaw_left: closed at 0, open at 0.04' in printed
    assert '-0.0\n' not in out.read_text()
    guessed, written = load_robot(out), load_robot(crane)
    assert guessed.joint_names == written.joint_names
    assert guessed.base_link == written.base_link == 'plinth'
    assert np.abs(guessed.tools[0].T_link_tool - written.tools[0].T_link_tool).max() < 0.01
    image = cv2.imread(str(picture))
    assert image is not None and image.shape == (960, 960, 3)
    assert (image < 200).any(axis=-1).mean() > 0.02
    assert main(command) == 1  # nothing that exists is overwritten
    assert 'exists' in capsys.readouterr().err


def test_the_guess_for_two_arms_agrees_with_the_bundled_file():
    yam = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    values = guess_robot(
        share_path('config', 'robots', 'yam_bimanual', 'yam_bimanual.urdf')
    ).values
    assert tuple(values['joints']) == yam.joint_names and values['base_link'] == yam.base_link
    for guess, tool in zip(values['tools'], yam.tools, strict=True):
        assert (guess['arm'], guess['link']) == (tool.arm, tool.link)
        assert guess['gripper_joint'] == tool.gripper_joint
        assert abs(guess['gripper_open'] - tool.gripper_open) < 1e-6
        assert abs(guess['gripper_closed'] - tool.gripper_closed) < 0.003
        assert np.abs(guess['position'] - tool.T_link_tool[:3, 3]).max() < 0.02
        aligned = np.abs(np.dot(guess['quaternion_xyzw'], [0, 0, -(0.5**0.5), 0.5**0.5]))
        assert aligned > 0.999


def _link(name, *shapes):
    visuals = ''.join(f'<visual><origin xyz="{xyz}"/><geometry>{shape}</geometry></visual>'
                      for xyz, shape in shapes)  # fmt: skip
    return f'<link name="{name}">{visuals}</link>'


def _four_bar_gripper(urdf):
    """The crane with a gripper as four-bar linkages have it: outer and inner knuckles and tips.

    Fingers turn about -y at (+-30.6, 0, 54.9) mm; tips stay parallel and end 150 mm ahead of the
    hand's link. One tip's shape has more points than the other's.
    """
    head = urdf.partition('<link name="left">')[0]
    joints = urdf[urdf.index('<joint name="stand"') : urdf.index('<joint name="jaw_left"')]
    box = ('0 0 0.02', '<box size="0.012 0.02 0.05"/>')
    knob = ('0.008 0.004 0.02', '<sphere radius="0.004"/>')
    parts = []
    for side, sign in (('left', 1), ('right', -1)):
        parts += [
            _link(f'{side}_knuckle', (f'{0.03 * sign} 0 0', '<box size="0.06 0.02 0.01"/>')),
            _link(f'{side}_inner', (f'{0.02 * sign} 0 0.02', '<box size="0.01 0.02 0.04"/>')),
            _link(f'{side}_tip', box, *([knob] if sign < 0 else [])),
        ]
        rows = [('knuckle', 'hand', f'{0.0306 * sign} 0 0.0549', sign),
                ('inner', 'hand', f'{0.0127 * sign} 0 0.0614', sign),
                ('tip', f'{side}_knuckle', f'{0.0372 * sign} 0 0.0501', -sign)]  # fmt: skip
        for name, parent, xyz, turns in rows:
            follows = f'<mimic joint="left_knuckle_joint" multiplier="{turns}"/>'
            limit = f'lower="{min(0, 0.8 * turns)}" upper="{max(0, 0.8 * turns)}"'
            parts.append(
                f'<joint name="{side}_{name}_joint" type="revolute"><parent link="{parent}"/>'
                f'<child link="{side}_{name}"/><origin xyz="{xyz}"/><axis xyz="0 -1 0"/>'
                f'<limit {limit} effort="1" velocity="1"/>'
                f'{"" if (side, name) == ("left", "knuckle") else follows}</joint>'
            )
    return head + joints + ''.join(parts) + '</robot>'


def test_the_tool_of_fingers_that_turn_is_on_the_axis_between_their_tips(crane):
    urdf = crane.with_name('crane.urdf')
    urdf.write_text(_four_bar_gripper(URDF))
    (tool,) = guess_robot(urdf).values['tools']
    assert (tool['link'], tool['gripper_joint']) == ('hand', 'left_knuckle_joint')
    assert (tool['gripper_open'], tool['gripper_closed']) == (0.0, 0.8)
    x, y, z = tool['position']
    assert abs(x) < 0.003 and abs(y) < 0.003  # 13 mm before, on one that is sold
    assert 0.12 < z < 0.16
    turned = Rotation.from_quat(tool['quaternion_xyzw']).as_matrix()
    assert turned[2, 2] > np.cos(np.radians(2))  # 17 degrees before
    assert abs(turned[0, 1]) > 0.999  # along the way of the fingers
    # a knuckle of (37.2, 50.1) mm turns by .8 rad
    way = 0.0372 - np.hypot(0.0372, 0.0501) * np.cos(np.arctan2(0.0501, 0.0372) + 0.8)
    assert tool['finger_travel_m'] == pytest.approx(way, abs=1e-4)


def test_joints_that_follow_in_a_chain_are_resolved_and_circles_named(crane):
    text = URDF.replace('<mimic joint="jaw_left"/>', '<mimic joint="{}" multiplier="2"/>')
    chain = text.format('jaw_right2') + (
        '<link name="x"/><joint name="jaw_right2" type="prismatic"><parent link="hand"/>'
        '<child link="x"/><axis xyz="0 1 0"/><limit lower="0" upper="0.04" effort="1" '
        'velocity="1"/><mimic joint="{}" multiplier="0.5" offset="0.01"/></joint></robot>'
    )
    chain = chain.replace('</robot><link', '<link')
    urdf = crane.with_name('crane.urdf')
    urdf.write_text(chain.format('jaw_left'))
    robot = load_robot(crane)
    shut, wide = np.zeros((1, 6)), np.zeros((1, 6))
    wide[0, 5] = 0.02
    moved = robot.link_poses('right', wide) - robot.link_poses('right', shut)
    apart = np.linalg.norm(moved[0, :3, 3])
    assert apart == pytest.approx(0.02)  # 2 * 0.5 of the leader
    urdf.write_text(chain.format('jaw_right'))
    with pytest.raises(RobotError, match='follows itself'):
        load_robot(crane)


def test_a_floating_joint_rests_and_is_named(crane, tmp_path):
    text = crane.with_name('crane.urdf').read_text()
    floating = text.replace('name="stand" type="fixed"', 'name="stand" type="floating"')
    crane.with_name('crane.urdf').write_text(floating)
    guessed = guess_robot(crane.with_name('crane.urdf'))
    assert 'joints of several numbers rest: stand' in guessed.notes[0]
    assert load(tmp_path / 'again').joint_names == tuple(guessed.values['joints'])


def _chain(*joints):
    """A URDF of joints (name, kind, parent, child, more) between links of boxes."""
    links = dict.fromkeys(link for _, _, *ends, _ in joints for link in ends)
    box = '<geometry><box size="0.02 0.02 0.06"/></geometry>'
    parts = [f'<link name="{link}"><visual>{box}</visual></link>' for link in links]
    parts += [
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 {0.03 * ("right" in name)} 0.2"/><axis xyz="0 1 0"/>'
        f'<limit lower="0" upper="0.5" effort="1" velocity="1"/>{more}</joint>'
        for name, kind, parent, child, more in joints
    ]
    return f'<robot name="r">{"".join(parts)}</robot>'


_SHORT = [('j1', 'revolute', 'base', 'upper', ''), ('j2', 'revolute', 'upper', 'hand', '')]
_JAWS = [
    ('finger_left', 'prismatic', 'hand', 'left', ''),
    ('finger_right', 'prismatic', 'hand', 'right', '<mimic joint="finger_left"/>'),
]


def test_an_arm_of_two_joints_has_its_gripper(tmp_path, capsys):
    (tmp_path / 'r.urdf').write_text(_chain(*_SHORT, *_JAWS))
    command = ['robot', str(tmp_path / 'r.urdf'), '--picture', str(tmp_path / 'r.png')]
    assert main(command) == 0
    robot = load_robot(tmp_path / 'r.yaml')
    assert robot.joint_names == ('j1', 'j2', 'finger_left')
    assert [(tool.link, tool.gripper_joint) for tool in robot.tools] == [('hand', 'finger_left')]
    assert 'guessed' in capsys.readouterr().out


def test_an_arm_of_two_joints_without_a_gripper_is_one(tmp_path):
    (tmp_path / 'r.urdf').write_text(_chain(*_SHORT))
    values = guess_robot(tmp_path / 'r.urdf').values
    assert values['joints'] == ['j1', 'j2'] and values['tools'][0]['link'] == 'hand'


def test_two_arms_beyond_a_torso_of_two_joints_are_no_fingers(tmp_path):
    arms = [
        (f'{side}_{k}', 'revolute', f'{side}_{k - 1}' if k else 'hand', f'{side}_{k}', '')
        for side in ('left', 'right')
        for k in range(4)
    ]
    (tmp_path / 'r.urdf').write_text(_chain(*_SHORT, *arms))
    values = guess_robot(tmp_path / 'r.urdf').values
    assert [tool['link'] for tool in values['tools']] == ['left_3', 'right_3']


def test_a_joint_of_the_arm_that_follows_another_is_not_commanded(tmp_path):
    joints = [
        ('j1', 'revolute', 'base', 'a', ''),
        ('j2', 'revolute', 'a', 'b', ''),
        ('j3', 'revolute', 'b', 'c', '<mimic joint="j2" multiplier="-1"/>'),
        ('j4', 'revolute', 'c', 'd', ''),
    ]
    (tmp_path / 'r.urdf').write_text(_chain(*joints))
    assert guess_robot(tmp_path / 'r.urdf').values['joints'] == ['j1', 'j2', 'j4']


def test_a_guess_that_cannot_be_used_leaves_no_file(crane, tmp_path, capsys):
    mesh = crane.parent / 'meshes' / 'hand.stl'
    data = bytearray(mesh.read_bytes())
    data[96:100] = np.float32(np.nan).tobytes()  # a vertex
    mesh.write_bytes(bytes(data))
    out = tmp_path / 'guessed.yaml'
    assert main(['robot', str(crane.with_name('crane.urdf')), '--out', str(out)]) == 1
    assert "hand.stl'" in capsys.readouterr().err
    assert not out.exists()


def test_what_has_no_arm_is_refused(tmp_path):
    (tmp_path / 'box.urdf').write_text('<robot name="box"><link name="base"/></robot>')
    with pytest.raises(RobotError, match='has no arm'):
        guess_robot(tmp_path / 'box.urdf')


@pytest.mark.parametrize('limit', ['', 'lower="0" upper="0"', 'lower="0.3" upper="0.3"'])
@pytest.mark.parametrize('joint', ['nod', 'jaw_left'])
def test_a_joint_without_a_range_is_named_before_a_file_is_written(
    crane, tmp_path, capsys, joint, limit
):
    root = ElementTree.fromstring(URDF)
    given = dict(part.split('=') for part in limit.replace('"', '').split())
    for element in root.iter('limit'):
        owner = next(j for j in root.iter('joint') if element in list(j))
        if owner.get('name') == joint:
            element.attrib = {'effort': '1', 'velocity': '2', **given}
    urdf, out = crane.with_name('crane.urdf'), tmp_path / 'guessed.yaml'
    urdf.write_text(ElementTree.tostring(root, encoding='unicode'))
    assert main(['robot', str(urdf), '--out', str(out)]) == 1
    said = capsys.readouterr().err
    assert f"joint '{joint}'" in said and 'cannot move' in said and "'continuous'" in said
    assert not out.exists()
    with pytest.raises(RobotError, match=f"'{joint}' of robot 'crane' cannot move"):
        load_robot(crane)
