"""Flips: commands that change the true outcome of a scene, and whether that was imagined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from mtv_world_ros.core.data_types import BoolArray, ByteArray
from mtv_world_ros.core.images import encode_png
from mtv_world_ros.ranking.jobs import Result
from mtv_world_ros.ranking.judges import is_contact
from mtv_world_ros.simulation.collect.contact_sheet import titled_picture
from mtv_world_ros.simulation.faults.catalogue import EXPERT

#: suffix of pictures with object masks
OBJECTS = '.objects.png'
#: gap between pictures [px]
_GAP_PX = 6


def find_flips(results: Sequence[Result], folder: Path) -> dict[str, bool]:
    """Return which flips are imagined; see `Optimism.flips`.

    Args:
        results: the rollouts of all policies.
        folder: folder with their last frames as `last_frames_png` writes them, `<name>.png`, and
            where objects are, `<name>.objects.png`; rollouts without are left out.
    """
    experts = {(r.task, r.index): r for r in results if r.policy == EXPERT}
    found = {}
    for result in results:
        expert = experts.get((result.task, result.index))
        if expert is None or result.final == expert.final:
            continue
        names = [r.name for r in (result, expert)]
        own, other = (read_last_frames(folder / f'{name}.png') for name in names)
        masks = [_read_objects(folder / f'{name}{OBJECTS}') for name in names]
        if own is not None and other is not None and masks[0] is not None and masks[1] is not None:
            found[result.name] = is_nearer(own[1], own[0], other[0], masks[0] | masks[1])
    return found


def is_nearer(imagined: ByteArray, real: ByteArray, other: ByteArray, objects: BoolArray) -> bool:
    """Return whether imagined frames are nearer to the real ones than to others, (..., 3) each.

    By squared distance over the pixels of objects (...) in which the real ones and the others
    differ.
    """
    differs = (real != other).any(-1) & objects
    shown, *ends = (frames[differs].astype(np.float64) for frames in (imagined, real, other))
    near, far = (((shown - end) ** 2).sum() for end in ends)
    return bool(near < far)


def last_frames_png(real: ByteArray, imagined: ByteArray) -> bytes:
    """Return a PNG of a rollout's last frames (V, H, W, 3): views in a row, real ones on top."""
    rows = [np.concatenate(list(frames), axis=1) for frames in (real, imagined)]
    return encode_png(np.concatenate(rows))


def objects_png(masks: BoolArray) -> bytes:
    """Return a PNG of where objects (V, N, H, W) are: white, views in a row."""
    shown = np.concatenate([view.any(axis=0) for view in masks], axis=1)
    return encode_png(np.repeat(255 * shown[..., None].astype(np.uint8), 3, axis=-1))


def _read_objects(path: Path) -> BoolArray | None:
    """Return (H, V * W) of `objects_png`; None = there is no such file."""
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    return None if picture is None else np.asarray(picture > 127)


def read_last_frames(path: Path) -> tuple[ByteArray, ByteArray] | None:
    """Return both rows of `last_frames_png` (H, V * W, 3) RGB; None = there is no such file."""
    picture = cv2.imread(str(path)) if path.is_file() else None
    if picture is None:
        return None
    picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)
    half = len(picture) // 2
    return picture[:half], picture[half:]


def flip_sheet(
    results: Sequence[Result], flips: Mapping[str, bool], folder: Path, count: int = 6
) -> ByteArray | None:
    """Return a picture (H, W, 3) uint8 RGB of flips of contact; None = there are none.

    A row is a flip: the last frames under the expert's commands and under the faulty ones, real
    above imagined. The flips are spread evenly over all, whether they were imagined or not.

    Args:
        results: the rollouts of a ranking.
        flips: see `Optimism.flips`.
        folder: the folder of their last frames.
        count: rows at most.
    """
    experts = {(r.task, r.index): r for r in results if r.policy == EXPERT}
    found = sorted(
        (r for r in results if r.name in flips and is_contact(r)),
        key=lambda r: (r.policy, r.name),
    )
    chosen = np.linspace(0, len(found), min(count, len(found)), endpoint=False).astype(int)
    rows: list[ByteArray] = []
    for result in (found[number] for number in chosen):
        expert = experts[result.task, result.index]
        scene = f'{result.task} {result.index}'
        word = 'imagined' if flips[result.name] else 'not imagined'
        blocks = [
            titled_picture(f'{scene}, expert: {_word(expert)}', _picture(expert, folder)),
            titled_picture(f'{result.policy}: {_word(result)}; {word}', _picture(result, folder)),
        ]
        gap = np.full((len(blocks[0]), _GAP_PX, 3), 255, np.uint8)
        row = np.concatenate([blocks[0], gap, blocks[1]], axis=1)
        rows += [row, np.full((_GAP_PX, row.shape[1], 3), 255, np.uint8)]
    return np.concatenate(rows) if rows else None


def _picture(result: Result, folder: Path) -> ByteArray:
    frames = read_last_frames(folder / f'{result.name}.png')
    assert frames is not None  # a flip has both
    real, imagined = (np.repeat(np.repeat(half, 2, axis=0), 2, axis=1) for half in frames)
    return np.concatenate([real, np.full((2, real.shape[1], 3), 255, np.uint8), imagined])


def _word(result: Result) -> str:
    return 'succeeds' if result.final else 'fails'
