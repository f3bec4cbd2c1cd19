"""Frames resized and normalised as the vision models expect them, without torchvision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import CheckpointError

Tensor = Any  # torch is imported where it is used


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalisation:
    """Channels become (x / 255 - mean) / std."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


#: of SAM 2 and MM-Grounding-DINO: the channels of ImageNet
IMAGENET = Normalisation(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
#: of SAM 3
SYMMETRIC = Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
#: of MM-Grounding-DINO: shorter edge, and what the longer one may not exceed [px]
DINO_EDGES = (800, 1333)


def stated_normalisation(config: dict[str, Any], default: Normalisation) -> Normalisation:
    """Returns what a preprocessor_config.json states, else the model family's own.

    Raises:
        CheckpointError: it states something else than three channels.
    """
    mean = tuple(config.get('image_mean') or default.mean)
    std = tuple(config.get('image_std') or default.std)
    if len(mean) != 3 or len(std) != 3 or not all(value > 0 for value in std):
        raise CheckpointError(
            f'preprocessor_config.json states image_mean {mean} and image_std {std}; both need '
            'three values, those of image_std above 0'
        )
    return Normalisation(mean=mean, std=std)


def stated_edges(config: dict[str, Any]) -> tuple[int, int]:
    """Returns the shorter edge and the bound of the longer one [px] that a config states."""
    size = config.get('size')
    if not isinstance(size, dict) or 'shortest_edge' not in size:
        return DINO_EDGES
    return int(size['shortest_edge']), int(size.get('longest_edge', DINO_EDGES[1]))


def size_with_edges(height: int, width: int, edges: tuple[int, int]) -> tuple[int, int]:
    """Returns (height, width) of the image whose shorter edge is `edges[0]`.

    It is smaller where the longer edge would exceed `edges[1]`. DETR's rule.
    """
    short, long = min(height, width), max(height, width)
    wanted: float = edges[0]
    if long / short * wanted > edges[1]:
        wanted = edges[1] * short / long
    small, large = round(wanted), int(wanted * long / short)
    if short == small:
        return height, width
    return (small, large) if height <= width else (large, small)


def prepare(
    frame: ByteArray, size: tuple[int, int], normalisation: Normalisation, device: str
) -> Tensor:
    """Returns the (1, 3, height, width) float32 tensor of a frame.

    Args:
        frame: (H, W, 3) uint8 RGB.
        size: height and width that the model wants [px].
        normalisation: of the model.
        device: where the tensor shall be.
    """
    import torch

    pixels = torch.tensor(frame, device=device).permute(2, 0, 1)[None].float()
    if tuple(pixels.shape[-2:]) != size:
        pixels = torch.nn.functional.interpolate(
            pixels, size=size, mode='bilinear', align_corners=False, antialias=True
        )
        # the published processors resize bytes
        pixels = pixels.round().clamp(0, 255)
    mean = torch.tensor(normalisation.mean, device=device).view(1, 3, 1, 1)
    std = torch.tensor(normalisation.std, device=device).view(1, 3, 1, 1)
    return (pixels / 255 - mean) / std
