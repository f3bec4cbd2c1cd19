"""Reads back what the node published, from the recorded bag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.data.bag.images import raw_to_rgb
from mtv_world_ros.data.bag.messages import deserialize, header_stamp
from mtv_world_ros.data.bag.reader import BagReader
from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.demo.processes import NODE
from mtv_world_ros.errors import EpisodeError


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedChunk:
    """A chunk as a subscriber saw it.

    Attributes:
        report: what `~/report` said of it, as text by key.
        stamps_ns: (T,) predicted times.
        predicted: (V, T, H, W, 3) uint8 RGB.
        trajectory: (V, T, H, W, 3) uint8 RGB.
    """

    report: dict[str, str]
    stamps_ns: np.ndarray
    predicted: ByteArray
    trajectory: ByteArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Predictions:
    """Everything that was recorded from the node.

    Attributes:
        chunks: in order.
        reports: all reports, as text by key.
        num_frames: predicted images received, all views.
        num_infos: CameraInfos received beside them.
    """

    chunks: tuple[RecordedChunk, ...]
    reports: tuple[dict[str, str], ...]
    num_frames: int
    num_infos: int


def read_predictions(bag: Path, views: Sequence[str]) -> Predictions:
    """Reads the bag that the recorder made.

    Raises:
        EpisodeError: no chunk in it, or a frame of a chunk is missing.
    """
    images: dict[tuple[str, int], list[ByteArray]] = {}
    reports: list[dict[str, str]] = []
    num_infos = 0
    reader = BagReader(bag)
    for message in reader.messages():
        name = message.topic.removeprefix(f'{NODE}/')
        if name.endswith('/image_raw'):
            decoded = deserialize(message.msgtype, message.data)
            key = (name.removesuffix('/image_raw'), header_stamp(decoded))
            images.setdefault(key, []).append(_pixels(decoded))
        elif name.endswith('/predicted/camera_info'):
            num_infos += 1
        elif name == 'report':
            reports += _values(deserialize(message.msgtype, message.data))
    chunks = [report for report in reports if report.get('state') == 'chunk']
    if not chunks:
        said = '; '.join(report.get('text', report.get('state', '')) for report in reports)
        raise EpisodeError(f"'{bag}' holds no imagined chunk; the node reported: {said or 'none'}")
    return Predictions(
        chunks=tuple(_chunk(report, images, views) for report in chunks),
        reports=tuple(reports),
        num_frames=sum(len(v) for k, v in images.items() if k[0].endswith('/predicted')),
        num_infos=num_infos,
    )


def _pixels(message: Any) -> ByteArray:
    return raw_to_rgb(
        np.asarray(message.data, np.uint8),
        encoding=message.encoding,
        height=message.height,
        width=message.width,
        step=message.step,
    )


def _values(array: Any) -> list[dict[str, str]]:
    return [{pair.key: pair.value for pair in status.values} for status in array.status]


def _chunk(
    report: dict[str, str],
    images: dict[tuple[str, int], list[ByteArray]],
    views: Sequence[str],
) -> RecordedChunk:
    first, last = int(report['first_stamp_ns']), int(report['last_stamp_ns'])
    count = int(report['frames'])
    stamps = sorted({s for (name, s) in images if name == f'{views[0]}/predicted'})
    inside = np.array([s for s in stamps if first <= s <= last])
    if len(inside) != count:
        raise EpisodeError(
            f'{len(inside)} of {count} frames of rollout {report.get("rollout")} chunk '
            f'{report.get("chunk")} were received'
        )
    # where rollouts overlap, a stamp was predicted twice; each chunk takes the oldest left
    frames = {
        stream: np.stack(
            [np.stack([_take(images, (f'{v}/{stream}', int(s))) for s in inside]) for v in views]
        )
        for stream in ('predicted', 'trajectory')
    }
    return RecordedChunk(
        report=report,
        stamps_ns=inside,
        predicted=frames['predicted'],
        trajectory=frames['trajectory'],
    )


def _take(images: dict[tuple[str, int], list[ByteArray]], key: tuple[str, int]) -> ByteArray:
    found = images.get(key)
    if not found:
        raise EpisodeError(f'no frame of {key[0]} at {key[1]} ns was received')
    return found.pop(0) if len(found) > 1 else found[0]
