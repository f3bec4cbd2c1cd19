"""Weights of the transformer's large layers in 8 bits: half the memory, faster products.

Format e4m3 with a scale for each output row. Where the device multiplies it (compute capability
8.9 and newer), inputs are brought into it too, with a scale for each token; elsewhere weights are
brought back for each product.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn, Tensor
import torch.nn.functional as F

from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

_FORMAT = torch.float8_e4m3fn
_LARGEST = torch.finfo(_FORMAT).max
#: what the device's product counts in
_ALIGNED = 16


class Float8Linear(nn.Module):
    """A linear layer whose weight is kept in 8 bits.

    Args:
        linear: with the weight to keep; its bias stays as it is.
    """

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        weight, scale = quantise(linear.weight.detach())
        self.register_buffer('weight', weight)
        self.register_buffer('scale', scale)
        self.bias = linear.bias

    def forward(self, x: Tensor) -> Tensor:
        """Returns (..., outputs) for (..., inputs), in the number format of the input."""
        weight, scale = self.get_buffer('weight'), self.get_buffer('scale')
        if not _multiplies(weight, x):
            return F.linear(x, (weight.float() * scale).to(x.dtype), self.bias)
        rows, row_scale = quantise(x.flatten(0, -2))
        out = torch._scaled_mm(
            rows,
            weight.t(),
            scale_a=row_scale,
            scale_b=scale.t(),
            bias=self.bias,
            out_dtype=x.dtype,
            use_fast_accum=True,
        )
        return out.unflatten(0, x.shape[:-1])


def quantise(values: Tensor) -> tuple[Tensor, Tensor]:
    """Returns (N, K) values in 8 bits and the (N, 1) float32 scale of each row."""
    scale = values.abs().amax(dim=1, keepdim=True).float().clamp(min=1e-12) / _LARGEST
    return (values.float() / scale).clamp(-_LARGEST, _LARGEST).to(_FORMAT), scale


def convert(transformer: MultiViewWanTransformer) -> None:
    """Puts the blocks' linear layers into 8 bits, in place; adapters are fused before."""
    for block in transformer.blocks:
        for name, module in list(block.named_modules()):
            if isinstance(module, nn.Linear):
                parent, _, own = name.rpartition('.')
                _replace(block.get_submodule(parent), own, Float8Linear(module))


def _replace(parent: Any, name: str, module: nn.Module) -> None:
    if name.isdigit():  # `to_out.0` and the like
        parent[int(name)] = module
    else:
        setattr(parent, name, module)


def _multiplies(weight: Tensor, x: Tensor) -> bool:
    fits = weight.shape[0] % _ALIGNED == 0 and weight.shape[1] % _ALIGNED == 0
    native = x.is_cuda and torch.cuda.get_device_capability(x.device) >= (8, 9)
    return fits and native and x.dtype == torch.bfloat16
