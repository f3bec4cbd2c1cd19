"""PSNR, SSIM and changed pixels of imagined frames, and of baselines without the commands.

The baselines are the held first frame and frames imagined with another episode's commands. Scores
are over whole frames and over the pixels that differ from the first recorded frame. No object is
needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.data_types import ByteArray
from mtv_world_ros.evaluation.metrics.statistics import Estimate, mean_interval, MIN_EPISODES

#: baseline: the first frame, held
HELD = 'held'
#: baseline: frames imagined with another episode's commands
SHUFFLED = 'shuffled'
#: upper bound: recorded frames, whose J of the arm is limited by the calibration alone
RECORDED = 'recorded'
#: names of the rows of tables, by the suffix of a number's name
KINDS = {
    '': 'imagined',
    f'_{HELD}': 'first frame held',
    f'_{SHUFFLED}': 'other commands',
    f'_{RECORDED}': 'recorded',
}
#: baselines that an imagined rollout is compared with, in pairs
BASELINES = (HELD, SHUFFLED)
#: names of the rows of margins, by the suffix of a number's name
MARGIN_KINDS = {
    f'_over_{HELD}': 'imagined - first frame held',
    f'_over_{SHUFFLED}': 'imagined - other commands',
}
#: numbers by name, and how tables call them
MEASURES = {
    'psnr': 'PSNR [dB]',
    'ssim': 'SSIM',
    'psnr_changed': 'PSNR where it changes [dB]',
    'ssim_changed': 'SSIM where it changes',
    'j_changed': 'J of changed pixels',
    'j_arm': 'J of the arm',
}
#: threshold of a changed pixel: difference of a blurred channel [grey levels]
_CHANGED = 20.0
#: frames in which fewer pixels change are not scored by them [share]
_LEAST_CHANGED = 0.002
#: largest margin over shuffled commands of a model that does not follow commands [dB]
_NO_MARGIN_DB = 0.25
#: verdict on frames that are further from the recorded ones than the first frame held
WORSE = 'worse than a still picture'
#: margin below the held frame from which episodes too few for an interval are `WORSE` [dB]
_WORSE_DB = 1.0
#: standard deviation of the window of SSIM [px] (Wang et al. 2004)
_SSIM_SIGMA_PX = 1.5
#: constant C1 of SSIM, K1 = 0.01 of the value range 255 (Wang et al. 2004)
_SSIM_C1 = (0.01 * 255) ** 2
#: constant C2 of SSIM, K2 = 0.03 of the value range 255 (Wang et al. 2004)
_SSIM_C2 = (0.03 * 255) ** 2


def picture_scores(frames: ByteArray, real: ByteArray, first: ByteArray) -> dict[str, float]:
    """Return the picture scores of a view: `MEASURES` without `j_arm`, means over frames.

    Args:
        frames: (T, H, W, 3) uint8 RGB imagined.
        real: (T, H, W, 3) recorded at the same times.
        first: (H, W, 3) recorded frame that both start from.
    """
    rows = [_frame_scores(a, b, first) for a, b in zip(frames, real, strict=True)]
    return {
        name: float(np.nanmean(values)) if np.isfinite(values).any() else nan
        for name in rows[0]
        for values in [np.array([row[name] for row in rows])]
    }


def _frame_scores(frame: ByteArray, real: ByteArray, first: ByteArray) -> dict[str, float]:
    error = (frame.astype(np.float64) - real) ** 2
    similar = ssim_map(frame, real)
    changes, imagined = changed_pixels(real, first), changed_pixels(frame, first)
    scores = dict.fromkeys((name for name in MEASURES if name != 'j_arm'), nan)
    scores |= {'psnr': _psnr(error), 'ssim': float(similar.mean())}
    if changes.mean() < _LEAST_CHANGED:
        return scores
    both = float((changes & imagined).sum()) / float((changes | imagined).sum())
    return scores | {
        'psnr_changed': _psnr(error[changes]),
        'ssim_changed': float(similar[changes].mean()),
        'j_changed': both,
    }


def _psnr(error: NDArray[np.float64]) -> float:
    """Return the PSNR of a squared error [dB].

    Equal frames count as if one value differed by half a grey level, so that means are finite.
    """
    return float(10 * np.log10(255.0**2 / max(float(error.mean()), 0.25 / error.size)))


def changed_pixels(frame: ByteArray, first: ByteArray) -> NDArray[np.bool_]:
    """Return (H, W) True for pixels that differ between two frames (H, W, 3)."""
    apart = np.abs(frame.astype(np.float32) - first.astype(np.float32)).max(axis=-1)
    return np.asarray(cv2.GaussianBlur(apart, (0, 0), 0.8) > _CHANGED)


def ssim_map(a: ByteArray, b: ByteArray) -> NDArray[np.float64]:
    """Return (H, W) structural similarity of two frames (H, W, 3), the mean of the channels."""

    def blurred(x: NDArray[np.float64]) -> NDArray[np.float64]:
        found = cv2.GaussianBlur(x, (11, 11), _SSIM_SIGMA_PX, borderType=cv2.BORDER_REFLECT_101)
        return np.asarray(found, np.float64)

    x, y = a.astype(np.float64), b.astype(np.float64)
    mx, my = blurred(x), blurred(y)
    vx, vy, both = blurred(x * x) - mx**2, blurred(y * y) - my**2, blurred(x * y) - mx * my
    top = (2 * mx * my + _SSIM_C1) * (2 * both + _SSIM_C2)
    found = top / ((mx**2 + my**2 + _SSIM_C1) * (vx + vy + _SSIM_C2))
    return np.asarray(found.mean(axis=-1), np.float64)


#: numbers of an episode by view and name; a name is `psnr`, `psnr_held`, `psnr_shuffled`, ...
PictureScores = Mapping[str, Mapping[str, float]]


def mean_pictures(
    chunks: Sequence[tuple[int, PictureScores]],
) -> dict[str, dict[str, float]]:
    """Return the means of an episode over its chunks by view, and margins over the baselines.

    Frames weigh equally, NaN counts nothing. A margin, `psnr_over_held` and so on, is the mean
    difference over the chunks that have both baselines, or the held frame alone where no chunk
    was imagined with other commands: all margins are over the same chunks.

    Args:
        chunks: number of frames and scores of each chunk.
    """
    found: dict[str, dict[str, float]] = {}
    for view in chunks[0][1]:
        rows = [(count, scores[view]) for count, scores in chunks]
        names = dict.fromkeys(name for _, numbers in rows for name in numbers)
        found[view] = {name: weighted(rows, name) for name in names} | _margins(rows)
    return found


def _margins(rows: Sequence[tuple[int, Mapping[str, float]]]) -> dict[str, float]:
    """Return the margins of a view over its baselines, from chunks that have all baselines."""
    present = [
        other for other in BASELINES if any(f'psnr_{other}' in numbers for _, numbers in rows)
    ]
    paired = [row for row in rows if all(f'psnr_{other}' in row[1] for other in present)]
    found = {}
    for name in MEASURES:
        for other in present:
            both = [
                (count, {name: numbers[name] - numbers[f'{name}_{other}']})
                for count, numbers in paired
                if name in numbers and f'{name}_{other}' in numbers
            ]
            found[f'{name}_over_{other}'] = weighted(both, name)
    return found


def weighted(rows: Sequence[tuple[int, Mapping[str, float]]], name: str) -> float:
    """Return the mean of a number over chunks, weighted by their frames."""
    known = [(count, row.get(name, nan)) for count, row in rows]
    known = [(count, value) for count, value in known if np.isfinite(value)]
    total = sum(count for count, _ in known)
    return sum(count * value for count, value in known) / total if total else nan


def episode_pictures(episode: PictureScores, view: str | None) -> dict[str, float]:
    """Return an episode's picture scores of a view (None = mean over views), and margins."""
    views = [numbers for name, numbers in episode.items() if view in (None, name)]
    names = dict.fromkeys(name for numbers in views for name in numbers)
    found = {name: _mean([numbers.get(name, nan) for numbers in views]) for name in names}
    for other in BASELINES:
        key, paired = f'psnr_changed_{other}', f'psnr_changed_over_{other}'
        if key in found:  # results of earlier versions have no margins of their own
            found[f'margin_over_{other}'] = found.get(paired, found['psnr_changed'] - found[key])
    return found


def _mean(values: Sequence[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else nan


def picture_estimates(
    episodes: Sequence[PictureScores], view: str | None = None
) -> dict[str, Estimate]:
    """Return means over episodes with 95 % intervals, by name.

    Margins are paired, and over the same episodes: where some were imagined with other commands,
    those that were not have no margin over the held frame either.
    """
    rows = [episode_pictures(episode, view) for episode in episodes if episode]
    key = f'margin_over_{SHUFFLED}'
    is_paired = [np.isfinite(row.get(key, nan)) for row in rows]
    found = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        values = np.array([row.get(name, nan) for row in rows])
        if '_over_' in name and any(is_paired):
            values[~np.array(is_paired)] = nan
        known = np.isfinite(values)
        sums = np.where(known, values, 0.0)[:, None]
        mean, ends = mean_interval(sums, known[:, None].astype(float), low=-np.inf, high=np.inf)
        found[name] = Estimate(
            value=float(mean[0]),
            interval=(float(ends[0, 0]), float(ends[1, 0])),
            num_episodes=int(known.sum()),
        )
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Following:
    """Verdict whether a model follows the commands, and its reason.

    Attributes:
        word: 'yes', 'no', 'cannot tell' or `WORSE`.
        why: numbers that the verdict rests on.
    """

    word: str
    why: str

    @property
    def line(self) -> str:
        """The first line of a report."""
        if self.word == WORSE:
            return f'the imagined frames are {WORSE} ({self.why})'
        return f'follows the commands: {self.word} ({self.why})'


def following(
    estimates: Mapping[str, Estimate],
    objects: Estimate | None = None,
    chunks: tuple[int, int] | None = None,
) -> Following:
    """Decide by PSNR where the picture changes, against held frame and shuffled commands.

    Args:
        estimates: estimates of `picture_estimates`.
        objects: J of the moving objects minus that of the held first frame, paired within the
            episodes; None = no episode names a moving object. A model below the held frame does
            not follow the commands, whatever its pictures of the arm are like.
        chunks: number of chunks that were imagined with other commands, and of all; None = not
            known.
    """
    found = _following_by_pictures(estimates, chunks)
    whole = estimates.get(f'psnr_over_{HELD}')
    if found.word != 'yes' and whole is not None and _is_worse(whole):
        why = f'PSNR {_signed(whole)} against the first frame held; {found.why}'
        return Following(word=WORSE, why=why)
    if objects is None or objects.num_episodes < MIN_EPISODES or found.word == 'no':
        return found
    why = f'{found.why}; J of moving objects {_against_held(objects)}'
    if objects.interval[1] < 0:
        return Following(word='no', why=why)
    is_above = objects.value > 0 and not objects.interval[0] <= 0
    return Following(word=found.word if is_above else 'cannot tell', why=why)


def _is_worse(margin: Estimate) -> bool:
    """Return whether whole frames are further from the recorded ones than the held frame is."""
    if margin.num_episodes < MIN_EPISODES:
        return margin.value < -_WORSE_DB
    return margin.interval[1] < 0


def _against_held(margin: Estimate) -> str:
    low, high = margin.interval
    ends = f' [{low:+.2f}, {high:+.2f}]' if np.isfinite(low) else ''
    return f'{margin.value:+.2f}{ends} against the held frame'


def _following_by_pictures(
    estimates: Mapping[str, Estimate], chunks: tuple[int, int] | None
) -> Following:
    shuffled = estimates.get(f'margin_over_{SHUFFLED}')
    held = estimates.get(f'margin_over_{HELD}')
    if shuffled is None or held is None or not np.isfinite([shuffled.value, held.value]).all():
        compared = estimates.get('psnr_changed')
        why = "no frames were imagined with another episode's commands"
        if compared is not None and compared.num_episodes < MIN_EPISODES:
            why = f'episodes: {compared.num_episodes}, give at least {MIN_EPISODES}'
        return Following(word='cannot tell', why=why)
    why = (
        f'where the picture changes, {_signed(shuffled)} against other commands, '
        f'{_signed(held)} against the held frame; {shuffled.num_episodes} episodes'
    )
    if chunks is not None:
        why += f', {chunks[0]} of {chunks[1]} chunks'
    if min(shuffled.num_episodes, held.num_episodes) < MIN_EPISODES:
        return Following(word='cannot tell', why=f'{why}, give at least {MIN_EPISODES}')
    if shuffled.interval[0] > 0 and held.interval[0] > 0:
        return Following(word='yes', why=why)
    is_no = shuffled.interval[1] < _NO_MARGIN_DB or held.interval[1] < 0
    return Following(word='no' if is_no else 'cannot tell', why=why)


def _signed(margin: Estimate) -> str:
    low, high = margin.interval
    ends = f' [{low:+.2f}, {high:+.2f}]' if np.isfinite(low) else ''
    return f'{margin.value:+.2f} dB{ends}'
