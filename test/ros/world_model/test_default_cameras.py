"""The default cameras are those of the checkpoint that the node has opened."""

from types import SimpleNamespace

import pytest

from mtv_world_ros.cameras.calibration_file import load_calibration
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model import checkpoint as opening
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.ros.world_model.loading import load_cameras


def settings(**values):
    return SimpleNamespace(**{'calibration_file': '', **values})


def test_an_opened_checkpoint_is_not_opened_again(monkeypatch):
    checkpoint = Checkpoint.open('bundled')
    monkeypatch.setattr(opening, 'read_card', None)
    cameras = load_cameras(settings(), checkpoint.spec, checkpoint)
    carried = load_calibration(checkpoint.cameras_file)
    assert [camera.view for camera in cameras] == list(checkpoint.spec.views)
    for camera in cameras:
        assert (camera.T_mount_camera == carried[camera.view].T_mount_camera).all()


def test_a_name_is_opened_where_no_file_is_set(tmp_path):
    spec = Checkpoint.open('bundled').spec
    assert len(load_cameras(settings(), spec, 'bundled')) == len(spec.views)
    own = settings(calibration_file=str(Checkpoint.open('bundled').cameras_file))
    nowhere = str(tmp_path / 'nowhere')
    assert len(load_cameras(own, spec, nowhere)) == len(spec.views)  # not needed
    with pytest.raises(CheckpointError, match='nowhere'):
        load_cameras(settings(), spec, nowhere)
