"""A segmenter is one file: chosen by name, by entry point or as `module:Class`."""

from importlib.metadata import EntryPoint
import os
from pathlib import Path
import sys

import numpy as np
import pytest

from mtv_world_ros.core import registry
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.vision.jaccard import jaccard
from mtv_world_ros.vision.segmenters.choose import choose_segmenter, WEIGHTS_VARIABLE
from mtv_world_ros.vision.segmenters.registry import check_segmenter_name, SEGMENTERS
from mtv_world_ros.vision.segmenters.segmenter import masks_from_ids

ROOT = Path(__file__).parents[3]
#: before the tests hide the variable
PUBLIC_WEIGHTS = Path(os.environ[WEIGHTS_VARIABLE]) if os.environ.get(WEIGHTS_VARIABLE) else None
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


def chosen(name):
    """The segmenter; the test is left out where it needs weights that are not here."""
    try:
        return choose_segmenter(name, weights=PUBLIC_WEIGHTS)
    except ConfigError as error:
        if 'whose weights are looked for' not in str(error):
            raise
        pytest.skip(f"weights: none for '{name}' in {WEIGHTS_VARIABLE}")


@pytest.fixture(scope='module')
def real_picture(robot):
    """Frames of the bundled recording (2, 5, H, W, 3), names and true masks of its objects."""
    spec = WorldModelSpec(
        views=('low', 'high'), fps=5, num_frames=16, width=192, height=144, robot=robot.name
    )
    recording = load_recording(share_path('resource', 'demo_episode'), spec, robot)
    times = slice(0, 40, 8)  # the purple block is lifted and set down again
    true = masks_from_ids(recording.object_ids[:, times], recording.objects, recording.objects)
    assert true.masks.any((-2, -1)).all()
    return recording.frames[:, times], recording.objects, true.masks


@pytest.mark.usefixtures('mine')
@pytest.mark.parametrize('name', [*SEGMENTERS, OWN])
def test_every_segmenter_finds_the_objects_of_a_real_picture(name, real_picture):
    frames, names, true = real_picture
    found = chosen(name).segment(frames, names)
    assert found.names == names
    assert found.status == (('ok', 'ok'),) * 2
    # of each view and object, in every frame
    assert jaccard(found.masks, true).min() > 0.75


def test_an_object_that_a_real_picture_does_not_show_is_absent(real_picture):
    frames, names, true = real_picture
    found = choose_segmenter('colour').segment(frames, ('green cup', *names))
    assert found.status == (('absent', 'ok', 'ok'),) * 2
    assert not found.masks[:, 0].any()
    assert jaccard(found.masks[:, 1:], true).min() > 0.9


@pytest.mark.usefixtures('mine')
@pytest.mark.parametrize('name', [*SEGMENTERS, OWN])
def test_masks_belong_to_the_names_in_their_order(name, real_picture):
    frames, names, true = real_picture
    found = chosen(name).segment(frames[:, :2], names[::-1])
    assert jaccard(found.masks, true[:, ::-1, :2]).min() > 0.75


@pytest.mark.parametrize('name', SEGMENTERS)
def test_every_segmenter_of_the_package_finds_nothing_in_an_empty_picture(name):
    frames = np.full((2, 3, 24, 32, 3), 128, np.uint8)
    segmenter = chosen(name)
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
