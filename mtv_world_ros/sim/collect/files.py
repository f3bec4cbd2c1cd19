"""Writes the files of a data set."""

from __future__ import annotations

from pathlib import Path

from mtv_world_ros.errors import SimulatorError
from mtv_world_ros.files import write_whole

#: what to do where something cannot be written
GO_ON = 'finished episodes are kept, so run the same command again once there is room'


def write_file(path: Path, data: bytes) -> None:
    """Writes a file, whole or not at all.

    Raises:
        SimulatorError: it cannot be written; what was there before is still there.
    """
    try:
        write_whole(path, data)
    except OSError as error:
        raise SimulatorError(f"cannot write '{path}': {error}; {GO_ON}") from error
