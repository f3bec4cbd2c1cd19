"""LoRA adapters: trained beside frozen weights, saved, read in three layouts, exchanged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
import json
from pathlib import Path
import re
from threading import Lock
from typing import Any, NamedTuple

from safetensors import safe_open, SafetensorError
from safetensors.torch import load_file, save_file
import torch
from torch import nn, Tensor

from mtv_world_ros.bounded_input import parse_json, read_json
from mtv_world_ros.errors import CheckpointError, ConfigError, nearest
from mtv_world_ros.files import whole_folder
from mtv_world_ros.model.card import CheckpointCard
from mtv_world_ros.model.tensor_files import disk_errors, pickle_error, PICKLES
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.model.wan_keys import transformer_keys

ADAPTER = 'pytorch_lora_weights.safetensors'
#: weights that are trained whole and saved beside the adapter: phi, views, the way in
BESIDE = ('ref_conv.', 'view_embedding', 'patch_embedding.')
BESIDE_FILE = 'beside.safetensors'
BASE_FILE = 'base.json'
#: the paper's targets in every block: queries, keys, values, outputs, feed-forward layers
TARGETS = r'blocks\.\d+\..*\.(to_q|to_k|to_v|to_out\.0|net\.0\.proj|net\.2)'
_NAME = 'adapter'
#: what files put before module names
_PREFIXES = ('base_model.model.', 'pipe.dit.', 'diffusion_model.', 'transformer.', 'lora_unet_')
_KEY = re.compile(r'(.+)\.(lora_A|lora_B|lora_down|lora_up)(?:\.default)?\.weight')
_SIDE = {'lora_A': 'A', 'lora_down': 'A', 'lora_B': 'B', 'lora_up': 'B'}
#: diffusers' key for peft's configuration
METADATA = 'lora_adapter_metadata'


def add_adapter(transformer: MultiViewWanTransformer, rank: int = 32, alpha: float = 32) -> None:
    """Freezes the transformer and adds a trainable adapter that changes nothing yet.

    Args:
        transformer: whose phi, view embedding and patch embedding stay trainable as they are.
        rank: of the adapter's factors (the paper's: 32).
        alpha: the factors' product counts alpha / rank.

    Raises:
        ConfigError: peft is not installed.
    """
    _check_peft()
    from peft import LoraConfig

    transformer.requires_grad_(False)
    config: Any = LoraConfig(r=rank, lora_alpha=alpha, target_modules=TARGETS)  # type: ignore[arg-type]
    transformer.add_adapter(config, adapter_name=_NAME)
    for parameter in beside(transformer).values():
        parameter.requires_grad_(True)


def beside(transformer: MultiViewWanTransformer) -> dict[str, Tensor]:
    """Returns the weights that are saved beside an adapter, by name."""
    return {n: p for n, p in transformer.named_parameters() if n.startswith(BESIDE)}


def save_adapter(
    transformer: MultiViewWanTransformer,
    folder: Path,
    *,
    weights: Mapping[str, Tensor] | None = None,
    card: CheckpointCard | None = None,
) -> None:
    """Writes the adapter's folder; it appears under its name only when it is whole.

    The adapter itself is in diffusers' layout.

    Args:
        transformer: has the adapter.
        folder: to write.
        weights: in place of the transformer's, by name; such as averaged ones.
        card: what it was trained for and on, as in a checkpoint.
    """
    from peft.utils import get_peft_model_state_dict

    config = json.dumps(transformer.peft_config[_NAME].to_dict(), default=list, sort_keys=True)
    tensors = {**transformer.state_dict(), **(weights or {})}
    factors = get_peft_model_state_dict(transformer, tensors, adapter_name=_NAME)
    with whole_folder(folder) as partial:
        _save(factors, partial / ADAPTER, config)
        _save({name: tensors[name] for name in beside(transformer)}, partial / BESIDE_FILE)
        (partial / BASE_FILE).write_text(json.dumps(_base(transformer), indent=2) + '\n')
        if card is not None:
            card.write(partial)


def _save(tensors: dict[str, Tensor], file: Path, config: str = '') -> None:
    metadata = {'format': 'pt', **({METADATA: config} if config else {})}
    with disk_errors():
        save_file({n: t.detach().contiguous() for n, t in tensors.items()}, file, metadata)


@dataclass(frozen=True, slots=True)
class Adapter:
    """An adapter in memory that is known to fit a transformer; without anything: none.

    Attributes:
        path: where it was read; None = none.
        factors: of the layers that it changes, by name.
        whole: the weights beside it, by name.
    """

    path: Path | None
    factors: Mapping[str, Factors]
    whole: Mapping[str, Tensor]


_NONE = Adapter(None, {}, {})


class Adapters:
    """Exchanges the adapter of a loaded transformer; the weights under it come back as they were.

    Reading one is safe in another thread than the one that exchanges them.

    Args:
        transformer: loaded, without an adapter.
        fuse: add the adapter into the weights: no cost a step, and a compiled transformer stays
            compiled. What it changes is kept on the CPU meanwhile.
    """

    def __init__(self, transformer: MultiViewWanTransformer, *, fuse: bool = False) -> None:
        self._transformer, self._fused = transformer, fuse
        #: the weights under a fused adapter, by module
        self._under: dict[str, Tensor] = {}
        self._beside = {n: p.detach().clone() for n, p in beside(transformer).items()}
        self._held = _NONE
        self._lock = Lock()

    @property
    def current(self) -> Path | None:
        """Where the adapter in use was read; None = there is none."""
        return self._held.path

    def read(self, path: Path | None) -> Adapter:
        """Returns an adapter that `use` takes at once, whatever becomes of its files.

        Args:
            path: a folder of ours, or a LoRA file of DiffSynth-Studio or VideoX-Fun; None = none.

        Raises:
            CheckpointError: it cannot be read, or is for another model.
            ConfigError: peft is not installed.
        """
        if path is None:
            return _NONE
        if not self._fused:
            _check_peft()
        with self._lock:
            return Adapter(path, *self._read(path))

    def use(self, adapter: Adapter | Path | None) -> None:
        """Takes another adapter, or none; where that fails, the one before stays.

        Args:
            adapter: what `read` gave, or what it takes.

        Raises:
            CheckpointError: it cannot be read, or is for another model.
            ConfigError: peft is not installed.
        """
        wanted = adapter if isinstance(adapter, Adapter) else self.read(adapter)
        with self._lock:
            try:
                self._exchange(wanted)
            except Exception:
                self._exchange(self._held)
                raise
            self._held = wanted

    def _exchange(self, adapter: Adapter) -> None:
        self._fill({**self._beside, **adapter.whole})
        if self._fused:
            self._fuse(adapter.factors)
            return
        self._transformer.unload_lora()
        if adapter.factors:
            self._inject(adapter.factors)

    @torch.no_grad()
    def _fuse(self, factors: Mapping[str, Factors]) -> None:
        """Adds factors into the weights, in place, and takes out what was fused before."""
        for name in self._under.keys() - factors.keys():
            restored: Any = self._transformer.get_submodule(name)
            restored.weight.copy_(self._under.pop(name))
        for name, (a, b) in factors.items():
            weight: Any = self._transformer.get_submodule(name).weight
            if name not in self._under:
                self._under[name] = weight.detach().to('cpu', copy=True)
            # added in float32: the format of the weights rounds the sum alone
            change = b.to(weight.device).float() @ a.to(weight.device).float()
            weight.copy_(self._under[name].to(weight.device).float() + change)

    def _read(self, path: Path) -> tuple[dict[str, Factors], dict[str, Tensor]]:
        if path.is_file():
            return read_lora(path, self._transformer), {}
        if not (path / ADAPTER).is_file():
            raise CheckpointError(
                f"'{path}' is no adapter: expected a folder with {ADAPTER}, or a .safetensors "
                'file of DiffSynth-Studio or VideoX-Fun'
            )
        self._check_base(path)
        return read_lora(path / ADAPTER, self._transformer), self._read_beside(path)

    def _check_base(self, path: Path) -> None:
        file = path / BASE_FILE
        mine = _base(self._transformer)
        try:
            theirs = dict(read_json(file)) if file.is_file() else mine
        except (OSError, ValueError, TypeError) as error:
            raise CheckpointError(f"'{file}' cannot be read: {error}") from error
        for key, value in mine.items():
            if theirs.get(key) != value:
                raise CheckpointError(
                    f"adapter '{path}' was trained on a transformer of {key} {theirs.get(key)}, "
                    f'this one has {value}; load the checkpoint it was trained on'
                )

    def _read_beside(self, path: Path) -> dict[str, Tensor]:
        file = path / BESIDE_FILE
        if not file.is_file():
            return {}
        try:
            whole = load_file(file)
        except (OSError, SafetensorError) as error:
            raise CheckpointError(f"'{file}' cannot be loaded: {error}") from error
        for name, value in whole.items():
            held = self._beside.get(name)
            if held is None or held.shape != value.shape:
                expected = 'none' if held is None else list(held.shape)
                raise CheckpointError(
                    f"'{file}': '{name}' has shape {list(value.shape)}, expected {expected}"
                )
        return whole

    @torch.no_grad()
    def _fill(self, whole: dict[str, Tensor]) -> None:
        for name, parameter in beside(self._transformer).items():
            parameter.copy_(whole[name])

    def _inject(self, factors: Mapping[str, Factors]) -> None:
        transformer = self._transformer
        tensors = {}
        for name, pair in factors.items():
            tensors[f'{name}.lora_A.weight'] = pair.A.float()
            tensors[f'{name}.lora_B.weight'] = pair.B.float()
        device, dtype = transformer.device, transformer.dtype
        transformer.load_lora_adapter(tensors, prefix=None, adapter_name=_NAME)  # type: ignore[arg-type]
        for name, parameter in transformer.named_parameters():
            if '.lora_' in name:
                parameter.data = parameter.data.to(device, dtype)


def _base(transformer: MultiViewWanTransformer) -> dict[str, Any]:
    """What must be equal where an adapter is used and where it was trained."""
    config: Any = transformer.config
    names = ('num_layers', 'num_attention_heads', 'attention_head_dim', 'in_channels', 'num_views')
    return {name: config[name] for name in names}


def _check_peft() -> None:
    if find_spec('peft') is None:
        raise ConfigError(
            "LoRA adapters need the package 'peft'; install it with "
            "pip install 'mtv_world_ros[wan]'"
        )


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
    try:
        config = parse_json(metadata.get(METADATA, '{}'), METADATA)
        return float(config.get('lora_alpha', 1) / config.get('r', 1))
    except (ValueError, AttributeError, TypeError, ArithmeticError) as error:
        raise CheckpointError(f'{METADATA} in the file cannot be used: {error}') from error


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
