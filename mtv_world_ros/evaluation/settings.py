"""Settings of an evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import Field, model_validator

from mtv_world_ros.core.config import Count, ListOf, Schema
from mtv_world_ros.data.bag_mapping import EpisodeSource
from mtv_world_ros.data.recording import DEFAULT
from mtv_world_ros.evaluation.imagined_stretches import check_mode
from mtv_world_ros.evaluation.references import check_actions


class EvaluationConfig(Schema):
    """Settings of an evaluation: rollouts and their scores."""

    section: ClassVar = ''

    mode: str = Field(
        default='observe',
        description='observe: every chunk from the real frames until its start; imagine: chunks '
        "chained from the episode's first frame",
    )
    seed: int = Field(default=0, description='of the noise and of the choice of shuffled actions')
    num_seeds: Count = Field(
        default=1,
        description="rollouts whose mean the success estimate is; J is of the first one's frames",
    )
    num_inference_steps: int = Field(
        default=0, ge=0, description='denoising steps; 0 = those the model is made for'
    )
    actions: ListOf[str] = Field(
        default=('true', 'shuffled'),
        description='of `references.ACTIONS`: everything is imagined once with each',
    )
    ceiling: bool = Field(
        default=True,
        description='score the recorded frames too, as they are and through the autoencoder',
    )
    observed: bool = Field(
        default=False,
        description='also judge the recorded frames of whole episodes, and with the last chunk '
        'imagined, for `calibrate`',
    )
    use_ids: bool = Field(
        default=True,
        description='score against the recorded identities, where an episode has them, instead of '
        "the segmenter's masks of the recorded frames",
    )
    quality: ListOf[str] = Field(default=(), description='of `image_quality.MEASURES`')
    fid_weights: Path | None = Field(
        default=None, description='Inception-v3 state dict; None = no FID'
    )
    fvd_weights: Path | None = Field(default=None, description='I3D state dict; None = no FVD')
    source: EpisodeSource = Field(
        default=DEFAULT, description="how episodes are read that are not this package's own"
    )

    @model_validator(mode='after')
    def _is_known(self) -> Self:
        check_mode(self.mode)
        check_actions(self.actions)
        return self

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        values = self.model_dump(mode='json', exclude={'source'})
        if self.source != DEFAULT:
            mapping = self.source.mapping
            values['topics'] = mapping.model_dump(mode='json') if mapping else None
            values['calibration'] = str(self.source.calibration or '')
        return values
