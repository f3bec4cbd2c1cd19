"""umT5's encoder and CLIP's image side in plain torch, over the names in Wan's files.

Written from the papers (T5, arXiv 1910.10683, section 2.1; umT5's bias per layer; CLIP,
arXiv 2103.00020, section 2.4) and from the names and shapes of the tensors.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
import torch.nn.functional as F

from test.support.wan_reference import Weights


def umt5_encode(w: Weights, ids: Tensor, *, layers: int, heads: int) -> Tensor:
    """Return (N, D) of the token numbers (N,), no padding among them."""
    x = w['token_embedding.weight'][ids]
    buckets = _buckets(len(ids))
    for index in range(layers):
        block = f'blocks.{index}'
        y = _rms(x) * w[f'{block}.norm1.weight']
        q, k, v = (
            (y @ w[f'{block}.attn.{n}.weight'].T).unflatten(1, (heads, -1)).transpose(0, 1)
            for n in 'qkv'
        )
        bias = w[f'{block}.pos_embedding.embedding.weight'][buckets].permute(2, 0, 1)
        y = ((q @ k.transpose(1, 2) + bias).softmax(-1) @ v).transpose(0, 1).flatten(1)
        x = x + y @ w[f'{block}.attn.o.weight'].T
        y = _rms(x) * w[f'{block}.norm2.weight']
        gate = F.gelu(y @ w[f'{block}.ffn.gate.0.weight'].T, approximate='tanh')
        x = x + (gate * (y @ w[f'{block}.ffn.fc1.weight'].T)) @ w[f'{block}.ffn.fc2.weight'].T
    return _rms(x) * w['norm.weight']


def _rms(x: Tensor) -> Tensor:
    return x / (x.square().mean(-1, keepdim=True) + 1e-6).sqrt()


def _buckets(length: int) -> Tensor:
    """(length, length): 16 buckets a direction, 8 of them exact, the rest spaced by logarithm."""
    table = torch.zeros(length, length, dtype=torch.long)
    for query in range(length):
        for key in range(length):
            far = abs(key - query)
            if far >= 8:
                far = min(15, 8 + int(math.log(far / 8) / math.log(128 / 8) * 8))
            table[query, key] = far + (16 if key > query else 0)
    return table


def clip_tokens(w: Weights, pixels: Tensor, *, layers: int, heads: int = 16) -> Tensor:
    """Return (N, D), the tokens before the last of `layers` layers, of pixels (3, S, S)."""
    patch = w['visual.patch_embedding.weight']
    x = F.conv2d(pixels[None], patch, stride=patch.shape[-1])[0].flatten(1).T
    x = torch.cat([w['visual.cls_embedding'][0], x]) + w['visual.pos_embedding'][0]
    x = _norm(w, 'visual.pre_norm', x)
    for index in range(layers - 1):
        layer = f'visual.transformer.{index}'
        qkv = _linear(w, f'{layer}.attn.to_qkv', _norm(w, f'{layer}.norm1', x))
        q, k, v = qkv.unflatten(1, (3, heads, -1)).permute(1, 2, 0, 3)
        y = (q @ k.transpose(1, 2) / math.sqrt(q.shape[-1])).softmax(-1) @ v
        x = x + _linear(w, f'{layer}.attn.proj', y.transpose(0, 1).flatten(1))
        y = F.gelu(_linear(w, f'{layer}.mlp.0', _norm(w, f'{layer}.norm2', x)))
        x = x + _linear(w, f'{layer}.mlp.2', y)
    return x


def _linear(w: Weights, name: str, x: Tensor) -> Tensor:
    return x @ w[f'{name}.weight'].T + w[f'{name}.bias']


def _norm(w: Weights, name: str, x: Tensor) -> Tensor:
    centred = x - x.mean(-1, keepdim=True)
    scaled = centred / (centred.square().mean(-1, keepdim=True) + 1e-5).sqrt()
    return scaled * w[f'{name}.weight'] + w[f'{name}.bias']
