import json
import shutil
import sys

import pytest
from safetensors.torch import load_file, save_file

from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.vision.segmenters.choose import choose_segmenter, WEIGHTS_VARIABLE
from mtv_world_ros.vision.segmenters.weights import (
    find_weights,
    load_tokenizer,
    load_vision_model,
)


@pytest.fixture
def tracker(weights, tmp_path):
    """A copy of the tiny SAM 2 to break."""
    return shutil.copytree(weights / 'tracker', tmp_path / 'tracker')


@pytest.fixture(autouse=True)
def no_variable(monkeypatch):
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)


def test_models_are_found_by_type_whatever_their_folders_are_called(weights):
    assert find_weights(weights) == {
        'mm-grounding-dino': weights / 'some org' / 'detector',
        'sam2_video': weights / 'tracker',
        'sam3_video': weights / 'third',
    }


def test_folder_of_one_model_is_found_itself(weights):
    assert find_weights(weights / 'tracker') == {'sam2_video': weights / 'tracker'}


def test_folder_without_models_holds_none(tmp_path):
    (tmp_path / 'config.json').write_text('{"model_type": "bert"}')
    assert find_weights(tmp_path) == {}


def test_saved_weights_are_loaded(weights):
    model = load_vision_model(weights / 'tracker', 'sam2_video', 'cpu')
    saved = load_file(weights / 'tracker' / 'model.safetensors')
    name = 'memory_attention.layer_norm.weight'
    assert model.state_dict()[name].equal(saved[name]) and not model.training


def test_missing_folder_names_what_belongs_there(tmp_path):
    with pytest.raises(CheckpointError, match=r'none.*no config.json.*facebook/sam2'):
        load_vision_model(tmp_path / 'none', 'sam2_video', 'cpu')


def test_model_of_another_type_names_both_types(weights):
    with pytest.raises(CheckpointError, match="type 'sam2_video', not 'mm-grounding-dino'"):
        load_vision_model(weights / 'tracker', 'mm-grounding-dino', 'cpu')


def test_pickled_weights_are_not_loaded(tracker):
    (tracker / 'model.safetensors').rename(tracker / 'pytorch_model.bin')
    with pytest.raises(CheckpointError, match='no \\*.safetensors'):
        load_vision_model(tracker, 'sam2_video', 'cpu')


def test_cut_off_weights_name_the_folder(tracker):
    file = tracker / 'model.safetensors'
    file.write_bytes(file.read_bytes()[:100_000])
    with pytest.raises(CheckpointError, match=f"'{tracker}' cannot be read"):
        load_vision_model(tracker, 'sam2_video', 'cpu')


def test_missing_tensor_is_named_instead_of_drawn_at_random(tracker):
    file = tracker / 'model.safetensors'
    tensors = load_file(file)
    del tensors['no_object_pointer']
    save_file(tensors, file, {'format': 'pt'})
    with pytest.raises(CheckpointError, match='lack no_object_pointer'):
        load_vision_model(tracker, 'sam2_video', 'cpu')


def test_tensors_of_another_size_are_refused(tracker):
    config = json.loads((tracker / 'config.json').read_text())
    config['memory_fuser_intermediate_dim'] = 64
    (tracker / 'config.json').write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match='cannot be read'):
        load_vision_model(tracker, 'sam2_video', 'cpu')


def test_broken_config_is_named(tracker):
    (tracker / 'config.json').write_text('{')
    with pytest.raises(CheckpointError, match='config.json'):
        load_vision_model(tracker, 'sam2_video', 'cpu')


def test_missing_tokenizer_is_named(weights):
    with pytest.raises(CheckpointError, match='no tokenizer.json'):
        load_tokenizer(weights / 'tracker')


def test_missing_transformers_says_what_to_install(weights, monkeypatch):
    monkeypatch.setitem(sys.modules, 'transformers', None)
    with pytest.raises(ConfigError, match=r'mtv_world_ros\[vision\]'):
        load_vision_model(weights / 'tracker', 'sam2_video', 'cpu')


def test_colour_is_the_default_without_weights(tmp_path):
    assert choose_segmenter().name == 'colour'
    assert choose_segmenter(weights=tmp_path).name == 'colour'


def test_weights_that_the_variable_names_are_the_default(weights, monkeypatch):
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(weights))
    assert choose_segmenter().name == 'mm-grounding-dino+sam2'
    assert choose_segmenter('colour').name == 'colour'


def test_tracker_without_a_detector_is_not_the_default_and_says_so_when_asked_for(tracker):
    assert choose_segmenter(weights=tracker).name == 'colour'
    with pytest.raises(ConfigError, match=r"'sam2', but .* holds no mm-grounding-dino \(openmm"):
        choose_segmenter('sam2', weights=tracker)


def test_sam3_is_taken_only_when_asked_for(weights):
    assert choose_segmenter(weights=weights / 'third').name == 'colour'
    assert choose_segmenter('sam3', weights=weights / 'third').name == 'sam3'


def test_named_segmenter_without_a_folder_names_the_variable():
    with pytest.raises(ConfigError, match=f"'sam3'.*{WEIGHTS_VARIABLE} names; it is not set"):
        choose_segmenter('sam3')


def test_folder_that_does_not_exist_is_an_error_even_by_default(tmp_path, monkeypatch):
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / 'gone'))
    with pytest.raises(ConfigError, match='gone.* is no folder'):
        choose_segmenter()


def test_unknown_segmenter_names_the_nearest():
    with pytest.raises(ConfigError, match="did you mean 'colour'"):
        choose_segmenter('color')
