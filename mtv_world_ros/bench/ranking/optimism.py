"""How optimistic imagination is: real failures called a success, and commands that are ignored.

Beside the judge that sees imagined pictures and foreseen motions stand those that have one of the
two alone, one that sees none (`no_picture_rule`) and one that sees the simulator's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite, nan
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.special import expit, logit

from mtv_world_ros.bench.expert.faults.catalogue import EXPERT, FAULTS, in_order, parse_variant
from mtv_world_ros.bench.ranking.judges import agreements, judged_by, JUDGES, probabilities, RULE
from mtv_world_ros.bench.ranking.rollout_jobs import Result
from mtv_world_ros.data_types import BoolArray, ByteArray, FloatArray
from mtv_world_ros.lab.evaluation.metrics.statistics import (
    clustered_wilson,
    Interval,
    MIN_SCENES,
    t_quantile,
    UNKNOWN,
)
from mtv_world_ros.rendering.images import encode_png

#: end of the names of pictures of where objects are
OBJECTS = '.objects.png'
#: what is measured of each judge, in the order of the tables
MEASURES = {
    'pearson': 'r observed',
    'pearson_noise_free': 'r noise-free',
    'mmrv': 'MMRV observed',
    'mmrv_noise_free': 'MMRV noise-free',
    'auroc': 'AUROC',
    'false_success': 'false success',
    'abstention': 'no verdict',
    'contact_flips': 'flips, contact',
    'flips': 'flips, all',
    'over_rule': 'AUROC - rule',
}
Scene = tuple[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """A number, its 95 % interval and what it was counted over; NaN = not defined.

    Attributes:
        value: the number.
        interval: 95 %.
        count: policies, rollouts, failures or flips, as the measure has it.
    """

    value: float = nan
    interval: Interval = UNKNOWN
    count: int = 0

    @classmethod
    def share(cls, results: Sequence[Result], is_hit: Callable[[Result], bool]) -> Score:
        """Returns the share of rollouts that are hits; those of a scene are a cluster."""
        counts: dict[Scene, list[bool]] = {}
        for result in results:
            counts.setdefault((result.task, result.index), []).append(is_hit(result))
        hits = np.array([sum(found) for found in counts.values()], np.float64)
        trials = np.array([len(found) for found in counts.values()], np.float64)
        return cls(
            value=float(hits.sum() / trials.sum()) if len(results) else nan,
            interval=clustered_wilson(hits, trials),
            count=len(results),
        )

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        return {'value': self.value, 'interval': self.interval, 'count': self.count}


@dataclass(frozen=True)
class Optimism:
    """The benchmark's numbers over a ranking's rollouts.

    Attributes:
        results: one a rollout; some of the policy `expert`.
        flips: of rollouts whose true outcome is another than the expert's in the same scene, by
            `name_of`: whether the imagined last frame is nearer to what really happened than to
            what happened under the expert's commands, where objects are in either. Arms do not
            count: they follow the commands in imagination as well.
    """

    results: Sequence[Result]
    flips: Mapping[str, bool]

    @classmethod
    def of(cls, results: Sequence[Result], folder: Path) -> Optimism:
        """Returns the numbers of results whose last frames lie in a folder."""
        return cls(results=results, flips=find_flips(results, folder))

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The policies' fault kinds, in the catalogue's order."""
        met = {kind for result in self.results for kind in kinds_of(result)}
        return tuple(in_order(met))

    def rollouts(self, kind: str | None) -> list[Result]:
        """Returns the rollouts of policies with a fault kind; None = all rollouts."""
        return [r for r in self.results if kind is None or kind in kinds_of(r)]

    def scores(self, judge: str, kind: str | None = None) -> dict[str, Score]:
        """Returns the `MEASURES` of a judge.

        Args:
            judge: key of `JUDGES`.
            kind: of the policies' faults; None = all. r, MMRV and AUROC of a kind are over its
                policies and the expert.
        """
        chosen = self.rollouts(kind)
        compared = [
            r for r in self.results if kind is None or r.policy == EXPERT or kind in kinds_of(r)
        ]
        failed = [r for r in chosen if not r.final and isfinite(judged_by(r, judge).success)]
        flips = [r for r in chosen if name_of(r) in self.flips] if judge == 'imagined' else []
        of_contact = [r for r in flips if is_contact(r)]
        return {
            **self._agreement(compared, judge),
            'auroc': self._auroc(compared, judge),
            'false_success': Score.share(failed, lambda r: judged_by(r, judge).success == 1),
            'abstention': Score.share(chosen, lambda r: not isfinite(judged_by(r, judge).success)),
            'contact_flips': Score.share(of_contact, lambda r: self.flips[name_of(r)]),
            'flips': Score.share(flips, lambda r: self.flips[name_of(r)]),
            'over_rule': self._over_rule(compared, judge),
        }

    def as_json(self) -> dict[str, Any]:
        """Returns everything as plain values."""
        groups = {'all': None, **{kind: kind for kind in self.kinds}}
        return {
            group: {
                'rollouts': len(self.rollouts(kind)),
                'true_success': true_rate(self.rollouts(kind)).as_json(),
                **{
                    judge: {k: v.as_json() for k, v in self.scores(judge, kind).items()}
                    for judge in JUDGES
                },
            }
            for group, kind in groups.items()
        }

    def _agreement(self, results: Sequence[Result], judge: str) -> dict[str, Score]:
        """Pearson r and MMRV over the policies."""
        found = {}
        for name, score in agreements(results, judge).items():
            count = score.num_policies
            found[name] = Score(value=score.value, count=count)
            found[f'{name}_noise_free'] = Score(
                value=score.noise_free, interval=score.interval, count=count
            )
        return found

    def _auroc(self, results: Sequence[Result], judge: str) -> Score:
        """Over the rollouts that were judged."""
        known = [r for r in results if isfinite(judged_by(r, judge).probability)]
        return self._area(known, [probabilities(known, judge)])

    def _over_rule(self, results: Sequence[Result], judge: str) -> Score:
        """AUROC less that of the no-picture rule, over the rollouts that both judge."""
        if judge == RULE:
            return Score()
        both = [
            r
            for r in results
            if isfinite(judged_by(r, judge).probability) and isfinite(r.no_picture.probability)
        ]
        return self._area(both, [probabilities(both, judge), probabilities(both, RULE)])

    def _area(self, results: Sequence[Result], said: Sequence[FloatArray]) -> Score:
        """The first area under the ROC less the second one, if there is one."""
        real = np.array([r.final for r in results], np.bool_)
        scenes = [(r.task, r.index) for r in results]
        if real.all() or not real.any():
            return Score(count=len(results))
        value, interval = area_interval(said, real, scenes)
        return Score(value=value, interval=interval, count=len(results))


def name_of(result: Result) -> str:
    """Returns the name of a rollout's files."""
    return f'{result.task}_{result.index:05d}_{result.policy}'


def kinds_of(result: Result) -> tuple[str, ...]:
    """Returns the fault kinds of the policy."""
    return parse_variant(result.policy).kinds


def is_contact(result: Result) -> bool:
    """Returns whether all faults of the policy are of contact: the arm's path does not tell."""
    return all(FAULTS[kind].contact for kind in kinds_of(result))


def true_rate(results: Sequence[Result]) -> Score:
    """Returns how often the rollouts really succeed."""
    return Score.share(results, lambda r: r.final)


def area_interval(
    said: Sequence[FloatArray], real: BoolArray, scenes: Sequence[Scene]
) -> tuple[float, Interval]:
    """Returns the area under the ROC and its 95 % t interval, from a jackknife over scenes.

    Args:
        said: (N,) estimates; of two, the first area less the second one is taken.
        real: (N,) outcomes.
        scenes: of the N rollouts; all of a scene are left out together.

    Returns:
        The area, its interval on the logit scale (of a difference: as it is); NaN for fewer than
        `MIN_SCENES` scenes, or where no scene makes a difference.
    """
    names = list(dict.fromkeys(scenes))
    number = np.array([names.index(scene) for scene in scenes])
    weights = np.concatenate([np.ones((1, len(scenes))), np.arange(len(names))[:, None] != number])
    areas = [areas_under_roc(one, real, weights.astype(np.float64)) for one in said]
    found = areas[0] if len(areas) == 1 else areas[0] - areas[1]
    value, rest = float(found[0]), found[1:][np.isfinite(found[1:])]
    num = len(rest)
    error = np.sqrt((num - 1) / max(num, 1) * ((rest - rest.mean()) ** 2).sum()) if num else 0.0
    if num < MIN_SCENES or error < 1e-9:
        return value, UNKNOWN
    half = float(t_quantile(num - 1)) * error
    if len(areas) > 1:
        return value, (max(value - half, -1.0), min(value + half, 1.0))
    inner = np.clip(value, 0.5 / len(real), 1 - 0.5 / len(real))
    half /= inner * (1 - inner)
    low, high = expit(logit(inner) + np.array([-half, half]))
    return value, (min(float(low), value), max(float(high), value))


def areas_under_roc(said: FloatArray, real: BoolArray, weights: FloatArray) -> FloatArray:
    """Returns (R,) areas under the ROC of (N,) estimates for weights (R, N), ties half."""
    gained, lost = said[real][:, None], said[~real][None]
    above = (gained > lost) + 0.5 * (gained == lost)
    up, down = weights[:, real], weights[:, ~real]
    with np.errstate(invalid='ignore', divide='ignore'):
        return ((up @ above) * down).sum(1) / (up.sum(1) * down.sum(1))


def find_flips(results: Sequence[Result], folder: Path) -> dict[str, bool]:
    """Returns which flips are imagined; see `Optimism.flips`.

    Args:
        results: of all policies.
        folder: with their last frames as `last_frames_png` writes them, `<name>.png`, and where
            objects are, `<name>.objects.png`; rollouts without are left out.
    """
    experts = {(r.task, r.index): r for r in results if r.policy == EXPERT}
    found = {}
    for result in results:
        expert = experts.get((result.task, result.index))
        if expert is None or result.final == expert.final:
            continue
        names = [name_of(r) for r in (result, expert)]
        own, other = (read_last_frames(folder / f'{name}.png') for name in names)
        masks = [_read_objects(folder / f'{name}{OBJECTS}') for name in names]
        if own is not None and other is not None and masks[0] is not None and masks[1] is not None:
            found[name_of(result)] = is_nearer(own[1], own[0], other[0], masks[0] | masks[1])
    return found


def is_nearer(imagined: ByteArray, real: ByteArray, other: ByteArray, objects: BoolArray) -> bool:
    """Returns whether imagined frames are nearer to the real ones than to others, (..., 3) each.

    By squared distance over the pixels of objects (...) in which the real ones and the others
    differ.
    """
    differs = (real != other).any(-1) & objects
    shown, *ends = (frames[differs].astype(np.float64) for frames in (imagined, real, other))
    near, far = (((shown - end) ** 2).sum() for end in ends)
    return bool(near < far)


def last_frames_png(real: ByteArray, imagined: ByteArray) -> bytes:
    """Returns a PNG of a rollout's last frames (V, H, W, 3): views in a row, real ones on top."""
    rows = [np.concatenate(list(frames), axis=1) for frames in (real, imagined)]
    return encode_png(np.concatenate(rows))


def objects_png(masks: BoolArray) -> bytes:
    """Returns a PNG of where objects (V, N, H, W) are: white, views in a row."""
    shown = np.concatenate([view.any(axis=0) for view in masks], axis=1)
    return encode_png(np.repeat(255 * shown[..., None].astype(np.uint8), 3, axis=-1))


def _read_objects(path: Path) -> BoolArray | None:
    """(H, V * W) of `objects_png`; None = there is no such file."""
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    return None if picture is None else np.asarray(picture > 127)


def read_last_frames(path: Path) -> tuple[ByteArray, ByteArray] | None:
    """Returns both rows of `last_frames_png` (H, V * W, 3) RGB; None = there is no such file."""
    picture = cv2.imread(str(path)) if path.is_file() else None
    if picture is None:
        return None
    picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)
    half = len(picture) // 2
    return picture[:half], picture[half:]
