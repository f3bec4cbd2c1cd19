"""A checkpoint of a robot that is not in config/ carries it, and loads from anywhere."""

import json
import shutil

import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import CalibrationError, CheckpointError, ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.robot.shape import load_shape
from test.support.crane import load, make_cameras, make_positions, write_episode
from test.support.sources import set_options, TINY_MODEL

TINY = set_options(
    {
        **TINY_MODEL,
        'transformer.frames_per_token': 2,
        'video.num_frames': 2,
        'optimizer.warmup_steps': 1,
        'optimizer.steps': 2,
    }
)


@pytest.fixture(scope='module')
def trained(tmp_path_factory):
    """Folder with `dataset/` and a checkpoint that was moved away from robot and training."""
    folder = tmp_path_factory.mktemp('crane')
    robot, cameras = load(folder), make_cameras()
    del cameras['palm']
    write_episode(folder / 'dataset' / 'one', robot, cameras, make_positions(3.0))
    command = ['train', str(folder / 'dataset'), '--out', str(folder / 'run')]
    command += ['--views', 'door,window', '--threads', '1', f'--set=video.robot={robot.file}']
    assert main([*command, *TINY]) == 0
    shutil.move(folder / 'run' / 'checkpoint', folder / 'elsewhere')
    shutil.rmtree(folder / 'run')
    shutil.rmtree(folder / 'crane')
    return folder


@pytest.mark.slow
def test_it_carries_robot_shapes_and_calibration(trained):
    robot = Checkpoint.open(trained / 'elsewhere').load_robot()
    assert robot.name == 'crane'
    assert json.loads((trained / 'elsewhere/world_model.json').read_text())['robot'] == 'crane'
    shape = load_shape(robot)
    assert shape.is_known and 'hand' in {part.link for part in shape.parts}
    cameras = load_calibration(Checkpoint.open(trained / 'elsewhere').cameras_file)
    assert list(cameras) == ['door', 'window']


@pytest.mark.slow
def test_evaluate_and_replay_take_it_without_flags(trained, capsys, monkeypatch):
    monkeypatch.chdir(trained)
    options = ['--no-ceiling', '--actions', 'true', '--threads', '1', '--no-report']
    assert main(['evaluate', 'elsewhere', 'dataset', '--out', 'scores', *options]) == 0
    assert (trained / 'scores' / 'metrics.json').is_file()
    command = ['replay', 'dataset/one', '--offline', '--checkpoint', 'elsewhere', '--out', 'said']
    assert main([*command, '--threads', '1']) == 0, capsys.readouterr().err


def test_another_file_of_the_same_robot_can_be_given_but_not_another_robot(trained, tmp_path):
    copy = shutil.copytree(trained / 'elsewhere' / 'robot', tmp_path / 'mine')
    assert (
        Checkpoint.open(trained / 'elsewhere').load_robot(copy / 'robot.yaml').file.parent == copy
    )
    with pytest.raises(CheckpointError, match="trained with robot 'crane'"):
        Checkpoint.open(trained / 'elsewhere').load_robot('yam_bimanual')


def test_older_checkpoints_find_their_robot_by_name_or_path(trained, tmp_path):
    assert Checkpoint.open('bundled').load_robot().name == 'yam_bimanual'
    assert Checkpoint.open('bundled').cameras_file.is_file()
    older = tmp_path / 'older'
    older.mkdir()
    card = json.loads((trained / 'elsewhere' / 'world_model.json').read_text())
    card['robot'] = str(trained / 'elsewhere' / 'robot' / 'robot.yaml')
    (older / 'world_model.json').write_text(json.dumps(card))
    assert Checkpoint.open(older).load_robot().name == 'crane'
    with pytest.raises(CalibrationError, match='no default calibration'):
        _ = Checkpoint.open(older).cameras_file
    card['robot'] = str(tmp_path / 'gone.yaml')
    (older / 'world_model.json').write_text(json.dumps(card))
    with pytest.raises(ConfigError, match=r'gone.yaml.* does not exist'):
        Checkpoint.open(older).load_robot()
    yam = share_path('config', 'robots', 'yam_bimanual', 'robot.yaml')
    assert Checkpoint.open(older).load_robot(yam).name == 'yam_bimanual'
