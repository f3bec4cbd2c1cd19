"""Contact sheet of flips: commands that change the true outcome, and what was imagined of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mtv_world_ros.bench.collect.contact_sheet import titled
from mtv_world_ros.bench.expert.faults.catalogue import EXPERT
from mtv_world_ros.bench.ranking.optimism import is_contact, name_of, read_last_frames
from mtv_world_ros.bench.ranking.rollout_jobs import Result
from mtv_world_ros.data_types import ByteArray

#: paper between the pictures [px]
_GAP = 6


def flip_sheet(
    results: Sequence[Result], flips: Mapping[str, bool], folder: Path, count: int = 6
) -> ByteArray | None:
    """Returns a picture (H, W, 3) uint8 RGB of flips of contact; None = there are none.

    A row is a flip: the last frames under the expert's commands and under the faulty ones, real
    above imagined. The flips are spread evenly over all, whether they were imagined or not.

    Args:
        results: of a ranking.
        flips: see `Optimism.flips`.
        folder: with the last frames.
        count: rows at most.
    """
    experts = {(r.task, r.index): r for r in results if r.policy == EXPERT}
    found = sorted(
        (r for r in results if name_of(r) in flips and is_contact(r)),
        key=lambda r: (r.policy, name_of(r)),
    )
    chosen = np.linspace(0, len(found), min(count, len(found)), endpoint=False).astype(int)
    rows: list[ByteArray] = []
    for result in (found[number] for number in chosen):
        expert = experts[result.task, result.index]
        scene = f'{result.task} {result.index}'
        word = 'imagined' if flips[name_of(result)] else 'not imagined'
        blocks = [
            titled(f'{scene}, expert: {_word(expert)}', _picture(expert, folder)),
            titled(f'{result.policy}: {_word(result)}; {word}', _picture(result, folder)),
        ]
        gap = np.full((len(blocks[0]), _GAP, 3), 255, np.uint8)
        row = np.concatenate([blocks[0], gap, blocks[1]], axis=1)
        rows += [row, np.full((_GAP, row.shape[1], 3), 255, np.uint8)]
    return np.concatenate(rows) if rows else None


def _picture(result: Result, folder: Path) -> ByteArray:
    frames = read_last_frames(folder / f'{name_of(result)}.png')
    assert frames is not None  # a flip has both
    real, imagined = (np.repeat(np.repeat(half, 2, axis=0), 2, axis=1) for half in frames)
    return np.concatenate([real, np.full((2, real.shape[1], 3), 255, np.uint8), imagined])


def _word(result: Result) -> str:
    return 'succeeds' if result.final else 'fails'
