"""Which describer a YAML file brings; and the object list, which is one too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from mtv_world_ros.core.errors import ConfigError, DescriptionError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.rollout.assembly import assemble_describer
from mtv_world_ros.vision.describers.describer import InstructionDescriber, names_of
from mtv_world_ros.vision.describers.describer_config import (
    DescriberConfig,
    load_describer_config,
    load_object_list,
)
from mtv_world_ros.vision.describers.openai_chat import OpenAIConfig

FRAME = np.zeros((4, 4, 3), np.uint8)
OBJECTS = """
objects: [cup, {name: blue bowl, role: container}]
instructions:
  Stack the red  block on the blue block.: [red block, blue block]
  wait: []
"""


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_without_a_configuration_the_instruction_names_the_objects():
    assert isinstance(assemble_describer(), InstructionDescriber)


def test_a_class_of_ones_own_describes(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / 'my_describer.py').write_text(
        'class Mine:\n    def describe(self, first_frame, instruction):\n        return ()\n'
    )
    file = write(tmp_path / 'describer.yaml', 'kind: python\npython: my_describer:Mine\n')
    assert type(assemble_describer(file)).__name__ == 'Mine'
    for name, said in (
        ('my_describer:Mien', "has no attribute 'Mien'"),
        ('json:JSONDecoder', 'is a JSONDecoder, which lacks describe'),
        ('mine', "describer 'mine' is not registered; registered are none. Set the key 'python'"),
    ):
        with pytest.raises(ConfigError, match=said):
            assemble_describer(write(file, f'kind: python\npython: {name}\n'))


def test_the_file_that_is_shipped_is_valid_with_each_of_its_variants():
    shipped = share_path('config', 'describer.yaml')
    assert load_describer_config(shipped).kind == 'instruction'
    paragraphs = shipped.read_text().split('\n\n')[1:]
    for kind, paragraph in zip(('list', 'openai', 'python'), paragraphs, strict=False):
        lines = [line.removeprefix('# ') for line in paragraph.splitlines()]
        config = DescriberConfig(**yaml.safe_load('\n'.join(lines)))
        assert config.kind == kind
        assert getattr(config, kind)


def test_an_object_list_is_found_beside_the_file_that_names_it(tmp_path):
    write(tmp_path / 'objects.yaml', OBJECTS)
    file = write(tmp_path / 'describer.yaml', 'kind: list\nlist: objects.yaml\n')
    describer = assemble_describer(file)
    stack = describer.describe(FRAME, 'stack the red block on the blue block')
    assert names_of(stack) == ('red block', 'blue block')
    assert describer.describe(FRAME, 'wait') == ()
    others = describer.describe(FRAME, 'anything else')
    assert names_of(others) == ('cup', 'blue bowl')
    assert others[1].role == 'container'


def test_an_instruction_that_is_not_listed_is_an_error_not_an_empty_scene(tmp_path):
    text = 'instructions: {stack the red block on the blue block: [red block]}'
    listed = load_object_list(write(tmp_path / 'objects.yaml', text))
    with pytest.raises(DescriptionError) as caught:
        listed.describe(FRAME, 'stack the red block on the blue blok')
    assert caught.value.status == 'unlisted'
    assert "did you mean 'stack the red block on the blue block'?" in str(caught.value)


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('object: [cup]', "unknown key 'object' (did you mean 'objects'?)"),
        ('', "needs the key 'objects'"),
        ('[cup]', "needs the key 'objects'"),
        ('objects: cup', 'has to be a list'),
        ('objects:', 'has to be a list'),
        ('objects: [{nam: cup}]', "did you mean 'name'?"),
        ('objects: [cup, cup]', "name 'cup' is given to more than one object"),
        ('instructions: [cup]', "'instructions' has to map"),
        ('instructions: {take it: [{name: cup, role: cup}]}', "instruction 'take it'"),
        ('objects: [', 'cannot be read'),
    ],
)
def test_a_wrong_object_list_says_what_and_where(tmp_path, text, words):
    file = write(tmp_path / 'objects.yaml', text)
    with pytest.raises(ConfigError) as caught:
        load_object_list(file)
    assert words in str(caught.value) and str(file) in str(caught.value)


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('kind: opnai', "kind 'opnai' is none (did you mean 'openai'?)"),
        ('kind: openai', "needs the key 'openai'"),
        ('kind: list', "needs the key 'list'"),
        ('kind: python', "needs the key 'python'"),
        ('kind: [openai]', "'kind' is ['openai']; expected a text"),
        ('cach: x', "unknown key 'cach' (did you mean 'cache'?)"),
        ('kind: openai\nopenai: {base_url: x}', "openai: key 'model' is missing"),
        ('kind: openai\nopenai: {model: x, timeout: 3}', "did you mean 'timeout_s'?"),
        ('kind: openai\nopenai: {model: x, timeout_s: 0}', 'a positive number'),
        ('kind: openai\nopenai: {model: x, timeout_s: true}', 'a positive number'),
        ('kind: openai\nopenai: {model: x, timeout_s: .nan}', 'a positive number'),
        ('kind: local', "kind 'local' is none"),
        ('kind: openai\nopenai: [x]', 'openai: expected keys and values'),
        ('- kind', 'expected keys and values'),
        ('kind: {', 'cannot be read'),
    ],
)
def test_a_wrong_configuration_says_what_and_where(tmp_path, text, words):
    file = write(tmp_path / 'describer.yaml', text)
    with pytest.raises(ConfigError) as caught:
        assemble_describer(file)
    assert words in str(caught.value) and str(file) in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigError, match='nowhere.yaml'):
        assemble_describer(tmp_path / 'nowhere.yaml')


def test_numbers_of_a_file_reach_the_client(tmp_path, monkeypatch):
    pytest.importorskip('openai')
    text = """
    kind: openai
    openai: {model: doubao, base_url: 'http://127.0.0.1:1/v1', key_variable: MY_KEY, timeout_s: 7}
    cache: answers
    """
    file = write(tmp_path / 'describer.yaml', text)
    with pytest.raises(ConfigError, match="'MY_KEY' is not set"):
        assemble_describer(file)
    monkeypatch.setenv('MY_KEY', 'secret')
    describer = assemble_describer(file)
    assert describer.chat.config == OpenAIConfig(
        model='doubao', base_url='http://127.0.0.1:1/v1', key_variable='MY_KEY', timeout_s=7.0
    )
    assert describer.cache.folder == tmp_path / 'answers'
    assert describer.chat._client.max_retries == 0
