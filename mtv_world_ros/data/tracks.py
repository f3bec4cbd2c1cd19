"""Recorded messages put in order of their stamps: frames, joint states."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.data.episode import JointStates
from mtv_world_ros.data_types import ByteArray
from mtv_world_ros.errors import EpisodeError, MtvWorldError

Item = TypeVar('Item')


class LazyFrames:
    """Frames that are decoded when asked for (`episode.Frames`).

    Args:
        topic: where they come from, for error texts.
        messages: the image messages.
        decode: message to frame.
    """

    def __init__(
        self, topic: str, messages: Sequence[Any], decode: Callable[[Any], ByteArray]
    ) -> None:
        self._topic = topic
        self._messages = messages
        self._decode = decode

    def __len__(self) -> int:
        return len(self._messages)

    def __getitem__(self, index: Any) -> ByteArray:
        chosen = np.arange(len(self))[index]
        if chosen.ndim == 0:
            return self._frame(int(chosen))
        return self._stack([self._frame(int(i)) for i in chosen])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        frames = self[:]
        return frames if dtype is None else frames.astype(dtype, copy=False)

    def _frame(self, index: int) -> ByteArray:
        try:
            return self._decode(self._messages[index])
        except MtvWorldError as error:
            raise EpisodeError(f"'{self._topic}', frame {index}: {error}") from error

    def _stack(self, frames: list[ByteArray]) -> ByteArray:
        sizes = sorted({frame.shape[:2] for frame in frames})
        if len(sizes) > 1:
            raise EpisodeError(f"'{self._topic}': the frames have several sizes (H, W): {sizes}")
        return np.stack(frames) if frames else np.empty((0, 0, 0, 3), np.uint8)


def in_order(
    topic: str, items: Iterable[tuple[int, Item]], warnings: list[str]
) -> list[tuple[int, Item]]:
    """Sorts (stamp, item) by stamp and keeps the last of equal stamps; says so in `warnings`."""
    given = list(items)
    stamps = [stamp for stamp, _ in given]
    late = sum(b < a for a, b in zip(stamps, stamps[1:], strict=False))
    kept = dict(sorted(given, key=lambda item: item[0]))
    if late:
        warnings.append(f"'{topic}': {late} messages were out of order and have been sorted")
    if len(kept) < len(given):
        repeated = len(given) - len(kept)
        warnings.append(f"'{topic}': {repeated} stamps came twice; the later message was kept")
    return list(kept.items())


def merge_joint_states(
    topic: str, messages: Sequence[tuple[int, Any]], warnings: list[str]
) -> JointStates | None:
    """One table of sensor_msgs/JointState messages, also of several publishers.

    Joints that a message does not name keep their last position; rows before every joint was
    named once are left out.

    Returns:
        None where no row is left.
    """
    ordered = sorted(messages, key=lambda item: item[0])
    whole = [(s, m) for s, m in ordered if len(m.name) == len(m.position) > 0]
    if len(whole) < len(ordered):
        count = len(ordered) - len(whole)
        warnings.append(f"'{topic}': {count} messages without a position per joint were left out")
    names = tuple(dict.fromkeys(name for _, message in whole for name in message.name))
    column = {name: index for index, name in enumerate(names)}
    current = np.full(len(names), np.nan)
    seen = np.zeros(len(names), bool)
    rows: list[tuple[int, NDArray[np.float64]]] = []
    for stamp, message in whole:
        columns = [column[name] for name in message.name]
        current[columns] = message.position
        seen[columns] = True
        if seen.all():
            rows.append((stamp, current.copy()))
    kept = in_order(topic, rows, warnings)
    if not kept:
        return None
    return JointStates(
        stamps_ns=np.array([stamp for stamp, _ in kept], np.int64),
        joint_names=names,
        positions=np.stack([row for _, row in kept]),
    )
