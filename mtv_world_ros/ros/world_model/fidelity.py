"""J of imagined against real frames of the same moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mtv_world_ros.data_types import ByteArray, FloatArray, ObjectMasks
from mtv_world_ros.vision.jaccard import mean_of_known, object_scores, persistence_scores
from mtv_world_ros.vision.segmenters.segmenter import Segmenter


@dataclass(frozen=True, slots=True, kw_only=True)
class Fidelity:
    """How a chunk compares with what really came: V views, O objects.

    Attributes:
        names: O names.
        jaccard: (V, O) mean J over the compared frames, NaN = not scored.
        copy: the same of the chunk's first masks held.
        num_frames: that were compared.
        masks: of the real frames.
    """

    names: tuple[str, ...]
    jaccard: FloatArray
    copy: FloatArray
    num_frames: int
    masks: ObjectMasks

    @property
    def mean(self) -> float:
        """Mean J over views and objects, NaN where none is scored."""
        return float(mean_of_known(self.jaccard))


def compare_masks(
    segmenter: Segmenter,
    predicted: ObjectMasks,
    indices: Sequence[int],
    frames: ByteArray,
    *,
    first_frames: ByteArray,
    first_masks: ObjectMasks,
) -> Fidelity:
    """Scores imagined masks against those of real frames.

    Args:
        segmenter: finds the real ones.
        predicted: masks of the T imagined frames.
        indices: N of these frames that have a real one.
        frames: (V, N, H, W, 3) uint8 RGB real frames.
        first_frames: (V, H, W, 3) uint8 RGB real frame before them.
        first_masks: its masks (T = 1).
    """
    firsts = first_masks.masks[:, :, 0]
    real = segmenter.segment(frames, predicted.names, firsts, first_frames)
    chosen = replace(predicted, masks=predicted.masks[:, :, list(indices)])
    return Fidelity(
        names=predicted.names,
        jaccard=object_scores(chosen, real).objects,
        copy=persistence_scores(firsts, real).objects,
        num_frames=len(indices),
        masks=real,
    )
