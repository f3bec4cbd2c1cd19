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
from mtv_world_ros.lab.training.object_motion import contact_fit
from mtv_world_ros.lab.training.object_motion.contact_fit import (
    first_settings,
    fit_contact,
    read_contact,
    read_recordings,
)
from mtv_world_ros.model.object_motion.contact_settings import ContactSettings
from mtv_world_ros.model.object_motion.predictor import (
    CONTACT_FILE,
    load_predictor,
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
    found = first_settings(robot, response)
    column = robot.joint_names.index(robot.tools[0].gripper_joint)
    other = robot.joint_names.index(robot.tools[1].gripper_joint)
    # two fingers share what drives the joint
    both = 0.5 / response.compliance[[column, other]]
    assert found.finger_stiffness == pytest.approx(both.mean())
    assert found.finger_damping == pytest.approx((both * response.damping[[column, other]]).mean())


def test_the_search_leaves_what_loses_the_block(robot, response, monkeypatch):
    """The recorded block was carried; with slippery fingers it is not."""
    recording = read_contact(DEMO, robot, VIEWS)
    first = first_settings(robot, response).model_copy(update={'grip_friction': 0.03})
    lost = np.nanmax(recording.errors(robot, response, first)[-1])
    monkeypatch.setattr(contact_fit, '_FACTORS', (30.0,))
    monkeypatch.setattr(contact_fit, '_FITTED', ('grip_friction', 'tray_kg'))
    lines: list[str] = []
    found = fit_contact(
        [recording], robot_path('yam_bimanual'), response, first, report=lines.append
    )
    assert found.grip_friction == pytest.approx(0.9)
    assert np.nanmax(recording.errors(robot, response, found)[-1]) < 0.03 < 0.05 < lost
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
        fit_contact([], robot_path('yam_bimanual'), response, first_settings(robot, response))


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
    contact = load_predictor(file.parent, robot).contact
    assert contact is not None and contact.num_motions == 2
    assert contact.model_dump() == pytest.approx(json.loads(file.read_text()))
    assert main(words) != 0
    assert '--overwrite' in capsys.readouterr().err


def test_a_checkpoint_that_does_not_know_its_arms_is_refused(checkpoint, capsys):
    (checkpoint / 'object_motion' / 'arm_response.json').unlink()
    assert main(['fit-contact', str(DEMO), '--checkpoint', str(checkpoint)]) != 0
    assert "run 'mtv-world train-motion' first" in capsys.readouterr().err
