"""Friction, weight and grip, found in recorded episodes."""

from __future__ import annotations

import json
from pathlib import Path
import shutil

import numpy as np
import pytest

from mtv_world_ros.assembly import checkpoint_path, robot_path
from mtv_world_ros.cli import main
from mtv_world_ros.errors import TrainingError
from mtv_world_ros.files import share_path
from mtv_world_ros.foresight.arms import Arms
from mtv_world_ros.foresight.contact_settings import ContactSettings
from mtv_world_ros.foresight.engine import Engine
from mtv_world_ros.foresight.loading import CONTACT_FILE, load_foresight
from mtv_world_ros.geometry.robot.file import load_robot
from mtv_world_ros.lab.training.object_motion import contact_fit
from mtv_world_ros.lab.training.object_motion.contact_fit import (
    first_settings,
    fit_contact,
    read_contact,
    read_recordings,
)

VIEWS = ('low', 'high')
DEMO = share_path('resource', 'demo_episode')


@pytest.fixture
def checkpoint(tmp_path) -> Path:
    copied = tmp_path / 'checkpoint'
    shutil.copytree(checkpoint_path('bundled'), copied)
    (copied / 'object_motion' / CONTACT_FILE).unlink(missing_ok=True)
    return copied


def test_fingers_begin_as_their_joints_follow(robot, response):
    found = first_settings(Arms(robot, response))
    column = robot.joint_names.index(robot.tools[0].gripper_joint)
    other = robot.joint_names.index(robot.tools[1].gripper_joint)
    # two fingers share what drives the joint
    both = 0.5 / response.compliance[[column, other]]
    assert found.finger_stiffness == pytest.approx(both.mean())
    assert found.finger_damping == pytest.approx((both * response.damping[[column, other]]).mean())


def test_the_search_leaves_what_loses_the_block(robot, response, monkeypatch):
    """The recorded block was carried; with slippery fingers it is not."""
    recording = read_contact(DEMO, robot, VIEWS)
    arms = Arms(robot, response)
    engine, slippery = Engine(arms), {'grip_friction': 0.03}
    first = first_settings(arms).model_copy(update=slippery)
    lost = np.nanmax(recording.errors(engine, first)[-1])
    monkeypatch.setattr(contact_fit, '_FACTORS', (30.0,))
    monkeypatch.setattr(contact_fit, '_FITTED', ('grip_friction', 'tray_kg'))
    lines: list[str] = []
    found = fit_contact(
        [recording], robot_path('yam_bimanual'), response, first, report=lines.append
    )
    assert found.grip_friction == pytest.approx(0.9)
    assert np.nanmax(recording.errors(engine, found)[-1]) < 0.03 < 0.05 < lost
    begins, ends = (float(line.split()[2].rstrip(':')) for line in lines[1:])
    assert ends < begins


def test_what_helps_in_one_episode_of_many_is_chance():
    assert contact_fit._sure_gain(np.array([0.1, np.nan])) == pytest.approx(0.1)
    assert contact_fit._sure_gain(np.array([0.1, 0.2, 0.1, 0.2])) > 0.1
    assert contact_fit._sure_gain(np.array([0.0, -0.01, 0.01, 0.5])) < 0


def test_recordings_that_say_nothing_are_refused(robot, response, tmp_path):
    recordings, skipped = read_recordings([DEMO, tmp_path], robot, VIEWS)
    assert len(recordings) == 1 and list(skipped) == [str(tmp_path)]
    with pytest.raises(TrainingError, match='no episode says where an object went'):
        first = first_settings(Arms(robot, response))
        fit_contact([], robot_path('yam_bimanual'), response, first)


def test_the_command_writes_what_a_checkpoint_foresees_with(
    checkpoint, robot, capsys, monkeypatch
):
    monkeypatch.setattr(contact_fit, '_FACTORS', (1.3,))
    assert set(contact_fit._FITTED) <= set(ContactSettings.model_fields)
    monkeypatch.setattr(contact_fit, '_FITTED', ('grip_friction',))
    words = ['fit-contact', str(DEMO), '--checkpoint', str(checkpoint), '--motions', '2']
    assert main(words) == 0
    file = checkpoint / 'object_motion' / CONTACT_FILE
    assert f'1 episodes, 0 left out: {file}' in capsys.readouterr().out
    contact = load_foresight(file.parent, robot).settings
    assert contact.num_motions == 2
    assert contact == ContactSettings(**json.loads(file.read_text()))
    assert main(words) != 0
    assert '--overwrite' in capsys.readouterr().err


def test_how_arms_follow_is_found_where_a_checkpoint_does_not_know(
    tmp_path, robot, capsys, monkeypatch
):
    """Of one episode alone nothing is: defaults are taken, and said."""
    monkeypatch.setattr(contact_fit, '_FACTORS', ())
    assert main(['fit-contact', str(DEMO), '--out', str(tmp_path / 'new')]) == 0
    told = capsys.readouterr().out
    assert 'how 14 joints follow commands was not found' in told and 'one episode' in told
    assert load_foresight(tmp_path / 'new' / 'object_motion', robot).response is None


@pytest.mark.parametrize('name', ['franka', 'ur5e_pair'])
def test_robots_without_inertias_have_numbers_to_begin_with(name):
    arms = Arms(load_robot(robot_path(name)), None)
    found = first_settings(arms)
    assert np.isfinite(found.finger_stiffness) and found.finger_stiffness > 50
    assert any('state no inertia' in note for note in arms.notes)
