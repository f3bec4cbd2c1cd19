"""Contents of bags by time: real, drawn and imagined frames, masks, joints, reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
import re
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.data.bag.image_decoding import to_ids, to_rgb
from mtv_world_ros.data.bag.messages import (
    COMPRESSED_IMAGE,
    deserialize,
    header_stamp,
    IMAGE,
    JOINT_STATE,
)
from mtv_world_ros.data.bag.reader import BagMessage, BagReader
from mtv_world_ros.viewing.video import KINDS

#: no recording is this long [s]
_APART_S = 86_400.0
#: camera images of a view, or what the node publishes of it; also what imagination starts from
_IMAGES = re.compile(
    r'^/(?:.+/)?(?P<view>(?!(?:predicted|trajectory|mask)/)[^/]+)/'
    r'(?:(?P<stream>predicted|trajectory|mask)/)?(?:image_raw(?:/compressed)?|mask/compressed)$'
)
#: of topics that end so
_WORDS = {
    '/success': 'std_msgs/msg/Float64',
    '/report': 'diagnostic_msgs/msg/DiagnosticArray',
    '/instruction': 'std_msgs/msg/String',
}
_KINDS = {'predicted': 'imagined', 'trajectory': 'trajectory', 'mask': 'imagined', None: 'real'}


@dataclass(frozen=True, slots=True)
class Streams:
    """Streams of one bag, or of several bags of the same time, each in the order of stamps [ns].

    Attributes:
        images: (kind, view) -> stamp and (H, W, 3) uint8 RGB.
        masks: (kind, view) -> stamp and (H, W) uint8 object numbers, 0 = none.
        joints: kind (`real`, `imagined`), stamp, names and positions [rad or m].
        success: stamp and probability; NaN = abstains.
        reasons: stamp and reasons of the estimate of each chunk, as its report joins them.
        words: stamp and text: instructions, reports with the reasons of estimates.
    """

    images: dict[tuple[str, str], list[tuple[int, ByteArray]]] = field(default_factory=dict)
    masks: dict[tuple[str, str], list[tuple[int, ByteArray]]] = field(default_factory=dict)
    joints: list[tuple[str, int, tuple[str, ...], np.ndarray]] = field(default_factory=list)
    success: list[tuple[int, float]] = field(default_factory=list)
    reasons: list[tuple[int, str]] = field(default_factory=list)
    words: list[tuple[int, str]] = field(default_factory=list)

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views, in the order of the recording."""
        return tuple(dict.fromkeys(view for _, view in self.images))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of frames in the streams."""
        return tuple(kind for kind in KINDS if any(kind == found for found, _ in self.images))


def read_streams(bags: Sequence[Path]) -> Streams:
    """Read episodes and predictions, joined by time.

    Raises:
        EpisodeError: one cannot be read, none holds an image, or they are more than a day apart.
    """
    streams = Streams()
    for bag in bags:
        for message in BagReader(bag).messages():
            try:
                add_message(streams, message)
            except MtvWorldError as error:
                raise EpisodeError(f"'{bag}', topic {message.topic}: {error}") from error
    if not streams.images:
        raise EpisodeError(
            f"'{', '.join(map(str, bags))}' holds no images of cameras or of a node"
        )
    times = [item[0] for found in streams.images.values() for item in found]
    apart_s = (max(times) - min(times)) / 1e9
    if len(bags) > 1 and apart_s > _APART_S:
        raise EpisodeError(
            f"'{', '.join(map(str, bags))}' are of different times, {apart_s:.0f} s from the "
            'first image to the last; give one of them, or predictions of the same recording'
        )
    for found in (*streams.images.values(), *streams.masks.values()):
        found.sort(key=lambda item: item[0])
    streams.joints.sort(key=lambda item: item[1])
    for rows in (streams.success, streams.reasons, streams.words):
        rows.sort(key=lambda item: item[0])
    return streams


def shown_as(topic: str, msgtype: str) -> tuple[str, ...] | None:
    """Return the kind of a topic's messages, with view or topic; None = they are not shown."""
    match = _IMAGES.match(topic)
    if match and msgtype in (IMAGE, COMPRESSED_IMAGE):
        is_mask = match['stream'] == 'mask' or '/mask/' in topic
        return 'mask' if is_mask else 'image', _KINDS[match['stream']], match['view']
    if msgtype == JOINT_STATE:
        return 'joints', topic
    for suffix, wanted in _WORDS.items():
        if topic.endswith(suffix) and msgtype == wanted:
            return suffix, topic
    return None


def add_message(streams: Streams, message: BagMessage) -> None:
    """Add the data of a message.

    Raises:
        MtvWorldError: the message cannot be read.
    """
    what = shown_as(message.topic, message.msgtype)
    if what is None:
        return
    read = deserialize(message.msgtype, message.data)
    if what[0] in ('image', 'mask'):
        _take_image(streams, read, what)
    elif what[0] == 'joints':
        row = np.asarray(read.position, np.float64)
        kind = 'imagined' if message.topic.endswith('/predicted/joint_states') else 'real'
        streams.joints.append((kind, header_stamp(read), tuple(read.name), row))
    elif what[0] == '/success':
        streams.success.append((message.stamp_ns, float(read.data)))
    elif what[0] == '/report':
        texts = [f'{one.message} {_reasons(one)}'.strip() for one in read.status]
        streams.words.extend((message.stamp_ns, text) for text in texts)
        values = [{pair.key: pair.value for pair in one.values} for one in read.status]
        streams.reasons.extend(
            (message.stamp_ns, one.get('success_reasons', ''))
            for one in values
            if 'observation_stamp_ns' in one  # a chunk
        )
    else:
        streams.words.append((message.stamp_ns, f'instruction: {read.data}'))


def _reasons(status: Any) -> str:
    values: Mapping[str, str] = {pair.key: pair.value for pair in status.values}
    shown = ('success', 'success_reasons', 'state')
    return ' · '.join(f'{key}: {values[key]}' for key in shown if values.get(key))


def _take_image(streams: Streams, image: Any, what: tuple[str, ...]) -> None:
    is_mask = what[0] == 'mask'
    frame = to_ids(image) if is_mask else to_rgb(image)
    held = streams.masks if is_mask else streams.images
    held.setdefault((what[1], what[2]), []).append((header_stamp(image), frame))
