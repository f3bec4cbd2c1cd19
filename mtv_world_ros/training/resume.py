"""The saved state of a training: everything that a resumed run needs, written atomically."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
import torch
from torch import Tensor

from mtv_world_ros.core.bounded_input import check_finite, read_json, require_regular
from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.core.files import recover_folder, whole_folder
from mtv_world_ros.training.averaged_weights import AveragedWeights
from mtv_world_ros.training.training_config import TrainingConfig

#: folder of the training state, in the folder of the training
STATE = 'state'
#: file of the tensors of weights and optimizer, in that folder
_TENSORS_FILE = 'state.safetensors'
#: file of the other values of the state, such as the step, in that folder
_CARD_FILE = 'state.json'


class DiskError(TrainingError):
    """Error of a full or broken disk; the previous state is intact."""


@contextmanager
def disk_errors_named(folder: Path) -> Iterator[None]:
    """Turn errors of the file system, such as a full disk, into `DiskError`.

    Raises:
        DiskError: in place of the error.
    """
    try:
        yield
    except (OSError, SafetensorError) as error:
        raise DiskError(
            f"files of '{folder}' cannot be read or written: {error}; the last saved state and "
            'checkpoint are whole: free some space and run the same command again'
        ) from error


def save_state(
    folder: Path,
    weights: AveragedWeights,
    optimizer: torch.optim.Optimizer,
    card: Mapping[str, Any],
) -> None:
    """Replace the state in `folder/state` atomically.

    Raises:
        DiskError: the state could not be written; the old one stays.
    """
    tensors = {f'master.{k}': v.detach() for k, v in weights.master.items()}
    tensors |= {f'ema.{i}': p for i, p in enumerate(weights.ema.shadow_params)}
    for index, state in optimizer.state_dict()['state'].items():
        tensors |= {f'adam.{index}.{k}': v for k, v in state.items()}
    tensors = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    whole = {**card, 'ema_step': weights.ema.optimization_step}
    with disk_errors_named(folder), whole_folder(folder / STATE) as partial:
        save_file(tensors, partial / _TENSORS_FILE)
        (partial / _CARD_FILE).write_text(json.dumps(whole))


def read_card(folder: Path) -> dict[str, Any] | None:
    """Return the metadata of the saved state; None if there is none.

    Raises:
        TrainingError: the state is damaged.
    """
    recover_folder(folder / STATE)
    file = folder / STATE / _CARD_FILE
    try:
        return dict(read_json(file)) if file.is_file() else None
    except (OSError, ValueError, TypeError) as error:
        raise TrainingError(
            f"'{file}' is damaged: {error}; remove '{file.parent}' to begin anew"
        ) from error


def architecture(config: TrainingConfig) -> dict[str, Any]:
    """Return the values of a preset that determine weights and videos, by dotted name (JSON)."""
    values = {
        **{f'transformer.{name}': value for name, value in config.transformer.items()},
        **{f'autoencoder.{name}': value for name, value in config.autoencoder.items()},
        **{f'video.{n}': v for n, v in config.video.model_dump(exclude={'clip_stride_s'}).items()},
        'lora.rank': config.lora.rank,
    }
    return json.loads(json.dumps(values))


def check_architecture(folder: Path, config: TrainingConfig) -> None:
    """Check that a preset has the architecture of the state in a folder, if there is one.

    Raises:
        TrainingError: the architectures differ; names the first difference.
    """
    held, mine = read_card(folder), architecture(config)
    if held is None or 'lora.rank' not in held:  # of a version that did not keep it
        return
    theirs = {name: value for name, value in held.items() if '.' in name}
    for name in sorted({*theirs, *mine}):
        if theirs.get(name) != mine.get(name):
            raise TrainingError(
                f"'{folder / STATE}' was trained with {name} {theirs.get(name)}, this preset has "
                f'{mine.get(name)}; give --preset and --set as before, or another --out'
            )


def check_card(folder: Path, card: Mapping[str, Any], mine: Mapping[str, Any]) -> None:
    """Check that a saved state is of this run's seed and base (a digest, or None).

    Raises:
        TrainingError: seed or base of the state differ from this run's.
    """
    trained, state = {'base': None, **card}, folder / STATE
    if trained['seed'] != mine['seed']:
        raise TrainingError(
            f"'{state}' was trained with seed {trained['seed']!r}, this run has "
            f'{mine["seed"]!r}; give --seed the same, or another --out'
        )
    if trained['base'] != mine['base']:
        raise TrainingError(
            f"'{state}' was trained on top of other weights than those of --init; give the "
            'same, or another --out'
        )


def load_state(folder: Path, weights: AveragedWeights, optimizer: torch.optim.Optimizer) -> None:
    """Load the tensors of the saved state.

    Raises:
        TrainingError: the state is damaged, or of another model.
    """
    card, file = read_card(folder), folder / STATE / _TENSORS_FILE
    assert card is not None
    try:
        require_regular(file)
        tensors = load_file(file)
        for name, tensor in tensors.items():
            check_finite(tensor, name, file)
        weights.load({k[7:]: v for k, v in tensors.items() if k.startswith('master.')})
        shadow = weights.ema.shadow_params
        weights.ema.shadow_params = [
            tensors[f'ema.{i}'].to(p.device) for i, p in enumerate(shadow)
        ]
    except (OSError, SafetensorError, KeyError, RuntimeError) as error:
        raise TrainingError(
            f"'{file}' is damaged or of another model: {error}; give the preset it was trained "
            'with, or another --out'
        ) from error
    weights.ema.optimization_step = card['ema_step']
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith('adam.'):
            _, index, name = key.split('.')
            state.setdefault(int(index), {})[name] = value
    groups = optimizer.state_dict()['param_groups']
    optimizer.load_state_dict({'state': state, 'param_groups': groups})
