"""What an evaluation imagines and how it scores it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from mtv_world_ros.data.bag_mapping import EpisodeSource
from mtv_world_ros.data.recording import DEFAULT
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.evaluation.references import check_actions
from mtv_world_ros.evaluation.rollouts import check_mode


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationConfig:
    """What is imagined and how it is scored.

    Attributes:
        mode: `observe`: every chunk from the real frames at its start; `imagine`: chunks chained
            from the episode's first frame.
        seed: of the noise and of the choice of shuffled actions.
        num_seeds: rollouts whose mean the success estimate is; J is of the first one's frames.
        num_inference_steps: denoising steps; 0 = those the model is made for.
        actions: of `controls.ACTIONS`: everything is imagined once with each.
        ceiling: score the recorded frames too, as they are and through the autoencoder.
        use_ids: score against the recorded identities, where an episode has them, instead of the
            segmenter's masks of the recorded frames.
        quality: of `image_quality.MEASURES`.
        fid_weights: Inception-v3 state dict; None = no FID.
        fvd_weights: I3D state dict or VideoMAE folder; None = no FVD.
        source: how episodes are read that are not this package's own.
    """

    mode: str = 'observe'
    seed: int = 0
    num_seeds: int = 1
    num_inference_steps: int = 0
    actions: tuple[str, ...] = ('true', 'shuffled')
    ceiling: bool = True
    use_ids: bool = True
    quality: tuple[str, ...] = ()
    fid_weights: Path | None = None
    fvd_weights: Path | None = None
    source: EpisodeSource = DEFAULT

    def __post_init__(self) -> None:
        check_mode(self.mode)
        check_actions(self.actions)
        if self.num_seeds < 1:
            raise ConfigError(f'num_seeds is {self.num_seeds}; it must be at least 1')

    def as_json(self) -> dict[str, Any]:
        """Returns plain values."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != 'source'}
        values = {key: str(v) if isinstance(v, Path) else v for key, v in values.items()}
        if self.source != DEFAULT:
            mapping = self.source.mapping
            values['topics'] = mapping.model_dump(mode='json') if mapping else None
            values['calibration'] = str(self.source.calibration or '')
        return {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}


def config_from(options: dict[str, Any]) -> EvaluationConfig:
    """Returns the configuration of these fields.

    Raises:
        ConfigError: an unknown field, mode, or name of actions.
    """
    try:
        return EvaluationConfig(**options)
    except TypeError as error:
        raise ConfigError(f'evaluation: {error}') from error
