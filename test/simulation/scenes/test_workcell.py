from dataclasses import replace
import shutil

import numpy as np
import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError, SimulatorError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import check_positions, RobotModel
from mtv_world_ros.simulation.collect.record import RecordConfig, simulate
from mtv_world_ros.simulation.expert.expert import Expert
from mtv_world_ros.simulation.scenes.tasks import TASKS
from mtv_world_ros.simulation.scenes.workcell import nominal_cameras, workcell_of
from mtv_world_ros.simulation.simulator import SimEpisode
from test.support.tiers import rest_slow

ROBOTS = sorted(p.parent.name for p in share_path('config', 'robots').glob('*/workcell.yaml'))
OTHERS = [name for name in ROBOTS if name != 'yam_bimanual']


def bundled(name):
    return load_robot(share_path('config', 'robots', name, 'robot.yaml'))


def test_franka_flange_is_where_the_published_parameters_put_it():
    """All joints at zero: the flange is 88 mm ahead and 333 + 316 + 384 - 107 mm up."""
    robot = bundled('franka')
    (pose,) = robot.link_poses('panda_hand', np.zeros((1, 8)))
    (base,) = robot.link_poses('panda_link0', np.zeros((1, 8)))
    np.testing.assert_allclose((np.linalg.inv(base) @ pose)[:3, 3], [0.088, 0, 0.926], atol=1e-12)
    assert robot.velocity_limits[0] == 2.175 and robot.upper[3] == -0.0698


def test_ur5e_flange_is_where_the_published_parameters_put_it():
    """All joints at zero: x = a2 + a3, y = -(d4 + d6), z = d1 - d5."""
    robot = bundled('ur5e_pair')
    for arm in ('left', 'right'):
        (pose,) = robot.link_poses(f'{arm}_tool0', np.zeros((1, 14)))
        (base,) = robot.link_poses(f'{arm}_base_link', np.zeros((1, 14)))
        wanted = [-0.425 - 0.3922, -0.1333 - 0.0996, 0.1625 - 0.0997]
        np.testing.assert_allclose((np.linalg.inv(base) @ pose)[:3, 3], wanted, atol=1e-12)


@pytest.mark.parametrize('name', OTHERS)
@pytest.mark.parametrize(
    'task',
    rest_slow(['stack_blocks_two', 'place_cup_plate', 'collect_food'], ['stack_blocks_two']),
)
def test_expert_does_tasks_with_other_arms(name, task):
    robot = bundled(name)
    expert = Expert(robot)
    sim = SimEpisode(robot, expert.home, rendering=False)
    outcomes = []
    for seed in range(4):
        try:
            take = simulate(sim, expert, TASKS[task], seed, RecordConfig(), miss=False)
        except SimulatorError:
            continue
        check_positions(robot, take.commands.positions)
        np.testing.assert_allclose(take.commands.positions[0], expert.home, atol=1e-12)
        outcomes.append(take.ever and take.final)
        if outcomes[-1]:
            return
    pytest.fail(f'{outcomes}')


def test_a_redundant_arm_comes_back_to_where_it_rests():
    robot = bundled('franka')
    expert = Expert(robot)
    sim = SimEpisode(robot, expert.home, rendering=False)
    sim.reset(1, 'collect_food')
    plan = expert.plan(sim.task, sim.scene, np.random.default_rng(0), miss=False)
    # two moves, one after the other: between them nothing jumps
    assert np.abs(np.diff(plan.positions, axis=0)).max() < 0.06
    np.testing.assert_allclose(plan.positions[-1], expert.home, atol=0.02)


@pytest.mark.parametrize('name', ROBOTS)
def test_default_calibration_is_that_of_the_workcell(name):
    path = share_path('config', 'robots', name, 'cameras.yaml')
    stored, made = load_calibration(path), nominal_cameras(bundled(name))
    remedy = f'mtv-world robot {path.with_name("robot.yaml")} --workcell --overwrite'
    assert list(stored) == list(made), remedy
    for view, camera in made.items():
        assert stored[view].mount_link == camera.mount_link, remedy
        assert np.allclose(stored[view].K, camera.K, rtol=1e-12), remedy
        assert np.allclose(stored[view].T_mount_camera, camera.T_mount_camera, atol=1e-12), remedy


def test_the_cameras_of_a_changed_workcell_are_written_by_a_command(tmp_path, capsys):
    folder = shutil.copytree(share_path('config', 'robots', 'franka'), tmp_path / 'mine')
    command = ['robot', str(folder / 'robot.yaml'), '--workcell']
    command += ['--picture', str(tmp_path / 'a.png')]
    assert main(command) == 0
    assert 'agrees with the workcell' in capsys.readouterr().out
    workcell = folder / 'workcell.yaml'
    workcell.write_text(workcell.read_text().replace('distance: 1.25', 'distance: 2.5'))
    before = (folder / 'cameras.yaml').read_text()
    assert main(command) == 1  # nothing that exists is overwritten
    assert 'cameras.yaml' in capsys.readouterr().err
    assert (folder / 'cameras.yaml').read_text() == before
    assert main([*command, '--overwrite']) == 0
    near, far = (load_calibration(path)['front'] for path in (
        share_path('config', 'robots', 'franka', 'cameras.yaml'), folder / 'cameras.yaml'
    ))  # fmt: skip
    target = np.array([0.0, 0.22, 0.1])  # of the camera in workcell.yaml
    apart = [np.linalg.norm(one.T_mount_camera[:3, 3] - target) for one in (near, far)]
    assert np.allclose(apart, [1.25, 2.5])


def test_a_robot_of_ones_own_has_its_workcell_in_its_folder(tmp_path):
    folder = shutil.copytree(share_path('config', 'robots', 'franka'), tmp_path / 'mine')
    file = folder / 'robot.yaml'
    file.write_text(file.read_text().replace('name: franka', 'name: mine'))
    robot, bundled_one = load_robot(file), workcell_of(bundled('franka'))
    assert workcell_of(robot).cameras == bundled_one.cameras
    assert workcell_of(robot).placement == bundled_one.placement
    (folder / 'workcell.yaml').unlink()
    with pytest.raises(SimulatorError, match=r"'mine' has no workcell.* stands in workcell.yaml"):
        workcell_of(load_robot(file))


@pytest.mark.parametrize(
    ('before', 'after', 'said'),
    [
        ('1.9, 0.785]', '1.9]', r'panda.home_joints has 6 numbers; the arm has 7 joints .*: p'),
        ('[0.0, 0.14, 0.24]', '[0.0, 0.14]', r"'home_tool' is .*, must be x, y, z"),
        ('target: [0.0, 0.22, 0.1]', 'target: [0, .1, 999]', r"'target' is .*, must be x, y, z"),
        ('distance: 1.25', 'distance: -1.25', r'distance'),
        ('elevation: 28', 'elevation: 280', r'elevation'),
        ('finger_width_m', 'finger_widht_m', r"did you mean 'finger_width_m'"),
    ],
)
def test_a_workcell_with_a_wrong_value_is_refused_and_says_which(tmp_path, before, after, said):
    folder = shutil.copytree(share_path('config', 'robots', 'franka'), tmp_path / 'franka')
    file = folder / 'workcell.yaml'
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after))
    with pytest.raises((ConfigError, SimulatorError), match=rf'workcell\.yaml.*{said}'):
        workcell_of(load_robot(folder / 'robot.yaml'))


@pytest.mark.slow
def test_collect_records_another_robot_with_its_views(tmp_path, opengl):
    out = tmp_path / 'set'
    arguments = f'collect --robot franka --task place_cup_plate --episodes 1 --out {out}'
    assert main([*arguments.split(), '--width', '96', '--height', '72']) == 0
    episode = read_episode(out / 'place_cup_plate_00000')
    assert episode.info.robot == 'franka' and episode.views == ('front', 'side', 'wrist')
    assert [camera.mount_link for camera in episode.cameras.values()] == [
        'table', 'table', 'panda_hand',
    ]  # fmt: skip
    assert episode.joint_states.joint_names == bundled('franka').joint_names
    text = (out / 'README.md').read_text()
    assert '--robot franka' in text and 'The robot `franka` in MuJoCo' in text
    assert main(['check', str(out / 'place_cup_plate_00000'), '--out', str(tmp_path / 'd')]) == 3


def test_a_robot_without_a_workcell_is_refused(robot):
    other = RobotModel(
        name='crane', model=robot.pinocchio_model, joint_names=robot.joint_names,
        tools=robot.tools, base_link='base',
    )  # fmt: skip
    with pytest.raises(SimulatorError, match="'crane' has no workcell.*franka.*yam_bimanual"):
        Expert(other)
    renamed = RobotModel(
        name='franka', model=robot.pinocchio_model, joint_names=robot.joint_names,
        tools=[replace(tool) for tool in robot.tools], base_link='base',
    )  # fmt: skip
    with pytest.raises(SimulatorError, match=r"\['panda'\], the robot has \['left', 'right'\]"):
        Expert(renamed)
