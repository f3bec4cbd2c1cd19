"""The configurations of umT5 and CLIP, read from their files or from their tensors' shapes."""

from __future__ import annotations

from collections.abc import Mapping
from math import isqrt
from pathlib import Path
from typing import Any

import torch

from mtv_world_ros.bounded_input import read_json
from mtv_world_ros.errors import CheckpointError
from mtv_world_ros.model.tensor_files import import_transformers, StoredTensor
from mtv_world_ros.model.wan_keys import KeyMap

#: heads of CLIP's ViT-H/14, which show in no tensor
_CLIP_HEADS = 16


def describe(
    part: str, source: Path, tensors: Mapping[str, StoredTensor], keys: KeyMap
) -> tuple[dict[str, Any], dict[str, tuple[int, ...]]]:
    """Returns the configuration of `text_encoder` or `image_encoder`, and its tensors' shapes.

    Raises:
        CheckpointError: the tensors are not those of umT5, or of CLIP's image side.
        ConfigError: transformers is not installed.
    """
    transformers = import_transformers()
    kind = transformers.UMT5Config if part == 'text_encoder' else transformers.CLIPVisionConfig
    file = source / 'config.json'
    if file.is_file():
        try:
            values = dict(read_json(file))
        except (OSError, ValueError, TypeError) as error:
            raise CheckpointError(f"'{file}' cannot be read: {error}") from error
        if values.get('model_type') != kind.model_type:
            raise CheckpointError(
                f"'{file}' is of a {values.get('model_type')}, expected {kind.model_type}"
            )
        config = kind.from_dict(values)
    else:
        shapes = {n: tensors[t.source].shape for n, t in keys.takes.items()}
        read = _umt5 if part == 'text_encoder' else _clip
        try:
            config = kind(**read(shapes))
        except KeyError as error:
            expected = 'the encoder of umT5-XXL' if part == 'text_encoder' else "CLIP's ViT-H/14"
            raise CheckpointError(
                f"{part} '{source}' lacks tensor {error}; expected {expected}"
            ) from error
    with torch.device('meta'):
        if part == 'text_encoder':
            model = transformers.UMT5EncoderModel(config)
        else:
            model = transformers.CLIPVisionModel(config)
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    shapes.pop('encoder.embed_tokens.weight', None)  # the same as shared.weight
    return {**config.to_dict(), 'architectures': [type(model).__name__]}, shapes


def check_width(part: str, source: Path, config: Mapping[str, Any], expected: int) -> None:
    """Checks that an encoder's tokens are as wide as the transformer takes them.

    Raises:
        CheckpointError: they are not.
    """
    width = config['d_model' if part == 'text_encoder' else 'hidden_size']
    if width != expected:
        raise CheckpointError(
            f"{part} '{source}' gives tokens of width {width}, the transformer takes {expected}; "
            'Wan 2.1 goes with umT5-XXL (4096) and CLIP ViT-H/14 (1280)'
        )


def _num_layers(shapes: Mapping[str, Any], prefix: str) -> int:
    return len({name[len(prefix) :].split('.')[0] for name in shapes if name.startswith(prefix)})


def _umt5(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    first = 'encoder.block.0.layer'
    buckets, heads = shapes[f'{first}.0.SelfAttention.relative_attention_bias.weight']
    vocab, width = shapes['shared.weight']
    return {
        'vocab_size': vocab,
        'd_model': width,
        'd_kv': shapes[f'{first}.0.SelfAttention.q.weight'][0] // heads,
        'd_ff': shapes[f'{first}.1.DenseReluDense.wi_0.weight'][0],
        'num_layers': _num_layers(shapes, 'encoder.block.'),
        'num_heads': heads,
        'relative_attention_num_buckets': buckets,
        'feed_forward_proj': 'gated-gelu',
    }


def _clip(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    width, _, patch, _ = shapes['embeddings.patch_embedding.weight']
    positions = shapes['embeddings.position_embedding.weight'][-2]
    return {
        'hidden_size': width,
        'intermediate_size': shapes['encoder.layers.0.mlp.fc1.weight'][0],
        'num_hidden_layers': _num_layers(shapes, 'encoder.layers.'),
        'num_attention_heads': _CLIP_HEADS,
        'image_size': isqrt(positions - 1) * patch,
        'patch_size': patch,
        'hidden_act': 'gelu',
    }
