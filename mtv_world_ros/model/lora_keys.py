"""LoRA files of this project, of DiffSynth-Studio and of VideoX-Fun, read as one layout."""

from __future__ import annotations

from collections.abc import Mapping
import json
from pathlib import Path
import re
from typing import Any, NamedTuple

from safetensors import safe_open, SafetensorError
from torch import nn, Tensor

from mtv_world_ros.errors import CheckpointError, nearest
from mtv_world_ros.model.tensor_files import pickle_error, PICKLES
from mtv_world_ros.model.wan_keys import transformer_keys

#: what files put before module names
_PREFIXES = ('base_model.model.', 'pipe.dit.', 'diffusion_model.', 'transformer.', 'lora_unet_')
_KEY = re.compile(r'(.+)\.(lora_A|lora_B|lora_down|lora_up)(?:\.default)?\.weight')
_SIDE = {'lora_A': 'A', 'lora_down': 'A', 'lora_B': 'B', 'lora_up': 'B'}
#: diffusers' key for peft's configuration
METADATA = 'lora_adapter_metadata'


class Factors(NamedTuple):
    """What a module's weight changes by: `B @ A`, scaled already; A (r, in), B (out, r)."""

    A: Tensor
    B: Tensor


def read_lora(file: Path, transformer: nn.Module) -> dict[str, Factors]:
    """Returns the factors by the name of the transformer's module.

    Raises:
        CheckpointError: a pickle, damaged, or for another model: every tensor must find its place.
    """
    tensors, metadata = _read(file)
    modules = linear_modules(transformer)
    names = _names(modules)
    sides: dict[str, dict[str, Tensor]] = {}
    alphas: dict[str, float] = {}
    for key, value in tensors.items():
        if key.endswith('.alpha'):
            alphas[_module(key.removesuffix('.alpha'), names, file)] = float(value)
            continue
        match = _KEY.fullmatch(key)
        if not match:
            raise CheckpointError(f"'{file}': tensor '{key}' is no factor of a LoRA{_hint(key)}")
        module = _module(match[1], names, file)
        sides.setdefault(module, {})[_SIDE[match[2]]] = value
    whole = _whole_scale(metadata)
    return {
        name: _factors(file, name, pair, modules[name], alphas.get(name), whole)
        for name, pair in sides.items()
    }


def linear_modules(transformer: nn.Module) -> dict[str, Any]:
    """Returns the layers that a LoRA may change, by name, also where one is loaded already."""
    found = {}
    for name, module in transformer.named_modules():
        layer = getattr(module, 'base_layer', module)
        inside = '.base_layer' in name or '.lora_' in name
        if isinstance(layer, nn.Linear) and not inside:
            found[name] = layer
    return found


def _read(file: Path) -> tuple[dict[str, Tensor], Mapping[str, str]]:
    if file.suffix in PICKLES:
        raise pickle_error([file])
    try:
        with safe_open(file, framework='pt') as handle:
            names = handle.keys()
            return {name: handle.get_tensor(name) for name in names}, handle.metadata() or {}
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"LoRA '{file}' cannot be loaded: {error}") from error


def _names(modules: Mapping[str, Any]) -> dict[str, str]:
    """Every name that files have for a module, flattened ones with `_` too, to ours."""
    originals = _original_names(modules)
    names = {name: name for name in modules} | originals
    return names | {name.replace('.', '_'): ours for name, ours in names.items()}


def _original_names(modules: Mapping[str, Any]) -> dict[str, str]:
    attention = [f'self_attn.{n}' for n in 'qkvo'] + [f'cross_attn.{n}' for n in 'qkvo']
    attention += ['cross_attn.k_img', 'cross_attn.v_img', 'ffn.0', 'ffn.2']
    numbers = {name.split('.')[1] for name in modules if name.startswith('blocks.')}
    wan = [f'blocks.{number}.{name}' for number in numbers for name in attention]
    wan += ['text_embedding.0', 'text_embedding.2', 'time_embedding.0', 'time_embedding.2']
    wan += ['time_projection.1', 'img_emb.proj.1', 'img_emb.proj.3', 'head.head']
    takes = transformer_keys([f'{name}.weight' for name in wan]).takes
    found = {
        take.source[: -len('.weight')]: ours[: -len('.weight')] for ours, take in takes.items()
    }
    return {name: ours for name, ours in found.items() if ours in modules}


def _module(name: str, names: Mapping[str, str], file: Path) -> str:
    bare = name
    for prefix in _PREFIXES:
        bare = bare.removeprefix(prefix)
    bare = bare.removeprefix('_')  # VideoX-Fun: `lora_unet__blocks_0_...`
    if bare not in names:
        raise CheckpointError(
            f"'{file}': '{name}' is no layer of this transformer{nearest(bare, names)}; the LoRA "
            'is for another model'
        )
    return names[bare]


def _whole_scale(metadata: Mapping[str, str]) -> float:
    """Alpha / r as peft's configuration in the file says; files of others have none."""
    config = json.loads(metadata.get(METADATA, '{}'))
    return config.get('lora_alpha', 1) / config.get('r', 1)


def _factors(
    file: Path,
    name: str,
    pair: Mapping[str, Tensor],
    layer: nn.Linear,
    alpha: float | None,
    whole: float,
) -> Factors:
    if set(pair) != {'A', 'B'}:
        raise CheckpointError(f"'{file}': layer '{name}' has one of its two factors only")
    a, b = pair['A'], pair['B']
    if a.shape[1:] != (layer.in_features,) or b.shape != (layer.out_features, a.shape[0]):
        raise CheckpointError(
            f"'{file}': the factors of '{name}' are {list(b.shape)} x {list(a.shape)}, the layer "
            f'is {layer.out_features} x {layer.in_features}: the LoRA is for another size'
        )
    return Factors(a, b * (whole if alpha is None else alpha / a.shape[0]))


def _hint(key: str) -> str:
    if key.startswith('lora_te'):
        return ' of the transformer; it is for a text encoder'
    if '.diff' in key:
        return '; whole differences (.diff, .diff_b) are not read: bake them into the weights'
    return ''
