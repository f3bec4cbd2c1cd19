"""Wan2.1-Fun-V1.1-Control in plain torch, over a checkpoint's own tensor names.

Written from the published description: Wan's technical report (arXiv 2503.20314), the names and
shapes of the tensors in the checkpoint, VideoX-Fun's account of its reference latents; it shares
no code with the class under test. One view.

Shape letters: B batch, C latent channels, F latent frames, H W latent size, N tokens, D width.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
import torch.nn.functional as F

Weights = dict[str, Tensor]


def video_tensors(
    *, dim: int, ffn: int, layers: int, in_dim: int = 48, text_dim: int = 32, clip_dim: int = 20
) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors of a VideoX-Fun checkpoint, at any width."""
    shapes: dict[str, tuple[int, ...]] = {
        'patch_embedding.weight': (dim, in_dim, 1, 2, 2),
        'patch_embedding.bias': (dim,),
        'ref_conv.weight': (dim, 16, 2, 2),
        'ref_conv.bias': (dim,),
        'head.head.weight': (64, dim),
        'head.head.bias': (64,),
        'head.modulation': (1, 2, dim),
    }
    linear: dict[str, tuple[int, int]] = {
        'text_embedding.0': (dim, text_dim),
        'text_embedding.2': (dim, dim),
        'time_embedding.0': (dim, 256),
        'time_embedding.2': (dim, dim),
        'time_projection.1': (6 * dim, dim),
        'img_emb.proj.1': (clip_dim, clip_dim),
        'img_emb.proj.3': (dim, clip_dim),
    }
    vectors = {
        'img_emb.proj.0.weight': clip_dim,
        'img_emb.proj.0.bias': clip_dim,
        'img_emb.proj.4.weight': dim,
        'img_emb.proj.4.bias': dim,
    }
    for index in range(layers):
        block = f'blocks.{index}'
        shapes[f'{block}.modulation'] = (1, 6, dim)
        for attention in ('self_attn', 'cross_attn'):
            for name in 'qkvo':
                linear[f'{block}.{attention}.{name}'] = (dim, dim)
            vectors[f'{block}.{attention}.norm_q.weight'] = dim
            vectors[f'{block}.{attention}.norm_k.weight'] = dim
        for name in ('k_img', 'v_img'):
            linear[f'{block}.cross_attn.{name}'] = (dim, dim)
        vectors[f'{block}.cross_attn.norm_k_img.weight'] = dim
        vectors[f'{block}.norm3.weight'] = vectors[f'{block}.norm3.bias'] = dim
        linear[f'{block}.ffn.0'] = (ffn, dim)
        linear[f'{block}.ffn.2'] = (dim, ffn)
    for name, shape in linear.items():
        shapes[f'{name}.weight'] = shape
        shapes[f'{name}.bias'] = shape[:1]
    return shapes | {name: (size,) for name, size in vectors.items()}


def random_weights(shapes: dict[str, tuple[int, ...]], seed: int = 0) -> Weights:
    """Random values that keep activations of order one; norms near one."""
    generator = torch.Generator().manual_seed(seed)
    weights = {}
    for name, shape in sorted(shapes.items()):
        fan_in = math.prod(shape[1:]) if len(shape) > 1 else 16
        value = torch.randn(shape, generator=generator) / math.sqrt(fan_in)
        is_gain = name.endswith('.weight') and len(shape) == 1
        weights[name] = value + 1.0 if is_gain else value
    return weights


def _linear(w: Weights, name: str, x: Tensor) -> Tensor:
    return x @ w[f'{name}.weight'].T + w[f'{name}.bias']


def _layer_norm(x: Tensor, eps: float) -> Tensor:
    centred = x - x.mean(-1, keepdim=True)
    return centred / (centred.square().mean(-1, keepdim=True) + eps).sqrt()


def _rms_norm(x: Tensor, gain: Tensor) -> Tensor:
    return x / (x.square().mean(-1, keepdim=True) + 1e-6).sqrt() * gain


def _rotate(x: Tensor, angles: Tensor) -> Tensor:
    """Turn channel pairs of x (B, N, heads, D) as complex numbers by angles (N, D / 2)."""
    pairs = torch.view_as_complex(x.double().reshape(*x.shape[:-1], -1, 2))
    turned = pairs * torch.polar(torch.ones_like(angles), angles)[None, :, None]
    return torch.view_as_real(turned).flatten(3).to(x.dtype)


def _angles(head_dim: int, frames: int, height: int, width: int) -> Tensor:
    """(frames * height * width, head_dim / 2): a part of the channels for each axis."""
    spatial = 2 * (head_dim // 6)
    parts = []
    for axis, size in enumerate((head_dim - 2 * spatial, spatial, spatial)):
        rates = 10000.0 ** -(torch.arange(0, size, 2, dtype=torch.float64) / size)
        position = torch.arange((frames, height, width)[axis], dtype=torch.float64)
        table = torch.outer(position, rates)
        shape = [1, 1, 1, -1]
        shape[axis] = -1 if axis == 3 else len(position)
        parts.append(table.reshape(*shape[:3], size // 2).expand(frames, height, width, -1))
    return torch.cat(parts, dim=-1).flatten(0, 2)


def _attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Attention of (B, N, heads, D) tensors, flattened to (B, N, heads * D)."""
    scores = torch.einsum('bqhd,bkhd->bhqk', q, k) / math.sqrt(q.shape[-1])
    return torch.einsum('bhqk,bkhd->bqhd', scores.softmax(-1), v).flatten(2)


def wan_forward(
    w: Weights,
    *,
    noisy: Tensor,
    control: Tensor,
    start: Tensor,
    reference: Tensor,
    timestep: Tensor,
    text: Tensor,
    image: Tensor,
    num_heads: int,
    num_layers: int,
) -> Tensor:
    """Return the flow (B, 16, F, H, W).

    Args:
        w: the checkpoint's tensors.
        noisy: (B, 16, F, H, W), and so control and start.
        reference: (B, 16, H, W).
        timestep: (B,) in [0, 1000].
        text: (B, 512, text_dim) umT5 tokens, zero where there are none.
        image: (B, 257, clip_dim) CLIP tokens.
    """
    x = torch.cat([noisy, control, start], dim=1)
    batch, _, frames, height, width = x.shape
    h, w_ = height // 2, width // 2
    tokens = F.conv3d(x, w['patch_embedding.weight'], w['patch_embedding.bias'], stride=(1, 2, 2))
    ref = F.conv2d(reference, w['ref_conv.weight'], w['ref_conv.bias'], stride=2)
    x = torch.cat([ref.flatten(2), tokens.flatten(2)], dim=2).transpose(1, 2)
    dim = x.shape[-1]
    angles = _angles(dim // num_heads, 1 + frames, h, w_)

    rates = 10000.0 ** -(torch.arange(128, dtype=torch.float64) / 128)
    phase = torch.outer(timestep.double(), rates)
    time = torch.cat([phase.cos(), phase.sin()], dim=1).to(x.dtype)
    time = _linear(w, 'time_embedding.2', F.silu(_linear(w, 'time_embedding.0', time)))
    modulation = _linear(w, 'time_projection.1', F.silu(time)).reshape(batch, 6, dim)

    text = F.gelu(_linear(w, 'text_embedding.0', text), approximate='tanh')
    text = _linear(w, 'text_embedding.2', text)
    image = _layer_norm(image, 1e-5) * w['img_emb.proj.0.weight'] + w['img_emb.proj.0.bias']
    image = _linear(w, 'img_emb.proj.3', F.gelu(_linear(w, 'img_emb.proj.1', image)))
    image = _layer_norm(image, 1e-5) * w['img_emb.proj.4.weight'] + w['img_emb.proj.4.bias']

    def heads(y: Tensor) -> Tensor:
        return y.unflatten(2, (num_heads, -1))

    for index in range(num_layers):
        block = f'blocks.{index}'
        m = (w[f'{block}.modulation'] + modulation).unbind(1)
        m = [row.unsqueeze(1) for row in m]
        name = f'{block}.self_attn'
        y = _layer_norm(x, 1e-6) * (1 + m[1]) + m[0]
        q = _rms_norm(_linear(w, f'{name}.q', y), w[f'{name}.norm_q.weight'])
        k = _rms_norm(_linear(w, f'{name}.k', y), w[f'{name}.norm_k.weight'])
        v = heads(_linear(w, f'{name}.v', y))
        y = _attend(_rotate(heads(q), angles), _rotate(heads(k), angles), v)
        x = x + _linear(w, f'{name}.o', y) * m[2]

        name = f'{block}.cross_attn'
        y = _layer_norm(x, 1e-6) * w[f'{block}.norm3.weight'] + w[f'{block}.norm3.bias']
        q = heads(_rms_norm(_linear(w, f'{name}.q', y), w[f'{name}.norm_q.weight']))
        k = heads(_rms_norm(_linear(w, f'{name}.k', text), w[f'{name}.norm_k.weight']))
        k_img = _rms_norm(_linear(w, f'{name}.k_img', image), w[f'{name}.norm_k_img.weight'])
        y = _attend(q, k, heads(_linear(w, f'{name}.v', text)))
        y = y + _attend(q, heads(k_img), heads(_linear(w, f'{name}.v_img', image)))
        x = x + _linear(w, f'{name}.o', y)

        y = _layer_norm(x, 1e-6) * (1 + m[4]) + m[3]
        y = F.gelu(_linear(w, f'{block}.ffn.0', y), approximate='tanh')
        x = x + _linear(w, f'{block}.ffn.2', y) * m[5]

    shift, scale = (w['head.modulation'] + time.unsqueeze(1)).chunk(2, dim=1)
    x = _linear(w, 'head.head', _layer_norm(x, 1e-6) * (1 + scale) + shift)
    x = x[:, h * w_ :].reshape(batch, frames, h, w_, 2, 2, 16)
    return x.permute(0, 6, 1, 2, 4, 3, 5).reshape(batch, 16, frames, height, width)
