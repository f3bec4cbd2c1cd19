"""A transformer of the small preset's kind, small enough for tests."""

from __future__ import annotations

import torch

from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

#: card of a checkpoint without what it was trained on
CARD = {
    'views': ['low', 'high'],
    'fps': 5.0,
    'num_frames': 4,
    'width': 32,
    'height': 32,
    'robot': 'yam_bimanual',
    'control': 'trajectory_video',
    'object_mask': True,
    'rendering': {},
    'trained_on': {},
}

SMALL = {
    'patch_size': (1, 4, 4),
    'num_attention_heads': 2,
    'attention_head_dim': 12,
    'in_channels': 36,
    'out_channels': 12,
    'text_dim': 8,
    'freq_dim': 16,
    'ffn_dim': 32,
    'num_layers': 2,
    'rope_max_seq_len': 64,
    'latent_channels': 12,
    'num_views': 3,
    'stem': 'conv',
    'stem_widths': (8, 16, 16),
    'frames_per_token': 2,
    'context': 'none',
    'prediction': 'sample',
}
PATCH = {
    **SMALL,
    'patch_size': (1, 2, 2),
    'stem': 'patch',
    'context': 'text_image',
    'prediction': 'flow',
    'text_dim': 16,
}


def build(config: dict, seed: int = 0, **changes: object) -> MultiViewWanTransformer:
    """A transformer with random weights everywhere, so that nothing is hidden by a zero."""
    torch.manual_seed(seed)
    model = MultiViewWanTransformer(**{**config, **changes})
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model


def inputs(views: int = 2, frames: int = 4, seed: int = 1, text_dim: int = 0) -> dict:
    """Arguments of a forward pass: batch 1, 12 channels, 16 x 16 latents."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    reference = random(1, views, 12, 16, 16)
    values = {
        'hidden_states': random(1, views, 12, frames, 16, 16),
        'timestep': torch.tensor([500.0]),
        'control': random(1, views, 12, frames, 16, 16),
        'start': reference.unsqueeze(3).expand(-1, -1, -1, frames, -1, -1),
        'reference': reference,
        'start_control': random(1, views, 12, 16, 16),
    }
    if text_dim:
        values['encoder_hidden_states'] = random(1, 512, text_dim)
    return values
