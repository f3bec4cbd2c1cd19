"""A ROS domain that no other test process of this machine uses."""

from __future__ import annotations

import fcntl
from functools import cache
import os
from pathlib import Path
import tempfile

#: highest domain whose ports Linux gives to no other program by itself
LAST_DOMAIN = 101
#: holds the lock until this process ends
_held: list[int] = []


@cache
def claim_domain() -> int:
    """Return this process' own domain, which was free and stays its own until the end."""
    folder = Path(tempfile.gettempdir()) / f'mtv_world_domains_{os.getuid()}'
    folder.mkdir(exist_ok=True)
    first = os.getpid()  # a process that knows no locks may be at the low numbers
    for number in range(LAST_DOMAIN):
        domain = 1 + (first + number) % LAST_DOMAIN
        file = os.open(folder / str(domain), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            continue
        _held.append(file)
        return domain
    raise RuntimeError(f'all {LAST_DOMAIN} ROS domains are in use by tests')
