"""Maps tensor names of public Wan 2.1 checkpoints to this package's.

Names of the original layout (Wan, VideoX-Fun, DiffSynth) and of diffusers and transformers are
both read; the maps of transformer and autoencoder are diffusers' own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
import re

#: prefixes of tensor names in repackaged files
_PREFIXES = ('model.diffusion_model.', 'diffusion_model.', 'model.', 'vae.', 'pipe.dit.')


@dataclass(frozen=True, slots=True)
class TakenTensor:
    """Source of a tensor: a stored tensor, or one of its equal parts along axis 0."""

    source: str
    part: int = 0
    num_parts: int = 1


@dataclass(frozen=True, slots=True)
class KeyMap:
    """Mapping of the tensors of a file to the tensors of a model.

    Attributes:
        takes: source of each tensor, by its name in this package.
        unused: names of tensors without use in the model, with the reason.
    """

    takes: dict[str, TakenTensor]
    unused: dict[str, str] = field(default_factory=dict)


def transformer_keys(names: Iterable[str]) -> KeyMap:
    """Return the keys of the transformer, of VideoX-Fun's or diffusers' names."""
    bare = _without_prefix(names)
    if 'head.head.weight' in bare:
        from diffusers.loaders.single_file_utils import convert_wan_transformer_to_diffusers

        ours = convert_wan_transformer_to_diffusers({name: name for name in bare})
    else:
        ours = {name: name for name in bare}
    return KeyMap({new: TakenTensor(bare[old]) for new, old in ours.items()})


def autoencoder_keys(names: Iterable[str]) -> KeyMap:
    """Return the keys of the autoencoder, of Wan's or diffusers' names."""
    bare = _without_prefix(names)
    original = 'encoder.conv1.weight' in bare
    # imported here: it pulls in transformers, which a node of the small preset does not need
    from diffusers.loaders.single_file_utils import convert_wan_vae_to_diffusers

    ours = convert_wan_vae_to_diffusers({n: n for n in bare}) if original else {n: n for n in bare}
    return KeyMap({new: TakenTensor(bare[old]) for new, old in ours.items()})


_UMT5 = {
    'norm1': 'layer.0.layer_norm',
    'attn.q': 'layer.0.SelfAttention.q',
    'attn.k': 'layer.0.SelfAttention.k',
    'attn.v': 'layer.0.SelfAttention.v',
    'attn.o': 'layer.0.SelfAttention.o',
    'pos_embedding.embedding': 'layer.0.SelfAttention.relative_attention_bias',
    'norm2': 'layer.1.layer_norm',
    'ffn.gate.0': 'layer.1.DenseReluDense.wi_0',
    'ffn.fc1': 'layer.1.DenseReluDense.wi_1',
    'ffn.fc2': 'layer.1.DenseReluDense.wo',
}


def text_encoder_keys(names: Iterable[str]) -> KeyMap:
    """Return the keys of umT5's encoder, of Wan's or transformers' names."""
    bare = _without_prefix(names)
    takes: dict[str, TakenTensor] = {}
    unused: dict[str, str] = {}
    for name, source in bare.items():
        block = re.fullmatch(r'blocks\.(\d+)\.(.+)\.weight', name)
        if block and block[2] in _UMT5:
            takes[f'encoder.block.{block[1]}.{_UMT5[block[2]]}.weight'] = TakenTensor(source)
        elif name == 'encoder.embed_tokens.weight' and 'shared.weight' in bare:
            unused[source] = 'the same as shared.weight'
        elif name in ('token_embedding.weight', 'encoder.embed_tokens.weight'):
            takes['shared.weight'] = TakenTensor(source)
        elif name == 'norm.weight':
            takes['encoder.final_layer_norm.weight'] = TakenTensor(source)
        else:
            takes[name] = TakenTensor(source)
    return KeyMap(takes, unused)


_CLIP = {
    'norm1': 'layer_norm1',
    'norm2': 'layer_norm2',
    'attn.proj': 'self_attn.out_proj',
    'mlp.0': 'mlp.fc1',
    'mlp.2': 'mlp.fc2',
}
_CLIP_ONCE = {
    'visual.patch_embedding.weight': 'embeddings.patch_embedding.weight',
    'visual.cls_embedding': 'embeddings.class_embedding',
    'visual.pos_embedding': 'embeddings.position_embedding.weight',
    'visual.pre_norm.weight': 'pre_layrnorm.weight',
    'visual.pre_norm.bias': 'pre_layrnorm.bias',
    'visual.post_norm.weight': 'post_layernorm.weight',
    'visual.post_norm.bias': 'post_layernorm.bias',
}
_CLIP_UNUSED = {
    'textual.': "CLIP's text side; text comes from umT5",
    'log_scale': "CLIP's temperature",
    'logit_scale': "CLIP's temperature",
    'visual.head': 'the projection behind the features that are used',
    'visual_projection.': 'the projection behind the features that are used',
    'vision_model.embeddings.position_ids': 'a range of numbers',
    'embeddings.position_ids': 'a range of numbers',
}


def image_encoder_keys(names: Iterable[str]) -> KeyMap:
    """Return the keys of CLIP's image side, of Wan's or transformers' names."""
    takes: dict[str, TakenTensor] = {}
    unused: dict[str, str] = {}
    for name, source in _without_prefix(names).items():
        reason = next((why for start, why in _CLIP_UNUSED.items() if name.startswith(start)), '')
        if reason:
            unused[source] = reason
        elif name in _CLIP_ONCE:
            takes[_CLIP_ONCE[name]] = TakenTensor(source)
        else:
            takes |= _clip_layer(name, source)
    return KeyMap(takes, unused)


def _clip_layer(name: str, source: str) -> dict[str, TakenTensor]:
    layer = re.fullmatch(r'visual\.transformer\.(\d+)\.(.+)\.(weight|bias)', name)
    if not layer:
        return {name.removeprefix('vision_model.'): TakenTensor(source)}
    index, module, kind = layer.groups()
    ours = f'encoder.layers.{index}'
    if module == 'attn.to_qkv':
        return {
            f'{ours}.self_attn.{part}_proj.{kind}': TakenTensor(source, number, 3)
            for number, part in enumerate('qkv')
        }
    return {f'{ours}.{_CLIP.get(module, module)}.{kind}': TakenTensor(source)}


def _without_prefix(names: Iterable[str]) -> dict[str, str]:
    """Return bare names -> names in the file; a prefix goes only where every name has it."""
    listed = list(names)
    for prefix in _PREFIXES:
        if listed and all(name.startswith(prefix) for name in listed):
            return {name.removeprefix(prefix): name for name in listed}
    return {name: name for name in listed}
