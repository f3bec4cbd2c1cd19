"""Boxes of named objects in one frame, from MM-Grounding-DINO."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, ByteArray, FloatArray
from mtv_world_ros.core.errors import CheckpointError, ConfigError
from mtv_world_ros.vision.segmenters.weights import (
    load_tokenizer,
    load_vision_model,
    preprocessor_config,
)

Tensor = Any  # torch is imported where it is used


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalisation:
    """Normalisation of image channels: (x / 255 - mean) / std."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


#: image normalisation of SAM 2 and MM-Grounding-DINO: the channels of ImageNet
IMAGENET = Normalisation(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
#: image normalisation of SAM 3
SYMMETRIC = Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
#: of MM-Grounding-DINO: shorter edge, and what the longer one may not exceed [px]
DINO_EDGES = (800, 1333)


def stated_normalisation(config: dict[str, Any], default: Normalisation) -> Normalisation:
    """Return the normalisation of preprocessor_config.json, else the model family's.

    Raises:
        CheckpointError: the preprocessor is not for images of three channels.
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
    """Return the shorter edge and the bound of the longer one [px] that a config states."""
    size = config.get('size')
    if not isinstance(size, dict) or 'shortest_edge' not in size:
        return DINO_EDGES
    return int(size['shortest_edge']), int(size.get('longest_edge', DINO_EDGES[1]))


def size_with_edges(height: int, width: int, edges: tuple[int, int]) -> tuple[int, int]:
    """Return (height, width) of the image whose shorter edge is `edges[0]`.

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
    """Return the (1, 3, height, width) float32 tensor of a frame.

    Args:
        frame: (H, W, 3) uint8 RGB.
        size: height and width that the model wants [px].
        normalisation: normalisation of the model.
        device: device of the returned tensor.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundingConfig:
    """Score thresholds of detections.

    Attributes:
        min_score: score below which an object is absent.
        sure_score: score below which an object is `low_confidence`.
        rival_share: another place with this share of the best score makes the object ambiguous.
        same_place: boxes of one name that overlap with at least this IoU are one place.
        same_box: boxes of two names that overlap with at least this IoU are one object, which
            then belongs to the name that scores more; the other is ambiguous.
    """

    min_score: float = 0.25
    sure_score: float = 0.35
    rival_share: float = 0.8
    same_place: float = 0.5
    same_box: float = 0.9

    def __post_init__(self) -> None:
        if not 0 < self.min_score <= self.sure_score < 1:
            raise ConfigError(
                f'min_score is {self.min_score} and sure_score {self.sure_score}; they must obey '
                '0 < min_score <= sure_score < 1'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Detections:
    """Detected boxes of the named objects.

    Attributes:
        boxes: (O, 4) left, top, right and bottom edge of each object [px]; NaN where there is
            none.
        status: O words: `ok`, `absent`, `ambiguous` or `low_confidence`.
    """

    boxes: FloatArray
    status: tuple[str, ...]


class MMGroundingDino:
    """Open-vocabulary detector; names may be any short noun phrases."""

    def __init__(
        self, folder: Path, *, device: str = 'cpu', config: GroundingConfig | None = None
    ) -> None:
        """Load the weights; see `load_vision_model` for the errors."""
        self.config = config or GroundingConfig()
        self._model = load_vision_model(folder, 'mm-grounding-dino', device)
        self._tokenizer = load_tokenizer(folder)
        stated = preprocessor_config(folder)
        self._normalisation = stated_normalisation(stated, IMAGENET)
        self._edges = stated_edges(stated)
        self._device = device

    def find(self, frame: ByteArray, names: tuple[str, ...]) -> Detections:
        """Return a box per name.

        Args:
            frame: (H, W, 3) uint8 RGB.
            names: names of the O objects.

        Raises:
            ConfigError: the names are longer than the model's text.
        """
        import torch

        if not names:
            return Detections(boxes=np.zeros((0, 4)), status=())
        height, width = frame.shape[:2]
        text, spans = _prompt(names)
        tokens = self._tokenizer(text, return_tensors='pt', return_offsets_mapping=True)
        token_sets = _tokens_of(spans, tokens.pop('offset_mapping')[0].numpy())
        longest = self._model.config.max_text_len
        if tokens['input_ids'].shape[1] > longest:
            raise ConfigError(
                f'{len(names)} object names make {tokens["input_ids"].shape[1]} tokens, the '
                f"detector reads {longest}; shorten 'objects'"
            )
        size = size_with_edges(height, width, self._edges)
        pixels = prepare(frame, size, self._normalisation, self._device)
        with torch.inference_mode():
            output: Any = self._model(pixel_values=pixels, **tokens.to(self._device))
        likely = output.logits[0].sigmoid().cpu().double().numpy()
        centre_boxes = output.pred_boxes[0].cpu().double().numpy()
        boxes = _corners(centre_boxes) * [width, height, width, height]
        # a phrase scores the mean of its tokens, as in the detector's own evaluation: with the
        # maximum `block` alone would make every block a red one
        scores = np.stack([_mean_score(likely, chosen) for chosen in token_sets], axis=1)
        return choose_boxes(boxes, scores, names, self.config)


def choose_boxes(
    boxes: FloatArray, scores: FloatArray, names: tuple[str, ...], config: GroundingConfig
) -> Detections:
    """Return the best box of every name; a place belongs to the name that fits it best.

    Args:
        boxes: (Q, 4) corners of candidates [px].
        scores: (Q, O) score of each box for each name, in [0, 1].
        names: names of the O objects.
        config: score thresholds of detections.
    """
    owner = scores.argmax(1)
    chosen = np.full((len(names), 4), np.nan)
    best_scores = np.zeros(len(names))
    status: list[str] = []
    for index, name in enumerate(names):
        own = np.flatnonzero((owner == index) & (scores[:, index] >= config.min_score))
        if not len(own):
            status.append('ambiguous' if names.count(name) > 1 else 'absent')
            continue
        best = own[scores[own, index].argmax()]
        chosen[index], best_scores[index] = boxes[best], scores[best, index]
        strong = own[scores[own, index] >= config.rival_share * scores[best, index]]
        rivals = box_iou(boxes[strong], boxes[best]) < config.same_place
        if rivals.any() or names.count(name) > 1:
            status.append('ambiguous')
        else:
            status.append('ok' if scores[best, index] >= config.sure_score else 'low_confidence')
    for index in range(len(names)):
        shared = box_iou(chosen, chosen[index]) >= config.same_box
        shared[index] = False
        if (best_scores[shared] >= best_scores[index]).any():
            status[index] = 'ambiguous'
    return Detections(boxes=chosen, status=tuple(status))


def box_iou(boxes: FloatArray, box: FloatArray) -> FloatArray:
    """Return the (N,) intersection over union of (N, 4) corner boxes with one.

    NaN boxes overlap with none.
    """
    sides = np.minimum(boxes[:, 2:], box[2:]) - np.maximum(boxes[:, :2], box[:2])
    shared = np.prod(np.clip(sides, 0, None), axis=1)
    areas = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) + np.prod(box[2:] - box[:2])
    return np.nan_to_num(shared / np.maximum(areas - shared, 1e-12))


def _prompt(names: tuple[str, ...]) -> tuple[str, list[tuple[int, int]]]:
    """Return the detector's text, `red block. blue cup.`, and the place of each name in it."""
    text, spans = '', []
    for name in names:
        phrase = ' '.join(name.lower().replace('.', ' ').split())
        spans.append((len(text), len(text) + len(phrase)))
        text += f'{phrase}. '
    return text.strip(), spans


def _tokens_of(spans: list[tuple[int, int]], offsets: np.ndarray) -> list[BoolArray]:
    """Return the numbers of the tokens in each name, by their (N, 2) character offsets."""
    begins, ends = offsets.T
    return [(begins >= first) & (ends <= last) & (begins < ends) for first, last in spans]


def _mean_score(likely: FloatArray, chosen: BoolArray) -> FloatArray:
    """Return (Q,) mean over the chosen tokens; 0 for a name without any."""
    return likely[:, : len(chosen)][:, chosen].mean(1) if chosen.any() else np.zeros(len(likely))


def _corners(boxes: FloatArray) -> FloatArray:
    """Return centre x, y, width, height to left, top, right, bottom, cut at the image's edge."""
    half = boxes[:, 2:] / 2
    return np.clip(np.hstack([boxes[:, :2] - half, boxes[:, :2] + half]), 0, 1)
