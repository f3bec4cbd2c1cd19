"""Files that are not code: where bundled ones lie, digests, writing them whole or not at all."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
import errno
import hashlib
import json
import math
import os
from pathlib import Path
import shutil
import sys
from typing import Any

from mtv_world_ros.errors import ConfigError, nearest

PACKAGE = 'mtv_world_ros'


def _candidates() -> list[Path]:
    source = Path(__file__).resolve().parent.parent
    roots = [source] if (source / 'package.xml').is_file() else []
    try:
        from ament_index_python.packages import get_package_share_directory

        roots.append(Path(get_package_share_directory(PACKAGE)))
    except (ImportError, LookupError, OSError):
        pass
    return [*roots, Path(sys.prefix) / 'share' / PACKAGE]


def share_path(*parts: str) -> Path:
    """Returns the path of a bundled file or folder.

    Looks in the source tree, then in the ament share folder, then in the pip prefix.

    Raises:
        ConfigError: none of them holds it.
    """
    roots = _candidates()
    for root in roots:
        path = root.joinpath(*parts)
        if path.exists():
            return path
    searched = ', '.join(str(root) for root in roots)
    wanted = '/'.join(parts)
    raise ConfigError(f"'{wanted}' is not among the installed files; looked in {searched}")


def bundled(kind: str, name: str | Path, setting: str) -> Path:
    """Returns the YAML file of `config/<kind>` with this name, or `name` if it is a YAML path.

    Raises:
        ConfigError: there is no such file; names the nearest known one and `setting`.
    """
    path = Path(name)
    if path.suffix in ('.yaml', '.yml'):
        return path
    folder = share_path('config', kind)
    known = sorted(file.stem for file in folder.glob('*.yaml'))
    if str(name) not in known:
        raise ConfigError(
            f"'{name}' is not in config/{kind}{nearest(str(name), known)}; set '{setting}' to a "
            f'YAML file or to one of {", ".join(known)}'
        )
    return folder / f'{name}.yaml'


def content_digest(folder: Path, without: Collection[str] = ()) -> str:
    """Returns the SHA-256 of a folder's files, or of one: other names or contents, another digest.

    Args:
        folder: searched recursively; or a file.
        without: names of files to leave out.
    """
    digest = hashlib.sha256()
    paths = [folder] if folder.is_file() else folder.rglob('*')
    files = (path for path in paths if path.is_file() and path.name not in without)
    for file in sorted(files):
        digest.update(file.relative_to(folder).as_posix().encode())
        with file.open('rb') as opened:
            while block := opened.read(2**24):
                digest.update(block)
    return digest.hexdigest()


def check_free(path: Path, overwrite: bool, instead: str = '--out') -> None:
    """Refuses to replace an existing file or folder unless the user asked for it.

    Args:
        path: file or folder that would be written; an empty folder counts as free.
        overwrite: the user asked for it.
        instead: option that names another place.

    Raises:
        ConfigError: the path exists.
    """
    is_free = not any(path.iterdir()) if path.is_dir() else not path.exists()
    if not (overwrite or is_free):
        raise ConfigError(f"'{path}' exists; give another {instead}, or --overwrite to replace it")


def check_room(folder: Path, num_bytes: int) -> None:
    """Checks the free space of a folder's disk before processes write to it; makes the folder.

    Raises:
        OSError: the disk has less.
    """
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if free < num_bytes:
        text = f'{os.strerror(errno.ENOSPC)}: {free} bytes are free, {num_bytes} are needed'
        raise OSError(errno.ENOSPC, text, str(folder))


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Writes a JSON file; NaN becomes null."""
    write_whole(path, json.dumps(plain(values), indent=1, allow_nan=False) + '\n')


def plain(value: Any) -> Any:
    """Returns what JSON can hold: NaN as None, tuples as lists, floats to 6 digits."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value


def write_whole(path: Path, content: bytes | str) -> None:
    """Writes a file beside its name and renames it, in a folder that is made where it is missing.

    Args:
        path: the file; what was there before stays until the new content is complete.
        content: text is written as UTF-8.

    Raises:
        OSError: the file cannot be written; the old one is untouched.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, f"'{path}' is a folder; name a file")
    data = content.encode() if isinstance(content, str) else content
    beside = path.with_name(f'.{path.name}.{os.getpid()}.part')  # others may write the same file
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        beside.write_bytes(data)
        beside.replace(path)
    except BaseException:  # a signal, too
        beside.unlink(missing_ok=True)
        raise


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """Yields an empty folder that gets the name `folder` when the block ends without an error.

    A folder of that name stays until then. A process that is killed between the two renames
    leaves it under the name `<folder>.old`; see `recover_folder`.

    Raises:
        OSError: the folder cannot be written; the old one is untouched.
    """
    partial, old = (folder.with_name(f'{folder.name}.{word}') for word in ('partial', 'old'))
    recover_folder(folder)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        for file in partial.rglob('*'):
            if file.is_file():
                with file.open('rb') as stream:
                    os.fsync(stream.fileno())  # the disk has its content before it gets its name
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)  # room for what is written next
        raise
    shutil.rmtree(old, ignore_errors=True)
    if folder.exists():
        folder.rename(old)
    partial.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def recover_folder(folder: Path) -> None:
    """Renames `<folder>.old` back if a process was killed while it replaced the folder."""
    old = folder.with_name(f'{folder.name}.old')
    if old.exists() and not folder.exists():
        old.rename(folder)
