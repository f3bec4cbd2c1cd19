"""Files that are not code: where bundled ones lie, digests, writing them whole or not at all."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
import ctypes
import errno
import fcntl
import hashlib
import json
import math
import os
from pathlib import Path
import re
import shutil
import stat
import sys
import tempfile
from typing import Any

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.writer_lock import LOCK_NAME

PACKAGE = 'mtv_world_ros'
#: arguments of renameat2(2): paths as they are, and exchange both [linux/fcntl.h, linux/fs.h]
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
#: what the names of files in progress have besides the name [bytes]
_OWN_NAME_BYTES = 24
#: file of a robot in a folder of its own
ROBOT_YAML = 'robot.yaml'
#: file of a robot's folder: where its arms and cameras stand in the simulator
WORKCELL_YAML = 'workcell.yaml'


def _candidates() -> list[Path]:
    source = Path(__file__).resolve().parents[2]
    roots = [source] if (source / 'package.xml').is_file() else []
    try:
        from ament_index_python.packages import get_package_share_directory

        roots.append(Path(get_package_share_directory(PACKAGE)))
    except (ImportError, LookupError, OSError):
        pass
    return [*roots, Path(sys.prefix) / 'share' / PACKAGE]


def share_path(*parts: str) -> Path:
    """Return the path of a bundled file or folder.

    Looks in the source tree, then in the ament share folder, then in the pip prefix.

    Raises:
        ConfigError: there is no such file in these folders.
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
    """Return the YAML file of `config/<kind>` with this name, or `name` if it is a YAML path.

    A robot is a folder that holds `robot.yaml`: by name in `config/robots`, or any path.

    Raises:
        ConfigError: there is no such file; names the nearest known one and `setting`.
    """
    path = Path(name)
    if path.suffix in ('.yaml', '.yml'):
        return path
    if kind == 'robots' and is_file(path / ROBOT_YAML):
        return path / ROBOT_YAML
    files = _bundled_files(kind)
    if str(name) not in files:
        raise ConfigError.unknown(
            '',
            str(name),
            files,
            is_not=f' is not in config/{kind}',
            listed=f"; set '{setting}' to a YAML file or to one of",
        )
    return files[str(name)]


def is_file(path: Path) -> bool:
    """Return whether a path is a file; False for names that no file system takes."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or a NUL
        return False


def bundled_names(kind: str, holding: str = '') -> list[str]:
    """Return the sorted names of the files in `config/<kind>`; of robots, their folders.

    Args:
        kind: folder of `config`.
        holding: name of a file that lies in the folder, for robots; empty = all.

    Raises:
        ConfigError: there is no such folder among the installed files.
    """
    files = _bundled_files(kind).items()
    return [name for name, file in files if not holding or (file.parent / holding).is_file()]


def _bundled_files(kind: str) -> dict[str, Path]:
    folder = share_path('config', kind)
    files = {file.stem: file for file in folder.glob('*.yaml')}
    files |= {file.parent.name: file for file in folder.glob(f'*/{ROBOT_YAML}')}
    return dict(sorted(files.items()))


def content_digest(folder: Path, without: Collection[str] = ()) -> str:
    """Return the SHA-256 of a folder's files, or of one: other names or contents, another digest.

    Args:
        folder: searched recursively; or a file.
        without: names of files to leave out.
    """
    digest, left_out = hashlib.sha256(), {LOCK_NAME, *without}
    paths = [folder] if folder.is_file() else folder.rglob('*')
    files = (path for path in paths if path.is_file() and path.name not in left_out)
    for file in sorted(files):
        digest.update(file.relative_to(folder).as_posix().encode())
        with file.open('rb') as opened:
            while block := opened.read(2**24):
                digest.update(block)
    return digest.hexdigest()


def check_free(path: Path, overwrite: bool | None, instead: str = '--out') -> None:
    """Refuse to replace an existing file or folder unless the user asked for it.

    Args:
        path: file or folder that would be written; an empty folder counts as free.
        overwrite: the user asked for it; None = the command cannot replace it.
        instead: option that names another place.

    Raises:
        ConfigError: the path exists.
    """
    if not (overwrite or is_free(path)):
        how = 'remove it' if overwrite is None else '--overwrite to replace it'
        raise ConfigError(f"'{path}' exists; give another {instead}, or {how}")
    check_output(path, instead)


def is_free(path: Path) -> bool:
    """Return True if nothing is there but, at most, an empty folder."""
    if not path.is_dir():
        return not path.exists()
    return all(entry.name == LOCK_NAME for entry in path.iterdir())


def check_output(path: Path, option: str = '--out') -> None:
    """Check that a file or folder can be written, before any work; it leaves nothing behind.

    Args:
        path: path that would be made, or replaced; folders above it may be missing.
        option: option that names another place.

    Raises:
        ConfigError: it cannot be written; names the path, the reason and the option.
    """
    check_name(os.path.realpath(path))
    try:
        with tempfile.TemporaryFile(dir=_written_folder(path)):
            return
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = (isinstance(error, OSError) and error.strerror) or str(error)
        raise ConfigError(
            f"'{path}' cannot be written: {reason}; give another {option}"
        ) from error


def _written_folder(path: Path) -> Path:
    """Return the folder in which a path, or the first missing folder above it, would be made.

    Raises:
        OSError, ValueError: nothing can be made there; the text is the reason.
    """
    if path.is_symlink():
        _check_link(path)
    if path.exists() and not (path.is_dir() or path.is_file()):
        raise ValueError('it is a device, a pipe or a socket')
    folder = path if path.is_dir() else path.absolute().parent
    while not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    if folder.is_symlink():
        _check_link(folder)
    if not folder.is_dir():
        raise ValueError(f"'{folder}' is a file, so that nothing can be made in it")
    longest = os.pathconf(folder, 'PC_NAME_MAX') - _OWN_NAME_BYTES
    for name in path.absolute().parts[len(folder.absolute().parts) :]:
        if len(os.fsencode(name)) > longest:
            raise ValueError(f'a name in it has more than {longest} bytes')
    return folder


def _check_link(link: Path) -> None:
    try:
        os.stat(link)
    except FileNotFoundError as error:
        raise ValueError(
            f"'{link}' is a link to '{os.readlink(link)}', which is missing"
        ) from error
    except OSError as error:
        raise ValueError(f"'{link}' is a link that leads to itself") from error


def check_room(folder: Path, num_bytes: int) -> None:
    """Check the free space of a folder's disk before processes write to it; make the folder.

    Raises:
        OSError: the disk has less.
    """
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if free < num_bytes:
        text = f'{os.strerror(errno.ENOSPC)}: {free} bytes are free, {num_bytes} are needed'
        raise OSError(errno.ENOSPC, text, str(folder))


def copy_folder(source: Path, target: Path) -> None:
    """Copy a folder's regular files; a link in it is replaced by the file that it points to.

    Raises:
        OSError: a file cannot be read, or is a device or a pipe, which may have no end, or a link
            leads to a folder outside.
    """
    inside = os.path.realpath(source)
    for place, folders, _ in os.walk(source):
        for link in (Path(place) / name for name in folders):
            outside = os.path.commonpath([os.path.realpath(link), inside]) != inside
            if link.is_symlink() and outside:
                text = f"it is a link to the folder '{os.path.realpath(link)}', which is outside"
                raise OSError(errno.EXDEV, f'{text}; copy the folder itself', str(link))
    shutil.copytree(source, target, copy_function=_copy_regular)


def _copy_regular(source: str, target: str) -> None:
    descriptor = os.open(source, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with open(descriptor, 'rb') as read:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, 'it is no regular file', source)
        with open(target, 'wb') as written:
            shutil.copyfileobj(read, written, 2**24)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON file; NaN becomes null."""
    write_whole(path, json.dumps(plain(values), indent=1, allow_nan=False) + '\n')


def plain(value: Any) -> Any:
    """Return plain values for JSON: NaN as None, tuples as lists, floats to 6 digits."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file under a temporary name and rename it; its folder is made if missing.

    Args:
        path: the file; what was there before stays until the new content is complete.
        content: text is written as UTF-8.

    Raises:
        OSError: the file cannot be written; the old one is untouched.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, f"'{path}' is a folder; name a file")
    data = encoded(content) if isinstance(content, str) else content
    beside = _own_name(path, _NEW)  # others may write the same file
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        beside.write_bytes(data)
        beside.replace(path)
    except BaseException:  # a signal, too
        beside.unlink(missing_ok=True)
        raise


def encoded(text: str) -> bytes:
    """Return a text as UTF-8; bytes of file names that are no UTF-8 become escapes."""
    data = text.encode(errors='surrogateescape')
    try:
        data.decode()
    except UnicodeDecodeError:
        return text.encode(errors='backslashreplace')
    return data


def check_name(text: str) -> None:
    """Check that a path, or another word of a command line, is UTF-8, as libraries want it.

    Raises:
        ConfigError: it is not, or the locale of this process cannot hold it.
    """
    if text.isascii():
        return
    try:
        os.fsencode(text).decode()
    except (UnicodeError, ValueError):
        raise ConfigError(
            f'{ascii(text)} holds bytes that are no UTF-8; give the file or folder another name'
        ) from None
    if any('\udc80' <= char <= '\udcff' for char in text):
        raise ConfigError(
            f'{ascii(os.fsencode(text).decode())} cannot be used in a locale of ASCII names; set '
            'LC_ALL=C.UTF-8, or PYTHONUTF8=1'
        )


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder that gets the name `folder` when the block ends without an error.

    A folder of that name stays until then. Hidden names in the same parent folder hold what is
    written, `.<folder>.mtv-new-<process>`, and what is replaced, `.<folder>.mtv-old-<process>`;
    nothing else is touched. The next call removes what a killed process left under those names;
    see `recover_folder`.

    Raises:
        OSError: the folder cannot be written; the old one is untouched.
    """
    folder = Path(os.path.realpath(folder))  # a link stays a link
    recover_folder(folder)
    new, old, waste = (_own_name(folder, word) for word in _WORDS)
    new.mkdir(parents=True)
    with _locked(new):
        try:
            yield new
            for file in new.rglob('*'):
                if file.is_file():
                    with file.open('rb') as stream:
                        os.fsync(stream.fileno())  # the disk has its content before its name
            if folder.exists():
                with _locked(folder):
                    folder.rename(old)
                    new.rename(folder)
                    old.rename(waste)
            else:
                new.rename(folder)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)  # room for what is written next
            if old.exists() and not folder.exists():
                old.rename(folder)
            raise
    shutil.rmtree(waste, ignore_errors=True)


def replace_folder(new: Path, folder: Path) -> None:
    """Give a complete folder the name of another one, which is removed.

    At every moment one of the two has the name, if the file system can exchange names (those of
    Linux can; some on the network cannot).

    Args:
        new: complete folder on the same file system.
        folder: folder that is replaced; a link stays a link.

    Raises:
        OSError: the folder cannot be replaced; the old one has the name.
    """
    folder = Path(os.path.realpath(folder))
    if _exchange_names(new, folder):
        shutil.rmtree(new, ignore_errors=True)
        return
    old = new.with_suffix('.old')
    folder.rename(old)
    try:
        new.rename(folder)
    except OSError:
        old.rename(folder)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _exchange_names(one: Path, other: Path) -> bool:
    """Exchange the names of two paths in one step; return whether the system can."""
    exchange = getattr(ctypes.CDLL(None, use_errno=True), 'renameat2', None)
    if exchange is None:
        return False
    names = os.fsencode(one), os.fsencode(other)
    return exchange(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0


def recover_folder(folder: Path) -> None:
    """Restore or remove the leftovers of a process that was killed while it wrote a folder.

    A folder that was replaced, while the new one did not get its name, is renamed back. What
    living processes write is left alone. Earlier versions left `<folder>.old` and, complete,
    `<folder>.partial`: where both hold files of the same names and `folder` is missing, the first
    is renamed back. Otherwise either may be somebody else's.
    """
    folder = Path(os.path.realpath(folder))
    abandoned = [path for path in _own_folders(folder) if _is_abandoned(path)]
    old = [path for path in abandoned if f'.{_OLD}-' in path.name]
    if old and not folder.exists():
        newest = max(old, key=lambda path: path.stat().st_mtime_ns)
        newest.rename(folder)
        abandoned.remove(newest)
    for path in abandoned:
        shutil.rmtree(path, ignore_errors=True)
    earlier, partial = (folder.with_name(f'{folder.name}.{word}') for word in ('old', 'partial'))
    if not folder.exists() and _names_in(earlier) == _names_in(partial) != set():
        earlier.rename(folder)
        shutil.rmtree(partial, ignore_errors=True)


#: words in the hidden names of a folder: being written, replaced, to be removed
_WORDS = _NEW, _OLD, _WASTE = 'mtv-new', 'mtv-old', 'mtv-waste'


def _own_name(path: Path, word: str) -> Path:
    """Return the hidden name that this process gives a file or folder, in the same parent."""
    return path.with_name(f'.{path.name}.{word}-{os.getpid()}')


def _own_folders(folder: Path) -> list[Path]:
    """Return the hidden folders that `whole_folder` made for a folder."""
    name = re.compile(rf'\.{re.escape(folder.name)}\.({"|".join(_WORDS)})-\d+')
    try:
        beside = sorted(folder.parent.iterdir())
    except FileNotFoundError:
        return []
    return [path for path in beside if name.fullmatch(path.name) and path.is_dir()]


def _names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a folder's lock, which ends with the process; a file system may have no locks."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _is_abandoned(folder: Path) -> bool:
    """Return True if no process of this machine writes the folder any more."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # no locks there: the number says who made it
        return not _is_running(int(folder.name.rpartition('-')[2]))
    finally:
        os.close(descriptor)
    return True


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's process
        return True
    return pid != os.getpid()
