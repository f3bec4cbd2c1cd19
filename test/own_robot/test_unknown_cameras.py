"""Recordings of which nothing is known but images and joints, and mappings with more views."""

import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.errors import CalibrationError
from mtv_world_ros.data.bag_mapping import load_bag_mapping
from mtv_world_ros.data.episode_reader import read_episode
from test.own_robot.test_import_bag import run
from test.support.bags import bag_cameras, MAPPING, record
from test.support.crane import FPS, make_positions, render


@pytest.fixture
def bag(robot, tmp_path):
    """A bag without the door's transform; the palm's camera_info is left out by the mapping."""
    cameras, positions = bag_cameras(), make_positions(20 / FPS)
    frames = {view: render(robot, camera, positions) for view, camera in cameras.items()}
    return record(tmp_path / 'wave', robot, cameras, positions, frames=frames)


def mapping_of(folder):
    """The mapping with views, as the import writes it."""
    return yaml.safe_load((folder / 'out' / 'mapping.yaml').read_text())


def test_unknown_poses_and_intrinsics_are_imported_and_marked(bag, tmp_path, capsys):
    assert run(tmp_path, bag) == 0
    views = mapping_of(tmp_path)['views']
    views['door']['frame'] = 'nobody_knows'
    views['palm'] |= {'frame': 'nobody_either', 'camera_info': '/no/such/topic'}
    capsys.readouterr()
    more = MAPPING | {'views': views}
    assert run(tmp_path, bag, mapping=more, more=['--out', str(tmp_path / 'blind')]) == 0
    printed = capsys.readouterr()
    clicks = f'mtv-world fit camera {tmp_path / "blind"} --view door --click points.html'
    assert f"view 'door': pose not known: {clicks}" in printed.err
    assert "view 'palm': pose and intrinsics not known" in printed.err
    assert 'wave: 1.9 s; frames: door 20, palm 20' in printed.out
    assert 'cameras not known: door, palm' in printed.out
    episode = tmp_path / 'blind' / 'wave'
    with pytest.raises(CalibrationError, match=rf'fit camera {episode} --view door'):
        read_episode(episode)
    blind = read_episode(episode, unknown_mount='plinth')
    assert blind.unknown == {'door': 'pose', 'palm': 'pose and intrinsics'}
    assert blind.cameras['door'].K[0, 0] == 300  # of the CameraInfo, which was kept
    report = ['--out', str(tmp_path / 'report')]
    robot = str(tmp_path / 'blind' / 'robot' / 'robot.yaml')
    assert main(['check', str(episode), '--robot', robot, *report]) == 3  # not checked, not ok
    printed = capsys.readouterr().out
    assert 'pose not known: mtv-world fit camera FOLDER --view door' in printed


@pytest.mark.slow
def test_a_mapping_may_have_more_views_than_are_asked_for(bag, tmp_path, capsys):
    assert run(tmp_path, bag) == 0
    mapping = load_bag_mapping(tmp_path / 'out' / 'mapping.yaml')
    assert read_episode(bag, views=['door'], mapping=mapping).views == ('door',)
    asked = ['--topics', str(tmp_path / 'out' / 'mapping.yaml'), '--views', 'door']
    main(['check', str(bag), *asked, '--out', str(tmp_path / 'report')])
    printed = capsys.readouterr()
    assert 'neither a view' not in printed.err and 'door' in printed.out


def test_intrinsics_of_a_file_are_used_and_the_difference_is_said(bag, tmp_path):
    assert run(tmp_path, bag) == 0
    episode = tmp_path / 'out' / 'wave'
    file = tmp_path / 'mine.yaml'
    values = yaml.safe_load((episode / 'calibration.yaml').read_text())
    file.write_text(yaml.safe_dump(values))
    assert not read_episode(episode, calibration=file).warnings
    values['views']['door']['K'][0][0] = 330.0
    file.write_text(yaml.safe_dump(values))
    read = read_episode(episode, calibration=file)
    assert read.cameras['door'].K[0, 0] == 330
    assert any('330.0' in line and '300.0' in line for line in read.warnings)
    np.testing.assert_allclose(read.cameras['palm'].K[0, 0], 300)
