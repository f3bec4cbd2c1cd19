"""What is foreseen without a picture, of an episode and of a file, for any robot."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import yaml

from mtv_world_ros.cli import main
from mtv_world_ros.core.files import share_path
from mtv_world_ros.simulation.opengl import missing_opengl

DEMO = str(share_path('resource', 'demo_episode'))
BLOCK = {'name': 'red block', 'centre': [0.0, 0.3, 0.02], 'size': [0.04, 0.04, 0.04]}


def scene_file(folder, joints: int, **changed):
    rows = [[0.0] * joints] * 2
    values = {'objects': [BLOCK], 'times': [0, 0.4], 'positions': rows} | changed
    (folder / 'scene.yaml').write_text(yaml.safe_dump(values))
    return str(folder / 'scene.yaml')


def test_the_recorded_block_is_carried_onto_the_other(tmp_path, capsys):
    picture = tmp_path / 'foreseen.png'
    words = ['foresee', DEMO, '--contact', 'bundled', '--futures', '2']
    words += [] if missing_opengl() else ['--picture', str(picture)]
    assert main(words) == 0
    carried, other, *_ = capsys.readouterr().out.splitlines()
    x, y, z = map(float, carried.partition('(')[2].partition(')')[0].split(', '))
    assert np.hypot(x, y) > 100 and 35 < z < 55  # on a block of 46 mm
    assert other.startswith('pink block: goes by (')
    if not missing_opengl():
        drawn = cv2.imread(str(picture))
        red, blue = (drawn[..., [2, 0]].astype(int) - drawn[..., [0, 2]]).transpose(2, 0, 1)
        assert (red > 50).sum() > 500 and (blue > 50).sum() > 500


@pytest.mark.parametrize(('robot', 'joints'), [('franka', 8), ('ur5e_pair', 14)])
def test_robots_without_inertias_are_foreseen_and_what_is_assumed_is_said(
    tmp_path, capsys, robot, joints
):
    home = {'franka': [0, 0, 0, -1.5, 0, 1.5, 0, 0.04]}.get(robot, [0.0] * joints)
    file = scene_file(tmp_path, joints, positions=[home, home])
    assert main(['foresee', file, '--robot', robot, '--futures', '2']) == 0
    told = capsys.readouterr().out
    assert 'are guessed' in told and 'state no inertia' in told and 'was not found' in told
    assert 'red block: goes by (' in told


def test_a_plan_that_does_not_fit_is_named(tmp_path, capsys):
    assert main(['foresee', scene_file(tmp_path, 3)]) != 0
    assert 'give a row of 14 for each time' in capsys.readouterr().err
    assert main(['foresee', scene_file(tmp_path, 14, times=[0.5, 1])]) != 0
    assert 'the first must be 0' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('changed', 'says'),
    [
        ({'times': [], 'positions': []}, 'times'),
        ({'times': [0], 'positions': [[0.0] * 14]}, 'times'),
        ({'times': [0, 1e4]}, 'must be at most 120'),
        ({'times': [0, 0]}, 'not increasing'),
        ({'positions': [[0.0] * 14, [0.0]]}, 'give a row of 14'),
        ({'positions': [[9.0] * 14, [0.0] * 14]}, 'its limits are'),
        ({'objects': []}, 'objects'),
        ({'objects': [BLOCK, BLOCK]}, "two objects are called 'red block'"),
        ({'objects': [BLOCK | {'centre': [0.0, 0.3]}]}, 'centre'),
        ({'objects': [BLOCK | {'size': [0.04, 0.04, 0.0]}]}, 'size'),
        ({'objects': [BLOCK | {'centre': [0.0, 1e6, 0.0]}]}, 'must be at most 100'),
    ],
)
def test_a_scene_that_is_none_is_refused_in_one_line(tmp_path, capsys, changed, says):
    assert main(['foresee', scene_file(tmp_path, 14, **changed)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line and 'scene.yaml' in line


@pytest.mark.parametrize('count', ['0', '-3', '1000000'])
def test_a_number_of_futures_that_cannot_be_is_refused(tmp_path, capsys, count):
    words = ['foresee', scene_file(tmp_path, 14), '--contact', 'bundled', '--futures', count]
    assert main(words) == 1
    assert f"'num_motions' is {count}, must be at " in capsys.readouterr().err
