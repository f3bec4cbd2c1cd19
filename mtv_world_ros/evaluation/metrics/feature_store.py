"""Features of scored episodes on disk; FID and FVD (Frechet distances) over all episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from mtv_world_ros.core.bounded_input import read_arrays
from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.core.files import write_whole
from mtv_world_ros.evaluation.metrics.frechet_features import ClipFeatures, FrameFeatures
from mtv_world_ros.evaluation.metrics.jaccard_scores import DISTANCES
from mtv_world_ros.evaluation.metrics.statistics import Estimate, MIN_EPISODES, t_quantile, UNKNOWN

#: most groups of episodes that are left out in turn for an interval
MAX_GROUPS = 10


def frechet_distance(real: FloatArray, predicted: FloatArray) -> float:
    """Return |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)) of the sample means and covariances.

    With C = A^T A the trace of the root is the sum of the singular values of A1 A2^T, so no root
    of a matrix is taken: the result is real and not negative whatever the rank of C, also with
    fewer samples (N, D) and (M, D) than features D.

    Raises:
        MtvWorldError: fewer than two samples, other numbers of features, or not finite.
    """
    _check(real, predicted)
    (mean1, root1), (mean2, root2) = _moments(real), _moments(predicted)
    cross = np.linalg.svd(root1 @ root2.T, compute_uv=False).sum()
    spread = (root1**2).sum() + (root2**2).sum() - 2 * cross
    return float(((mean1 - mean2) ** 2).sum() + max(spread, 0.0))


def _check(real: FloatArray, predicted: FloatArray) -> None:
    for name, features in (('real', real), ('predicted', predicted)):
        if features.ndim != 2 or len(features) < 2 or not np.isfinite(features).all():
            raise MtvWorldError(
                f'Frechet distance: {name} features of shape {features.shape}; needed are at '
                'least two rows of finite numbers (score more episodes)'
            )
    if real.shape[1] != predicted.shape[1]:
        raise MtvWorldError(
            f'Frechet distance: {real.shape[1]} features against {predicted.shape[1]}; both must '
            'come from the same network'
        )


def _moments(features: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean (D,) and A (at most min(N, D) rows) with A^T A the sample covariance."""
    features = np.asarray(features, np.float64)
    mean = features.mean(0)
    root = (features - mean) / np.sqrt(len(features) - 1)
    if len(root) > root.shape[1]:
        root = np.asarray(np.linalg.qr(root, mode='r'), np.float64)
    return mean, root


def frechet_interval(
    real: Sequence[FloatArray], predicted: Sequence[FloatArray]
) -> tuple[float, float]:
    """Return a 95 % interval of the distance of (N, D) and (M, D) features of each episode.

    Groups of episodes are left out in turn (jackknife): a resample of a bootstrap holds some
    samples twice, has a smaller covariance, and lies further from the other set. The interval is
    the distance of all -/+ the t quantile of the groups times the standard error, not below 0; NaN
    with fewer than `MIN_EPISODES` episodes. The distance falls as samples grow in number: compare
    only distances of equally many.
    """
    count = len(real)
    if count < MIN_EPISODES:
        return UNKNOWN
    whole = frechet_distance(np.concatenate(real), np.concatenate(predicted))
    groups = np.array_split(np.arange(count), min(count, MAX_GROUPS))
    left = []
    for group in groups:
        kept = [index for index in range(count) if index not in set(group.tolist())]
        parts = (np.concatenate([features[k] for k in kept]) for features in (real, predicted))
        left.append(frechet_distance(*parts))
    share = (len(groups) - 1) / len(groups)
    error = np.sqrt(share * ((np.array(left) - np.mean(left)) ** 2).sum())
    half = float(t_quantile(len(groups) - 1) * error)
    return (max(whole - half, 0.0), whole + half)


_SIDES = ('predicted', 'real')


def feature_path(out: Path, episode: str) -> Path:
    """Return the path of an episode's features in the folder of an evaluation."""
    return out / 'episodes' / f'{episode}.features.npz'


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureTaker:
    """Feature extractors of frames and clips.

    Attributes:
        views: names of the V views.
        num_frames: number of frames of a clip; the last frames of a stretch are left out if fewer.
        frames: feature extractor for FID; None = not measured.
        clips: feature extractor for FVD; None = not measured.
    """

    views: tuple[str, ...]
    num_frames: int
    frames: FrameFeatures | None = None
    clips: ClipFeatures | None = None

    def start(self) -> EpisodeFeatures:
        """Return an empty collection for one episode."""
        return EpisodeFeatures(self)

    def take(self, video: ByteArray) -> dict[str, FloatArray]:
        """Return the features of a (T, H, W, 3) video by the name of the distance."""
        found = {}
        if self.frames is not None:
            found['fid'] = self.frames(video)
        if self.clips is not None:
            starts = range(0, len(video) - self.num_frames + 1, self.num_frames)
            cut = [self.clips(video[k : k + self.num_frames]) for k in starts]
            if cut:
                found['fvd'] = np.concatenate(cut)
        return found


class EpisodeFeatures:
    """Features of the predicted and the real frames of one episode."""

    def __init__(self, taker: FeatureTaker) -> None:
        self._taker = taker
        self._found: dict[str, list[FloatArray]] = {}

    def add(self, predicted: ByteArray, real: ByteArray) -> None:
        """Add the features of a stretch: predicted and real frames, (V, T, H, W, 3) each."""
        for side, videos in zip(_SIDES, (predicted, real), strict=True):
            for view, video in zip(self._taker.views, videos, strict=True):
                for name, features in self._taker.take(video).items():
                    self._found.setdefault(f'{name}/{view}/{side}', []).append(features)

    def save(self, path: Path) -> None:
        """Write the features to a temporary file, then rename it: a reader never sees a part."""
        held = {
            key: np.concatenate(parts).astype(np.float32) for key, parts in self._found.items()
        }
        archive = BytesIO()
        np.savez(archive, **held)  # type: ignore[arg-type]
        write_whole(path, archive.getvalue())


def load_features(path: Path) -> dict[str, FloatArray]:
    """Return the features by `distance/view/side`; none if there is no file.

    Raises:
        EpisodeError: the file cannot be read.
    """
    if not path.is_file():
        return {}
    try:
        return read_arrays(path)
    except (OSError, ValueError) as error:
        raise EpisodeError(
            f"features '{path}' cannot be read ({error}); remove the file and evaluate again"
        ) from error


def frechet_distances(episodes: Sequence[dict[str, FloatArray]], view: str) -> dict[str, Estimate]:
    """Return FID and FVD of a view, if measured, from the `load_features` of each episode."""
    found = {}
    for name in DISTANCES:
        keys = {side: f'{name}/{view}/{side}' for side in _SIDES}
        sides = {
            side: [features[key] for features in episodes if key in features]
            for side, key in keys.items()
        }
        if not sides['real']:
            continue
        try:
            value = frechet_distance(
                *(np.concatenate(sides[side]) for side in ('real', 'predicted'))
            )
            interval = frechet_interval(sides['real'], sides['predicted'])
        except MtvWorldError:  # a single clip has no covariance: not measured
            continue
        found[name] = Estimate(
            value=value,
            interval=interval,
            num_episodes=len(sides['real']),
        )
    return found
