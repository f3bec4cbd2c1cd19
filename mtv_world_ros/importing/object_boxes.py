"""Boxes that somebody drew around objects in a few frames: `objects.yaml` of an import."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import AfterValidator, Field, Strict

from mtv_world_ros.core.config import expected, ListOf, Number, read_yaml, Schema, validated, wrong
from mtv_world_ros.core.data_types import BoolArray, ByteArray
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.data.episode import Episode
from mtv_world_ros.vision.segmenters.examples import Box, Example, ObjectExamples

#: minimum side length of a box [px]
LEAST_SIDE = 3
#: maximum time between a box and the nearest frame, which it belongs to [s]
_NEAR_S = 0.5
#: recordings that an error names
_LISTED = 12


def _box(row: tuple[float, ...]) -> tuple[float, ...]:
    seconds, left, top, right, bottom = row
    if seconds < 0 or min(left, top) < 0 or min(right - left, bottom - top) < LEAST_SIDE:
        raise wrong(
            'seconds of at least 0, then left, top, right, bottom [px], at least '
            f'{LEAST_SIDE} px apart'
        )
    return row


Row = Annotated[
    tuple[Number, Number, Number, Number, Number],
    Strict(False),
    expected('a list of 5 numbers: seconds, left, top, right, bottom [px]'),
    AfterValidator(_box),
]


def _named(name: str) -> str:
    if not name.strip():
        raise wrong('the name of an object')
    return name


class ObjectBoxes(Schema):
    """A file of boxes, in pixels of the recorded images."""

    section: ClassVar = ''

    boxes: dict[str, dict[str, dict[Annotated[str, AfterValidator(_named)], ListOf[Row]]]] = Field(
        description='by view, recording and object: rows of seconds from the first frame of the '
        'view on, left, top, right, bottom [px]'
    )

    @property
    def recordings(self) -> tuple[str, ...]:
        """Names of the recordings that have boxes."""
        return tuple(dict.fromkeys(name for view in self.boxes.values() for name in view))

    def names(self, recording: str) -> tuple[str, ...]:
        """Return the names of the objects of a recording, in the order of the file."""
        views = (view.get(recording, {}) for view in self.boxes.values())
        return tuple(dict.fromkeys(name for view in views for name, rows in view.items() if rows))


def load_object_boxes(path: Path) -> ObjectBoxes:
    """Read a file of boxes.

    Raises:
        ConfigError: it is missing, no YAML, or has an unknown key or a wrong value.
    """
    found = validated(ObjectBoxes, read_yaml(path, 'file of boxes', '--objects'), f"'{path}'")
    if not any(map(found.names, found.recordings)):
        raise ConfigError(f"'{path}': 'boxes' is empty; draw one around an object")
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxedObjects:
    """Object examples and start masks from boxes that a user drew.

    Attributes:
        boxes: boxes as the user drew them.
        examples: appearance of the objects in their boxes.
        starts: first frame (H, W, 3) uint8 RGB and masks (H, W) of the objects that have a box in
            it, by recording and view.
        missing: recordings that have boxes and are not among those of the import.
    """

    boxes: ObjectBoxes
    examples: ObjectExamples
    starts: Mapping[str, Mapping[str, tuple[ByteArray, Mapping[str, BoolArray]]]]
    missing: tuple[str, ...] = ()

    @property
    def note(self) -> str:
        """Line on the boxes that are not used; empty = all are."""
        if not self.missing:
            return ''
        rest = len(self.missing) - _LISTED
        names = ', '.join(self.missing[:_LISTED]) + (f' and {rest} more' if rest > 0 else '')
        return (
            f'objects: boxes of {len(self.missing)} of {len(self.boxes.recordings)} recordings '
            f'are not used, as they are not in the folder: {names}'
        )


def learn_objects(
    boxes: ObjectBoxes, found: Mapping[str, Any], read: Callable[[Any], Episode]
) -> BoxedObjects:
    """Cut the objects out of the frames in which they have boxes.

    Args:
        boxes: boxes as the user drew them.
        found: the recordings of the import by name; boxes of others are not used.
        read: reads a recording.

    Raises:
        ConfigError: none of the recordings, or a view, is there, or a box lies outside of the
            frame or time.
    """
    missing = tuple(name for name in boxes.recordings if name not in found)
    if len(missing) == len(boxes.recordings):
        raise ConfigError.unknown(
            'objects: there is no recording',
            missing[0],
            found,
            listed=', nor any other that has boxes; there are',
            most=_LISTED,
        )
    frames: list[tuple[ByteArray, dict[str, Box]]] = []
    starts: dict[str, dict[str, tuple[ByteArray, Mapping[str, BoolArray]]]] = {}
    for name in boxes.recordings:
        if name in missing:
            continue
        episode = read(found[name])
        for view, rows in boxes.boxes.items():
            by_frame = _by_frame(episode, name, view, rows.get(name, {}))
            for index, drawn in by_frame.items():
                frame = np.asarray(episode.images[view].frames[index])
                _check_inside(drawn, frame, name, view)
                frames.append((frame, drawn))
                if index == 0:
                    masks = {n: _whole_mask(n, frame, box) for n, box in drawn.items()}
                    starts.setdefault(name, {})[view] = frame, masks
    return BoxedObjects(
        boxes=boxes, examples=ObjectExamples.of(frames), starts=starts, missing=missing
    )


def _by_frame(
    episode: Episode, recording: str, view: str, rows: Mapping[str, tuple[Any, ...]]
) -> dict[int, dict[str, Box]]:
    """Return the boxes by name, by number of the frame."""
    if rows and view not in episode.images:
        raise ConfigError.unknown(
            'objects: there is no view', view, episode.views, listed='; there are'
        )
    found: dict[int, dict[str, Box]] = {}
    for name, drawn in rows.items():
        stamps = episode.images[view].stamps_ns
        times = (stamps - stamps[0]) * 1e-9
        for seconds, *box in drawn:
            index = int(np.abs(times - seconds).argmin())
            if abs(times[index] - seconds) > _NEAR_S:
                raise ConfigError(
                    f"objects: '{recording}', view '{view}', '{name}': there is no frame at "
                    f'{seconds:g} s; the recording has {times[-1]:.1f} s'
                )
            found.setdefault(index, {})[name] = tuple(box)
    return found


def _check_inside(drawn: Mapping[str, Box], frame: ByteArray, recording: str, view: str) -> None:
    height, width = frame.shape[:2]
    for name, (left, top, right, bottom) in drawn.items():
        if right > width or bottom > height:
            raise ConfigError(
                f"objects: '{recording}', view '{view}', '{name}': the box [{left:g}, {top:g}, "
                f'{right:g}, {bottom:g}] is not inside of the frame, {width} x {height} px'
            )
        if (right - left) * (bottom - top) > width * height / 2:
            raise ConfigError(
                f"objects: '{recording}', view '{view}', '{name}': the box covers more than half "
                'of the frame; draw it around the object alone'
            )


def _whole_mask(name: str, frame: ByteArray, box: Box) -> BoolArray:
    """Return the mask (H, W) of the object in a box."""
    example = Example.in_box(name, frame, box)
    left, top, right, bottom = (round(edge) for edge in box)
    x, y = max(0, left - (right - left)), max(0, top - (bottom - top))
    mask = np.zeros(frame.shape[:2], np.bool_)
    mask[y : y + example.mask.shape[0], x : x + example.mask.shape[1]] = example.mask
    return mask
