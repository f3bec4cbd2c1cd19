"""Whether and how a model takes up what a rollout showed before its present chunk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from mtv_world_ros.errors import CheckpointError, ConfigError

#: what the reference tokens show: the chunk's start frame, or the rollout's first one
REFERENCES = ('chunk_start', 'first_frame')


@dataclass(frozen=True, slots=True, kw_only=True)
class HistorySettings:
    """What a model was trained with, the same in serving; the default is none of it.

    Attributes:
        num_frames: N, frames before the chunk's start frame; 0 = no history tokens.
        noise_level: share of noise that the history's latents are given, in [0, 1): enough to hide
            what a model's own frames look like, too little to hide what they show.
        reference: `chunk_start` or `first_frame`: what the reference tokens show.
    """

    num_frames: int = 0
    noise_level: float = 0.05
    reference: str = 'chunk_start'

    def __post_init__(self) -> None:
        if self.num_frames < 0:
            raise ConfigError(f'history.num_frames is {self.num_frames}; it must be 0 or more')
        if not 0 <= self.noise_level < 1:
            raise ConfigError(
                f'history.noise_level is {self.noise_level}; it must be at least 0 and below 1'
            )
        if self.reference not in REFERENCES:
            raise ConfigError(
                f"history.reference '{self.reference}' is not one of {', '.join(REFERENCES)}"
            )

    @property
    def on(self) -> bool:
        """Whether the model takes up anything."""
        return self.num_frames > 0 or self.anchored

    @property
    def anchored(self) -> bool:
        """Whether the reference tokens show the rollout's first frame."""
        return self.reference == 'first_frame'

    def as_card(self) -> dict[str, Any]:
        """Returns the checkpoint card's entry; empty where nothing is on."""
        names = [f.name for f in fields(HistorySettings)]
        return {'history': {n: getattr(self, n) for n in names}} if self.on else {}


def history_settings(card: Mapping[str, Any]) -> HistorySettings:
    """Returns what a checkpoint's card says.

    Raises:
        CheckpointError: an unknown key or a value that cannot be.
    """
    try:
        return HistorySettings(**card.get('history', {}))
    except (TypeError, ConfigError) as error:
        raise CheckpointError(f"world_model.json: 'history' cannot be used: {error}") from error
