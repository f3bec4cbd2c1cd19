"""Objects of an imported episode: named and segmented once, stored with the episode."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import require_regular
from mtv_world_ros.core.config import read_yaml
from mtv_world_ros.core.data_types import BoolArray, ByteArray
from mtv_world_ros.data.episode import MASKS_BY
from mtv_world_ros.data.episode_writer import EpisodeWriter
from mtv_world_ros.importing.object_boxes import BoxedObjects
from mtv_world_ros.vision.describers.describer import Describer, name_objects
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

#: minimum number of frames that are segmented in one call; the next call continues from the masks
#: of its last frame
_MIN_BATCH_FRAMES = 32
#: memory of the frames of one call; small frames fill it in larger batches [bytes]
_BATCH_BYTES = 64 * 2**20


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectStage:
    """Describer and segmenter that name the objects of imported episodes and find their masks.

    Attributes:
        describer: names the objects; None = the mapping or the recording names them.
        segmenter: finds the masks that are stored; None = recorded masks are kept.
        boxed: objects with boxes, which start the masks of their recordings.
        key: text that changes with any of the three.
    """

    describer: Describer | None = None
    segmenter: Segmenter | None = None
    boxed: BoxedObjects | None = None
    key: bytes = b''

    def names(
        self,
        recording: str,
        instruction: str,
        first_frame: Callable[[], ByteArray],
        *,
        given: Sequence[str] = (),
        stored: Sequence[str] = (),
    ) -> tuple[str, ...]:
        """Return the names to store, by `name_objects`.

        The colour words of an instruction are stored only with masks. Objects with boxes go
        before all others.

        Raises:
            DescriptionError: the describer failed.
        """
        drawn = () if self.boxed is None else self.boxed.boxes.names(recording)
        if drawn:
            return drawn
        if self.describer is None and self.segmenter is None:
            return tuple(given or stored)
        return name_objects(
            instruction,
            given=given,
            describer=self.describer,
            first_frame=first_frame,
            stored=stored,
        )

    def masks(self, recording: str, writer: EpisodeWriter) -> MaskWriter:
        """Return the step that finds and stores the masks of an episode's objects."""
        if self.segmenter is not None and writer.objects:
            writer.metadata[MASKS_BY] = self.segmenter.name
        starts = {} if self.boxed is None else self.boxed.starts.get(recording, {})
        return MaskWriter(
            writer=writer, segmenter=self.segmenter, _last=dict(_starts(starts, writer.objects))
        )


def _starts(
    starts: Mapping[str, tuple[ByteArray, Mapping[str, BoolArray]]], names: Sequence[str]
) -> Iterator[tuple[str, tuple[BoolArray, ByteArray]]]:
    """Yield by view the masks (O, H, W) that were drawn in its first frame, and the frame."""
    for view, (frame, drawn) in starts.items():
        none = np.zeros(frame.shape[:2], np.bool_)
        yield view, (np.stack([drawn.get(name, none) for name in names]), frame)


#: stores what the mapping and the recording say
AS_RECORDED = ObjectStage()


def stage_key(describer: Path | None, segmenter: str) -> bytes:
    """Return a digest of the describer's file, its list of objects, and the segmenter."""
    if describer is None:
        return segmenter.encode()
    values = read_yaml(describer, 'describer file', '--describer')
    listed = values.get('list') if isinstance(values, dict) else None
    file = describer.parent / listed if isinstance(listed, str) else None
    require_regular(describer)
    more = file.read_bytes() if file is not None and file.is_file() else b''
    return b'\0'.join([segmenter.encode(), describer.read_bytes(), more])


@dataclass(slots=True, kw_only=True)
class MaskWriter:
    """Writer of the masks of frames that are added view by view, in order of time.

    Attributes:
        writer: writer of the episode; its objects are looked for.
        segmenter: finds them; None = nothing is written.
    """

    writer: EpisodeWriter
    segmenter: Segmenter | None
    _waiting: dict[str, list[tuple[int, ByteArray]]] = field(default_factory=dict)
    _last: dict[str, tuple[BoolArray, ByteArray]] = field(default_factory=dict)

    def add(self, view: str, stamp_ns: int, frame: ByteArray) -> None:
        """Take a frame (H, W, 3) uint8 RGB; its mask is written now or later."""
        if self.segmenter is None or not self.writer.objects:
            return
        waiting = self._waiting.setdefault(view, [])
        waiting.append((stamp_ns, frame))
        if len(waiting) >= max(_MIN_BATCH_FRAMES, _BATCH_BYTES // frame.nbytes):
            self._write(view)

    def finish(self) -> None:
        """Write the masks of the frames that wait."""
        for view in self._waiting:
            self._write(view)

    def _write(self, view: str) -> None:
        waiting, self._waiting[view] = self._waiting[view], []
        if not waiting or self.segmenter is None:
            return
        names = tuple(self.writer.objects)
        frames = np.stack([frame for _, frame in waiting])
        before: dict[str, Any] = {}
        if view in self._last:
            masks, frame = self._last[view]
            before = {'first_masks': masks[None], 'first_frames': frame[None]}
        found = self.segmenter.segment(frames[None], names, **before)
        certain = np.array([word == 'ok' for word in found.status[0]])
        masks = found.masks[0] & certain[:, None, None, None]  # (O, T, H, W)
        ids = np.zeros(frames.shape[:3], np.uint8)
        for number, mask in enumerate(masks, start=1):
            ids[mask] = number
        for (stamp_ns, _), row in zip(waiting, ids, strict=True):
            self.writer.write_mask(view, stamp_ns, row)
        self._last.pop(view, None)
        if masks[:, -1].any((-2, -1)).all():  # else an object is looked for anew
            self._last[view] = masks[:, -1], frames[-1]
