"""Imports MuJoCo with an available OpenGL library, or names the missing package."""

from __future__ import annotations

import ctypes
import os
from types import ModuleType

from mtv_world_ros.core.errors import SimulatorError

#: MUJOCO_GL value -> (alternative shared libraries, Debian packages)
BACKENDS = {
    'egl': (('libEGL.so.1', 'libEGL.so'), 'libegl1 libgl1-mesa-dri'),
    'osmesa': (('libOSMesa.so.8', 'libOSMesa.so.6', 'libOSMesa.so'), 'libosmesa6'),
}
INSTALL_HINT = 'install one of the two: `apt-get install libegl1` or `apt-get install libosmesa6`'


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def missing_opengl() -> str | None:
    """Return why nothing can be rendered on this machine, or None if an OpenGL library is there.

    Reads `MUJOCO_GL`; where it is not set, EGL is taken before OSMesa.
    """
    wanted = os.environ.get('MUJOCO_GL', '').lower()
    if wanted and wanted not in BACKENDS:
        return f"MUJOCO_GL is '{wanted}', which renders without a screen only as 'egl' or 'osmesa'"
    for backend in [wanted] if wanted else BACKENDS:
        if any(_loads(name) for name in BACKENDS[backend][0]):
            return None
    if wanted:
        return f"MUJOCO_GL is '{wanted}' but its library is missing: {BACKENDS[wanted][1]}"
    return f'no OpenGL library for rendering without a screen; {INSTALL_HINT}'


def load_mujoco(*, rendering: bool = True) -> ModuleType:
    """Return the `mujoco` module, with `MUJOCO_GL` set to a backend whose library exists.

    Args:
        rendering: whether images will be rendered; physics alone needs no OpenGL.

    Raises:
        SimulatorError: no usable OpenGL library; the text names the package to install.
    """
    reason = missing_opengl()
    if reason and rendering:
        raise SimulatorError(f'the simulator cannot render: {reason}')
    if reason:
        os.environ['MUJOCO_GL'] = 'disable'
    elif not os.environ.get('MUJOCO_GL'):
        usable = (b for b, (names, _) in BACKENDS.items() if any(map(_loads, names)))
        os.environ['MUJOCO_GL'] = next(usable)
    try:
        import mujoco
    except (ImportError, AttributeError, RuntimeError) as error:
        raise SimulatorError(
            f"MuJoCo does not start with MUJOCO_GL='{os.environ['MUJOCO_GL']}': {error}; "
            f'{INSTALL_HINT}'
        ) from error
    return mujoco
