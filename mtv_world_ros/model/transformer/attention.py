"""Scaled dot-product attention by the kernel that is fastest on a device.

Shape letters: B batch, H heads, M queries, N keys, D channels of a key, P of a value.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch
from torch import Tensor
import torch.nn.functional as F

#: largest score matrix that is held as a whole [numbers]; 128 MiB in bfloat16
MAX_SCORES = 2**26


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Return the attention (B, H, M, P) of queries (B, H, M, D), keys (B, H, N, D) and values.

    Torch's fused CPU kernel computes in float32. Where the CPU multiplies bfloat16 natively, two
    matrix products in bfloat16 take half of its time forward and a quarter backward (measured
    on an AMD EPYC with AVX-512 bfloat16, `experiments/training_speed.py`).

    Args:
        query: (B, H, M, D) queries.
        key: (B, H, N, D) keys.
        value: (B, H, N, P); P may differ from D.
    """
    scale = query.shape[-1] ** -0.5
    if _has_fast_products(query, key):
        return ((query * scale) @ key.transpose(2, 3)).softmax(dim=-1) @ value
    # the fused kernel wants one width and contiguous channels, else it holds all scores
    width, wide = value.shape[-1], max(query.shape[-1], value.shape[-1])
    query, key, value = (
        F.pad(x, (0, wide - x.shape[-1])).contiguous() for x in (query, key, value)
    )
    return F.scaled_dot_product_attention(query, key, value, scale=scale)[..., :width]


def _has_fast_products(query: Tensor, key: Tensor) -> bool:
    if query.device.type != 'cpu' or query.dtype != torch.bfloat16:
        return False
    scores = query.shape[:-1].numel() * key.shape[-2]
    return scores <= MAX_SCORES and cpu_multiplies_bfloat16()


@cache
def cpu_multiplies_bfloat16() -> bool:
    """Return whether this CPU has instructions for products of bfloat16."""
    info = Path('/proc/cpuinfo')
    return info.is_file() and 'avx512_bf16' in info.read_text()
