"""Bounds on the sizes in configurations of networks, checked before anything is built.

A configuration of a few bytes may ask for a billion layers. Public models stay far below the
bounds: Wan 2.1 14B has 40 layers of 5120 channels, umT5-XXL a vocabulary of 256384.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
import re
from typing import Any

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.errors import CheckpointError

#: largest whole number of a configuration: of channels, words, positions
MAX_SIZE = 2_000_000
#: largest number of whatever is built one by one: layers, blocks, experts, stages
MAX_MODULES = 128
#: entries of a list, e.g. of the statistics of latent channels
MAX_ENTRIES = 8_192
#: names of what is built one by one
_MODULES = re.compile(r'layers?\b|_layers|blocks|depth|experts|stages|views|levels')
#: bounds of single fields: tables of positions and of noise levels are computed, and hold
#: rows times columns; patches and blocks of pixels count squared
_BOUNDS = {
    'attention_head_dim': 1_024,
    'rope_max_seq_len': 16_384,
    'num_train_timesteps': 100_000,
    'max_image_seq_len': 1_000_000,
    'frames_per_token': 64,
    'patch_size': 64,
    'block_size': 64,
    'dim_mult': 64,
    'num_attention_heads': 1_024,
}


def check_sizes(config: Mapping[str, Any], what: str) -> None:
    """Raise if a network of this configuration would be larger than any that is known.

    Args:
        config: config of the network; configurations in it are looked at as well.
        what: beginning of the error, e.g. the file.

    Raises:
        CheckpointError: a size is beyond its bound; names the field, the value and the bound.
    """
    for name, value in _sizes(config, ''):
        largest = _largest(name)
        if value > largest:
            raise CheckpointError(
                f'{what}: {name} is {value:g}; at most {largest} are built. Is the file damaged? '
                'Copy or export it again'
            )


def check_config_file(file: Path) -> None:
    """Check the sizes in a configuration file of another library; see `check_sizes`.

    Raises:
        CheckpointError: a size is beyond its bound, or the file cannot be read.
    """
    try:
        config = read_json(file)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"'{file}' cannot be loaded: {error}") from error
    check_sizes(config if isinstance(config, Mapping) else {}, f"'{file}'")


def _largest(name: str) -> int:
    field = name.rpartition('.')[2].partition('[')[0]
    if field.endswith('entries'):
        return MAX_ENTRIES
    return _BOUNDS.get(field, MAX_MODULES if _MODULES.search(field) else MAX_SIZE)


def _sizes(value: Any, name: str) -> Iterator[tuple[str, float]]:
    """Yield whole numbers and lengths of lists, with their dotted names."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _sizes(part, f'{name}.{key}' if name else str(key))
    elif isinstance(value, list | tuple):
        yield f'{name}.entries', len(value)
        for number, part in enumerate(value[: MAX_ENTRIES + 1]):
            yield from _sizes(part, f'{name}[{number}]')
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield name, value
