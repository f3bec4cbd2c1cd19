"""Tables of keys on the pages are complete: every key that a user may write is there."""

from pathlib import Path

import pytest

from mtv_world_ros.cameras.calibration_file import _View
from mtv_world_ros.robot.file import DhArmEntry, DhEntry, MimicEntry, RobotFile, ToolEntry
from mtv_world_ros.simulation.collect.dataset_readme import KEYS

DOCS = Path(__file__).resolve().parents[2] / 'docs'


@pytest.mark.parametrize(
    ('page', 'kinds'),
    [
        ('robots.md', (RobotFile, ToolEntry, MimicEntry, DhArmEntry, DhEntry)),
        ('cameras.md', (_View,)),
    ],
)
def test_every_key_of_a_file_is_on_its_page(page, kinds):
    text = (DOCS / page).read_text()
    keys = {name for kind in kinds for name in kind.model_fields}
    assert not {key for key in keys if f'`{key}`' not in text and f'{key}:' not in text}


def test_every_key_of_an_episodes_metadata_is_on_its_page():
    text = (DOCS / 'episodes.md').read_text()
    assert not {key for key in KEYS if f'`{key}`' not in text}
