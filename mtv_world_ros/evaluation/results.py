"""Scores of one episode, as they are kept on disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from mtv_world_ros.evaluation.scores import ScoreRow
from mtv_world_ros.evaluation.statistics import episode_means, QUALITY


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeResult:
    """Scores of one episode.

    Attributes:
        episode: name of its folder.
        task: its name.
        zero_shot: what the model was not trained for in it: `view`, `task`, `object`; or empty.
        outcome: `success`, `failure` or `unknown`.
        rows: scores.
        quality: PSNR and the like by view, as far as measured.
        probability: the success estimate at the end of its last stretch; NaN = abstained.
        reasons: of that estimate.
        notes: what was wrong with the recording, and what could not be imagined.
        seconds_per_chunk: mean time to imagine a chunk [s].
        seconds: what the time of the episode went into [s].
        features: of that estimate, by name; empty where it abstained.
        has_ids: which objects move was read from recorded identities.
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
    features: Mapping[str, float] = field(default_factory=dict)

    def means(self, view: str | None) -> dict[str, float]:
        """Returns the numbers of a view (None = all views) that are averaged over episodes."""
        views = [numbers for name, numbers in self.quality.items() if view in (None, name)]
        known = [name for name in QUALITY if views and all(name in numbers for numbers in views)]
        quality = {n: float(np.mean([numbers[n] for numbers in views])) for n in known}
        return {**episode_means(self.rows, view), **quality}

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        return {**asdict(self), 'rows': [row.as_json() for row in self.rows]}

    @staticmethod
    def from_json(values: dict[str, Any]) -> EpisodeResult:
        """The inverse of `as_json`, read back from a file."""
        read: dict[str, Any] = dict(values)
        read['rows'] = tuple(ScoreRow.from_json(row) for row in values['rows'])
        read['reasons'], read['notes'] = tuple(values['reasons']), tuple(values['notes'])
        read['probability'] = np.nan if values['probability'] is None else values['probability']
        given = values.get('features', {})
        read['features'] = {k: np.nan if v is None else v for k, v in given.items()}
        return EpisodeResult(**read)
