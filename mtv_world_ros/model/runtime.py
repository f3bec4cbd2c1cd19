"""Choices that depend on the machine: threads and number format."""

from __future__ import annotations

import ctypes
import os
from typing import TypeVar

import torch
from torch import nn

from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.model.transformer.attention import cpu_multiplies_bfloat16

Module = TypeVar('Module', bound=nn.Module)

#: number of glibc's setting of the free memory at the heap's end that is returned (`malloc.h`)
_M_TRIM_THRESHOLD = -1
#: number of glibc's setting of the blocks that are taken from the system one by one (`malloc.h`)
_M_MMAP_MAX = -4
#: environment variables of glibc's allocator
_ALLOCATOR_VARIABLES = ('MALLOC_MMAP_MAX_', 'MALLOC_TRIM_THRESHOLD_', 'GLIBC_TUNABLES')
_DTYPES = {'float32': torch.float32, 'bfloat16': torch.bfloat16}


def set_num_threads(num_threads: int) -> None:
    """Limit torch's threads; 0 = all usable cores but one for callbacks, or both of two."""
    usable = len(os.sched_getaffinity(0))
    torch.set_num_threads(num_threads or max(min(usable, 2), usable - 1))


def keep_freed_memory() -> bool:
    """Let this process keep freed memory for later tensors; return whether glibc does so now.

    By default glibc returns the memory of a large tensor to the system when it is freed, and the
    system clears the pages of the next one: a seventh of a training step on a CPU
    (`experiments/cpu_speed.py`). Call it when the model is loaded, so that memory that
    loading alone needs is returned. Nothing happens with another allocator, or where the user has
    set glibc's own variables (`MALLOC_MMAP_MAX_`, `MALLOC_TRIM_THRESHOLD_`, `GLIBC_TUNABLES`).
    """
    if any(name in os.environ for name in _ALLOCATOR_VARIABLES):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not glibc
        return False
    return bool(mallopt(_M_MMAP_MAX, 0) and mallopt(_M_TRIM_THRESHOLD, 2**31 - 1))


def check_device(name: str) -> None:
    """Check that this machine has a device.

    Raises:
        ConfigError: the machine has no such device, or torch does not know it.
    """
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigError(f"device '{name}' is not known; e.g. cpu, cuda or cuda:1") from None
    if device.type == 'cuda' and not torch.cuda.is_available():
        why = f'torch {torch.__version__} finds no GPU'
        if torch.version.cuda is None:
            why = f'torch {torch.__version__} is built without CUDA'
        raise ConfigError(f"device '{name}' cannot be used: {why}; use cpu")
    if device.type == 'cuda' and (device.index or 0) >= torch.cuda.device_count():
        count = torch.cuda.device_count()
        raise ConfigError(f"device '{name}': this machine has cuda:0 to cuda:{count - 1}")


def choose_dtype(name: str, device: str) -> torch.dtype:
    """Return the number format; `auto` is bfloat16 where the device multiplies it natively.

    Raises:
        ConfigError: an unknown name.
    """
    if name == 'auto':
        native = device != 'cpu' or cpu_multiplies_bfloat16()
        return torch.bfloat16 if native else torch.float32
    if name not in _DTYPES:
        raise ConfigError(f"dtype '{name}' is not one of auto, {', '.join(_DTYPES)}")
    return _DTYPES[name]


def place(module: Module, device: torch.device, dtype: torch.dtype) -> Module:
    """Return the module on a device, in a number format, images channels-last.

    What the module names in `_keep_in_fp32_modules` stays in float32.
    """
    precise = getattr(module, '_keep_in_fp32_modules', None) or ()
    kept = {
        name: tensor.data.to(device, torch.float32)
        for name, tensor in [*module.named_parameters(), *module.named_buffers()]
        if any(part in precise for part in name.split('.'))
    }
    nn.Module.to(module, device=device, dtype=dtype)
    for name, tensor in [*module.named_parameters(), *module.named_buffers()]:
        if name in kept:
            tensor.data = kept[name]
    for parameter in module.parameters():
        if parameter.ndim == 4:  # images; video convolutions have 5 axes and stay as they are
            parameter.data = parameter.data.to(memory_format=torch.channels_last)
    return module
