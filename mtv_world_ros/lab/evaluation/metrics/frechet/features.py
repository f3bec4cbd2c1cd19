"""Features of frames (FID) and clips (FVD), by networks whose weights the user names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from mtv_world_ros.bounded_input import check_weights
from mtv_world_ros.data_types import ByteArray, FloatArray
from mtv_world_ros.errors import CheckpointError, ConfigError, EpisodeError

if TYPE_CHECKING:
    import torch

#: frames that go through the network at once
_BATCH = 16

#: (N, H, W, 3) uint8 RGB frames to (N, D)
FrameFeatures = Callable[[ByteArray], FloatArray]
#: (T, H, W, 3) uint8 RGB clip to (1, D)
ClipFeatures = Callable[[ByteArray], FloatArray]


def frame_features(weights: Path, device: str = 'cpu') -> FrameFeatures:
    """Returns the 2,048 features of the Inception-v3 that FID is defined by.

    Args:
        weights: `pt_inception-2015-12-05-*.pth` or `weights-inception-2015-12-05-*.pth`, or the
            same as safetensors.
        device: e.g. `cpu`, `cuda`.

    Raises:
        ConfigError: there is no such file.
        CheckpointError: the file holds other tensors.
    """
    _check_file(weights, 'fid_weights')
    import torch

    from mtv_world_ros.lab.evaluation.metrics.frechet.inception import InceptionV3

    network = _loaded(InceptionV3(), weights, device, 'fid_weights')

    def features(frames: ByteArray) -> FloatArray:
        found = []
        with torch.inference_mode():
            for first in range(0, len(frames), _BATCH):
                batch = torch.from_numpy(np.array(frames[first : first + _BATCH])).to(device)
                found.append(network(batch.permute(0, 3, 1, 2).float()).float().cpu().numpy())
        return np.concatenate(found)

    return features


def clip_features(weights: Path, device: str = 'cpu') -> ClipFeatures:
    """Returns the features that FVD is measured with.

    Args:
        weights: a file: the state dict of an I3D (400 logits, the usual FVD); a folder: a VideoMAE
            as transformers saves it (mean over its tokens). The two give different numbers.
        device: e.g. `cpu`, `cuda`.

    Raises:
        ConfigError: there is no such file or folder.
        CheckpointError: the file holds other tensors.
    """
    return _video_mae(weights, device) if weights.is_dir() else _i3d(weights, device)


def _i3d(weights: Path, device: str) -> ClipFeatures:
    _check_file(weights, 'fvd_weights')
    import torch

    from mtv_world_ros.lab.evaluation.metrics.frechet.i3d import I3D, MIN_FRAMES

    network = _loaded(I3D(), weights, device, 'fvd_weights')

    def features(clip: ByteArray) -> FloatArray:
        if len(clip) < MIN_FRAMES:
            raise EpisodeError(
                f'FVD with I3D needs clips of at least {MIN_FRAMES} frames, this one has '
                f"{len(clip)}; use a VideoMAE folder for 'fvd_weights', or leave it out"
            )
        with torch.inference_mode():
            video = torch.from_numpy(np.array(clip)).to(device).permute(3, 0, 1, 2)
            return network(video[None].float()).float().cpu().numpy()

    return features


def _video_mae(folder: Path, device: str) -> ClipFeatures:
    """Clips are brought to the network's number of frames by taking the nearest ones."""
    import torch
    import torch.nn.functional as F

    network = _transformers_model(folder).to(device).eval()
    side, num_frames = network.config.image_size, network.config.num_frames
    mean, deviation = (
        torch.tensor(values, device=device)[None, :, None, None]
        for values in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    )

    def features(clip: ByteArray) -> FloatArray:
        places = np.linspace(0, len(clip) - 1, num_frames).round().astype(int)
        with torch.inference_mode():
            frames = torch.from_numpy(clip[places]).to(device).permute(0, 3, 1, 2) / 255
            frames = F.interpolate(frames, (side, side), mode='bilinear', antialias=True)
            video = ((frames - mean) / deviation)[None]
            tokens = network(pixel_values=video).last_hidden_state
            return tokens.mean(1).float().cpu().numpy()

    return features


def _transformers_model(folder: Path) -> Any:
    try:
        from transformers import VideoMAEModel
    except ImportError as error:
        raise ConfigError(
            f"fvd_weights '{folder}' is a folder, which needs transformers: "
            "pip install 'mtv_world_ros[describe]', or name an I3D state dict file"
        ) from error
    try:
        model = VideoMAEModel.from_pretrained(folder, local_files_only=True, use_safetensors=True)
    except (OSError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f"fvd_weights '{folder}' cannot be loaded as a VideoMAE ({error}); it needs "
            'config.json and model.safetensors'
        ) from error
    check_weights(model, folder)
    return model


def _loaded(network: torch.nn.Module, path: Path, device: str, option: str) -> torch.nn.Module:
    """The network with its weights from a file, in evaluation mode."""
    state = _state_dict(path, option)
    missing, unexpected = network.load_state_dict(_of_network(state, network), strict=False)
    missing = [name for name in missing if not name.endswith('num_batches_tracked')]
    if missing or unexpected:
        raise CheckpointError(
            f"{option} '{path}' is not a {type(network).__name__}: it lacks {missing[:3]} and has "
            f'unknown {list(unexpected)[:3]}'
        )
    check_weights(network, path)
    return network.to(device).eval()


def _of_network(state: dict[str, Any], network: torch.nn.Module) -> dict[str, Any]:
    """The tensors whose shapes fit; others count as missing and unknown."""
    wanted = {name: tensor.shape for name, tensor in network.state_dict().items()}
    return {
        (name if name not in wanted or wanted[name] == tensor.shape else f'{name} (shape)'): tensor
        for name, tensor in state.items()
    }


def _check_file(path: Path, option: str) -> None:
    if not path.is_file():
        raise ConfigError(
            f"{option} '{path}' does not exist; nothing is downloaded, name a file that you have"
        )


def _state_dict(path: Path, option: str) -> dict[str, Any]:
    if path.suffix == '.safetensors':
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(path)
        except (OSError, SafetensorError) as error:
            raise CheckpointError(f"{option} '{path}' cannot be loaded: {error}") from error
    import torch

    try:
        state = torch.load(path, map_location='cpu', weights_only=True)
    except Exception as error:  # torch raises pickle, zip and runtime errors alike
        raise CheckpointError(
            f"{option} '{path}' holds no plain tensors ({str(error).splitlines()[0]}); "
            'TorchScript and pickled modules are not loaded: save its state_dict'
        ) from error
    if not isinstance(state, dict):
        raise CheckpointError(f"{option} '{path}' holds {type(state).__name__}, not a state dict")
    return state
