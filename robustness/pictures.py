"""Damaged pictures from a later plan on: estimate, interval, word and reason beside real frames.

    python -m robustness.pictures [EPISODE | FOLDER]

The first plan of an episode starts from real frames. From the second one on all frames of one
view, or of all, are damaged. What must hold: no damaged row has the opposite verdict, or a
narrower interval than the real frames and another answer. The exit status is 1 if one has. For
a folder of episodes the answers are counted for each damage.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
import sys

import cv2
import numpy as np
from tqdm import tqdm

from mtv_world_ros.core.data_types import ByteArray, SuccessEstimate
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.episode_reader import list_episodes
from mtv_world_ros.data.recording import frame_indices, load_recording, Recording
from mtv_world_ros.data.recordings import commands_until
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.success.estimator import verdict_word
from robustness.node_messages import commit

#: damages frames (V, T, H, W, 3) of all views; the second argument is the recorded index of each
Damage = Callable[[ByteArray, np.ndarray], ByteArray]


def _each(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """Return the damage that changes every picture (H, W, 3) by itself."""

    def damage(frames: ByteArray, rows: np.ndarray) -> ByteArray:
        del rows
        return np.stack([[change(frame) for frame in view] for view in frames])

    return damage


def _turned(degrees: float) -> Callable[[np.ndarray], np.ndarray]:
    def turn(frame: np.ndarray) -> np.ndarray:
        height, width = frame.shape[:2]
        matrix = cv2.getRotationMatrix2D((width / 2, height / 2), degrees, 1.0)
        return cv2.warpAffine(frame, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)

    return turn


def _shifted(share: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda frame: np.roll(frame, round(share * frame.shape[1]), axis=1)


def _hand(frame: np.ndarray) -> np.ndarray:
    height, width = frame.shape[:2]
    shown = frame.copy()
    axes = (round(0.3 * width), round(0.42 * height))
    cv2.ellipse(shown, (width // 2, height // 2), axes, 20, 0, 360, (205, 160, 130), -1)
    return shown


def _jpeg(frame: np.ndarray) -> np.ndarray:
    _, data = cv2.imencode('.jpg', frame, [cv2.IMWRITE_JPEG_QUALITY, 4])
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded


def _overexposed(frame: np.ndarray) -> np.ndarray:
    return np.minimum(frame.astype(np.float32) * 4.0 + 60, 255).astype(np.uint8)


def _noise(frame: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, frame.shape, dtype=np.uint8)


def damages(recording: Recording, others: ByteArray | None) -> dict[str, Damage]:
    """Return the damages by name.

    Args:
        recording: the episode.
        others: (V, H, W, 3) pictures of another scene at the model's size; None = no such row.
    """
    delay = round(1.0 / float(np.diff(recording.times).mean()))

    def of_rows(change: Callable[[np.ndarray], np.ndarray]) -> Damage:
        def damage(frames: ByteArray, rows: np.ndarray) -> ByteArray:
            size = frames.shape[2:4]
            shown = recording.frames[:, change(rows)]
            return np.stack([[_resized(f, size) for f in view] for view in shown])

        return damage

    found = {
        'black': _each(np.zeros_like),
        'noise': _each(_noise),
        'frozen at the first frame': of_rows(np.zeros_like),
        'delayed by 1 s': of_rows(lambda rows: np.maximum(rows - delay, 0)),
        'upside down': _each(lambda frame: frame[::-1, ::-1]),
        'turned by 10 degrees': _each(_turned(10)),
        'mirrored': _each(lambda frame: frame[:, ::-1]),
        'shifted by a quarter': _each(_shifted(0.25)),
        'shifted by a tenth': _each(_shifted(0.104)),
        'cameras exchanged': lambda frames, rows: frames[::-1],
        'a hand before the lens': _each(_hand),
        'JPEG of quality 4': _each(_jpeg),
        'overexposed': _each(_overexposed),
    }
    if others is not None:
        found['another scene'] = lambda frames, rows: np.stack(
            [
                np.repeat(_resized(other, frames.shape[2:4])[None], frames.shape[1], axis=0)
                for other in others
            ]
        )
    return found


def _resized(frame: np.ndarray, size: Sequence[int]) -> np.ndarray:
    return cv2.resize(frame, (size[1], size[0]), interpolation=cv2.INTER_AREA)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Estimate of the last plan under a damage.

    Attributes:
        name: the damage.
        views: the damaged views.
        success: estimate at the end of the plan.
    """

    name: str
    views: str
    success: SuccessEstimate

    @property
    def word(self) -> str:
        """`success`, `failure`, `open`, or `no verdict` if there is no estimate."""
        if not isfinite(self.success.probability):
            return 'no verdict'
        return verdict_word(self.success.probability, self.success.interval)

    def is_surer_than(self, real: Row) -> bool:
        """Return True if it has another answer than real frames, and dares to.

        That is an opposite verdict, or another one with a narrower interval.
        """
        if not isfinite(self.success.probability):
            return False
        if {self.word, real.word} == {'success', 'failure'}:
            return True
        widths = [high - low for low, high in (self.success.interval, real.success.interval)]
        is_other = (
            self.word != real.word
            or abs(self.success.probability - real.success.probability) > 0.1
        )
        return is_other and widths[0] < widths[1]

    def line(self, real: Row | None) -> str:
        """Return the row of a Markdown table."""
        low, high = self.success.interval
        shown = (
            f'{self.success.probability:.2f} [{low:.2f}, {high:.2f}]'
            if isfinite(self.success.probability)
            else '–'
        )
        reason = next(iter(self.success.reasons), '').removeprefix('cannot tell, because ')
        mark = '' if real is None else 'SURER' if self.is_surer_than(real) else 'no'
        return f'| {self.name} | {self.views} | {shown} | {self.word} | {mark} | {reason[:150]} |'


def run(
    pipeline: Pipeline,
    recording: Recording,
    plan: int,
    damage: Damage | None = None,
    views: Sequence[int] = (),
    first_plan: int = 0,
) -> SuccessEstimate:
    """Return the estimate of a later plan, whose frames until its start are damaged.

    Args:
        pipeline: imagines and judges.
        recording: the episode.
        plan: number of the plan, from 1 on; plan 0 starts from the first real frame.
        damage: changes the frames after the first plan's start; None = real frames.
        views: indices of the damaged views.
        first_plan: the plan after whose start frames are damaged.
    """
    options = RolloutOptions(instruction=recording.instruction)
    rows = frame_indices(recording, 0, pipeline.spec, plan * pipeline.spec.num_frames)
    assert rows is not None
    episode, length = pipeline.begin(recording.observation(0), options), pipeline.spec.num_frames
    for number in range(plan):
        chunk = rows[number * length : (number + 1) * length + 1]
        frames = recording.frames[:, chunk[1:]].copy()
        start = recording.observation(int(chunk[-1]))
        if damage is not None and number >= first_plan:
            damaged = damage(frames, chunk[1:])
            large, shown = damage(start.frames[:, None], chunk[-1:])[:, 0], start.frames.copy()
            for view in views:
                frames[view], shown[view] = damaged[view], large[view]
            start = replace(start, frames=shown)
        episode.observe(frames, recording.positions[chunk])
        episode = episode.branch(start)
    left_s = float(recording.times[-1] - recording.times[rows[-1]])
    *_, last = episode.extend(commands_until(recording, int(rows[-1]), left_s))
    return last.success


def table(pipeline: Pipeline, recording: Recording, others: ByteArray | None) -> list[Row]:
    """Return the row of real frames, then one for each damage and set of views."""
    names = pipeline.spec.views
    sets = [(*range(len(names)),), (0,)] if len(names) > 1 else [(0,)]
    rows = [Row(name='real frames', views='', success=run(pipeline, recording, 1))]
    for name, damage in damages(recording, others).items():
        for views in sets:
            success = run(pipeline, recording, 1, damage, views)
            shown = 'all' if len(views) == len(names) else ', '.join(names[v] for v in views)
            rows.append(Row(name=name, views=shown, success=success))
    return rows


def answer(row: Row, real: Row) -> str:
    """Return what became of the answer of real frames; one of `ANSWERS`."""
    if not isfinite(row.success.probability):
        return 'no verdict'
    if row.is_surer_than(real):
        return 'SURER'
    if row.word == real.word:
        return 'the same'
    return 'open' if row.word == 'open' else 'another, wider'


#: what becomes of an answer, from best to worst
ANSWERS = ('no verdict', 'the same', 'open', 'another, wider', 'SURER')


def sweep(pipeline: Pipeline, folder: Path) -> int:
    """Print how often each damage has each answer over all episodes that have a second plan.

    Returns:
        The number of answers that are surer.
    """
    counts: dict[tuple[str, str], Counter[str]] = {}
    words: Counter[str] = Counter()
    surer = 0
    for path in tqdm(list_episodes(folder), desc='episodes', mininterval=30):
        recording = load_recording(path, pipeline.spec, pipeline.robot)
        if frame_indices(recording, 0, pipeline.spec, pipeline.spec.num_frames) is None:
            continue
        real, *rows = table(pipeline, recording, None)
        words[real.word] += 1
        for row in rows:
            found = answer(row, real)
            counts.setdefault((row.name, row.views), Counter())[found] += 1
            if found == 'SURER':
                surer += 1
                print(f'{path.name}: {row.line(real)} real: {real.line(None)}', file=sys.stderr)
    print(f'{sum(words.values())} episodes; real frames: {dict(words)}; commit {commit()}\n')
    print(f'| pictures | views | {" | ".join(ANSWERS)} |')
    print(f'|---|---|{"---|" * len(ANSWERS)}')
    for (name, views), found in counts.items():
        cells = ' | '.join(str(found[word]) for word in ANSWERS)
        print(f'| {name} | {views} | {cells} |')
    return surer


def main() -> int:
    """Print the table; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = share_path('resource', 'demo_episode')
    parser.add_argument('episode', nargs='?', type=Path, default=default)
    parser.add_argument('--other', type=Path, help='episode of another scene')
    arguments = parser.parse_args()
    pipeline = Pipeline.load()
    if not (arguments.episode / 'metadata.yaml').is_file():
        return int(sweep(pipeline, arguments.episode) > 0)
    recording = load_recording(arguments.episode, pipeline.spec, pipeline.robot)
    others = None
    if arguments.other is not None:
        other = load_recording(arguments.other, pipeline.spec, pipeline.robot)
        others = other.frames[:, len(other.times) // 2]
    rows = table(pipeline, recording, others)
    print(f'{arguments.episode.name}, commit {commit()}, damaged from plan 1 on\n')
    print('| pictures | views | estimate | word | surer, and another answer | first reason |')
    print('|---|---|---|---|---|---|')
    for row in rows:
        print(row.line(None if row is rows[0] else rows[0]))
    return int(any(row.is_surer_than(rows[0]) for row in rows[1:]))


if __name__ == '__main__':
    sys.exit(main())
