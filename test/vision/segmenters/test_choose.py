"""A segmenter is one file: chosen by name, by entry point or as `module:Class`."""

from importlib.metadata import EntryPoint
from pathlib import Path
import sys

import numpy as np
import pytest

from mtv_world_ros.core import registry
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.vision.segmenters.choose import choose_segmenter, WEIGHTS_VARIABLE
from mtv_world_ros.vision.segmenters.registry import check_segmenter_name, SEGMENTERS

ROOT = Path(__file__).parents[3]
OWN = 'own_segmenter:HueSegmenter'
MINE = """
class Made:
    name, segment = 'made', None

    @classmethod
    def create(cls, options):
        made = cls()
        made.options = options
        return made

class Needy:
    def __init__(self, camera): ...

class Speechless:
    name = 'speechless'
"""


@pytest.fixture(autouse=True)
def without_weights(monkeypatch):
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)


@pytest.fixture
def mine(tmp_path, monkeypatch):
    (tmp_path / 'my_segmenters.py').write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(ROOT / 'examples')
    yield
    for module in ('my_segmenters', 'own_segmenter'):
        sys.modules.pop(module, None)


@pytest.mark.usefixtures('mine')
def test_the_example_is_chosen_by_module_and_class_and_finds_the_objects():
    segmenter = choose_segmenter(OWN)
    assert segmenter.name == 'hue'
    frames = np.full((1, 1, 60, 80, 3), 128, np.uint8)
    frames[..., 10:20, 10:20, :] = (200, 30, 30)
    frames[..., 30:50, 40:60, :] = (30, 60, 200)
    found = segmenter.segment(frames, ('red block', 'blue cup', 'green car'))
    assert found.status == (('ok', 'ok', 'absent'),)
    squares = np.zeros((2, 60, 80), bool)
    squares[0, 10:20, 10:20] = squares[1, 30:50, 40:60] = True
    np.testing.assert_array_equal(found.masks[0, :2, 0], squares)


@pytest.mark.usefixtures('mine')
def test_a_class_with_create_gets_the_name_the_weights_and_the_device(tmp_path):
    made = choose_segmenter('my_segmenters:Made', weights=tmp_path, device='cuda')
    options = made.options
    assert (options.name, options.weights, options.device) == (
        'my_segmenters:Made', tmp_path, 'cuda',
    )  # fmt: skip
    with pytest.raises(ConfigError, match=r"segmenter is 'my_segmenters:Made', but .* no sam3_vi"):
        options.folders('sam3_video')


@pytest.mark.usefixtures('mine')
def test_an_entry_point_is_a_name_like_those_of_the_package(monkeypatch):
    point = EntryPoint('somebodys', 'my_segmenters:Made', 'mtv_world.segmenters')
    monkeypatch.setattr(registry, 'registered', lambda group: {'somebodys': point})
    assert choose_segmenter('somebodys').name == 'made'
    with pytest.raises(ConfigError, match=r"'sombodys' is not.*did you mean 'somebodys'"):
        check_segmenter_name('sombodys')


@pytest.mark.usefixtures('mine')
@pytest.mark.parametrize(
    ('choice', 'said'),
    [
        ('colr', r"'colr' is not registered \(did you mean 'colour'\?\); registered are auto, "),
        ('x', r'Set --segmenter .*or to module:Class, or to the objects.safetensors of an import'),
        ('nowhere_at_all:Mine', "No module named 'nowhere_at_all'; install the package"),
        ('my_segmenters:Nothing', "has no attribute 'Nothing'"),
        ('my_segmenters:Needy', r'cannot be created \(TypeError: .*camera'),
        ('my_segmenters:Speechless', 'is a Speechless, which lacks segment; see '),
        ('json:JSONDecoder', 'is a JSONDecoder, which lacks name, segment; see '),
    ],
)
def test_a_segmenter_that_cannot_be_used_is_refused_with_the_reason(choice, said):
    with pytest.raises(ConfigError, match=said):
        choose_segmenter(choice)


def test_a_script_that_runs_when_it_is_imported_is_refused(tmp_path, monkeypatch):
    text = 'import argparse\nargparse.ArgumentParser().parse_args(["--unknown"])\n'
    (tmp_path / 'my_script.py').write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match="'my_script' is a script that ends the program; put"):
        choose_segmenter('my_script:Mine')


@pytest.mark.parametrize('name', SEGMENTERS)
def test_every_segmenter_of_the_package_finds_nothing_in_an_empty_picture(name):
    frames = np.full((2, 3, 24, 32, 3), 128, np.uint8)
    try:
        segmenter = choose_segmenter(name)
    except ConfigError as error:
        assert 'whose weights are looked for' in str(error)
        return
    assert segmenter.name
    found = segmenter.segment(frames, ('red block', 'blue cup'))
    assert found.names == ('red block', 'blue cup')
    assert found.masks.shape == (2, 2, 3, 24, 32)
    assert not found.masks.any()
    assert {status for view in found.status for status in view} == {'absent'}


def test_all_names_of_the_package_are_valid_without_an_import():
    assert [check_segmenter_name(name) for name in SEGMENTERS] == list(SEGMENTERS)
    assert check_segmenter_name('runs/objects.safetensors') == 'runs/objects.safetensors'


def test_a_file_of_examples_that_is_not_there_is_no_name(tmp_path):
    with pytest.raises((CheckpointError, ConfigError), match='none.safetensors'):
        choose_segmenter(str(tmp_path / 'none.safetensors'))
