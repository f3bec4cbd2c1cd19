"""`check` on a robot whose root link is `world`: what moves follows the kinematics."""

from dataclasses import replace
import shutil

import numpy as np
import pytest

from mtv_world_ros.cli import main
from mtv_world_ros.data.episode_reader import read_episode
from mtv_world_ros.inspection.inspect import Inspector
from mtv_world_ros.inspection.motion_residual import ResidualSearch
from mtv_world_ros.robot.shape import load_shape, moving_links
from test.support.crane import load, make_cameras, make_positions, tilted, write_episode

SEARCH = ResidualSearch(max_pairs=20, lags_s=(0.0,))


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """Robot and a recording whose camera `door` is given in the root link."""
    folder = tmp_path_factory.mktemp('crane')
    robot, cameras = load(folder), make_cameras()
    del cameras['window']
    cameras['door'] = replace(cameras['door'], mount_link='world')
    positions = make_positions(5.0)
    return robot, write_episode(folder / 'episode', robot, cameras, positions)


def doctor(robot, path, out, *options):
    return main(['check', str(path), '--robot', str(robot.file), '--out', str(out), *options])


def test_links_that_move_are_those_beyond_a_joint(recorded):
    robot, _ = recorded
    assert not {'world', 'plinth'} & moving_links(robot)
    assert {'tower', 'hand', 'left', 'right'} <= moving_links(robot)


@pytest.mark.slow
def test_a_camera_of_the_root_link_is_compared_with_the_images(recorded, tmp_path, capsys):
    robot, path = recorded
    assert doctor(robot, path, tmp_path, '--views', 'door') == 0, capsys.readouterr().out
    episode = read_episode(path, views=['door'], with_masks=False)
    inspector = Inspector(robot, load_shape(robot), SEARCH)
    wrong = {
        'rolled': tilted(episode.cameras['door'], 10, 2),
        'zoomed': replace(
            episode.cameras['door'], K=np.diag([1.15, 1.15, 1]) @ episode.cameras['door'].K
        ),
    }
    for name, camera in wrong.items():
        section = inspector.inspect(replace(episode, cameras={'door': camera})).views[0]
        assert section.verdict in ('suspicious', 'broken'), name


def test_what_was_not_checked_has_an_exit_status_of_its_own(recorded, tmp_path, capsys):
    robot, path = recorded
    shutil.copytree(robot.file.parent, tmp_path / 'crane')
    (tmp_path / 'crane' / 'meshes' / 'hand.stl').unlink()
    status = main(
        ['check', str(path), '--robot', str(tmp_path / 'crane' / 'crane.yaml'), '--views', 'door']
        + ['--out', str(tmp_path)]
    )
    printed = capsys.readouterr().out
    assert status == 3, printed
    assert 'door: not checked' in printed and 'hand.stl' in printed
