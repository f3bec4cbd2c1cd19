"""Outcomes of imagined chunks: their frames go out, and they are compared with real ones."""

from __future__ import annotations

from dataclasses import dataclass, field

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.ros.world_model.worker import Chunk
from mtv_world_ros.vision.jaccard import mean_of_known


@dataclass(slots=True)
class Sent:
    """Fate of the frames of a chunk: published, dropped, pre-empted.

    Attributes:
        publish_s: time spent on publishing [s].
        out_s: (N,) when each frame that was published went out [s], of `time.monotonic`.
        leads_s: (N,) lead of publishing a frame before its stamp [s], by the node's clock.
    """

    publish_s: float = 0.0
    out_s: list[float] = field(default_factory=list)
    leads_s: list[float] = field(default_factory=list)

    @property
    def num_frames(self) -> int:
        """Number of published frames."""
        return len(self.out_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoredChunk:
    """Comparison of a chunk with the real frames: V views, O objects.

    Attributes:
        chunk: the imagined chunk.
        names: names of the O objects.
        jaccard: (V, O) mean J over the compared frames, NaN = not scored.
        copy: (V, O) J of the chunk's first masks, held.
        num_frames: number of compared frames.
    """

    chunk: Chunk
    names: tuple[str, ...]
    jaccard: FloatArray
    copy: FloatArray
    num_frames: int

    @property
    def mean(self) -> float:
        """Mean J over views and objects, NaN where none is scored."""
        return float(mean_of_known(self.jaccard))
