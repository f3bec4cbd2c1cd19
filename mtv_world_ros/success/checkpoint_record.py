"""Dataclasses that `mtv-world calibrate` keeps as JSON files in a checkpoint folder."""

from __future__ import annotations

from dataclasses import asdict, fields
import json
from pathlib import Path
from typing import Any, TypeVar

from mtv_world_ros.errors import CheckpointError, nearest
from mtv_world_ros.files import write_whole

Record = TypeVar('Record')


def save_record(path: Path, record: Any, what: str) -> Path:
    """Writes a dataclass into a checkpoint.

    Args:
        path: the file.
        record: the dataclass.
        what: what it is, for the error's text.

    Raises:
        CheckpointError: the folder cannot be written to.
    """
    try:
        write_whole(path, json.dumps(asdict(record), indent=1) + '\n')
    except OSError as error:
        raise CheckpointError(
            f"the {what} cannot be stored in the checkpoint '{path.parent}' ({error}); copy the "
            'checkpoint to a folder of your own and calibrate that one'
        ) from error
    return path


def load_record(path: Path, kind: type[Record]) -> Record | None:
    """Returns a dataclass of a checkpoint, its lists as tuples; None = there is no such file.

    Args:
        path: the file.
        kind: the dataclass; it raises ValueError where its values do not fit each other.

    Raises:
        CheckpointError: the file is not what `mtv-world calibrate` writes.
    """
    if not path.is_file():
        return None
    try:
        values = json.loads(path.read_text(encoding='utf-8'))
        _check_keys(values, kind)
        return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
    except (OSError, ValueError, TypeError) as error:
        raise CheckpointError(
            f"'{path}' cannot be used: {error}; run 'mtv-world calibrate {path.parent} DATASET "
            "--out DIR' again, or delete the file"
        ) from error


def _check_keys(values: Any, kind: Any) -> None:
    known = [item.name for item in fields(kind)]
    if not isinstance(values, dict):
        raise ValueError('expected keys and values')
    for key in values:
        if key not in known:
            raise ValueError(f"unknown key '{key}'{nearest(key, known)}")
