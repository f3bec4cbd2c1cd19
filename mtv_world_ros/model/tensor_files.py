"""Tensors on disk: safetensors files seen as one table, read one tensor at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from os.path import isfile
from pathlib import Path
import re
from typing import Any

from safetensors import safe_open, SafetensorError
from torch import Tensor

from mtv_world_ros.core.bounded_input import check_finite, placeholder, read_json, require_regular
from mtv_world_ros.core.errors import CheckpointError, MissingPackageError

PICKLES = ('.bin', '.pt', '.pth', '.ckpt', '.pkl')
INDEX = '.safetensors.index.json'
_SHARD = re.compile(r'-(\d+)-of-(\d+)\.safetensors$')
_BYTES = {'F64': 8, 'F32': 4, 'F16': 2, 'BF16': 2, 'I64': 8, 'I32': 4, 'F8_E4M3': 1}


@dataclass(frozen=True, slots=True)
class StoredTensor:
    """A tensor that has not been read.

    Attributes:
        shape: shape of the tensor.
        dtype: number format in safetensors' words, e.g. `BF16`.
        read: function that reads the tensor.
    """

    shape: tuple[int, ...]
    dtype: str
    read: Callable[[], Tensor]

    @property
    def num_bytes(self) -> int:
        """Its size on disk."""
        return prod(self.shape) * _BYTES.get(self.dtype, 8)


def open_tensors(path: Path, stem: str = '') -> dict[str, StoredTensor]:
    """Return the tensors of a safetensors file, or of a folder's files or shards, by name.

    Args:
        path: a `.safetensors` file, an index, or a folder.
        stem: beginning of the names of the folder's files.

    Raises:
        CheckpointError: nothing there, a pickle, a shard is missing or damaged.
    """
    if path.is_dir():
        return _open_folder(path, stem)
    if path.suffix in PICKLES:
        raise pickle_error([path])
    if not path.is_file():
        raise CheckpointError(f"'{path}' does not exist; name a .safetensors file or a folder")
    if path.name.endswith(INDEX):
        return _open_index(path)
    if path.suffix != '.safetensors':
        raise CheckpointError(f"'{path}' is no .safetensors file; only those are read")
    return _open_files([path])


def pickle_error(files: Iterable[Path]) -> CheckpointError:
    """Return the error for pickles, which names the formats to use in their place."""
    names = sorted(str(file) for file in files)
    return CheckpointError(
        f'{names} may be pickles, which can run code and are never read; expected '
        '.safetensors: take a public conversion (DiffSynth-Studio/Wan-Series-Converted-Safetensors'
        ', Comfy-Org/Wan_2.1_ComfyUI_repackaged, a diffusers folder of Wan-AI)'
    )


def _open_folder(folder: Path, stem: str) -> dict[str, StoredTensor]:
    indices = sorted(folder.glob(f'{stem}*{INDEX}'))
    if indices:
        return _open_index(indices[0])
    files = sorted(folder.glob(f'{stem}*.safetensors'))
    if not files:
        pickles = [f for f in folder.glob(f'{stem}*') if f.suffix in PICKLES]
        if pickles:
            raise pickle_error(pickles)
        raise CheckpointError(f"'{folder}' holds no {stem}*.safetensors")
    _check_shards(files)
    return _open_files(files)


def _check_shards(files: list[Path]) -> None:
    """Check that shards without an index are complete, by the number in their names."""
    numbers = [match for file in files if (match := _SHARD.search(file.name))]
    if not numbers:
        return
    have = {int(match[1]) for match in numbers}
    missing = sorted(set(range(1, int(numbers[0][2]) + 1)) - have)
    if missing:
        raise CheckpointError(
            f"'{files[0].parent}' lacks shards {missing} of {numbers[0][2]}; has "
            f'{sorted(file.name for file in files)}: copy the missing ones there'
        )


def _open_index(path: Path) -> dict[str, StoredTensor]:
    try:
        places: dict[str, str] = read_json(path)['weight_map']
        files = sorted({path.parent / Path(name).name for name in places.values()})
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise CheckpointError(f"'{path}' is no index of shards: {error}") from error
    missing = sorted(file.name for file in files if not isfile(file))
    if missing:
        raise CheckpointError(
            f"'{path.parent}' lacks the shards {missing} that '{path.name}' names; copy them there"
        )
    tensors = _open_files(files)
    absent = sorted(set(places) - set(tensors))
    if absent:
        raise CheckpointError(
            f"the shards of '{path}' lack {len(absent)} tensors that it names, the first "
            f"'{absent[0]}'; copy the shards again"
        )
    return tensors


def _open_files(files: list[Path]) -> dict[str, StoredTensor]:
    tensors: dict[str, StoredTensor] = {}
    for file in files:
        with _opened(file) as handle:
            for name in list(handle.keys()):
                if name in tensors:
                    raise CheckpointError(f"tensor '{name}' is in '{file}' and in another shard")
                tensors[name] = _stored(file, handle.get_slice(name), name)
    return tensors


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    try:
        require_regular(file)
        with safe_open(file, framework='pt') as handle:
            yield handle
    except (OSError, SafetensorError) as error:
        reason = placeholder(file) or f'cannot be loaded: {error}'
        raise CheckpointError(f"'{file}' {reason}") from error


def _stored(file: Path, part: Any, name: str) -> StoredTensor:
    def read() -> Tensor:
        # opened for each: a file that stays open keeps all that was read of it in memory
        with _opened(file) as handle:
            tensor: Tensor = handle.get_tensor(name)
        check_finite(tensor, name, file)
        return tensor

    return StoredTensor(tuple(part.get_shape()), part.get_dtype(), read)


def read_tensors(path: Path, stem: str = '') -> dict[str, Tensor]:
    """Read all tensors that `open_tensors` finds, by name.

    Raises:
        CheckpointError: the file cannot be opened, or a tensor holds values that are not finite.
    """
    return {name: stored.read() for name, stored in open_tensors(path, stem).items()}


@contextmanager
def disk_errors() -> Iterator[None]:
    """Turn the error of safetensors on a full disk into OSError."""
    try:
        yield
    except SafetensorError as error:
        raise OSError(f'tensors cannot be written: {error}') from error


def import_transformers() -> Any:
    """Return the package.

    Raises:
        MissingPackageError: the package is not installed.
    """
    try:
        import transformers
    except ImportError as error:
        raise MissingPackageError('a text or image encoder', 'transformers') from error
    return transformers
