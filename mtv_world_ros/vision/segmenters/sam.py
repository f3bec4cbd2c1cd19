"""The segmenter with public weights: MM-Grounding-DINO finds, SAM 2 outlines and follows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.data_types import BoolArray, ByteArray, FloatArray
from mtv_world_ros.vision.segmenters.grounding import GroundingConfig, MMGroundingDino
from mtv_world_ros.vision.segmenters.image_normalisation import (
    IMAGENET,
    prepare,
    stated_normalisation,
)
from mtv_world_ros.vision.segmenters.mask_tracking import output_masks
from mtv_world_ros.vision.segmenters.prompted import FirstMasks, PromptedSegmenter
from mtv_world_ros.vision.segmenters.tracking import TrackingConfig
from mtv_world_ros.vision.segmenters.weights import load_vision_model, preprocessor_config

#: what SAM 2 calls the corners of a box among the points of a prompt
_BOX_LABELS = (2, 3)


class Sam2Video:
    """`Sam2VideoModel` frame by frame; a `SamVideo`."""

    def __init__(self, folder: Path, *, device: str = 'cpu') -> None:
        """Loads the weights; see `load_vision_model` for the errors."""
        self.tracker = load_vision_model(folder, 'sam2_video', device)
        self.device = device
        self._normalisation = stated_normalisation(preprocessor_config(folder), IMAGENET)

    def open_session(self, height: int, width: int) -> Any:
        """See `SamVideo.open_session`."""
        import torch
        from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

        return Sam2VideoInferenceSession(
            video_height=height,
            video_width=width,
            inference_device=self.device,
            inference_state_device=self.device,
            video_storage_device=self.device,
            dtype=torch.float32,
        )

    def advance(self, session: Any, frame: ByteArray, index: int) -> Any:
        """See `SamVideo.advance`."""
        size = int(self.tracker.image_size)
        pixels = prepare(frame, (size, size), self._normalisation, self.device)
        return self.tracker(session, frame=pixels, frame_idx=index)

    def masks_in_boxes(self, frame: ByteArray, boxes: FloatArray) -> BoolArray:
        """Returns the (N, H, W) masks of what is in (N, 4) corner boxes [px] of a frame."""
        import torch

        height, width = frame.shape[:2]
        if not len(boxes):
            return np.zeros((0, height, width), np.bool_)
        session = self.open_session(height, width)
        scale = int(self.tracker.image_size) / np.array([width, height])
        for number, box in enumerate(boxes):
            corners = torch.tensor(box.reshape(1, 1, 2, 2) * scale, dtype=torch.float32)
            labels = torch.tensor([[_BOX_LABELS]], dtype=torch.int32)
            prompt = {'point_coords': corners, 'point_labels': labels}
            session.add_point_inputs(session.obj_id_to_idx(number), 0, prompt)
        session.obj_with_new_inputs = list(range(len(boxes)))
        return output_masks(self.advance(session, frame, 0), height, width)


class BoxedFinder:
    """Boxes by name, then the mask in each box; a `Finder`."""

    def __init__(self, detector: MMGroundingDino, video: Sam2Video) -> None:
        self._detector, self._video = detector, video

    def find(self, frame: ByteArray, names: tuple[str, ...]) -> FirstMasks:
        """See `Finder.find`."""
        detections = self._detector.find(frame, names)
        known = np.isfinite(detections.boxes).all(1)
        masks = np.zeros((len(names), *frame.shape[:2]), np.bool_)
        masks[known] = self._video.masks_in_boxes(frame, detections.boxes[known])
        return FirstMasks(masks=masks, status=detections.status)


def sam2_segmenter(
    grounding_folder: Path,
    sam2_folder: Path,
    *,
    device: str = 'cpu',
    grounding: GroundingConfig | None = None,
    tracking: TrackingConfig | None = None,
) -> PromptedSegmenter:
    """Loads both models.

    Raises:
        CheckpointError: a folder does not hold the model.
        ConfigError: transformers is not installed.
    """
    video = Sam2Video(sam2_folder, device=device)
    detector = MMGroundingDino(grounding_folder, device=device, config=grounding)
    return PromptedSegmenter(
        name='mm-grounding-dino+sam2',
        finder=BoxedFinder(detector, video),
        video=video,
        tracking=tracking or TrackingConfig(),
    )
