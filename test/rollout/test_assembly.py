"""Checkpoints are found by path or by the names of those in the package."""

from __future__ import annotations

from pathlib import Path

import pytest

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.checkpoint import BUNDLED_FOLDERS, Checkpoint, checkpoint_folder


@pytest.mark.parametrize('name', BUNDLED_FOLDERS)
def test_names_of_the_packages_checkpoints_are_folders_of_checkpoints(name: str):
    assert Checkpoint.open(name).card.robot == 'yam_bimanual'


def test_one_foresees_objects_and_the_papers_way_draws_first_masks():
    bundled, paper = (Checkpoint.open(name) for name in ('bundled', 'bundled-paper'))
    assert bundled.can_foresee(bundled.load_robot())
    assert not paper.can_foresee(paper.load_robot())
    card = paper.card
    assert card.object_mask and not card.rendering.get('object_motion', False)


def test_a_misspelt_name_of_the_package_names_the_nearest():
    with pytest.raises(CheckpointError, match="'bundled_paper' is no folder.*'bundled-paper'"):
        checkpoint_folder('bundled_paper')


def test_a_folder_whose_name_begins_alike_is_a_path(tmp_path: Path):
    folder = tmp_path / 'bundled_mine'
    folder.mkdir()
    assert checkpoint_folder(folder) == folder
