"""The presets of the paper's size: the published architectures, counted without memory."""

import math

import pytest
import torch

from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.training.training_config import load_training_config
from test.support.wan_reference import video_tensors

#: the published configurations of Wan2.1-Fun-V1.1-Control: width, ffn, blocks, heads
PUBLISHED = {'wan-1.3b': (1536, 8960, 30, 12), 'wan-14b': (5120, 13824, 40, 40)}


@pytest.mark.parametrize('preset', PUBLISHED)
def test_a_preset_has_the_published_number_of_parameters(preset):
    dim, ffn, layers, heads = PUBLISHED[preset]
    config = load_training_config(preset)
    with torch.device('meta'):
        model = MultiViewWanTransformer(**config.transformer)
    shapes = video_tensors(dim=dim, ffn=ffn, layers=layers, text_dim=4096, clip_dim=1280)
    published = sum(math.prod(shape) for shape in shapes.values())
    new = config.transformer['num_views'] * dim  # the view embedding
    assert sum(p.numel() for p in model.parameters()) == published + new
    assert round(published / 1e9, 2) == {'wan-1.3b': 1.56, 'wan-14b': 16.40}[preset]
    assert model.config['num_attention_heads'] == heads
    assert all(p.is_meta for p in model.parameters())
    assert not any(b.is_meta for b in model.rope.buffers())


@pytest.mark.parametrize('preset', PUBLISHED)
def test_a_preset_predicts_the_papers_chunk(preset):
    """Two views of 81 frames at 288x384; 4k + 1 frames and multiples of 16, as the VAE needs."""
    video = load_training_config(preset).video
    assert (video.views, 1 + video.num_frames) == (('low', 'high'), 81)
    assert (video.height, video.width) == (288, 384)
    assert video.num_frames % 4 == video.height % 16 == video.width % 16 == 0
