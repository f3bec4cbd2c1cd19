"""MuJoCo, imported so that a simulator in the same process can still draw.

It chooses how it draws when it is imported; foresight itself draws nothing.
"""

from __future__ import annotations

import ctypes
import os

#: what draws without a screen, the best first: value of MUJOCO_GL, its library
_BACKENDS = (('egl', 'libEGL.so.1'), ('osmesa', 'libOSMesa.so.8'))


def _backend() -> str:
    for name, library in _BACKENDS:
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return name
    return ''


_was_set = bool(os.environ.get('MUJOCO_GL'))
if not _was_set:
    os.environ['MUJOCO_GL'] = _backend() or 'disable'

import mujoco  # noqa: E402
from mujoco.rollout import Rollout  # noqa: E402

if not _was_set and os.environ['MUJOCO_GL'] == 'disable':
    del os.environ['MUJOCO_GL']  # the simulator says what is missing

__all__ = ['mujoco', 'Rollout']
