"""The opt-in segmenters of the SAM family: MM-Grounding-DINO with SAM 2, and SAM 3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, ByteArray, FloatArray
from mtv_world_ros.vision.segmenters.grounding import (
    choose_boxes,
    GroundingConfig,
    IMAGENET,
    MMGroundingDino,
    prepare,
    stated_normalisation,
    SYMMETRIC,
)
from mtv_world_ros.vision.segmenters.prompted import FirstMasks, output_masks, PromptedSegmenter
from mtv_world_ros.vision.segmenters.tracking import TrackingConfig
from mtv_world_ros.vision.segmenters.weights import (
    load_tokenizer,
    load_vision_model,
    preprocessor_config,
    SegmenterOptions,
)

#: labels of SAM 2 for the two corners of a box among the points of a prompt
_BOX_LABELS = (2, 3)


def _session(kind: Any, height: int, width: int, device: str) -> Any:
    import torch

    return kind(
        video_height=height,
        video_width=width,
        inference_device=device,
        inference_state_device=device,
        video_storage_device=device,
        dtype=torch.float32,
    )


class Sam2Video:
    """`Sam2VideoModel` frame by frame; a `SamVideo`."""

    def __init__(self, folder: Path, *, device: str = 'cpu') -> None:
        """Load the weights; see `load_vision_model` for the errors."""
        self.tracker = load_vision_model(folder, 'sam2_video', device)
        self.device = device
        self._normalisation = stated_normalisation(preprocessor_config(folder), IMAGENET)

    def open_session(self, height: int, width: int) -> Any:
        """See `SamVideo.open_session`."""
        from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

        return _session(Sam2VideoInferenceSession, height, width, self.device)

    def advance(self, session: Any, frame: ByteArray, index: int) -> Any:
        """See `SamVideo.advance`."""
        size = int(self.tracker.image_size)
        pixels = prepare(frame, (size, size), self._normalisation, self.device)
        return self.tracker(session, frame=pixels, frame_idx=index)

    def masks_in_boxes(self, frame: ByteArray, boxes: FloatArray) -> BoolArray:
        """Return the masks (N, H, W) of the objects in corner boxes (N, 4) [px] of a frame."""
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
    """Load Grounding DINO and SAM 2, and return the segmenter that uses them.

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


class Sam2:
    """Any short noun phrase: MM-Grounding-DINO's box in the first frame, followed by SAM 2.

    Needs the extra `vision` and weights.
    """

    models = ('mm-grounding-dino', 'sam2_video')

    @classmethod
    def create(cls, options: SegmenterOptions) -> PromptedSegmenter:
        """Load both models; see `sam2_segmenter` for the errors."""
        detector, tracker = options.folders(*cls.models)
        return sam2_segmenter(detector, tracker, device=options.device)


#: maximum number of tokens of a name in SAM 3's text encoder
_TEXT_LENGTH = 32
#: SAM 3's own threshold for detections is .5; it adds an object to a video from .7 on
SAM3_SCORES = GroundingConfig(min_score=0.5, sure_score=0.7)


class Sam3Video:
    """`Sam3VideoModel` frame by frame; a `SamVideo` and a `Finder`.

    Its own loop detects anew in every frame, so that two videos get identities of their own. Here
    both halves are called one after the other: names are looked for in the first frame alone, and
    the tracker starts from masks, the same for every video.
    """

    def __init__(
        self, folder: Path, *, device: str = 'cpu', config: GroundingConfig = SAM3_SCORES
    ) -> None:
        """Load the weights; see `load_vision_model` for the errors."""
        self._model = load_vision_model(folder, 'sam3_video', device)
        self._tokenizer = load_tokenizer(folder)
        self._normalisation = stated_normalisation(preprocessor_config(folder), SYMMETRIC)
        self._config = config
        self.device = device

    @property
    def tracker(self) -> Any:
        """See `SamVideo.tracker`."""
        return self._model.tracker_model

    def open_session(self, height: int, width: int) -> Any:
        """See `SamVideo.open_session`."""
        from transformers.models.sam3_tracker_video import modeling_sam3_tracker_video as module

        kind = module.Sam3TrackerVideoInferenceSession
        return _session(kind, height, width, self.device)

    def advance(self, session: Any, frame: ByteArray, index: int) -> Any:
        """See `SamVideo.advance`."""
        import torch

        with torch.inference_mode():
            features, places = self._model.get_vision_features_for_tracker(self._see(frame))
        session.cache.cache_vision_features(
            index, {'vision_feats': features, 'vision_pos_embeds': places}
        )
        # the tracker has no image encoder of its own: it takes the features above, not the frame
        return self.tracker(session, frame=torch.zeros(1, 3, 1, 1), frame_idx=index)

    def find(self, frame: ByteArray, names: tuple[str, ...]) -> FirstMasks:
        """See `Finder.find`."""
        import torch

        height, width = frame.shape[:2]
        if not names:
            return FirstMasks(masks=np.zeros((0, height, width), np.bool_), status=())
        with torch.inference_mode():
            seen = self._see(frame)
            found = [self._detect(seen, name) for name in names]
        masks = np.concatenate([logits for _, _, logits in found])
        boxes = np.concatenate([boxes for _, boxes, _ in found]) * [width, height, width, height]
        # every name has candidates of its own
        scores = np.zeros((len(masks), len(names)))
        for index, (own, _, _) in enumerate(found):
            scores[index * len(own) : (index + 1) * len(own), index] = own
        chosen = choose_boxes(boxes, scores, names, self._config)
        best = scores.argmax(0)
        known = np.isfinite(chosen.boxes).all(1)
        first = np.zeros((len(names), height, width), np.bool_)
        first[known] = _upscaled(masks[best[known]], height, width)
        return FirstMasks(masks=first, status=chosen.status)

    def _see(self, frame: ByteArray) -> Any:
        """Return features of a frame from the image encoder that detector and tracker share."""
        size = int(self.tracker.image_size)
        pixels = prepare(frame, (size, size), self._normalisation, self.device)
        return self._model.detector_model.get_vision_features(pixel_values=pixels)

    def _detect(self, seen: Any, name: str) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Scores (Q,), corner boxes (Q, 4) as shares of the image, mask logits (Q, h, w)."""
        text = self._tokenizer(
            name,
            return_tensors='pt',
            padding='max_length',
            truncation=True,
            max_length=_TEXT_LENGTH,
        ).to(self.device)
        output = self._model.detector_model(
            vision_embeds=seen, input_ids=text.input_ids, attention_mask=text.attention_mask
        )
        scores = output.pred_logits.sigmoid() * output.presence_logits.sigmoid()
        parts = (scores[0], output.pred_boxes[0], output.pred_masks[0])
        first, second, third = (part.float().cpu().double().numpy() for part in parts)
        return first, second, third


def _upscaled(logits: FloatArray, height: int, width: int) -> BoolArray:
    """Return (N, H, W) masks of (N, h, w) logits."""
    import torch

    likely = torch.tensor(logits)[:, None].sigmoid()
    likely = torch.nn.functional.interpolate(
        likely, size=(height, width), mode='bilinear', align_corners=False
    )
    return (likely[:, 0] > 0.5).numpy()


def sam3_segmenter(
    folder: Path,
    *,
    device: str = 'cpu',
    grounding: GroundingConfig = SAM3_SCORES,
    tracking: TrackingConfig | None = None,
) -> PromptedSegmenter:
    """Load SAM 3, and return the segmenter that uses it.

    Raises:
        CheckpointError: the folder does not hold it.
        ConfigError: transformers is not installed.
    """
    video = Sam3Video(folder, device=device, config=grounding)
    return PromptedSegmenter(
        name='sam3', finder=video, video=video, tracking=tracking or TrackingConfig()
    )


class Sam3:
    """Any short noun phrase, with SAM 3 alone.

    Needs the extra `vision` and weights, to which Meta grants access.
    """

    models = ('sam3_video',)

    @classmethod
    def create(cls, options: SegmenterOptions) -> PromptedSegmenter:
        """Load the model; see `sam3_segmenter` for the errors."""
        (folder,) = options.folders(*cls.models)
        return sam3_segmenter(folder, device=options.device)
