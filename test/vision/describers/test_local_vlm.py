"""Tiny random models, saved in the form in which Qwen3-VL and LLaVA are published."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mtv_world_ros.errors import CheckpointError, ConfigError, DescriptionError
from mtv_world_ros.vision.describers.local_vlm import LocalVlm, LocalVlmConfig
from mtv_world_ros.vision.describers.vlm import VlmDescriber

pytest.importorskip('transformers')

TEXT = {
    'hidden_size': 32,
    'intermediate_size': 64,
    'num_hidden_layers': 2,
    'num_attention_heads': 2,
    'num_key_value_heads': 1,
    'head_dim': 16,
}
VISION = {'hidden_size': 32, 'intermediate_size': 64, 'patch_size': 16}
#: multiples of Qwen3-VL's 32 px, so that its resizing changes nothing
FRAME = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)


def tokenizer(folder: Path, *special: str) -> Any:
    """One token per byte, and the special ones."""
    from tokenizers import decoders, models, pre_tokenizers, Tokenizer
    from transformers import PreTrainedTokenizerFast

    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    plain = Tokenizer(models.BPE(vocab={c: i for i, c in enumerate(letters)}, merges=[]))
    plain.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    plain.decoder = decoders.ByteLevel()
    made = PreTrainedTokenizerFast(
        tokenizer_object=plain, eos_token='<|im_end|>', pad_token='<|endoftext|>'
    )
    made.add_tokens(['<|im_start|>', *special], special_tokens=True)
    made.save_pretrained(folder)
    return made


def template(image: str) -> str:
    return (
        "{% for m in messages %}<|im_start|>{{ m['role'] }}\n{% for c in m['content'] %}"
        "{% if c['type'] == 'image' %}" + image + "{% else %}{{ c['text'] }}{% endif %}"
        '{% endfor %}<|im_end|>\n{% endfor %}'
        '{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}'
    )


def write(folder: Path, **files: dict[str, Any]) -> None:
    for name, content in files.items():
        (folder / f'{name}.json').write_text(json.dumps(content))


def save_qwen3_vl(folder: Path) -> None:
    """Its processor has a part for videos, which needs torchvision."""
    from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

    names = ('<|vision_start|>', '<|vision_end|>', '<|image_pad|>', '<|video_pad|>')
    made = tokenizer(folder, *names)
    start, end, image, video = (int(made.convert_tokens_to_ids(name)) for name in names)
    config = Qwen3VLConfig(
        text_config={
            **TEXT,
            'vocab_size': len(made),
            'rope_scaling': {'rope_type': 'default', 'mrope_section': [4, 2, 2]},
        },
        vision_config={
            **VISION,
            'depth': 2,
            'num_heads': 2,
            'out_hidden_size': 32,
            'spatial_merge_size': 2,
            'temporal_patch_size': 2,
            'num_position_embeddings': 64,
            'deepstack_visual_indexes': [0],
        },
        image_token_id=image,
        video_token_id=video,
        vision_start_token_id=start,
        vision_end_token_id=end,
    )
    Qwen3VLForConditionalGeneration(config).save_pretrained(folder)
    patches = {'patch_size': 16, 'temporal_patch_size': 2, 'merge_size': 2}
    half = {'image_mean': [0.5] * 3, 'image_std': [0.5] * 3}
    pixels = {'size': {'shortest_edge': 1024, 'longest_edge': 100_000}}
    write(
        folder,
        preprocessor_config={
            'processor_class': 'Qwen3VLProcessor',
            'image_processor_type': 'Qwen2VLImageProcessorFast',
            **patches,
            **half,
            **pixels,
        },
        video_preprocessor_config={
            'processor_class': 'Qwen3VLProcessor',
            'video_processor_type': 'Qwen3VLVideoProcessor',
            **patches,
            **half,
            **pixels,
        },
        chat_template={'chat_template': template('<|vision_start|><|image_pad|><|vision_end|>')},
    )


def save_llava(folder: Path) -> None:
    from transformers import LlavaConfig, LlavaForConditionalGeneration

    made = tokenizer(folder, '<image>')
    config = LlavaConfig(
        text_config={**TEXT, 'model_type': 'llama', 'vocab_size': len(made)},
        vision_config={
            **VISION,
            'model_type': 'clip_vision_model',
            'num_hidden_layers': 2,
            'num_attention_heads': 2,
            'image_size': 64,
            'projection_dim': 32,
        },
        image_token_index=made.convert_tokens_to_ids('<image>'),
    )
    LlavaForConditionalGeneration(config).save_pretrained(folder)
    write(
        folder,
        preprocessor_config={
            'processor_class': 'LlavaProcessor',
            'image_processor_type': 'CLIPImageProcessor',
            'do_resize': True,
            'do_center_crop': True,
            'do_rescale': True,
            'do_normalize': True,
            'size': {'shortest_edge': 64},
            'crop_size': {'height': 64, 'width': 64},
            'image_mean': [0.48145466, 0.4578275, 0.40821073],
            'image_std': [0.26862954, 0.26130258, 0.27577711],
        },
        processor_config={
            'processor_class': 'LlavaProcessor',
            'image_token': '<image>',
            'patch_size': 16,
            'num_additional_image_tokens': 1,
            'vision_feature_select_strategy': 'default',
        },
        chat_template={'chat_template': template('<image>')},
    )


SAVE = {'qwen3_vl': save_qwen3_vl, 'llava': save_llava}


@pytest.fixture(scope='module')
def folders(tmp_path_factory) -> dict[str, Path]:
    made = {}
    for name, save in SAVE.items():
        made[name] = tmp_path_factory.mktemp(name)
        torch.manual_seed(0)
        save(made[name])
    return made


@pytest.fixture
def copy(folders, tmp_path) -> Path:
    for file in folders['llava'].iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def load(folder: Path, **options: Any) -> LocalVlm:
    return LocalVlm(LocalVlmConfig(model=str(folder), **{'max_new_tokens': 8, **options}))


def watch(vlm: LocalVlm, monkeypatch) -> dict[str, Any]:
    """What the model is given."""
    seen: dict[str, Any] = {}
    generate = vlm._model.generate

    def record(**inputs: Any) -> Any:
        seen.update(inputs)
        return generate(**inputs)

    monkeypatch.setattr(vlm._model, 'generate', record)
    return seen


@pytest.mark.parametrize(
    ('name', 'image_token', 'num_tokens'),
    # 64 x 96 px, 16 px patches, 2 x 2 merged; 64 x 64 px after the crop, the class token dropped
    [('qwen3_vl', '<|image_pad|>', 6), ('llava', '<image>', 16)],
)
def test_the_chat_template_and_the_image_tokens_reach_the_model(
    folders, monkeypatch, name, image_token, num_tokens
):
    vlm = load(folders[name])
    seen = watch(vlm, monkeypatch)
    vlm.ask(FRAME, ['what is here?', 'a cat', 'no'])
    said = vlm._processor.tokenizer.decode(seen['input_ids'][0])
    assert said.count(image_token) == num_tokens
    first, answer, repair, rest = said.split('<|im_end|>\n')
    assert first.startswith('<|im_start|>user\n') and first.endswith('what is here?')
    assert image_token in first and image_token not in answer + repair + rest
    assert (answer, repair) == ('<|im_start|>assistant\na cat', '<|im_start|>user\nno')
    assert rest == '<|im_start|>assistant\n'


def test_pixels_are_normalised_as_published_without_torchvision(folders, monkeypatch):
    grey = np.full((64, 96, 3), 51, np.uint8)  # 0.2
    for name, expected in {
        'qwen3_vl': [-0.6],  # (0.2 - 0.5) / 0.5
        # (0.2 - mean) / std of CLIP
        'llava': [-1.047774, -0.986697, -0.754997],
    }.items():
        vlm = load(folders[name])
        seen = watch(vlm, monkeypatch)
        vlm.ask(grey, ['?'])
        pixels = seen['pixel_values'].float().numpy()
        found = pixels.mean((0, 2, 3)) if name == 'llava' else [pixels.mean()]
        np.testing.assert_allclose(found, expected, atol=1e-4)
        assert pixels.std(axis=(-1, -2)).max() < 1e-4


def test_the_answer_is_the_most_likely_one_whatever_the_checkpoint_samples_with(copy, monkeypatch):
    write(copy, generation_config={'do_sample': True, 'temperature': 9.0, 'top_k': 0})
    vlm = load(copy, max_new_tokens=1)
    seen = watch(vlm, monkeypatch)
    answer = vlm.ask(FRAME, ['what is here?'])
    names = ('input_ids', 'attention_mask', 'pixel_values')
    with torch.inference_mode():
        logits = vlm._model(**{name: seen[name] for name in names}).logits[0, -1]
    best = vlm._processor.tokenizer.decode([int(logits.argmax())], skip_special_tokens=True)
    assert answer == (best, True)
    assert all(vlm.ask(FRAME, ['what is here?']) == answer for _ in range(5))


def test_only_the_new_text_is_the_answer(folders, monkeypatch):
    vlm = load(folders['llava'])

    def say(**inputs: Any) -> torch.Tensor:
        said = vlm._processor.tokenizer('{"objects": []}<|im_end|>', return_tensors='pt')
        return torch.cat([inputs['input_ids'], said['input_ids']], 1)

    monkeypatch.setattr(vlm._model, 'generate', say)
    assert VlmDescriber(vlm).describe(FRAME, 'take the cup') == ()


@pytest.mark.parametrize('name', SAVE)
def test_the_babble_of_an_untrained_model_is_not_taken_for_objects(folders, name):
    with pytest.raises(DescriptionError, match='gave no valid object list') as caught:
        VlmDescriber(load(folders[name])).describe(FRAME, 'take the cup')
    assert caught.value.status == 'invalid'
    assert 'cut off at the token limit' in str(caught.value)


def test_bfloat16_goes_through(folders, monkeypatch):
    vlm = load(folders['qwen3_vl'], dtype='bfloat16')
    seen = watch(vlm, monkeypatch)
    vlm.ask(FRAME, ['?'])
    assert seen['pixel_values'].dtype == next(vlm._model.parameters()).dtype == torch.bfloat16
    assert not seen['input_ids'].is_floating_point()


def test_other_weights_have_another_identity(copy):
    vlm = load(copy)
    before = vlm.identity
    assert vlm.identity == before
    weights = copy / 'model.safetensors'
    weights.write_bytes(weights.read_bytes()[:-1] + b'\1')
    assert vlm.identity != before


def test_weights_that_are_a_pickle_are_not_loaded(copy):
    state = load(copy)._model.state_dict()
    (copy / 'model.safetensors').unlink()
    torch.save(state, copy / 'pytorch_model.bin')
    with pytest.raises(CheckpointError, match='safetensors'):
        load(copy)


def test_a_model_that_is_no_chat_model_is_refused(copy):
    (copy / 'chat_template.json').unlink()
    with pytest.raises(CheckpointError, match='no chat template'):
        load(copy)


def test_a_model_that_sees_nothing_is_refused(copy):
    (copy / 'config.json').write_text(json.dumps({'model_type': 'gpt2'}))
    with pytest.raises(CheckpointError, match="'local: model'"):
        load(copy)


def test_an_unknown_dtype_is_refused(folders):
    with pytest.raises(ConfigError, match="'float31'"):
        load(folders['llava'], dtype='float31')
