"""The saved state of a training: everything that a resumed run needs, written atomically.

It is a distributed checkpoint of torch in safetensors: each process writes a file, and any number
of processes reads them. Earlier versions wrote one file of the same tensors, which is read, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, ExitStack
import json
from pathlib import Path
from typing import Any
import warnings

from safetensors import SafetensorError
import torch
from torch import Tensor
from torch.distributed import checkpoint
from torch.distributed.checkpoint import HuggingFaceStorageReader, HuggingFaceStorageWriter
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.tensor import DTensor

from mtv_world_ros.core.bounded_input import check_finite, read_json, require_regular
from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.core.files import recover_folder, whole_folder
from mtv_world_ros.training.averaged_weights import AveragedWeights
from mtv_world_ros.training.distributed import Processes
from mtv_world_ros.training.training_config import TrainingConfig

#: folder of the training state, in the folder of the training
STATE = 'state'
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
    processes: Processes,
) -> None:
    """Replace the state in `folder/state` atomically; every process writes a part of it.

    Raises:
        DiskError: the state could not be written; the old one stays.
        TrainingError: another process is gone.
    """
    tensors = _tensors_of(weights, optimizer)
    whole = {**card, 'ema_step': weights.ema.optimization_step}
    with disk_errors_named(folder), ExitStack() as stack:
        new = stack.enter_context(whole_folder(folder / STATE)) if processes.is_main else None
        partial = processes.of_main(new)
        assert partial is not None
        writer = HuggingFaceStorageWriter(str(partial), save_distributed=True)
        try:
            with processes.losses_named(), _one_process_is_meant():
                checkpoint.save(tensors, storage_writer=writer)
        except CheckpointException as error:
            _raise_stop(error)
            raise OSError(_of_processes(error)) from error
        if processes.is_main:
            (partial / _CARD_FILE).write_text(json.dumps(whole))


def _tensors_of(weights: AveragedWeights, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Return copies of the tensors of weights and optimizer on the CPU by the state's names."""
    for parameter in weights.parameters:
        if not optimizer.state[parameter]:  # no step was made: as AdamW begins
            zeros = torch.zeros_like(parameter, requires_grad=False)
            begin = {'step': torch.tensor(0.0), 'exp_avg': zeros, 'exp_avg_sq': zeros.clone()}
            optimizer.state[parameter] = begin
    tensors = {f'master.{k}': v.detach() for k, v in weights.master.items()}
    tensors |= {f'ema.{i}': p for i, p in enumerate(weights.ema.shadow_params)}
    for index, state in optimizer.state_dict()['state'].items():
        tensors |= {f'adam.{index}.{k}': v for k, v in state.items()}
    # copies: a part of the file that is mapped by a reader must not change
    return {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}


@contextmanager
def _one_process_is_meant() -> Iterator[None]:
    """Silence torch's warning that it saves or loads in a single process."""
    with warnings.catch_warnings():
        warnings.filterwarnings('ignore', message='torch.distributed is disabled')
        yield


def _raise_stop(error: CheckpointException) -> None:
    """Raise what stopped a process, such as a second Ctrl-C: torch's error holds it, too."""
    for stop, _ in error.failures.values():
        if not isinstance(stop, Exception):
            raise stop from error


def _of_processes(error: CheckpointException) -> str:
    """Return what torch's error says of each process."""
    reasons = [f'process {n}: {failure[0]}' for n, failure in sorted(error.failures.items())]
    return '; '.join(reasons)


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


def load_state(
    folder: Path,
    weights: AveragedWeights,
    optimizer: torch.optim.Optimizer,
    processes: Processes,
) -> None:
    """Load the tensors of the saved state, whatever number of processes wrote them.

    Raises:
        TrainingError: the state is damaged, or of another model.
    """
    card, held = read_card(folder), folder / STATE
    assert card is not None
    tensors = _tensors_of(weights, optimizer)
    try:
        require_regular(*sorted(held.glob('*.safetensors')))
        reader = HuggingFaceStorageReader(str(held))
        with processes.losses_named(), _one_process_is_meant():
            checkpoint.load(tensors, storage_reader=reader)
        for name, tensor in tensors.items():
            check_finite(tensor.to_local() if isinstance(tensor, DTensor) else tensor, name, held)
    except (CheckpointException, OSError, SafetensorError, KeyError, RuntimeError) as error:
        if isinstance(error, CheckpointException):
            _raise_stop(error)
        said = _of_processes(error) if isinstance(error, CheckpointException) else error
        raise TrainingError(
            f"'{held}' is damaged or of another model: {said}; give the preset it was trained "
            'with, or another --out'
        ) from error
    with torch.no_grad():
        for name, master in weights.master.items():
            master.copy_(tensors[f'master.{name}'])
        weights.share()
        for index, (parameter, average) in enumerate(
            zip(weights.parameters, weights.ema.shadow_params, strict=True)
        ):
            average.copy_(tensors[f'ema.{index}'])
            for name, value in optimizer.state[parameter].items():
                value.copy_(tensors[f'adam.{index}.{name}'])
    weights.ema.optimization_step = card['ema_step']
