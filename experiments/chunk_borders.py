"""Do masks that remember the episode keep objects in whole rollouts? Trials without training.

    python experiments/chunk_borders.py data/test --out out/chunk_borders

Each chunk after the first starts from an imagined frame, in which arms half hide objects, and its
control shows what the segmenter finds there. Variants of that search, for a checkpoint whose
control shows the masks of the first frame:

- `found`: as the pipeline has it.
- `lost`: an object that is not found keeps its last mask.
- `carried`: as `lost`; and an object of which less than `VISIBLE` of its last whole mask shows
  gets that whole mask, placed where it covers the visible part best.
- `stays`: as `carried`; and an object keeps its last whole mask where the picture under that mask
  is still the same, whatever is found elsewhere: an object cannot be at two places.

Whole episodes are imagined with their own commands. Printed are J of moving objects and the
differences from `found`, paired by episode, with 95 % t intervals. The same command goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from mtv_world_ros.core.data_types import BoolArray, ByteArray, ObjectMasks
from mtv_world_ros.core.documents import DASH, Table
from mtv_world_ros.data.splits import EVERY, select
from mtv_world_ros.evaluation.evaluate_episodes import evaluate
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary
from mtv_world_ros.evaluation.metrics.statistics import mean_interval
from mtv_world_ros.evaluation.result_settings import fingerprint
from mtv_world_ros.evaluation.settings import EvaluationConfig
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.state import RolloutState

FOUND, LOST, CARRIED, STAYS = VARIANTS = ('found', 'lost', 'carried', 'stays')
#: an object of which less shows is taken to be partly hidden [fraction of its last whole mask]
VISIBLE = 0.8
#: least part of the visible pixels that the placed mask covers [fraction]
AGREEMENT = 0.7
#: greatest median difference under a mask by which a picture is the same, of 255
SAME = 10.0
#: what a pixel of displacement costs, against covered pixels; breaks ties alone
_DISPLACEMENT_COST = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class RememberingPipeline(Pipeline):
    """Pipeline whose search remembers the masks of the episode; one rollout at a time.

    Attributes:
        variant: one of `VARIANTS`.
        whole: last whole masks (V, O, H, W), by name `whole`, and the last ones, `last`.
        seen: start frames (V, O, H, W, 3) of the last whole masks, by name `frames`.
    """

    variant: str = FOUND
    whole: dict[str, BoolArray] = field(default_factory=dict)
    seen: dict[str, ByteArray] = field(default_factory=dict)

    @classmethod
    def of(cls, pipeline: Pipeline, variant: str) -> RememberingPipeline:
        """Return a pipeline with a variant of the search."""
        held = {item.name: getattr(pipeline, item.name) for item in fields(Pipeline)}
        return cls(**held, variant=variant)

    def find(self, state: RolloutState, options: RolloutOptions) -> ObjectMasks:
        """Return masks of the frame that a chunk starts from (T = 1)."""
        found = Pipeline.find(self, state, options)
        first, frames = found.masks[:, :, 0], state.observation.frames
        if not state.num_imagined:
            self.whole.update(whole=first.copy(), last=first.copy())
            self.seen['frames'] = np.repeat(frames[:, None], first.shape[1], 1)
            return found
        if self.variant == FOUND:
            return found
        shown = first.copy()
        followed = None if state.followed is None else state.followed.masks.masks[:, :, 0]
        for index in np.ndindex(*first.shape[:2]):
            tracked = None if followed is None else followed[index]
            if self.variant == STAYS and self._stays(frames[index[0]], index):
                shown[index] = self.whole['whole'][index]
                self.whole['last'][index] = shown[index]
                continue
            shown[index] = self._remembered(first[index], tracked, index)
            if (shown[index] == self.whole['whole'][index]).all():
                self.seen['frames'][index] = frames[index[0]]
        return replace(found, masks=shown[:, :, None])

    def _stays(self, frame: ByteArray, index: tuple[int, ...]) -> bool:
        """Whether the picture under an object's last whole mask is what it was."""
        whole = self.whole['whole'][index]
        if not whole.any():
            return False
        now, then = (
            picture[whole].astype(float) for picture in (frame, self.seen['frames'][index])
        )
        return float(np.median(np.abs(now - then).max(-1))) < SAME

    def _remembered(
        self, mask: BoolArray, followed: BoolArray | None, index: tuple[int, ...]
    ) -> BoolArray:
        """Return the mask (H, W) of an object as the control shows it, and remember it."""
        whole = self.whole['whole'][index]
        if not whole.any():
            return mask
        if not mask.any():
            known = followed is not None and followed.any()
            return followed if known else self.whole['last'][index]  # type: ignore[return-value]
        self.whole['last'][index] = mask
        if mask.sum() >= VISIBLE * whole.sum():
            self.whole['whole'][index] = mask
            return mask
        return placed(whole, mask) if self.variant == CARRIED else mask


def placed(whole: BoolArray, visible: BoolArray) -> BoolArray:
    """Return the visible part (H, W), with a whole mask moved to where it covers it best.

    The visible part alone where no place covers `AGREEMENT` of it.
    """
    shape, seen = np.argwhere(whole), np.argwhere(visible)
    middle = np.rint(seen.mean(0) - shape.mean(0))
    best, result = -np.inf, visible
    low, high = seen.min(0) - shape.max(0), seen.max(0) - shape.min(0)
    for down in range(low[0], high[0] + 1):
        for right in range(low[1], high[1] + 1):
            moved = _moved(shape + (down, right), whole.shape)
            away = abs(down - middle[0]) + abs(right - middle[1])
            covered = (moved & visible).sum() - _DISPLACEMENT_COST * away
            if covered > best:
                best, result = covered, moved
    return visible | result if best >= AGREEMENT * visible.sum() else visible


def _moved(points: np.ndarray, shape: tuple[int, ...]) -> BoolArray:
    inside = ((points >= 0) & (points < shape)).all(1)
    mask = np.zeros(shape, np.bool_)
    mask[tuple(points[inside].T)] = True
    return mask


def moving_jaccard(summary: EvaluationSummary, key: str = 'j_moving') -> dict[str, float]:
    """Return J of moving objects by episode; NaN where nothing moves."""
    return {result.episode: result.means(None)[key] for result in summary.results}


def differences(scores: dict[str, dict[str, float]]) -> list[tuple[str, ...]]:
    """Return rows: variant, episodes, J of moving objects, difference from the first variant."""
    base = next(iter(scores.values()))
    known = [name for name, value in base.items() if np.isfinite(value)]
    rows = []
    for variant, found in scores.items():
        values = np.array([found[name] for name in known])
        gain = values - [base[name] for name in known]
        _, ((low,), (high,)) = mean_interval(gain[:, None], np.ones((len(gain), 1)), low=-1.0)
        text = f'{gain.mean():+.4f} [{low:+.4f}, {high:+.4f}]' if variant != FOUND else DASH
        rows.append((variant, str(len(known)), f'{values.mean():.4f}', text))
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Evaluate the variants, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('dataset', type=Path, help='folder of episodes')
    parser.add_argument('--out', type=Path, required=True, help='folder of the results')
    parser.add_argument('--checkpoint', default='bundled-paper')
    options = parser.parse_args(arguments)
    checkpoint = Checkpoint.open(options.checkpoint)
    pipeline = Pipeline.load(checkpoint, num_threads=1)
    summaries = {}
    for variant in VARIANTS:
        summaries[variant] = evaluate(
            RememberingPipeline.of(pipeline, variant),
            select(options.dataset, EVERY, None).paths,
            options.out / variant,
            EvaluationConfig(mode='imagine', actions=('true',), ceiling=False),
            name=f'{variant}: {fingerprint(checkpoint)}',
        )
    for key, words in (('j_moving', 'truth'), ('j_moving_either', 'truth or imagination')):
        scores = {variant: moving_jaccard(found, key) for variant, found in summaries.items()}
        head = ('masks at a border', 'episodes', f'J, moves in {words}', 'difference')
        print(Table(head=head, rows=tuple(differences(scores))).markdown(), end='\n\n')
    for variant, found in summaries.items():
        print(f'{variant}: {found.dreams.line}')


if __name__ == '__main__':
    main()
