"""Lock of an output path: one process at a time writes a file or folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import errno
import fcntl
import os
from pathlib import Path
import re
import shlex
import socket
import sys
import time

from mtv_world_ros.core.errors import ConfigError

#: name of a lock inside a folder whose parent folder cannot be written
LOCK_NAME = '.mtv-lock'
#: errors of a file system without locks, or one that cannot be written: its writers are not told
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL, errno.EROFS)
#: a link in place of a lock is not followed
_FLAGS = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
#: time that workers of a process that was killed get to let go of its lock [s]
_PATIENCE_S = 5.0
#: a lock of such a process is looked at this often [s]
_POLL_S = 0.05
#: longest text about the holder that is read back [bytes]
_MOST_BYTES = 1_000
#: characters of the holder's command line that are written
_MOST_CHARACTERS = 200
#: path of a lock -> its descriptor and how often this process holds it
_held: dict[Path, tuple[int, int]] = {}


@contextmanager
def only_writer(path: Path, option: str = '--out') -> Iterator[None]:
    """Hold the lock of an output path, which also ends with the process (SIGKILL).

    The lock is a file beside the path, `.NAME.mtv-lock`, or `.mtv-lock` inside a folder whose
    parent cannot be written. It is removed with the block, and so are folders above the path that
    were made for it and are still empty. A process may take a lock that it holds again. Forked
    workers do not keep it. On a file system without locks nothing is held.

    Args:
        path: file or folder that is written; a link stands for its target.
        option: option that names another place.

    Raises:
        ConfigError: another process writes it; names its process number, host and command.
    """
    target = Path(os.path.realpath(path))
    made = _make_parents(target)
    lock = _lock_path(target)
    _acquire(lock, path, option)
    try:
        yield
    finally:
        _release(lock)
        for folder in made:
            with suppress(OSError):  # something was written into it
                folder.rmdir()


@contextmanager
def turn_to_write(path: Path) -> Iterator[None]:
    """Wait until no other process has its turn to change a file, and hold the turn.

    On a file system without locks nothing is held.

    Args:
        path: the file; its lock, `.NAME.mtv-lock`, stays beside it.

    Raises:
        OSError: the lock cannot be made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(_lock_path(path), _FLAGS, 0o666)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        yield
    finally:
        os.close(descriptor)


def _make_parents(target: Path) -> list[Path]:
    """Make the folders above a path; return those that were missing, the deepest first."""
    missing = [folder for folder in target.parents if not folder.exists()]
    with suppress(OSError):  # whoever writes the path names the reason
        target.parent.mkdir(parents=True, exist_ok=True)
    return missing


def _lock_path(target: Path) -> Path:
    if target.is_dir() and not os.access(target.parent, os.W_OK):
        return target / LOCK_NAME
    return target.with_name(f'.{target.name}{LOCK_NAME}')


def _acquire(lock: Path, path: Path, option: str) -> None:
    if lock in _held:
        descriptor, count = _held[lock]
        _held[lock] = descriptor, count + 1
        return
    descriptor, end_s = -1, time.monotonic() + _PATIENCE_S
    while descriptor < 0:
        try:
            descriptor = os.open(lock, _FLAGS, 0o666)
        except OSError:  # it cannot be written; whoever writes the path names the reason
            return
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, _MOST_BYTES, 0).decode(errors='replace').strip()
            os.close(descriptor)
            descriptor = -1
            if _has_ended(holder) and time.monotonic() < end_s:
                time.sleep(_POLL_S)  # a worker that it forked has yet to let go
                continue
            raise ConfigError(
                f"'{path}' is being written by {holder or 'another process'}; wait until it has "
                f'ended, or give another {option}'
            ) from None
        except OSError as error:
            os.close(descriptor)
            if error.errno in _NO_LOCKS:
                return
            raise
        if not _is_file_of(lock, descriptor):  # its last holder has just removed it
            os.close(descriptor)
            descriptor = -1
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, _this_process().encode(errors='replace'), 0)
    _held[lock] = descriptor, 1


def _has_ended(holder: str) -> bool:
    """Return whether a holder was a process of this machine that is there no more."""
    found = re.match(r"process (\d+) on host '(.*?)' since", holder)
    if found is None or found[2] != socket.gethostname():
        return False
    return Path('/proc/self').exists() and not Path(f'/proc/{found[1]}').exists()


def _is_file_of(lock: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(lock), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _this_process() -> str:
    words = [Path(sys.argv[0]).name, *sys.argv[1:]] if sys.argv else []
    command = ascii(shlex.join(words))[1:-1][:_MOST_CHARACTERS]
    since = time.strftime('%Y-%m-%d %H:%M:%S')
    return f"process {os.getpid()} on host '{socket.gethostname()}' since {since} ({command})"


def _release(lock: Path) -> None:
    descriptor, count = _held.get(lock, (-1, 0))
    if count > 1:
        _held[lock] = descriptor, count - 1
    elif count == 1:
        del _held[lock]
        with suppress(OSError):
            lock.unlink()  # before it is released: nobody else holds it
        os.close(descriptor)


def _leave_to_parent() -> None:
    """Close the locks in a forked process: they end with the process that took them."""
    for descriptor, _ in _held.values():
        with suppress(OSError):
            os.close(descriptor)
    _held.clear()


os.register_at_fork(after_in_child=_leave_to_parent)
