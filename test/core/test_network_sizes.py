"""Configurations that ask for more than any network has are refused before anything is built."""

from __future__ import annotations

import json
import resource
import shutil
import time

import pytest

from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.network_sizes import check_config_file, check_sizes

BUNDLED = share_path('resource', 'checkpoint')
MOST_S, MOST_MB = 1.0, 200
#: https://huggingface.co/Wan-AI/Wan2.1-T2V-14B-Diffusers, transformer/config.json
WAN_14B = {
    'patch_size': [1, 2, 2],
    'num_attention_heads': 40,
    'attention_head_dim': 128,
    'in_channels': 16,
    'out_channels': 16,
    'text_dim': 4096,
    'freq_dim': 256,
    'ffn_dim': 13824,
    'num_layers': 40,
    'rope_max_seq_len': 1024,
}
#: https://huggingface.co/google/umt5-xxl, config.json
UMT5_XXL = {
    'd_ff': 10240,
    'd_kv': 64,
    'd_model': 4096,
    'dropout_rate': 0.1,
    'num_decoder_layers': 24,
    'num_heads': 64,
    'num_layers': 24,
    'relative_attention_max_distance': 128,
    'vocab_size': 256384,
}


@pytest.mark.parametrize('config', [WAN_14B, UMT5_XXL, {'layer_norm_eps': 1e-6, 'a': [True]}])
def test_public_models_are_within_the_bounds(config):
    check_sizes(config, 'it')


def test_bundled_models_are_within_the_bounds():
    for file in BUNDLED.glob('*/*config.json'):
        check_config_file(file)


@pytest.mark.parametrize(
    ('config', 'named'),
    [
        ({'num_hidden_layers': 10**9}, 'num_hidden_layers is 1e\\+09; at most 128'),
        ({'vision_config': {'depths': [2, 10**6]}}, r'vision_config.depths\[1\] is 1e\+06'),
        ({'vocab_size': 10**40}, r'vocab_size is 1e\+40; at most 2000000'),
        ({'width': float('inf')}, 'width is inf'),
        ({'latents_mean': [0.0] * 10**6}, 'latents_mean.entries is 1e'),
        ({'rope_max_seq_len': 65536}, 'rope_max_seq_len is 65536; at most 16384'),
    ],
)
def test_what_no_network_has_is_named_with_its_bound(config, named):
    with pytest.raises(CheckpointError, match=f'it: {named}'):
        check_sizes(config, 'it')


@pytest.mark.parametrize(
    ('part', 'field', 'value'),
    [
        ('transformer/config.json', 'num_layers', 10**9),
        ('transformer/config.json', 'num_attention_heads', 10**9),
        ('transformer/config.json', 'rope_max_seq_len', 10**9),
        ('transformer/config.json', 'stem_widths', [10**9] * 3),
        ('autoencoder/config.json', 'block_size', 10**5),
        ('scheduler/scheduler_config.json', 'num_train_timesteps', 10**9),
        ('world_model.json', 'width', 16384),
    ],
)
def test_a_checkpoint_beyond_the_bounds_takes_neither_time_nor_memory(
    tmp_path, part, field, value
):
    pytest.importorskip('torch')
    from mtv_world_ros.model.checkpoint import Checkpoint
    from mtv_world_ros.model.trained_model import load_trained_model

    folder = shutil.copytree(BUNDLED, tmp_path / 'checkpoint')
    values = json.loads((folder / part).read_text()) | {field: value}
    if field == 'width':
        values |= {'num_frames': 10_000, 'height': 16384}
    (folder / part).write_text(json.dumps(values))
    begin_s = time.process_time()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError, match='at most'):
        load_trained_model(Checkpoint.open(folder))
    assert time.process_time() - begin_s < MOST_S
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MOST_MB * 1024


def test_a_preset_is_refused_as_a_checkpoint_is():
    from mtv_world_ros.model.parts import build_autoencoder, build_scheduler
    from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

    with pytest.raises(CheckpointError, match='transformer: num_layers'):
        MultiViewWanTransformer(num_layers=10**9)
    with pytest.raises(CheckpointError, match='autoencoder: block_size'):
        build_autoencoder({'block_size': 10**9})
    with pytest.raises(CheckpointError, match='autoencoder: num_res_blocks'):
        build_autoencoder({'_class_name': 'AutoencoderKLWan', 'num_res_blocks': 10**9})
    with pytest.raises(CheckpointError, match='scheduler: num_train_timesteps'):
        build_scheduler({'num_train_timesteps': 10**9})
