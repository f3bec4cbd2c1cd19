"""The Inception-v3 network that FID is defined by, in the layout of its converted weights.

It takes TensorFlow's weights of 2015-12-05 as `pt_inception-2015-12-05-*.pth` (pytorch-fid) and
`weights-inception-2015-12-05-*.pth` (torch-fidelity) hold them: keys as in torchvision's Inception
v3, 1,008 classes, no auxiliary classifier. As in TensorFlow's graph, and unlike torchvision's,
average pools leave the padding out, the last block pools by the maximum, and images are resized as
TensorFlow 1 does. torch-fidelity has the same network, but loads its weights by unpickling.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import nn, Tensor
import torch.nn.functional as F

#: side of the images that the network sees [px]
SIZE = 299
NUM_FEATURES = 2048


class _Step(NamedTuple):
    """A convolution of a branch: name, channels, kernel, stride, whether it keeps the size."""

    name: str
    channels: int
    kernel: tuple[int, int] = (1, 1)
    stride: int = 1
    same: bool = True


#: kernel sizes (height, width) of the convolutions
_KERNEL_3X3 = (3, 3)
_KERNEL_5X5 = (5, 5)
_KERNEL_1X7 = (1, 7)
_KERNEL_7X1 = (7, 1)
#: one list of steps per branch; a tuple within a list is a fork whose ends are put side by side
_Branch = list[_Step | tuple[_Step, _Step]]


def _pooled(channels: int) -> _Branch:
    return [_Step('branch_pool', channels)]


def _block_35(pool_channels: int) -> tuple[_Branch, ...]:
    return (
        [_Step('branch1x1', 64)],
        [_Step('branch5x5_1', 48), _Step('branch5x5_2', 64, _KERNEL_5X5)],
        [
            _Step('branch3x3dbl_1', 64),
            _Step('branch3x3dbl_2', 96, _KERNEL_3X3),
            _Step('branch3x3dbl_3', 96, _KERNEL_3X3),
        ],
        _pooled(pool_channels),
    )


def _block_17(inner: int) -> tuple[_Branch, ...]:
    return (
        [_Step('branch1x1', 192)],
        [
            _Step('branch7x7_1', inner),
            _Step('branch7x7_2', inner, _KERNEL_1X7),
            _Step('branch7x7_3', 192, _KERNEL_7X1),
        ],
        [
            _Step('branch7x7dbl_1', inner),
            _Step('branch7x7dbl_2', inner, _KERNEL_7X1),
            _Step('branch7x7dbl_3', inner, _KERNEL_1X7),
            _Step('branch7x7dbl_4', inner, _KERNEL_7X1),
            _Step('branch7x7dbl_5', 192, _KERNEL_1X7),
        ],
        _pooled(192),
    )


def _fork(name: str) -> tuple[_Step, _Step]:
    return _Step(f'{name}a', 384, (1, 3)), _Step(f'{name}b', 384, (3, 1))


def _block_8() -> tuple[_Branch, ...]:
    return (
        [_Step('branch1x1', 320)],
        [_Step('branch3x3_1', 384), _fork('branch3x3_2')],
        [
            _Step('branch3x3dbl_1', 448),
            _Step('branch3x3dbl_2', 384, _KERNEL_3X3),
            _fork('branch3x3dbl_3'),
        ],
        _pooled(192),
    )


_TO_17: tuple[_Branch, ...] = (
    [_Step('branch3x3', 384, _KERNEL_3X3, 2, False)],
    [
        _Step('branch3x3dbl_1', 64),
        _Step('branch3x3dbl_2', 96, _KERNEL_3X3),
        _Step('branch3x3dbl_3', 96, _KERNEL_3X3, 2, False),
    ],
)
_TO_8: tuple[_Branch, ...] = (
    [_Step('branch3x3_1', 192), _Step('branch3x3_2', 320, _KERNEL_3X3, 2, False)],
    [
        _Step('branch7x7x3_1', 192),
        _Step('branch7x7x3_2', 192, _KERNEL_1X7),
        _Step('branch7x7x3_3', 192, _KERNEL_7X1),
        _Step('branch7x7x3_4', 192, _KERNEL_3X3, 2, False),
    ],
)
#: before the first block; 'pool' halves the size
_STEM = (
    _Step('Conv2d_1a_3x3', 32, _KERNEL_3X3, 2, False),
    _Step('Conv2d_2a_3x3', 32, _KERNEL_3X3, 1, False),
    _Step('Conv2d_2b_3x3', 64, _KERNEL_3X3),
    'pool',
    _Step('Conv2d_3b_1x1', 80),
    _Step('Conv2d_4a_3x3', 192, _KERNEL_3X3, 1, False),
    'pool',
)
#: (name, branches, what happens to the input of the pooled branch)
_BLOCKS = (
    ('Mixed_5b', _block_35(32), 'average'),
    ('Mixed_5c', _block_35(64), 'average'),
    ('Mixed_5d', _block_35(64), 'average'),
    ('Mixed_6a', _TO_17, 'halve'),
    ('Mixed_6b', _block_17(128), 'average'),
    ('Mixed_6c', _block_17(160), 'average'),
    ('Mixed_6d', _block_17(160), 'average'),
    ('Mixed_6e', _block_17(192), 'average'),
    ('Mixed_7a', _TO_8, 'halve'),
    ('Mixed_7b', _block_8(), 'average'),
    ('Mixed_7c', _block_8(), 'maximum'),
)


class _Conv(nn.Module):
    def __init__(self, num_inputs: int, step: _Step) -> None:
        super().__init__()
        height, width = step.kernel
        padding = (height // 2, width // 2) if step.same else 0
        self.conv = nn.Conv2d(
            num_inputs, step.channels, step.kernel, step.stride, padding, bias=False
        )
        self.bn = nn.BatchNorm2d(step.channels, eps=1e-3)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)))


class _Block(nn.Module):
    """Branches side by side, the last one after (or, where the size is halved, as) a pool."""

    def __init__(self, num_inputs: int, branches: tuple[_Branch, ...], pool: str) -> None:
        super().__init__()
        self.pool = pool
        self.branches = [self._add(num_inputs, branch) for branch in branches]
        widths = [last.channels if isinstance(last, _Step) else 768 for *_, last in branches]
        self.num_outputs = sum(widths) + (num_inputs if pool == 'halve' else 0)

    def _add(self, num_inputs: int, branch: _Branch) -> list[tuple[str, ...]]:
        names = []
        for part in branch:
            steps = (part,) if isinstance(part, _Step) else part
            for step in steps:
                self.add_module(step.name, _Conv(num_inputs, step))
            names.append(tuple(step.name for step in steps))
            num_inputs = steps[0].channels
        return names

    def forward(self, x: Tensor) -> Tensor:
        pooled = _POOLS[self.pool](x)
        found = []
        for branch in self.branches:
            y = pooled if branch[0] == ('branch_pool',) else x
            for names in branch:
                y = torch.cat([self.get_submodule(name)(y) for name in names], 1)
            found.append(y)
        return torch.cat([*found, pooled] if self.pool == 'halve' else found, 1)


def _average(x: Tensor) -> Tensor:
    return F.avg_pool2d(x, 3, 1, 1, count_include_pad=False)


def _maximum(x: Tensor) -> Tensor:
    return F.max_pool2d(x, 3, 1, 1)


def _halve(x: Tensor) -> Tensor:
    return F.max_pool2d(x, 3, 2)


_POOLS = {'average': _average, 'maximum': _maximum, 'halve': _halve}


class InceptionV3(nn.Module):
    """Network from (N, 3, H, W) images of 0..255 to (N, 2048) features: mean of the last map."""

    def __init__(self) -> None:
        super().__init__()
        width = 3
        for step in _STEM:
            if isinstance(step, _Step):
                self.add_module(step.name, _Conv(width, step))
                width = step.channels
        for name, branches, pool in _BLOCKS:
            block = _Block(width, branches, pool)
            self.add_module(name, block)
            width = block.num_outputs
        self.fc = nn.Linear(width, 1008)  # in the weights; FID does not use it

    def forward(self, images: Tensor) -> Tensor:
        """Return the features."""
        x = (_resized(images) - 128) / 128
        for step in _STEM:
            x = self.get_submodule(step.name)(x) if isinstance(step, _Step) else _halve(x)
        for name, _, _ in _BLOCKS:
            x = self.get_submodule(name)(x)
        return x.mean((2, 3))


def _resized(images: Tensor) -> Tensor:
    """Resize bilinearly, corner to corner of the first pixels: pixel i lies at i * size / 299."""
    rows, columns = (_weights(count, images) for count in images.shape[2:])
    return rows @ images @ columns.T


def _weights(count: int, like: Tensor) -> Tensor:
    """Return (299, count) shares of the old pixels in each new one."""
    places = torch.arange(SIZE, dtype=torch.float64) * (count / SIZE)
    lower = places.floor().long().clamp(max=count - 1)
    upper = (lower + 1).clamp(max=count - 1)
    share = (places - lower)[:, None]
    eye = torch.eye(count, dtype=torch.float64)
    return (eye[lower] * (1 - share) + eye[upper] * share).to(like)
