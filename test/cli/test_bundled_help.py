"""Help texts name what is bundled, as its folder or registry has it today."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from mtv_world_ros.cli import make_parser
from mtv_world_ros.cli.commands import COMMANDS
from mtv_world_ros.control.registry import CONTROLS
from mtv_world_ros.core import files
from mtv_world_ros.core.files import bundled_names, share_path
from mtv_world_ros.ros.parameters import Settings
from mtv_world_ros.training.training_config import VideoConfig
from mtv_world_ros.vision.segmenters.registry import SEGMENTERS


def helps(option: str) -> dict[str, str]:
    """Help text of an option, by the command that has it."""
    found = {}
    for command in COMMANDS:
        parser = make_parser(command)
        for word in command.split():
            choices = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
            parser = choices.choices[word]
        for action in parser._actions:
            if option in action.option_strings:
                found[command] = action.help or ''
    return found


@pytest.fixture
def share(tmp_path, monkeypatch) -> Path:
    """Installed files that a test adds to."""
    for kind in ('robots', 'models', 'policies'):
        folder = tmp_path / 'config' / kind
        folder.mkdir(parents=True)
        for entry in share_path('config', kind).iterdir():
            (folder / entry.name).symlink_to(entry)
    monkeypatch.setattr(files, '_candidates', lambda: [tmp_path])
    return tmp_path / 'config'


def test_a_robot_that_is_added_to_the_folder_is_in_the_help_of_every_command_with_a_robot(share):
    before = helps('--robot')
    (share / 'robots' / 'crane').mkdir()
    (share / 'robots' / 'crane' / 'robot.yaml').write_text('name: crane')
    after = helps('--robot')
    assert len(after) >= 10
    assert not [command for command, text in before.items() if 'crane' in text]
    # `collect` asks for a workcell, too
    assert [command for command, text in after.items() if 'crane, franka' not in text] == [
        'collect'
    ]
    (share / 'robots' / 'crane' / 'workcell.yaml').write_text('arms: {}')
    assert 'crane, franka' in helps('--robot')['collect']


@pytest.mark.parametrize(
    ('option', 'kind', 'commands'),
    [('--preset', 'models', {'train', 'import wan'}), ('--policy', 'policies', {'imagine'})],
)
def test_a_file_that_is_added_to_its_folder_is_in_the_help(share, option, kind, commands):
    (share / kind / 'added_here.yaml').write_text('{}')
    said = {command: text for command, text in helps(option).items() if 'added_here' in text}
    assert set(said) == commands


def test_a_segmenter_that_is_added_to_the_registry_is_in_the_help(monkeypatch):
    monkeypatch.setitem(SEGMENTERS, 'added_here', 'nowhere:Nothing')
    texts = helps('--segmenter')
    assert len(texts) >= 7
    assert not [command for command, text in texts.items() if 'added_here' not in text]


@pytest.mark.parametrize(
    ('text', 'names'),
    [
        (VideoConfig.model_fields['control'].description, CONTROLS),
        (Settings.model_fields['segmenter'].description, SEGMENTERS),
    ],
    ids=['video.control', 'the node: segmenter'],
)
def test_descriptions_of_settings_name_every_class_of_the_registry(text, names):
    assert ', '.join(names) in text


def test_only_robots_that_hold_a_file_are_listed_where_it_is_asked_for():
    assert set(bundled_names('robots')) >= set(bundled_names('robots', 'workcell.yaml'))
    assert bundled_names('robots', 'no_such_file.yaml') == []
