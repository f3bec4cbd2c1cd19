"""The checkpoint that a training starts from is opened once, and travels as an object."""

from __future__ import annotations

from pathlib import Path

import pytest

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.model import checkpoint as opening
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.robot.file import load_robot, robot_path
from mtv_world_ros.training.clips.episode_index import IndexedEpisode
from mtv_world_ros.training.clips.fit_control import fitted_control
from mtv_world_ros.training.training_config import load_training_config, TrainingRun
from mtv_world_ros.training.training_run import training_notes

CONFIG = load_training_config('small')
DEMO = share_path('resource', 'demo_episode')


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Folders whose cards are read."""
    folders: list[Path] = []
    read_card = opening.read_card

    def counted(folder: Path):
        folders.append(folder)
        return read_card(folder)

    monkeypatch.setattr(opening, 'read_card', counted)
    return folders


def run_from(initial: object, tmp_path: Path) -> TrainingRun:
    return TrainingRun(config=CONFIG, dataset=DEMO, out=tmp_path, initial=initial)


def test_its_card_is_read_once(read, tmp_path):
    opened = Checkpoint.open('bundled')
    run = run_from(opened, tmp_path)
    assert run.initial is opened
    robot = load_robot(robot_path('yam_bimanual'))
    recording = load_recording(DEMO, CONFIG.spec, robot)
    fitted_control(tmp_path, CONFIG, [recording], robot, initial=run.initial)
    training_notes(CONFIG, [IndexedEpisode.of(recording, CONFIG.spec)], run.initial)
    assert read == [opened.folder]


@pytest.mark.parametrize('initial', ['bundled', share_path('resource', 'checkpoint')])
def test_a_name_or_a_path_is_opened(initial, read, tmp_path):
    run = run_from(initial, tmp_path)
    assert run.initial is not None
    assert run.initial.card.robot == 'yam_bimanual'
    assert run_from(None, tmp_path).initial is None
    assert len(read) == 1


def test_a_folder_that_is_no_checkpoint_is_refused_at_once(tmp_path):
    with pytest.raises(CheckpointError, match='nothing_here'):
        run_from(tmp_path / 'nothing_here', tmp_path)
