"""Files that are there whole or not at all, whatever ends the process that writes them."""

from __future__ import annotations

import os
from pathlib import Path


def write_whole(path: Path, content: bytes | str) -> None:
    """Writes a file beside its name and renames it, in a folder that is made where it is missing.

    Args:
        path: the file; what was there before stays until the new content is complete.
        content: text is written as UTF-8.

    Raises:
        OSError: it cannot be written; what was there before is still there.
    """
    data = content.encode() if isinstance(content, str) else content
    beside = path.with_name(f'.{path.name}.{os.getpid()}.part')  # others may write the same file
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        beside.write_bytes(data)
        beside.replace(path)
    except OSError:
        beside.unlink(missing_ok=True)
        raise
