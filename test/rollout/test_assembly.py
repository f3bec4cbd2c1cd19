"""Checkpoints are found by path or by the names of those in the package."""

from __future__ import annotations

from pathlib import Path

import pytest

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.card import read_card
from mtv_world_ros.rollout.assembly import BUNDLED_FOLDERS, can_foresee, checkpoint_path


@pytest.mark.parametrize('name', BUNDLED_FOLDERS)
def test_names_of_the_packages_checkpoints_are_folders_of_checkpoints(name: str):
    assert read_card(checkpoint_path(name)).robot == 'yam_bimanual'


def test_one_foresees_objects_and_the_papers_way_draws_first_masks():
    assert can_foresee(checkpoint_path('bundled'))
    assert not can_foresee(checkpoint_path('bundled-paper'))
    card = read_card(checkpoint_path('bundled-paper'))
    assert card.object_mask and not card.rendering.get('object_motion', False)


def test_a_misspelt_name_of_the_package_names_the_nearest():
    with pytest.raises(CheckpointError, match="'bundled_paper' is no folder.*'bundled-paper'"):
        checkpoint_path('bundled_paper')


def test_a_folder_whose_name_begins_alike_is_a_path(tmp_path: Path):
    folder = tmp_path / 'bundled_mine'
    folder.mkdir()
    assert checkpoint_path(folder) == folder
