"""Blocks that hold noise levels by runs of tokens compute what diffusers' own block does."""

from __future__ import annotations

import copy
from typing import Any

from diffusers.models.transformers.transformer_wan import WanTransformerBlock
import pytest
import torch
from torch import nn, Tensor

from mtv_world_ros.model.transformer.block import hold_levels_by_run, RunwiseBlock

DIM, HEADS, RUNS, EACH = 24, 2, 3, 5


def both() -> tuple[Any, Any]:
    torch.manual_seed(0)
    theirs: Any = WanTransformerBlock(DIM, 40, HEADS, cross_attn_norm=True, added_kv_proj_dim=DIM)
    for parameter in theirs.parameters():  # norms, too, have something to say
        parameter.data += 0.1 * torch.randn_like(parameter)
    ours = copy.deepcopy(theirs)
    hold_levels_by_run(nn.ModuleList([ours]))
    assert type(ours) is RunwiseBlock and type(theirs) is WanTransformerBlock
    return theirs, ours


def inputs(dtype: torch.dtype) -> tuple[Tensor, Tensor, Any]:
    generator = torch.Generator().manual_seed(1)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    turns = random(1, RUNS * EACH, 1, DIM // HEADS // 2).repeat_interleave(2, -1)
    x = random(2, RUNS * EACH, DIM).to(dtype).requires_grad_(True)
    return x, random(2, 512 + 7, DIM).to(dtype), (turns.cos(), turns.sin())


@pytest.mark.parametrize('runs', [1, RUNS])
@pytest.mark.parametrize(('dtype', 'atol'), [(torch.float32, 1e-5), (torch.bfloat16, 0.1)])
def test_values_and_gradients_are_those_of_the_stock_block(runs, dtype, atol):
    theirs, ours = (block.to(dtype) for block in both())
    levels = torch.randn(2, runs, 6, DIM, generator=torch.Generator().manual_seed(2))
    of_tokens = levels[:, 0] if runs == 1 else levels.repeat_interleave(EACH, dim=1)
    found = []
    for block, temb in ((theirs, of_tokens), (ours, levels)):
        x, context, rotary = inputs(dtype)
        out = block(x, context, temb, rotary)
        assert out.dtype == dtype
        out.float().square().sum().backward()
        assert x.grad is not None
        found.append((out, x.grad / x.grad.abs().max()))
    for expected, value in zip(*found, strict=True):
        torch.testing.assert_close(value, expected, rtol=0, atol=atol)


def test_names_of_weights_stay():
    theirs, ours = both()
    assert list(ours.state_dict()) == list(theirs.state_dict())
