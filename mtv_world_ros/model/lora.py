"""LoRA adapters: read, checked, exchanged in a loaded transformer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file
import torch
from torch import Tensor

from mtv_world_ros.core.bounded_input import check_finite, read_json
from mtv_world_ros.core.errors import CheckpointError
from mtv_world_ros.model.lora_file import Factors, PEFT_CONFIG, read_lora
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

ADAPTER = 'pytorch_lora_weights.safetensors'
#: weights that are trained whole and saved with the adapter: phi, views, the stem, the
#: embeddings of controls that are not drawn
BESIDE = ('ref_conv.', 'view_embedding', 'patch_embedding.', 'control_tokens.')
BESIDE_FILE = 'beside.safetensors'
BASE_FILE = 'base.json'
#: peft's name for an adapter's file
_PEFT_FILE = 'adapter_model.safetensors'


def fully_trained_weights(transformer: MultiViewWanTransformer) -> dict[str, Tensor]:
    """Return the weights that are trained whole and saved with an adapter, by name."""
    return {n: p for n, p in transformer.named_parameters() if n.startswith(BESIDE)}


@dataclass(frozen=True, slots=True)
class Adapter:
    """An adapter in memory, checked against a transformer; an empty one means no adapter.

    Attributes:
        path: path of the adapter's file; None = no adapter.
        factors: low-rank factors of the changed layers, by name.
        whole: weights that were trained whole, by name.
    """

    path: Path | None
    factors: Mapping[str, Factors]
    whole: Mapping[str, Tensor]


_NONE = Adapter(None, {}, {})


class Adapters:
    """Exchange of the adapter of a loaded transformer; it restores the weights without adapter.

    Reading one is safe in another thread than the one that exchanges them.

    An adapter is added into the weights: no cost a step, and a compiled transformer stays
    compiled. What it changes is kept on the CPU meanwhile.

    Args:
        transformer: loaded, without an adapter.
    """

    def __init__(self, transformer: MultiViewWanTransformer) -> None:
        self._transformer = transformer
        #: the weights without the adapter, by module
        self._under: dict[str, Tensor] = {}
        self._beside = {
            n: p.detach().clone() for n, p in fully_trained_weights(transformer).items()
        }
        self._held = _NONE
        self._lock = Lock()

    @property
    def current(self) -> Path | None:
        """Path of the active adapter; None = there is none."""
        return self._held.path

    def read(self, path: Path | None) -> Adapter:
        """Read an adapter into memory, for `use`.

        Args:
            path: a folder of ours, of diffusers or of peft, or a LoRA file; None = none.

        Raises:
            CheckpointError: the adapter cannot be read, or is for another model.
        """
        if path is None:
            return _NONE
        with self._lock:
            return Adapter(path, *self._read(path))

    def use(self, adapter: Adapter | Path | None) -> None:
        """Activate another adapter, or none; on failure the previous one stays active.

        Args:
            adapter: the result of `read`, or a path for it.

        Raises:
            CheckpointError: the adapter cannot be read, or is for another model.
        """
        wanted = adapter if isinstance(adapter, Adapter) else self.read(adapter)
        with self._lock:
            try:
                self._exchange(wanted)
            except Exception:
                self._exchange(self._held)
                raise
            self._held = wanted

    @torch.no_grad()
    def _exchange(self, adapter: Adapter) -> None:
        """Remove the previous adapter from the weights and add another one, in place."""
        whole = {**self._beside, **adapter.whole}
        for name, parameter in fully_trained_weights(self._transformer).items():
            parameter.copy_(whole[name])
        for name in self._under.keys() - adapter.factors.keys():
            restored: Any = self._transformer.get_submodule(name)
            restored.weight.copy_(self._under.pop(name))
        for name, (a, b, scale) in adapter.factors.items():
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
        self._checkbase_of(path)
        return read_lora(file, self._transformer), self._read_beside(path)

    def _checkbase_of(self, path: Path) -> None:
        file = path / BASE_FILE
        mine = base_of(self._transformer)
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


def base_of(transformer: MultiViewWanTransformer) -> dict[str, Any]:
    """Return the configuration that must be equal in training and in use of an adapter."""
    config: Any = transformer.config
    names = ('num_layers', 'num_attention_heads', 'attention_head_dim', 'in_channels', 'num_views')
    return {name: config[name] for name in names}
