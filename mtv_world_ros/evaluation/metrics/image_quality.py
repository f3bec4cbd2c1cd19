"""PSNR, SSIM and LPIPS of predicted frames, as torchmetrics computes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import ConfigError, MissingPackageError

#: names of the measures; LPIPS also needs torchvision and downloads its AlexNet weights
MEASURES = ('psnr', 'ssim', 'lpips')

#: (T, H, W, 3) uint8 RGB predicted and real frames to numbers by name
ImageQuality = Callable[[ByteArray, ByteArray], dict[str, float]]


def image_quality(names: Sequence[str], device: str = 'cpu') -> ImageQuality | None:
    """Return the measures of the given names, each the mean over frames; None without names.

    PSNR [dB] of equal frames is that of an error of 1/2 of a grey level in one value, so that
    means stay finite.

    Raises:
        ConfigError: an unknown name, or a package that it needs is missing.
    """
    unknown = [name for name in names if name not in MEASURES]
    if unknown:
        raise ConfigError(f"quality '{unknown[0]}' is not one of {', '.join(MEASURES)}")
    if not names:
        return None
    makers = {'psnr': _psnr, 'ssim': _ssim, 'lpips': partial(_lpips, device)}
    try:
        measures = {name: makers[name]() for name in names}
    except ImportError as error:
        raise MissingPackageError(f'quality {", ".join(names)}', 'torchmetrics') from error

    def measure(predicted: ByteArray, real: ByteArray) -> dict[str, float]:
        import torch

        videos = [torch.from_numpy(np.array(v)).permute(0, 3, 1, 2) for v in (predicted, real)]
        return {name: float(found(*videos)) for name, found in measures.items()}

    return measure


def _psnr() -> Callable[[Any, Any], Any]:
    from torchmetrics.functional.image import peak_signal_noise_ratio

    def measure(predicted: Any, real: Any) -> Any:
        found = peak_signal_noise_ratio(
            predicted.double(), real.double(), data_range=255.0, dim=(1, 2, 3), reduction='none'
        )
        pixels = predicted[0].numel()
        return found.clamp(max=10 * np.log10(255.0**2 * 4 * pixels)).mean()

    return measure


def _ssim() -> Callable[[Any, Any], Any]:
    from torchmetrics.functional.image import structural_similarity_index_measure

    def measure(predicted: Any, real: Any) -> Any:
        # within 2e-4 of float64, which takes 16 times as long
        return structural_similarity_index_measure(
            predicted.float(), real.float(), data_range=255.0
        )

    return measure


def _lpips(device: str) -> Callable[[Any, Any], Any]:
    from importlib.util import find_spec

    import torch
    from torchmetrics.functional.image import learned_perceptual_image_patch_similarity

    if find_spec('torchvision') is None:
        raise ConfigError(
            'quality lpips needs torchvision, which is not installed and which this package does '
            'not install (its Linux wheels pull CUDA); install a build that fits your torch, or '
            'leave lpips out'
        )

    def measure(predicted: Any, real: Any) -> Any:
        batch = [video.to(device).float() / 255 for video in (predicted, real)]
        with torch.inference_mode():
            return learned_perceptual_image_patch_similarity(*batch, normalize=True)

    return measure
