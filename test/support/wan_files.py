"""Small checkpoints in the true published layouts, with random weights.

The names are those of Wan's and VideoX-Fun's files, written down here once more and not taken
from the code under test.
"""

from __future__ import annotations

import json
from pathlib import Path

from diffusers import AutoencoderKLWan
from safetensors.torch import save_file
from tokenizers import models, pre_tokenizers, Tokenizer
import torch
from transformers import PreTrainedTokenizerFast

from mtv_world_ros.model.card import CheckpointCard
from test.support.wan_reference import random_weights, video_tensors, Weights

Shapes = dict[str, tuple[int, ...]]

HEADS, LAYERS, DIM, FFN = 2, 2, 24, 40
TEXT_DIM, CLIP_DIM = 32, 32
TRANSFORMER = {
    'num_attention_heads': HEADS,
    'attention_head_dim': DIM // HEADS,
    'in_channels': 48,
    'out_channels': 16,
    'text_dim': TEXT_DIM,
    'ffn_dim': FFN,
    'num_layers': LAYERS,
    'image_dim': CLIP_DIM,
    'added_kv_proj_dim': DIM,
    'rope_max_seq_len': 64,
    'num_views': 3,
}
AUTOENCODER = {'_class_name': 'AutoencoderKLWan', 'base_dim': 4}
SCHEDULER = {
    '_class_name': 'UniPCMultistepScheduler',
    'prediction_type': 'flow_prediction',
    'use_flow_sigmas': True,
    'flow_shift': 3.0,
}
CARD = CheckpointCard(
    views=['low', 'high'],
    fps=16.0,
    num_frames=4,
    width=32,
    height=32,
    robot='yam_bimanual',
    control='trajectory_video',
    object_mask=True,
    rendering={},
    trained_on={},
    prompt='pick the block',
)


def transformer_weights(seed: int = 0) -> Weights:
    shapes = video_tensors(dim=DIM, ffn=FFN, layers=LAYERS, text_dim=TEXT_DIM, clip_dim=CLIP_DIM)
    return random_weights(shapes, seed)


def umt5_shapes(width: int, vocab: int, ffn: int, layers: int, heads: int) -> Shapes:
    """Names and shapes in `models_t5_umt5-xxl-enc-bf16`, at any size."""
    shapes: Shapes = {'token_embedding.weight': (vocab, width), 'norm.weight': (width,)}
    for index in range(layers):
        block = f'blocks.{index}'
        shapes |= {f'{block}.attn.{name}.weight': (width, width) for name in 'qkvo'}
        shapes |= {f'{block}.norm{n}.weight': (width,) for n in (1, 2)}
        shapes |= {f'{block}.ffn.{name}.weight': (ffn, width) for name in ('gate.0', 'fc1')}
        shapes[f'{block}.ffn.fc2.weight'] = (width, ffn)
        shapes[f'{block}.pos_embedding.embedding.weight'] = (32, heads)
    return shapes


def umt5_weights() -> Weights:
    return random_weights(umt5_shapes(TEXT_DIM, vocab=64, ffn=48, layers=2, heads=4), 1)


def clip_shapes(width: int, layers: int, side: int, patch: int, out: int) -> Shapes:
    """Names and shapes of the image side of `models_clip_open-clip-xlm-roberta-...-huge-14`."""
    shapes: Shapes = {
        'log_scale': (),
        'visual.cls_embedding': (1, 1, width),
        'visual.pos_embedding': (1, 1 + side**2, width),
        'visual.patch_embedding.weight': (width, 3, patch, patch),
        'visual.head': (width, out),
    }
    linear = {
        'attn.to_qkv': (3 * width, width),
        'attn.proj': (width, width),
        'mlp.0': (4 * width, width),
        'mlp.2': (width, 4 * width),
    }
    norms = ['visual.pre_norm', 'visual.post_norm']
    for index in range(layers):
        layer = f'visual.transformer.{index}'
        norms += [f'{layer}.norm1', f'{layer}.norm2']
        for name, shape in linear.items():
            shapes |= {f'{layer}.{name}.weight': shape, f'{layer}.{name}.bias': shape[:1]}
    return shapes | {f'{name}.{kind}': (width,) for name in norms for kind in ('weight', 'bias')}


def clip_text_shapes(width: int = 1024, layers: int = 24, vocab: int = 250002) -> Shapes:
    """Names and shapes of its text side, which nobody needs."""
    shapes: Shapes = {
        'textual.token_embedding.weight': (vocab, width),
        'textual.type_embedding.weight': (1, width),
        'textual.pos_embedding.weight': (514, width),
        'textual.head.0.weight': (width, width),
        'textual.head.2.weight': (width, width),
    }
    linear = {f'attn.{name}': (width, width) for name in 'qkvo'}
    linear |= {'ffn.0': (4 * width, width), 'ffn.2': (width, 4 * width)}
    norms = ['textual.norm']
    for index in range(layers):
        block = f'textual.blocks.{index}'
        norms += [f'{block}.norm1', f'{block}.norm2']
        for name, shape in linear.items():
            shapes |= {f'{block}.{name}.weight': shape, f'{block}.{name}.bias': shape[:1]}
    return shapes | {f'{name}.{kind}': (width,) for name in norms for kind in ('weight', 'bias')}


def clip_weights() -> Weights:
    """At another size, with 16 heads as the published one."""
    image = clip_shapes(CLIP_DIM, layers=3, side=4, patch=2, out=8)
    return random_weights({**image, 'textual.head.0.weight': (8, 8)}, 2)


def vae_model(seed: int = 3) -> AutoencoderKLWan:
    torch.manual_seed(seed)
    return AutoencoderKLWan(base_dim=4).eval()


def vae_original_name(name: str) -> str:
    """The name that Wan's own `Wan2.1_VAE` has for a tensor of diffusers' class."""
    side, *rest = name.split('.')
    if side in ('quant_conv', 'post_quant_conv'):
        return '.'.join(['conv1' if side == 'quant_conv' else 'conv2', *rest])
    inner = {'norm1': 'residual.0', 'conv1': 'residual.2', 'norm2': 'residual.3'}
    inner |= {'conv2': 'residual.6', 'conv_shortcut': 'shortcut'}
    where, *rest = rest
    if where in ('conv_in', 'conv_out', 'norm_out'):
        middle = {'conv_in': 'conv1', 'conv_out': 'head.2', 'norm_out': 'head.0'}[where]
        return '.'.join([side, middle, *rest])
    if where == 'mid_block':
        kind, index, *rest = rest
        if kind == 'attentions':
            return '.'.join([side, 'middle.1', *rest])
        return '.'.join([side, f'middle.{2 * int(index)}', inner[rest[0]], *rest[1:]])
    if where == 'down_blocks':
        index, module, *rest = rest
        return '.'.join([side, f'downsamples.{index}', inner.get(module, module), *rest])
    level, kind, index, module, *rest = rest  # up_blocks: 3 residual blocks and an upsampler each
    number = 4 * int(level) + (int(index) if kind == 'resnets' else 3)
    return '.'.join([side, f'upsamples.{number}', inner.get(module, module), *rest])


def vae_weights() -> Weights:
    return {vae_original_name(k): v.clone() for k, v in vae_model().state_dict().items()}


def write_tokenizer(folder: Path) -> None:
    words = ['<pad>', '</s>', '<unk>', 'pick', 'place', 'the', 'block', 'red']
    tokenizer = Tokenizer(models.WordLevel({w: i for i, w in enumerate(words)}, '<unk>'))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()  # type: ignore[assignment]
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token='<pad>', eos_token='</s>', unk_token='<unk>'
    )
    fast.save_pretrained(folder)


def write_videox(folder: Path, *, dtype: torch.dtype = torch.bfloat16) -> Path:
    """A folder like that of VideoX-Fun, its pickles converted to safetensors."""
    folder.mkdir(parents=True)
    files = {
        'diffusion_pytorch_model': transformer_weights(),
        'models_t5_umt5-xxl-enc-bf16': umt5_weights(),
        'models_clip_open-clip-xlm-roberta-large-vit-huge-14': clip_weights(),
    }
    for name, weights in files.items():
        save_file({k: v.to(dtype) for k, v in weights.items()}, folder / f'{name}.safetensors')
    save_file(vae_weights(), folder / 'Wan2.1_VAE.safetensors')
    (folder / 'config.json').write_text(json.dumps({'dim': DIM, 'num_heads': HEADS}))
    write_tokenizer(folder / 'google' / 'umt5-xxl')
    return folder


def write_shards(folder: Path, weights: Weights, count: int = 3) -> None:
    """The transformer in shards with their index, as the 14B comes."""
    names = sorted(weights)
    places = {}
    for number in range(count):
        file = f'diffusion_pytorch_model-{number + 1:05d}-of-{count:05d}.safetensors'
        part = names[number::count]
        save_file({name: weights[name] for name in part}, folder / file)
        places |= dict.fromkeys(part, file)
    index = folder / 'diffusion_pytorch_model.safetensors.index.json'
    index.write_text(json.dumps({'metadata': {}, 'weight_map': places}))
