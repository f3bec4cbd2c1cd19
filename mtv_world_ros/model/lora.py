"""LoRA adapters: trained beside frozen weights, saved, exchanged in a loaded transformer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
import json
from pathlib import Path
from threading import Lock
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
import torch
from torch import Tensor

from mtv_world_ros.bounded_input import check_finite, read_json
from mtv_world_ros.errors import CheckpointError, ConfigError
from mtv_world_ros.files import whole_folder
from mtv_world_ros.model.card import CheckpointCard
from mtv_world_ros.model.lora_file import Factors, METADATA, PEFT_CONFIG, read_lora
from mtv_world_ros.model.tensor_files import disk_errors
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

ADAPTER = 'pytorch_lora_weights.safetensors'
#: weights that are trained whole and saved beside the adapter: phi, views, the way in
BESIDE = ('ref_conv.', 'view_embedding', 'patch_embedding.')
BESIDE_FILE = 'beside.safetensors'
BASE_FILE = 'base.json'
#: the paper's targets in every block: queries, keys, values, outputs, feed-forward layers
TARGETS = r'blocks\.\d+\..*\.(to_q|to_k|to_v|to_out\.0|net\.0\.proj|net\.2)'
_NAME = 'adapter'
#: peft's name for an adapter's file
_PEFT_FILE = 'adapter_model.safetensors'


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
        card: base model and training data, as in a checkpoint.
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
        path: of the adapter's file; None = no adapter.
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
            path: a folder of ours, of diffusers or of peft, or a LoRA file; None = none.

        Raises:
            CheckpointError: the adapter cannot be read, or is for another model.
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
            adapter: the result of `read`, or a path for it.

        Raises:
            CheckpointError: the adapter cannot be read, or is for another model.
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
        for name, (a, b, scale) in factors.items():
            weight: Any = self._transformer.get_submodule(name).weight
            if name not in self._under:
                self._under[name] = weight.detach().to('cpu', copy=True)
            # added in float32: the format of the weights rounds the sum alone
            change = b.to(weight.device).float() @ a.to(weight.device).float()
            weight.copy_(self._under[name].to(weight.device).float() + scale * change)

    def _read(self, path: Path) -> tuple[dict[str, Factors], dict[str, Tensor]]:
        if path.is_file():
            return read_lora(path, self._transformer), {}
        file = next((path / n for n in (ADAPTER, _PEFT_FILE) if (path / n).is_file()), None)
        if file is None:
            raise CheckpointError(
                f"'{path}' is no adapter: expected a folder with {ADAPTER} or {_PEFT_FILE} (and "
                f'its {PEFT_CONFIG}), or a .safetensors file'
            )
        self._check_base(path)
        return read_lora(file, self._transformer), self._read_beside(path)

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
            for name, value in whole.items():
                check_finite(value, name, file)
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
            tensors[f'{name}.lora_B.weight'] = pair.scale * pair.B.float()
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
