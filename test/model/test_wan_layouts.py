"""The layouts that the tests write are those of the published files, and all of each is mapped.

DiffSynth-Studio knows the published files by a hash of their tensors' names and shapes
(`diffsynth/configs/model_configs.py`); the hashes are its.
"""

from __future__ import annotations

import hashlib

from diffusers import AutoencoderKLWan
import pytest
import torch

from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.model.wan_keys import (
    autoencoder_keys,
    image_encoder_keys,
    KeyMap,
    text_encoder_keys,
    transformer_keys,
)
from mtv_world_ros.model.wan_weights import NEW
from mtv_world_ros.training.training_config import load_training_config
from test.support.wan_files import (
    clip_shapes,
    clip_text_shapes,
    Shapes,
    umt5_shapes,
    vae_original_name,
)
from test.support.wan_reference import video_tensors


def hash_of(shapes: Shapes) -> str:
    """MD5 of the sorted names, each with and without its shape, as DiffSynth-Studio makes it."""
    keys = [f'{name}:{"_".join(map(str, shape))}' for name, shape in shapes.items()]
    return hashlib.md5(','.join(sorted([*keys, *shapes])).encode()).hexdigest()


def wan(dim: int, ffn: int, layers: int) -> Shapes:
    return video_tensors(dim=dim, ffn=ffn, layers=layers, text_dim=4096, clip_dim=1280)


def vae() -> Shapes:
    return {vae_original_name(name): tuple(t.shape) for name, t in vae_state().items()}


def vae_state() -> dict[str, torch.Tensor]:
    with torch.device('meta'):
        return AutoencoderKLWan().state_dict()


UMT5 = umt5_shapes(4096, vocab=256384, ffn=10240, layers=24, heads=64)
CLIP = clip_shapes(1280, layers=32, side=16, patch=14, out=1024) | clip_text_shapes()


@pytest.mark.parametrize(
    ('shapes', 'published'),
    [
        pytest.param(wan(1536, 8960, 30), '70ddad9d3a133785da5ea371aae09504', id='1.3B'),
        pytest.param(wan(5120, 13824, 40), '26bde73488a92e64cc20b0a7485b9e5b', id='14B'),
        pytest.param(vae(), 'ccc42284ea13e1ad04693284c7a09be6', id='Wan2.1_VAE'),
        pytest.param(UMT5, '9c8818c2cbea55eca56c7b447df170da', id='umT5'),
        pytest.param(CLIP, '5941c53e207d62f20f9025686193c40b', id='CLIP'),
    ],
)
def test_a_layout_is_the_published_one(shapes, published):
    assert hash_of(shapes) == published


def mapped(shapes: Shapes, keys: KeyMap) -> Shapes:
    """Shapes by our name; every published tensor is taken or said to be unused."""
    settled = {take.source for take in keys.takes.values()} | set(keys.unused)
    assert settled == set(shapes)
    return {name: shapes[take.source] for name, take in keys.takes.items()}


@pytest.mark.parametrize(
    ('preset', 'size'), [('wan-1.3b', (1536, 8960, 30)), ('wan-14b', (5120, 13824, 40))]
)
def test_every_published_tensor_finds_its_place(preset, size):
    with torch.device('meta'):
        model = MultiViewWanTransformer(**load_training_config(preset).transformer)
    ours = {name: tuple(t.shape) for name, t in model.state_dict().items() if name not in NEW}
    shapes = wan(*size)
    assert mapped(shapes, transformer_keys(shapes)) == ours
    repackaged = {f'model.diffusion_model.{name}': shape for name, shape in shapes.items()}
    assert mapped(repackaged, transformer_keys(repackaged)) == ours


def test_every_tensor_of_the_other_parts_is_settled():
    expected = {name: tuple(t.shape) for name, t in vae_state().items()}
    assert mapped(vae(), autoencoder_keys(vae())) == expected
    assert len(mapped(UMT5, text_encoder_keys(UMT5))) == 242
    assert len(mapped(CLIP, image_encoder_keys(CLIP))) == 5 + 32 * 16 + 2
