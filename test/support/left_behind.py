"""What a test may leave behind in its process, so that another one fails only after it."""

from __future__ import annotations

from collections.abc import Mapping
import logging
import os
from pathlib import Path
import signal
import sys
import threading
import time
from typing import Any

#: what stops a process, ends its children or wakes it
_SIGNALS = ('SIGINT', 'SIGTERM', 'SIGALRM', 'SIGCHLD', 'SIGHUP', 'SIGUSR1', 'SIGUSR2')
#: libraries and `test/support/ros_nodes.py` set these when they are imported, always to the same
_SET_BY_IMPORTS = (
    'ROS_DOMAIN_ID',
    'ROS_AUTOMATIC_DISCOVERY_RANGE',
    'FASTRTPS_DEFAULT_PROFILES_FILE',
    'MUJOCO_GL',
    'PYOPENGL_PLATFORM',
    'TORCHINDUCTOR_CACHE_DIR',
)
#: who is about to end is waited for [s]
_PATIENCE_S = 10.0
_TORCH = "torch's threads"
_THREADS, _CHILDREN = 'threads that keep the process alive', 'child processes'


def state() -> dict[str, Any]:
    """What tests of a process share."""
    root = logging.getLogger()
    return {
        'working folder': _working_folder(),
        'environment': _environment(),
        'signal handlers': {name: signal.getsignal(getattr(signal, name)) for name in _SIGNALS},
        'alarm': signal.getitimer(signal.ITIMER_REAL)[0] > 0,
        'log handlers': [one for one in root.handlers if not _is_of_pytest(one)],
        'log level': root.level,
        _THREADS: _threads(),
        _CHILDREN: _children(),
        "ROS's default context": 'rclpy' in sys.modules and sys.modules['rclpy'].ok(),
        **_torch(),
    }


def restore(before: Mapping[str, Any]) -> None:
    """Give torch the threads back that it had: commands that run in this process set them."""
    if _TORCH in before:
        sys.modules['torch'].set_num_threads(before[_TORCH])


def left(before: Mapping[str, Any]) -> list[str]:
    """Say what differs from an earlier state; what is about to end is waited for."""
    end_s = time.monotonic() + _PATIENCE_S
    while (found := _differences(before, state())) and time.monotonic() < end_s:
        if not any(text.startswith((_THREADS, _CHILDREN)) for text in found):
            break
        time.sleep(0.05)
    return found


def _differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    return [
        f'{name}: {_change(before[name], value)}'
        for name, value in after.items()
        if name in before and not _is_same(before[name], value)
    ]


def _is_same(before: Any, after: Any) -> bool:
    """Fewer threads and processes than before are no trace."""
    return after <= before if isinstance(after, set) else after == before


def _change(before: Any, after: Any) -> str:
    if isinstance(after, set):
        return ', '.join(map(str, after - before))
    if not isinstance(after, dict):
        return f'{before} before, {after} now'
    keys = [key for key in {**before, **after} if before.get(key) != after.get(key)]
    return ', '.join(f'{key} {before.get(key)!r}, now {after.get(key)!r}' for key in keys)


def _working_folder() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError:
        return 'a folder that is gone'


def _environment() -> dict[str, str]:
    left_out = ('PYTEST_CURRENT_TEST', *_SET_BY_IMPORTS)
    return {name: value for name, value in os.environ.items() if name not in left_out}


def _is_of_pytest(handler: logging.Handler) -> bool:
    return type(handler).__module__.startswith('_pytest')


def _threads() -> set[str]:
    return {thread.name for thread in threading.enumerate() if not thread.daemon}


def _children() -> set[str]:
    """Number and command of the processes that this one started, resource trackers aside."""
    found = set()
    for file in Path('/proc/self/task').glob('*/children'):
        for pid in file.read_text().split():
            try:
                words = Path(f'/proc/{pid}/cmdline').read_bytes().split(b'\0')
            except OSError:  # it ended
                continue
            command = b' '.join(words[:6]).decode(errors='replace')
            if 'resource_tracker' not in command and 'forkserver' not in command:
                found.add(f'{pid} ({command or "ended, not waited for"})')
    return found


def _torch() -> dict[str, Any]:
    torch = sys.modules.get('torch')
    if torch is None or not hasattr(torch, 'get_num_threads'):
        return {}
    return {
        _TORCH: torch.get_num_threads(),
        "torch's type": torch.get_default_dtype(),
        "torch's gradients": torch.is_grad_enabled(),
    }
