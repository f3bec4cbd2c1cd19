"""Features of frames (FID) and clips (FVD), by networks whose weights the user names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.torch import load_file
import torch
from torch import nn, Tensor
import torch.nn.functional as F

from mtv_world_ros.core.bounded_input import check_weights, require_regular
from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import CheckpointError, ConfigError, EpisodeError
from mtv_world_ros.evaluation.metrics.inception import InceptionV3

#: side of the frames that the network sees [px]
SIZE = 224
NUM_FEATURES = 400
#: fewer frames leave nothing to average after three halvings in time
MIN_FRAMES = 9

#: channels of the six convolutions of each block, and the pools between blocks
_BLOCKS: tuple[tuple[str, tuple[int, ...]], ...] = (
    ('Mixed_3b', (64, 96, 128, 16, 32, 32)),
    ('Mixed_3c', (128, 128, 192, 32, 96, 64)),
    ('pool_3', ()),
    ('Mixed_4b', (192, 96, 208, 16, 48, 64)),
    ('Mixed_4c', (160, 112, 224, 24, 64, 64)),
    ('Mixed_4d', (128, 128, 256, 24, 64, 64)),
    ('Mixed_4e', (112, 144, 288, 32, 64, 64)),
    ('Mixed_4f', (256, 160, 320, 32, 128, 128)),
    ('pool_2', ()),
    ('Mixed_5b', (256, 160, 320, 32, 128, 128)),
    ('Mixed_5c', (384, 192, 384, 48, 128, 128)),
)


def _same(x: Tensor, kernel: tuple[int, ...], stride: tuple[int, ...]) -> Tensor:
    """Zero padding after which ceil(size / stride) outputs fit; the odd one goes to the end."""
    padding: list[int] = []
    for size, k, s in zip(x.shape[2:], kernel, stride, strict=True):
        total = max(k - (size % s or s), 0)
        padding = [total // 2, total - total // 2, *padding]
    return F.pad(x, padding)


def _pool(x: Tensor, kernel: tuple[int, int, int], stride: tuple[int, int, int]) -> Tensor:
    return F.max_pool3d(_same(x, kernel, stride), kernel, stride)


class _Unit(nn.Module):
    def __init__(
        self, num_inputs: int, num_outputs: int, side: int = 1, stride: int = 1, *, last=False
    ) -> None:
        super().__init__()
        self.kernel, self.stride = (side,) * 3, (stride,) * 3
        self.conv3d = nn.Conv3d(num_inputs, num_outputs, side, stride, bias=last)
        self.bn = None if last else nn.BatchNorm3d(num_outputs, eps=1e-3)

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv3d(_same(x, self.kernel, self.stride))
        return x if self.bn is None else F.relu(self.bn(x))


class _Block(nn.Module):
    def __init__(self, num_inputs: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.b0 = _Unit(num_inputs, widths[0])
        self.b1a = _Unit(num_inputs, widths[1])
        self.b1b = _Unit(widths[1], widths[2], 3)
        self.b2a = _Unit(num_inputs, widths[3])
        self.b2b = _Unit(widths[3], widths[4], 3)
        self.b3b = _Unit(num_inputs, widths[5])

    def forward(self, x: Tensor) -> Tensor:
        pooled = _pool(x, (3, 3, 3), (1, 1, 1))
        branches = self.b0(x), self.b1b(self.b1a(x)), self.b2b(self.b2a(x)), self.b3b(pooled)
        return torch.cat(branches, 1)


class I3D(nn.Module):
    """Network from (N, 3, T, H, W) video of 0..255, T >= 9, to mean logits (N, 400)."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv3d_1a_7x7 = _Unit(3, 64, 7, 2)
        self.Conv3d_2b_1x1 = _Unit(64, 64)
        self.Conv3d_2c_3x3 = _Unit(64, 192, 3)
        width = 192
        for name, widths in _BLOCKS:
            if widths:
                self.add_module(name, _Block(width, widths))
                width = widths[0] + widths[2] + widths[4] + widths[5]
        self.logits = _Unit(width, NUM_FEATURES, last=True)

    def forward(self, video: Tensor) -> Tensor:
        """Return the logits."""
        count, _, num_frames, _, _ = video.shape
        frames = F.interpolate(video.transpose(1, 2).flatten(0, 1), (SIZE, SIZE), mode='bilinear')
        x = (frames / 127.5 - 1).unflatten(0, (count, num_frames)).transpose(1, 2)
        x = _pool(self.Conv3d_1a_7x7(x), (1, 3, 3), (1, 2, 2))
        x = _pool(self.Conv3d_2c_3x3(self.Conv3d_2b_1x1(x)), (1, 3, 3), (1, 2, 2))
        for name, widths in _BLOCKS:
            if widths:
                x = self.get_submodule(name)(x)
            else:
                side = int(name[-1])
                x = _pool(x, (side, side, side), (2, 2, 2))
        return self.logits(F.avg_pool3d(x, (2, 7, 7), 1)).mean((2, 3, 4))


#: frames that go through the network at once
_BATCH = 16

#: (N, H, W, 3) uint8 RGB frames to (N, D)
FrameFeatures = Callable[[ByteArray], FloatArray]
#: (T, H, W, 3) uint8 RGB clip to (1, D)
ClipFeatures = Callable[[ByteArray], FloatArray]


def frame_features(weights: Path, device: str = 'cpu') -> FrameFeatures:
    """Return the 2,048 features of the Inception-v3 that FID is defined by.

    Args:
        weights: `pt_inception-2015-12-05-*.pth` or `weights-inception-2015-12-05-*.pth`, or the
            same as safetensors.
        device: PyTorch device, e.g. `cpu`, `cuda`.

    Raises:
        ConfigError: there is no such file.
        CheckpointError: the file holds other tensors.
    """
    network = _loaded(InceptionV3, weights, device, 'fid_weights')

    def features(frames: ByteArray) -> FloatArray:
        images = frames.transpose(0, 3, 1, 2)
        starts = range(0, len(images), _BATCH)
        return np.concatenate([network(images[k : k + _BATCH]) for k in starts])

    return features


def clip_features(weights: Path, device: str = 'cpu') -> ClipFeatures:
    """Return the features that FVD is measured with.

    Args:
        weights: the state dict of an I3D (400 logits).
        device: PyTorch device, e.g. `cpu`, `cuda`.

    Raises:
        ConfigError: there is no such file.
        CheckpointError: the file holds other tensors.
    """
    network = _loaded(I3D, weights, device, 'fvd_weights')

    def features(clip: ByteArray) -> FloatArray:
        if len(clip) < MIN_FRAMES:
            raise EpisodeError(
                f'FVD with I3D needs clips of at least {MIN_FRAMES} frames, this one has '
                f"{len(clip)}; leave 'fvd_weights' out"
            )
        return network(clip.transpose(3, 0, 1, 2)[None])

    return features


def _loaded(
    kind: type[nn.Module], path: Path, device: str, option: str
) -> Callable[[ByteArray], FloatArray]:
    """Return a network with its weights from a file, from arrays to arrays."""
    if not path.is_file():
        raise ConfigError(
            f"{option} '{path}' does not exist; nothing is downloaded, name a file that you have"
        )
    network, state = kind(), _state_dict(path, option)
    missing, unexpected = network.load_state_dict(_of_network(state, network), strict=False)
    missing = [name for name in missing if not name.endswith('num_batches_tracked')]
    if missing or unexpected:
        raise CheckpointError(
            f"{option} '{path}' is not a {kind.__name__}: it lacks {missing[:3]} and has "
            f'unknown {list(unexpected)[:3]}'
        )
    check_weights(network, path)
    network.to(device).eval()

    @torch.inference_mode()
    def run(pixels: ByteArray) -> FloatArray:
        batch = torch.from_numpy(np.array(pixels)).to(device).float()
        return network(batch).float().cpu().numpy()

    return run


def _of_network(state: dict[str, Any], network: torch.nn.Module) -> dict[str, Any]:
    """Return the tensors whose shapes fit; others count as missing and unknown."""
    wanted = {name: tensor.shape for name, tensor in network.state_dict().items()}
    return {
        (name if name not in wanted or wanted[name] == tensor.shape else f'{name} (shape)'): tensor
        for name, tensor in state.items()
    }


def _state_dict(path: Path, option: str) -> dict[str, Any]:
    if path.suffix == '.safetensors':
        try:
            require_regular(path)
            return load_file(path)
        except (OSError, SafetensorError) as error:
            raise CheckpointError(f"{option} '{path}' cannot be loaded: {error}") from error
    try:
        require_regular(path)
        state = torch.load(path, map_location='cpu', weights_only=True)
    except Exception as error:  # torch raises pickle, zip and runtime errors alike
        raise CheckpointError(
            f"{option} '{path}' holds no plain tensors ({str(error).splitlines()[0]}); "
            'TorchScript and pickled modules are not loaded: save its state_dict'
        ) from error
    if not isinstance(state, dict):
        raise CheckpointError(f"{option} '{path}' holds {type(state).__name__}, not a state dict")
    return state
