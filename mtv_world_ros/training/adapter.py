"""LoRA adapters in training: added to layers with frozen weights, and saved."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
import json
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import Tensor

from mtv_world_ros.control.control import Control
from mtv_world_ros.control.registry import save_control
from mtv_world_ros.core.errors import MissingPackageError
from mtv_world_ros.core.files import whole_folder
from mtv_world_ros.model.card import CheckpointCard
from mtv_world_ros.model.lora import (
    ADAPTER,
    BASE_FILE,
    base_of,
    BESIDE_FILE,
    fully_trained_weights,
)
from mtv_world_ros.model.lora_file import METADATA
from mtv_world_ros.model.tensor_files import disk_errors
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer

#: the paper's targets in every block: queries, keys, values, outputs, feed-forward layers
TARGETS = r'blocks\.\d+\..*\.(to_q|to_k|to_v|to_out\.0|net\.0\.proj|net\.2)'
_NAME = 'adapter'


def add_adapter(transformer: MultiViewWanTransformer, rank: int = 32, alpha: float = 32) -> None:
    """Freeze the transformer and add a trainable adapter that changes nothing yet.

    Args:
        transformer: whose phi, view embedding and patch embedding stay trainable as they are.
        rank: rank of the adapter's factors (the paper's: 32).
        alpha: the factors' product counts alpha / rank.

    Raises:
        MissingPackageError: peft is not installed.
    """
    if find_spec('peft') is None:
        raise MissingPackageError('a LoRA adapter', 'peft')
    from peft import LoraConfig

    transformer.requires_grad_(False)
    config: Any = LoraConfig(r=rank, lora_alpha=alpha, target_modules=TARGETS)  # type: ignore[arg-type]
    transformer.add_adapter(config, adapter_name=_NAME)
    for parameter in fully_trained_weights(transformer).values():
        parameter.requires_grad_(True)


def save_adapter(
    transformer: MultiViewWanTransformer,
    folder: Path,
    *,
    weights: Mapping[str, Tensor] | None = None,
    card: CheckpointCard | None = None,
    control: Control | None = None,
) -> None:
    """Write the adapter's folder; it appears under its name only when it is whole.

    The adapter itself is in diffusers' layout.

    Args:
        transformer: transformer that has the adapter.
        folder: folder to write.
        weights: weights in place of the transformer's, by name; such as averaged ones.
        card: base model and training data, as in a checkpoint.
        control: control of the model.
    """
    from peft.utils import get_peft_model_state_dict

    config = json.dumps(transformer.peft_config[_NAME].to_dict(), default=list, sort_keys=True)
    tensors = {**transformer.state_dict(), **(weights or {})}
    factors = get_peft_model_state_dict(transformer, tensors, adapter_name=_NAME)
    with whole_folder(folder) as partial:
        _save(factors, partial / ADAPTER, config)
        _save(
            {name: tensors[name] for name in fully_trained_weights(transformer)},
            partial / BESIDE_FILE,
        )
        (partial / BASE_FILE).write_text(json.dumps(base_of(transformer), indent=2) + '\n')
        if card is not None:
            card.write(partial)
            if control is not None:
                save_control(control, card.control, partial)


def _save(tensors: dict[str, Tensor], file: Path, config: str = '') -> None:
    metadata = {'format': 'pt', **({METADATA: config} if config else {})}
    with disk_errors():
        save_file({n: t.detach().contiguous() for n, t in tensors.items()}, file, metadata)
