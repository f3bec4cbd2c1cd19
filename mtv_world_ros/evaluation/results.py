"""Scores of one episode, and what is kept of its frames for later reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.data_types import ByteArray, FloatArray, ObjectMasks
from mtv_world_ros.evaluation.imagined_stretches import Stretch
from mtv_world_ros.evaluation.metrics.grasp_outcomes import GraspOutcome
from mtv_world_ros.evaluation.metrics.jaccard_scores import episode_means, QUALITY, ScoreRow
from mtv_world_ros.rollout.prediction import Prediction
from mtv_world_ros.viewing.scored_rollout import StoredRollout
from mtv_world_ros.viewing.video import Comparison


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeResult:
    """Scores of one episode.

    Attributes:
        episode: name of its folder.
        task: name of its task.
        zero_shot: aspect that the model was not trained for: `view`, `task`, `object`; or empty.
        outcome: `success`, `failure` or `unknown`.
        rows: scores of the objects.
        quality: PSNR, SSIM and LPIPS by view, if measured.
        probability: success estimate at the end of the last stretch; NaN = abstained.
        reasons: reasons of that estimate.
        interval: interval of that estimate; NaN = not known.
        notes: defects of the recording, and rollouts that could not be imagined.
        seconds_per_chunk: mean time to imagine a chunk [s].
        seconds: seconds by stage of the episode's evaluation [s].
        pictures: `mean_pictures` by view and name, with the held frame and shuffled commands.
        num_chunks: number of stretches that were imagined; 0 = not known.
        num_shuffled: number of those that were imagined with other commands, too.
        features: features of the success estimate, by name; empty if it abstained.
        observed: features of the success estimate at the end of the recorded frames, by name;
            empty if the recorded frames were not judged.
        resumed: features of the success estimate if only the last chunk is imagined.
        has_ids: recorded object identities show which objects move.
        grasps: outcomes of all attempts to grasp; empty in results of earlier versions.
        shares: time [s] since the episode began, and share of the futures that succeed there, of
            each chunk's end; empty where no motion was foreseen, and in results of earlier
            versions.
        digest: digest of the episode's motion, see `Recording`; empty = not known.
    """

    episode: str
    task: str
    zero_shot: str
    outcome: str
    rows: tuple[ScoreRow, ...]
    quality: Mapping[str, Mapping[str, float]]
    probability: float
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    seconds_per_chunk: float
    seconds: Mapping[str, float]
    has_ids: bool
    digest: str = ''
    interval: tuple[float, float] = (np.nan, np.nan)
    pictures: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    num_chunks: int = 0
    num_shuffled: int = 0
    features: Mapping[str, float] = field(default_factory=dict)
    observed: Mapping[str, float] = field(default_factory=dict)
    resumed: Mapping[str, float] = field(default_factory=dict)
    grasps: tuple[GraspOutcome, ...] = ()
    shares: tuple[tuple[float, float], ...] = ()

    def means(self, view: str | None) -> dict[str, float]:
        """Return the episode's mean scores of a view (None = all views), by name."""
        views = [numbers for name, numbers in self.quality.items() if view in (None, name)]
        known = [name for name in QUALITY if views and all(name in numbers for numbers in views)]
        quality = {n: float(np.mean([numbers[n] for numbers in views])) for n in known}
        return {**episode_means(self.rows, view), **quality}

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {**asdict(self), 'rows': [row.as_json() for row in self.rows]}

    @staticmethod
    def from_json(values: dict[str, Any]) -> EpisodeResult:
        """Return the inverse of `as_json`, read back from a file."""
        read: dict[str, Any] = dict(values)
        read['rows'] = tuple(ScoreRow.from_json(row) for row in values['rows'])
        read['grasps'] = tuple(GraspOutcome(**grasp) for grasp in values.get('grasps', ()))
        read['shares'] = tuple((time, share) for time, share in values.get('shares', ()))
        read['reasons'], read['notes'] = tuple(values['reasons']), tuple(values['notes'])
        read['probability'] = np.nan if values['probability'] is None else values['probability']
        ends = values.get('interval') or (None, None)
        read['interval'] = tuple(np.nan if end is None else float(end) for end in ends)
        for name in ('features', 'observed', 'resumed'):
            read[name] = _nan_for_none(values.get(name, {}))
        read['pictures'] = {k: _nan_for_none(v) for k, v in values.get('pictures', {}).items()}
        return EpisodeResult(**read)


def _nan_for_none(values: Mapping[str, float | None]) -> dict[str, float]:
    return {k: np.nan if v is None else v for k, v in values.items()}


def compare(chunks: Sequence[Prediction], real: ByteArray) -> Comparison:
    """Pair the chunks of a rollout with recorded frames (V, T, H, W, 3) of the same times."""
    videos = [chunk.video for chunk in chunks]
    return Comparison(
        views=videos[0].views,
        times=np.concatenate([video.times for video in videos]),
        real=real,
        trajectory=np.concatenate(
            [
                chunk.trajectory_video.frames[:, 1 : 1 + video.frames.shape[1]]
                for chunk, video in zip(chunks, videos, strict=True)
            ],
            axis=1,
        ),
        imagined=np.concatenate([video.frames for video in videos], axis=1),
    )


def stored_stretch(
    chunks: Sequence[Prediction],
    stretch: Stretch,
    *,
    start_seconds: float,
    fps: float,
    true_masks: ObjectMasks,
    masks: ObjectMasks,
    j: FloatArray,
) -> StoredRollout:
    """Return the frames, masks and scores of a stretch that later reports need.

    Args:
        chunks: imagined from the stretch's first frame.
        stretch: the recorded frames.
        start_seconds: start seconds from the episode's first frame to the stretch's [s].
        fps: frames a second.
        true_masks: true masks of the recorded frames 1..T.
        masks: masks of the predicted frames.
        j: (V, O, T) J per frame.
    """
    shown = compare(chunks, stretch.frames[:, 1:])
    return StoredRollout(
        views=shown.views,
        objects=masks.names,
        fps=fps,
        stretches=np.full(len(shown.times), stretch.index),
        times=shown.times + start_seconds,
        real=shown.real,
        trajectory=shown.trajectory,
        imagined=shown.imagined,
        true_masks=true_masks.masks,
        masks=masks.masks,
        j=j,
    )


def rollout_path(out: Path, episode: str) -> Path:
    """Return the path of an episode's rollout in the folder of an evaluation."""
    return Path(out) / 'episodes' / f'{episode}.rollout.npz'
