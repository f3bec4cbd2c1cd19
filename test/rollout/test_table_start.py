"""A picture and a table of joints become a video, without a recording."""

import cv2
import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.rollout.table_start import read_view_cameras, table_start, view_images
from mtv_world_ros.viewing.video import decode_video


@pytest.fixture(scope='module')
def episode():
    return read_episode(share_path('resource', 'demo_episode'))


@pytest.fixture(scope='module')
def model():
    checkpoint = Checkpoint.open('bundled')
    cameras = read_view_cameras(checkpoint.spec, checkpoint.cameras_file)
    return checkpoint.spec, checkpoint.load_robot(), cameras


def test_the_first_row_is_the_start_and_the_others_are_commands(model):
    spec, robot, cameras = model
    frames = view_images(spec, {v: np.zeros((72, 96, 3), np.uint8) for v in spec.views})
    names = (*reversed(robot.joint_names), 'time')
    rows = np.arange(3.0)[:, None] * np.linspace(0.01, 0.1, len(names) - 1)
    values = np.column_stack([rows, [10.0, 10.5, 11.5]])
    start, commands = table_start(robot, spec, frames, cameras, names, values)
    assert not start.positions.any() and start.frames.shape == (2, 72, 96, 3)
    np.testing.assert_allclose(commands.times, [0.5, 1.5])
    np.testing.assert_allclose(commands.positions, rows[1:, ::-1])
    _, commands = table_start(robot, spec, frames, cameras, names[:-1], rows)
    np.testing.assert_allclose(commands.times, [0.2, 0.4])  # a row is a frame of 5 Hz


def test_tables_that_cannot_be_imagined_are_refused(model):
    spec, robot, cameras = model
    frames = np.zeros((2, 72, 96, 3), np.uint8)
    names = (*robot.joint_names, 'time')
    with pytest.raises(ConfigError, match='has 1 rows'):
        table_start(robot, spec, frames, cameras, names, np.zeros((1, len(names))))
    with pytest.raises(ConfigError, match="'time' .* must increase"):
        table_start(robot, spec, frames, cameras, names, np.zeros((2, len(names))))
    with pytest.raises(ConfigError, match='needs one of each: --image low.png,high.png'):
        view_images(spec, {'low': frames[0]})


def test_the_command_names_what_is_missing(tmp_path, capsys):
    assert main(['imagine', '--image', 'low.png,high.png']) == 1
    assert '--image and --joints go together' in capsys.readouterr().err
    command = ['imagine', '--image', 'low.png,high.png', '--joints', 'plan.csv']
    assert main([*command, '--out', str(tmp_path / 'a.mp4')]) == 1
    assert "'low.png' is no file" in capsys.readouterr().err
    assert main(['imagine', '--image', 'low.png', *command[3:]]) == 1
    assert 'the checkpoint has 2 views: low, high' in capsys.readouterr().err


@pytest.mark.slow
def test_the_demo_as_pictures_and_a_table_is_imagined(episode, tmp_path, capsys):
    for view in ('low', 'high'):
        picture = np.asarray(episode.images[view].frames[0])[..., ::-1]
        cv2.imwrite(str(tmp_path / f'{view}.png'), picture)
    states = episode.joint_states
    _, commands = episode.trajectories[0]
    names = list(states.joint_names)
    columns = [commands.joint_names.index(name) for name in names]
    rows = [[0.0, *states.positions[0]]]
    rows += [
        [time, *row]
        for time, row in zip(commands.times, commands.positions[:, columns], strict=True)
    ]
    lines = [','.join(['time', *names]), *(','.join(map(str, row)) for row in rows)]
    (tmp_path / 'plan.csv').write_text('\n'.join(lines))
    out = tmp_path / 'a.mp4'
    command = ['imagine', '--image', f'{tmp_path}/low.png,{tmp_path}/high.png']
    command += ['--joints', f'{tmp_path}/plan.csv', '--out', str(out), '--threads', '1']
    command += ['--instruction', episode.info.instruction, '--place', 'simulator/nominal']
    assert main(command) == 0
    said = capsys.readouterr().out
    assert '16 frames of low, high at 5 Hz' in said and 'foreseen motions' in said
    assert decode_video(out.read_bytes()).shape == (16, 72, 192, 3)
