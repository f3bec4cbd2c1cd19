"""`world_model.json`: a checkpoint's inputs, outputs and training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from mtv_world_ros.control.registry import check_control_name
from mtv_world_ros.core.bounded_input import check_limit, read_json
from mtv_world_ros.core.config import expected, ListOf, Schema, validated
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.errors import CheckpointError, ConfigError

CARD = 'world_model.json'
#: folder of the robot that a checkpoint was trained on (see `robot.file.save_robot`)
ROBOT_FOLDER = 'robot'
#: file of the cameras that a checkpoint was trained on, in that folder
CAMERAS = 'cameras.yaml'
#: LoRA adapter of the transformer
ADAPTER_FOLDER = 'adapter'
#: contact settings and response of the arms, for object motion
OBJECT_MOTION_FOLDER = 'object_motion'


class HistorySettings(Schema):
    """Conditioning of a model on earlier frames of a rollout; off by default."""

    section: ClassVar = 'history'

    num_frames: int = Field(
        default=0,
        ge=0,
        le=10_000,
        description="N, frames before the chunk's start frame; 0 = no history tokens",
    )
    noise_level: Annotated[float, expected('at least 0 and below 1')] = Field(
        default=0.05,
        ge=0,
        lt=1,
        description="share of noise in the history's latents: enough to hide what a model's own "
        'frames look like, too little to hide what they show',
    )
    reference: Literal['chunk_start', 'first_frame'] = Field(
        default='chunk_start', description='frame that the reference tokens show'
    )

    @property
    def on(self) -> bool:
        """True if the model is conditioned on earlier frames."""
        return self.num_frames > 0 or self.anchored

    @property
    def anchored(self) -> bool:
        """True if the reference tokens show the rollout's first frame."""
        return self.reference == 'first_frame'

    def as_card(self) -> dict[str, Any]:
        """Return the entry of the checkpoint card; empty without history."""
        names = set(HistorySettings.model_fields)
        return {'history': self.model_dump(include=names)} if self.on else {}


def _known_control(name: str) -> str:
    try:
        return check_control_name(name)
    except ConfigError as error:
        raise ValueError(str(error)) from error


def _some_steps(count: int) -> int:
    if not 1 <= count <= 1000:
        raise ValueError(f'num_inference_steps is {count}; it must be at least 1, at most 1000')
    return count


class CheckpointCard(Schema):
    """Contents of `world_model.json`."""

    views: ListOf[str]
    fps: float = Field(ge=0.01, le=1000, description='frames a second')
    num_frames: int = Field(ge=1, le=10_000, description='of a chunk')
    width: int = Field(ge=1, le=16_384, description='of a view [px]')
    height: int = Field(ge=1, le=16_384, description='of a view [px]')
    robot: str
    control: Annotated[str, AfterValidator(_known_control)]
    object_mask: bool
    rendering: dict[str, Any]
    trained_on: dict[str, Any]
    prompt: str = Field(default='', description='instruction of models with text')
    negative_prompt: str = Field(default='', description='text that guidance leads away from')
    guidance_scale: float = Field(default=1.0, ge=0, le=1000)
    num_inference_steps: Annotated[int, AfterValidator(_some_steps)] = Field(
        default=4, description='denoising steps that the model is made for'
    )
    history: HistorySettings = HistorySettings()
    scene_memory: bool = Field(
        default=False, description='background is held as real frames showed it'
    )

    @model_validator(mode='after')
    def _chunk_fits_the_memory(self) -> Self:
        size = self.num_frames * self.width * self.height * 3 * len(self.views)
        check_limit('video_bytes', size, 'a chunk of these views')
        return self

    @property
    def spec(self) -> WorldModelSpec:
        """The model's inputs and outputs."""
        return WorldModelSpec(
            views=self.views,
            fps=self.fps,
            num_frames=self.num_frames,
            width=self.width,
            height=self.height,
            robot=self.robot,
            num_inference_steps=self.num_inference_steps,
            num_history=self.history.num_frames,
        )

    def plain(self) -> dict[str, Any]:
        """Return the contents of the file, without values that were left to their defaults."""
        return self.model_dump(mode='json', exclude_unset=True)

    def write(self, folder: Path) -> None:
        """Write it into a checkpoint's or adapter's folder."""
        (folder / CARD).write_text(json.dumps(self.plain(), indent=2) + '\n')


#: keys that only some checkpoints have
OPTIONAL_KEYS = tuple(k for k, f in CheckpointCard.model_fields.items() if not f.is_required())
#: keys whose values must be equal in an adapter and its checkpoint
SHARED_KEYS = tuple(
    key
    for key in CheckpointCard.model_fields
    if key not in ('rendering', 'trained_on', *OPTIONAL_KEYS)
)


def read_card(folder: Path) -> CheckpointCard:
    """Return the contents of `world_model.json`.

    Raises:
        CheckpointError: missing, not JSON, or with missing, unknown or wrong values.
    """
    path = Path(folder) / CARD
    if not path.is_file():
        raise CheckpointError(
            f"'{folder}' is not a checkpoint: it has no {CARD}; train one with 'mtv-world train' "
            "or set 'checkpoint' to a folder that has it"
        )
    try:
        values = read_json(path)
    except (OSError, ValueError) as error:
        raise CheckpointError(f"'{path}' is not valid JSON: {error}") from error
    return validated(CheckpointCard, values, f"'{path}'", error=CheckpointError)


def check_same_model(card: CheckpointCard, adapter: Path) -> None:
    """Check that an adapter was trained for a model of the same inputs and outputs.

    Args:
        card: card of the checkpoint.
        adapter: folder of the adapter; one without a card of its own is not checked.

    Raises:
        CheckpointError: the adapter was trained for another model.
    """
    if not (adapter / CARD).is_file():
        return
    theirs = read_card(adapter)
    own, given = card.plain(), theirs.plain()
    for key in SHARED_KEYS:
        mine, other = own[key], given[key]
        if mine != other:
            raise CheckpointError(
                f"adapter '{adapter}' was trained with '{key}' {other}, this checkpoint's is "
                f'{mine}; use the checkpoint that it was trained on'
            )
    mine, other = card.history, theirs.history
    if mine != other:
        raise CheckpointError(
            f"adapter '{adapter}' was trained with history ({_settings(other)}), this checkpoint "
            f'has ({_settings(mine)}); use the checkpoint that it was trained on'
        )


def _settings(history: HistorySettings) -> str:
    return ', '.join(f'{name} {value}' for name, value in history.model_dump().items())
