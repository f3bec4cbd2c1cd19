"""`mtv-world import bag`: a robot's own bags, with TF, its description and no commands."""

from dataclasses import replace
import json
import re
import shlex

import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag_mapping import load_bag_mapping
from mtv_world_ros.data.episode_reader import read_episode, read_info
from mtv_world_ros.data.recording import motion_digest
from mtv_world_ros.importing.view_names import guess_views
from mtv_world_ros.robot.file import load_robot
from test.support.bags import bag_cameras, MAPPING, record
from test.support.crane import FPS, make_positions, render, START_NS, URDF

NUM = 25


@pytest.fixture(scope='module')
def scene(robot):
    """Cameras, positions, and what the cameras see."""
    cameras, positions = bag_cameras(), make_positions(NUM / FPS)
    return cameras, positions, {v: render(robot, c, positions) for v, c in cameras.items()}


@pytest.fixture
def make_bag(robot, scene, tmp_path):
    """Record the scene, changed in some way, as a bag of a name."""
    cameras, positions, frames = scene

    def make(name='wave', **how):
        how = {'cameras': cameras, 'positions': positions, 'frames': frames, **how}
        return record(tmp_path / name, robot, **how)

    return make


def run(folder, *bags, mapping=MAPPING, more=()):
    (folder / 'bag.yaml').write_text(yaml.safe_dump(mapping))
    command = ['import', 'bag', *map(str, bags), '--topics', str(folder / 'bag.yaml')]
    return main([*command, '--out', str(folder / 'out'), *more])


@pytest.mark.parametrize(
    ('sqlite', 'compression'),
    [(True, 'none'), (True, 'file'), (True, 'message'), (False, 'file'), (False, 'message')],
)
def test_views_joints_cameras_and_robot_come_from_the_bag(
    robot, scene, make_bag, tmp_path, capsys, sqlite, compression
):
    cameras, positions, frames = scene
    bag = make_bag(sqlite=sqlite, compression=compression)
    assert run(tmp_path, bag) == 0, capsys.readouterr().err
    episode = read_episode(tmp_path / 'out' / 'wave')
    assert episode.info.robot == 'crane' and episode.info.instruction == 'wave'
    assert episode.joint_states.joint_names == robot.joint_names
    np.testing.assert_allclose(episode.joint_states.positions, positions)
    assert set(episode.views) == {'door', 'palm'}
    for view, link in (('door', 'plinth'), ('palm', 'hand')):
        camera = episode.cameras[view]
        assert camera.mount_link == link
        np.testing.assert_allclose(camera.T_mount_camera, cameras[view].T_mount_camera, atol=1e-6)
        np.testing.assert_allclose(camera.K, cameras[view].K)
        apart = np.abs(np.asarray(episode.images[view].frames)[3].astype(int) - frames[view][3])
        assert apart.mean() < 12
    commanded = np.concatenate([t.positions for _, t in episode.trajectories])
    np.testing.assert_allclose(commanded, positions[1:], atol=1e-9)
    guessed = load_robot(tmp_path / 'out' / 'robot' / 'robot.yaml')
    assert guessed.tools[0].gripper_joint == 'jaw_left' and guessed.base_link == 'plinth'


def test_the_look_at_the_robot_that_is_printed_runs(make_bag, tmp_path, capsys, monkeypatch):
    bag = make_bag()
    assert run(tmp_path, bag) == 0
    words = shlex.split(capsys.readouterr().out.partition('look at it with: ')[2].split('\n')[0])
    assert words[:2] == ['mtv-world', 'robot']
    monkeypatch.chdir(tmp_path)
    assert main(words[1:]) == 0
    assert (tmp_path / 'out' / 'robot' / 'crane.png').is_file()


def test_again_keeps_what_is_there_and_another_mapping_is_named(make_bag, tmp_path, capsys):
    bag = make_bag()
    assert run(tmp_path, bag) == 0
    assert run(tmp_path, bag) == 0
    assert '0 made, 1 kept, 0 failed' in capsys.readouterr().out
    assert run(tmp_path, bag, mapping=MAPPING | {'task': 'other'}) == 1
    assert 'imported with another mapping' in capsys.readouterr().err


def test_what_is_wrong_with_a_bag_is_named_and_the_others_are_imported(
    scene, make_bag, tmp_path, capsys
):
    good, degrees = make_bag('good'), make_bag('degrees', positions=np.degrees(scene[1]))
    other, cut = make_bag('other', prefix='ur_'), make_bag('cut', sqlite=False)
    file = next(cut.glob('*.mcap'))
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    assert run(tmp_path, good, degrees, other, cut) == 1
    printed = capsys.readouterr()
    assert '2 made, 0 kept, 2 failed' in printed.out
    assert 'its limits are' in printed.err and 'ur_yaw' in printed.err
    assert f'{cut}' in printed.err and 'cut off' in printed.err
    assert 5 < len(read_episode(tmp_path / 'out' / 'cut').images['door'].frames) < NUM


def test_a_bag_without_commands_says_how_to_take_the_measured_ones(make_bag, tmp_path, capsys):
    bag = make_bag()
    assert run(tmp_path, bag, mapping={**MAPPING, 'action': 'joint_trajectory'}) == 1
    assert "set 'action: state'" in capsys.readouterr().err


def test_a_bag_with_plans_elsewhere_says_where(robot, scene, make_bag, tmp_path, capsys):
    point = messages.make(
        'trajectory_msgs/msg/JointTrajectoryPoint',
        positions=scene[1][-1], velocities=np.empty(0), accelerations=np.empty(0),
        effort=np.empty(0),
        time_from_start=messages.make('builtin_interfaces/msg/Duration', sec=1, nanosec=0),
    )  # fmt: skip
    plan = messages.make(
        messages.JOINT_TRAJECTORY, header=messages.make_header(START_NS, ''),
        joint_names=list(robot.joint_names), points=[point],
    )  # fmt: skip

    def write(bag):
        bag.write('/arm_controller/plan', messages.JOINT_TRAJECTORY, START_NS, plan)

    bag = make_bag('plan', more=write)
    assert run(tmp_path, bag, mapping={**MAPPING, 'action': 'joint_trajectory'}) == 1
    said = capsys.readouterr().err
    assert "at '/cell/joint_trajectory'; there are some at /arm_controller/plan" in said


def test_without_commands_the_measured_ones_are_taken_if_the_command_line_says_so(
    make_bag, tmp_path, capsys
):
    bag = make_bag()
    mapping = {**MAPPING, 'action': 'joint_trajectory'}
    assert run(tmp_path, bag, mapping=mapping, more=['--action', 'state']) == 0
    episode = read_episode(tmp_path / 'out' / 'wave')
    assert episode.trajectories
    assert load_bag_mapping(tmp_path / 'out' / 'mapping.yaml').action == 'state'


def test_commands_made_of_states_start_when_every_view_has_an_image(
    robot, scene, make_bag, tmp_path
):
    def before(bag):
        names = ['lab_' + name for name in robot.joint_names]
        for k in range(1, 4):
            stamp = START_NS - k * 10_000_000
            state = messages.make_joint_state(stamp, names, scene[1][0])
            bag.write('/cell/joint_states', messages.JOINT_STATE, stamp, state)

    assert run(tmp_path, make_bag('early', more=before)) == 0
    episode = read_episode(tmp_path / 'out' / 'early')
    assert len(episode.joint_states.positions) == NUM + 3
    assert episode.trajectories[0][0] == START_NS


def test_of_an_sqlite_bag_that_was_cut_off_what_comes_before_is_kept(make_bag, tmp_path, capsys):
    bag = make_bag('cut')
    file = next(bag.glob('*.db3'))
    size = file.stat().st_size
    file.write_bytes(file.read_bytes()[: size * 2 // 3 + 100])
    assert run(tmp_path, bag) == 0
    assert f'{size * 2 // 3 + 100} of {size} bytes are there' in capsys.readouterr().err
    kept = len(read_episode(tmp_path / 'out' / 'cut').images['door'].frames)
    assert NUM // 2 < kept < NUM


def test_another_robot_in_the_same_bag_is_named_and_left_out(robot, make_bag, tmp_path, capsys):
    def other(bag):
        urdf = re.sub(' name="|link="', r'\g<0>ur_', URDF)
        text = messages.make(messages.STRING, data=urdf)
        bag.write('/cell/robot_description', messages.STRING, START_NS - 1, text)
        for k in range(5):
            state = messages.make_joint_state(START_NS + k, ['ur_yaw', 'ur_elbow'], np.zeros(2))
            bag.write('/cell/joint_states', messages.JOINT_STATE, START_NS + k, state)

    assert run(tmp_path, make_bag('two', more=other)) == 0, capsys.readouterr().err
    printed = capsys.readouterr()
    assert 'the bag describes 2 robots' in printed.out and f'({NUM} of {NUM + 5}' in printed.out
    assert '5 messages without a joint of the robot were left out' in printed.err
    assert 'ur_yaw, ur_elbow' in printed.err
    episode = read_episode(tmp_path / 'out' / 'two')
    assert episode.joint_states.joint_names == robot.joint_names
    assert len(episode.joint_states.positions) == NUM


@pytest.mark.parametrize(
    ('urdf', 'reason'),
    [
        (URDF.replace('<robot ', '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ', 1)
         .replace('</robot>', '<xacro:tool/></robot>'),
         'is unexpanded xacro; expand it first: xacro FILE > robot.urdf'),
        (re.sub('lower="[^"]*"', 'lower="${-pi}"', URDF, count=1),
         'it has expressions of xacro; expand it first'),
        (re.sub('<child link="[^"]*"', '<child link="nowhere"', URDF, count=1), 'nowhere'),
        ('<robot name="box"><link name="box"/></robot>', 'has no arm'),
    ],
)  # fmt: skip
def test_a_description_that_is_no_robot_is_named_by_its_topic(
    urdf, reason, make_bag, tmp_path, capfd
):
    bag = make_bag('bag', urdf=urdf)
    assert run(tmp_path, bag) == 1
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 1, said  # urdfdom prints lines of its own
    assert reason in said[0] and f"'/cell/robot_description' of '{bag}'" in said[0]
    assert "robot.urdf'" not in said[0] and '--robot' in said[0]


def test_bags_are_read_as_they_are_with_the_mapping(make_bag, tmp_path, capsys):
    bag = make_bag()
    assert run(tmp_path, bag) == 0
    mapping = tmp_path / 'out' / 'mapping.yaml'
    assert load_bag_mapping(mapping).robot == str(tmp_path / 'out' / 'robot' / 'robot.yaml')
    status = main(['check', str(bag), '--topics', str(mapping), '--out', str(tmp_path / 'doctor')])
    printed = capsys.readouterr().out
    assert status == 3, printed  # the description has a mesh that no bag carries
    assert 'not checked' in printed and 'hand.stl' in printed


def test_a_fisheye_keeps_its_model(scene, make_bag, tmp_path, capsys):
    cameras, _, _ = scene
    bent = replace(
        cameras['door'], distortion_model='equidistant', distortion=np.array([0.1, 0, 0, 0])
    )
    bag = make_bag('bent', cameras={**cameras, 'door': bent})
    assert run(tmp_path, bag) == 0, capsys.readouterr().err
    camera = read_episode(tmp_path / 'out' / 'bent').cameras['door']
    assert camera.distortion_model == 'equidistant'
    assert camera.distortion.tolist() == [0.1, 0, 0, 0]


def test_views_are_named_after_what_tells_them_apart():
    topics = ['/cell/front/color/image_raw', '/cell/front/color/image_raw/compressed',
              '/wrist_camera/image_rect', '/cell/front/depth/image_raw']  # fmt: skip
    assert guess_views(topics) == {
        'front': '/cell/front/color/image_raw',
        'wrist_camera': '/wrist_camera/image_rect',
    }


def test_an_import_keeps_what_a_recording_is_known_by(robot, make_bag, tmp_path, capsys):
    bag = make_bag()
    assert run(tmp_path, bag) == 0, capsys.readouterr().err
    mapping = load_bag_mapping(tmp_path / 'out' / 'mapping.yaml')
    raw = read_episode(bag, mapping=mapping, views=list(mapping.views), robot=robot)
    episode = read_episode(tmp_path / 'out' / 'wave')
    assert motion_digest(raw) == motion_digest(episode) != ''
    other = replace(raw.joint_states, positions=raw.joint_states.positions + 0.01)
    assert motion_digest(replace(raw, joint_states=other)) != motion_digest(raw)


def test_an_import_keeps_the_robot_cell_of_an_episode(tmp_path, capsys):
    demo = share_path('resource', 'demo_episode')
    out = tmp_path / 'out'
    assert main(['import', 'bag', str(demo), '--robot', 'yam_bimanual', '--out', str(out)]) == 0
    original, imported = read_info(demo), read_info(out / 'demo_episode')
    assert imported.place == original.place == 'simulator/nominal'


def test_four_bags_are_split_and_the_command_says_so(make_bag, tmp_path, capsys):
    bags = [make_bag(f'wave_{k}') for k in range(4)]
    assert run(tmp_path, *bags) == 0, capsys.readouterr().err
    assert 'split: 3 to train on, 1 to test on (wave_' in capsys.readouterr().out
    card = json.loads((tmp_path / 'out' / 'dataset.json').read_text())
    assert {name: len(names) for name, names in card['splits'].items()} == {'train': 3, 'test': 1}
    assert run(tmp_path, *bags, more=['--split', 'half']) == 1
    assert '75:25' in capsys.readouterr().err
