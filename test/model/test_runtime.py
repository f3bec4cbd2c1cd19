"""Choices that depend on the machine: how freed memory is held, and norms of bfloat16 images."""

import os
import platform
import subprocess
import sys

import pytest
import torch
from torch import nn

from mtv_world_ros.model.transformer.stem import _normed

_FAULTS = """
import resource, torch
from mtv_world_ros.model.runtime import keep_freed_memory
print(keep_freed_memory())
for _ in range(8):  # the heap grows to its size
    torch.ones(2**24)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(8):
    torch.ones(2**24)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def _run(**variables: str) -> tuple[bool, int]:
    """Return whether memory is kept, and the page faults of eight tensors of 64 MiB."""
    unset = {k: v for k, v in os.environ.items() if not k.startswith(('MALLOC_', 'GLIBC_'))}
    words = [sys.executable, '-c', _FAULTS]
    done = subprocess.run(
        words, env={**unset, **variables}, capture_output=True, text=True, check=True
    )
    kept, faults = done.stdout.split()
    return kept == 'True', int(faults)


@pytest.mark.skipif(platform.libc_ver()[0] != 'glibc', reason='another C library than glibc')
def test_freed_memory_is_used_again_unless_the_user_has_set_the_allocator() -> None:
    kept, faults = _run()
    theirs, more = _run(MALLOC_MMAP_MAX_='65536')

    assert kept and not theirs
    # pages are 4 KiB, or 2 MiB where the system has large ones
    assert faults < more / 4 and more >= 8 * 32


def test_norms_of_bfloat16_images_differ_by_rounding_alone() -> None:
    torch.manual_seed(0)
    norm = nn.GroupNorm(8, 16).to(torch.bfloat16)
    x = torch.randn(4, 16, 6, 8).to(torch.bfloat16).contiguous(memory_format=torch.channels_last)
    plain, own = x.clone().requires_grad_(), x.clone().requires_grad_()

    expected, found = norm(plain), _normed(norm, own)
    expected.square().sum().backward()
    wanted = norm.weight.grad.clone()
    norm.weight.grad = None
    found.square().sum().backward()

    assert found.dtype == torch.bfloat16
    assert found.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(found, expected, atol=0.02, rtol=0.01)
    torch.testing.assert_close(own.grad, plain.grad, atol=0.1, rtol=0.05)
    torch.testing.assert_close(norm.weight.grad, wanted, atol=1.0, rtol=0.02)
