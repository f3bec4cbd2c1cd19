"""Writes the files of a data set, whole or not at all."""

from __future__ import annotations

from pathlib import Path

from mtv_world_ros.errors import SimulatorError

#: what to do where something cannot be written
GO_ON = 'finished episodes are kept, so run the same command again once there is room'


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file beside its name and renames it.

    Raises:
        SimulatorError: it cannot be written; what was there before is still there.
    """
    beside = path.with_name(f'.{path.name}.part')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes(data)
        beside.replace(path)
    except OSError as error:
        raise SimulatorError(f"cannot write '{path}': {error}; {GO_ON}") from error
