"""Features of scored episodes on disk, and FID and FVD over all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
import zipfile

import numpy as np

from mtv_world_ros.data_types import ByteArray, FloatArray
from mtv_world_ros.errors import EpisodeError, MtvWorldError
from mtv_world_ros.evaluation.metrics.frechet.distance import frechet_distance, frechet_interval
from mtv_world_ros.evaluation.metrics.frechet.features import ClipFeatures, FrameFeatures
from mtv_world_ros.evaluation.metrics.statistics import Estimate
from mtv_world_ros.files import write_whole

#: name of the distance -> what it is measured on
DISTANCES = ('fid', 'fvd')
_SIDES = ('predicted', 'real')


def feature_path(out: Path, episode: str) -> Path:
    """Returns where the features of an episode lie in an evaluation's folder."""
    return out / 'episodes' / f'{episode}.features.npz'


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureTaker:
    """Takes the features of frames and clips.

    Attributes:
        views: V names.
        num_frames: a stretch is cut into clips of so many frames; what is left over is no clip.
        frames: for FID; None = not measured.
        clips: for FVD; None = not measured.
    """

    views: tuple[str, ...]
    num_frames: int
    frames: FrameFeatures | None = None
    clips: ClipFeatures | None = None

    def start(self) -> EpisodeFeatures:
        """Returns an empty collection for one episode."""
        return EpisodeFeatures(self)

    def take(self, video: ByteArray) -> dict[str, FloatArray]:
        """Returns the features of a (T, H, W, 3) video by the name of the distance."""
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
        """Takes the features of a stretch, (V, T, H, W, 3) each."""
        for side, videos in zip(_SIDES, (predicted, real), strict=True):
            for view, video in zip(self._taker.views, videos, strict=True):
                for name, features in self._taker.take(video).items():
                    self._found.setdefault(f'{name}/{view}/{side}', []).append(features)

    def save(self, path: Path) -> None:
        """Writes them beside the name and renames."""
        held = {
            key: np.concatenate(parts).astype(np.float32) for key, parts in self._found.items()
        }
        archive = BytesIO()
        np.savez(archive, **held)  # type: ignore[arg-type]
        write_whole(path, archive.getvalue())


def load_features(path: Path) -> dict[str, FloatArray]:
    """Returns the features by `distance/view/side`; none if there is no file.

    Raises:
        EpisodeError: the file cannot be read.
    """
    if not path.is_file():
        return {}
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise EpisodeError(
            f"features '{path}' cannot be read ({error}); remove the file and evaluate again"
        ) from error


def distances(
    episodes: Sequence[dict[str, FloatArray]], view: str, *, with_interval: bool = True
) -> dict[str, Estimate]:
    """Returns FID and FVD of a view over episodes, as far as their features were taken.

    Args:
        episodes: `load_features` of each.
        view: name.
        with_interval: also leave groups of episodes out in turn, which takes ten times as long.
    """
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
            spread = with_interval and frechet_interval(sides['real'], sides['predicted'])
        except MtvWorldError:  # a single clip has no covariance: not measured
            continue
        found[name] = Estimate(
            value=value,
            interval=spread or (np.nan, np.nan),
            num_episodes=len(sides['real']),
        )
    return found
