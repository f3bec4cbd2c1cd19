"""A small transformer with random weights that adapters change, and its output."""

from __future__ import annotations

import torch
from torch import Tensor

from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from test.support.wan_files import CLIP_DIM, TEXT_DIM, TRANSFORMER

RANK = 4


def build(seed: int = 0, **changes: object) -> MultiViewWanTransformer:
    torch.manual_seed(seed)
    model = MultiViewWanTransformer(**{**TRANSFORMER, **changes}).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model


def run(model: MultiViewWanTransformer) -> Tensor:
    generator = torch.Generator().manual_seed(1)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator).to(model.dtype)

    with torch.inference_mode():
        return model(
            random(1, 2, 16, 2, 4, 4),
            torch.tensor([500.0]),
            control=random(1, 2, 16, 2, 4, 4),
            start=random(1, 2, 16, 2, 4, 4),
            reference=random(1, 2, 16, 4, 4),
            encoder_hidden_states=random(1, 512, TEXT_DIM),
            encoder_hidden_states_image=random(1, 2 * 257, CLIP_DIM),
        )
