"""Training presets: YAML read into dataclasses, unknown keys refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from math import ceil
from pathlib import Path
from typing import Any

from mtv_world_ros.config import check_keys, read_yaml
from mtv_world_ros.data_types import WorldModelSpec
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.files import share_path
from mtv_world_ros.model.action_features import check_control, TRAJECTORY_VIDEO
from mtv_world_ros.model.card import spec_of
from mtv_world_ros.model.history_tokens import HistorySettings
from mtv_world_ros.rendering.trajectory_video import TrajectoryVideoConfig

_SIGMA_WEIGHTINGS = ('uniform', 'middle')
_PROBABILITIES = (
    'name_dropout',
    'start_noise',
    'colour_permutation',
    'action_dropout',
    'control_dropout',
    'reference_dropout',
    'image_dropout',
)


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimizerConfig:
    """AdamW with warm-up, a constant stretch and a linear decay to zero.

    Attributes:
        learning_rate: the highest.
        weight_decay: AdamW's.
        warmup_steps: until the rate is the highest.
        decay_share: of the steps, at the end.
        max_grad_norm: longer gradients are shortened to it.
        ema_decay: of the averaged weights, which the checkpoint holds.
        batch_size: clips of a step, over all processes and accumulated parts.
        accumulation: parts that a process computes one after the other; more take less memory.
        gradient_checkpointing: computes blocks again in the backward pass instead of keeping them.
        steps: of the whole training.
        epochs: in place of `steps`: so many times the number of clips; null = `steps` holds.
    """

    learning_rate: float = 6e-4
    weight_decay: float = 0.01
    warmup_steps: int = 200
    decay_share: float = 0.35
    max_grad_norm: float = 1.0
    ema_decay: float = 0.999
    batch_size: int = 4
    accumulation: int = 1
    gradient_checkpointing: bool = False
    steps: int = 5000
    epochs: float | None = None

    def __post_init__(self) -> None:
        if self.epochs is not None and not self.epochs > 0:
            raise ConfigError(f'optimizer.epochs is {self.epochs}; it must be positive, or null')
        if not 1 <= self.accumulation <= self.batch_size:
            raise ConfigError(
                f'optimizer.accumulation is {self.accumulation}, must be 1 to '
                f'optimizer.batch_size, {self.batch_size}'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class LoraSettings:
    """A LoRA adapter on frozen weights, see `lora.py`; rank 0 = all weights are trained."""

    rank: int = 0
    alpha: float = 32.0

    def __post_init__(self) -> None:
        if self.rank < 0:
            raise ConfigError(f'lora.rank is {self.rank}; it must be positive, or 0 for none')


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoConfig:
    """What the model sees and predicts: views, frame rate [Hz], T, size [px], robot, control.

    Attributes:
        control: how the actions enter, of `action_features.CONTROLS`.
        object_mask: whether the trajectory video carries the objects' masks.
        clip_stride_s: time between the starts of training clips [s]; 0 = one from every frame.
    """

    views: tuple[str, ...] = ('low', 'high')
    fps: float = 5.0
    num_frames: int = 16
    width: int = 96
    height: int = 72
    robot: str = 'yam_bimanual'
    control: str = TRAJECTORY_VIDEO
    object_mask: bool = True
    clip_stride_s: float = 0.0

    def __post_init__(self) -> None:
        check_control(self.control)


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectiveConfig:
    """The loss: see `objective.py`.

    Attributes:
        sigma_shift: draws noise levels towards high noise.
        full_noise_share: share of samples at noise level 1, where sampling starts.
        sigma_weighting: how much samples count by their noise level: `uniform`, or `middle`
            (DiffSynth-Studio's, see `sigma_weights`).
        huber_delta: in units of the latents; None = the squared error, as Wan was trained.
        change_weight: extra weight of pixels that differ from the start frame.
        object_weight: extra weight of pixels on objects.
        moved_weight: extra weight of pixels where objects came or went.
    """

    sigma_shift: float = 5.0
    full_noise_share: float = 0.25
    sigma_weighting: str = 'uniform'
    huber_delta: float | None = 0.1
    change_weight: float = 4.0
    object_weight: float = 6.0
    moved_weight: float = 10.0

    def __post_init__(self) -> None:
        if self.sigma_weighting not in _SIGMA_WEIGHTINGS:
            raise ConfigError(
                f"objective.sigma_weighting '{self.sigma_weighting}' is not one of "
                f'{", ".join(_SIGMA_WEIGHTINGS)}'
            )
        if self.huber_delta is not None and not self.huber_delta > 0:
            raise ConfigError(
                f'objective.huber_delta is {self.huber_delta}; it must be positive, or null for '
                'the squared error'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class AugmentConfig:
    """Disturbances of the start frame and of colours, and which episodes are seen how often.

    Attributes:
        start_noise: probability of a start frame that is blurred and noisy.
        start_noise_std: largest standard deviation of that noise, as a share of full range.
        colour_permutation: probability of exchanged colour channels.
        failure_share: share of clips drawn from failed episodes alone, on top of those that come
            by chance: they are few, and a model that rarely sees a miss imagines grasps instead.
        name_dropout: probability of a clip of which only some objects, or none, are named, so that
            what an instruction does not name stays in the picture.
        action_dropout: probability of a sample without its actions; control `ee_mlp` alone
            (Ctrl-World's value).
        control_dropout: probability of a sample without its trajectory video.
        reference_dropout: of one without its start image.
        image_dropout: of one without that image's CLIP tokens.
    """

    start_noise: float = 0.5
    start_noise_std: float = 0.04
    colour_permutation: float = 0.3
    failure_share: float | None = None
    name_dropout: float = 0.0
    action_dropout: float = 0.05
    control_dropout: float = 0.0
    reference_dropout: float = 0.0
    image_dropout: float = 0.0

    def __post_init__(self) -> None:
        for name in _PROBABILITIES:
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ConfigError(f'augment.{name} is {value}; it must be in [0, 1]')


@dataclass(frozen=True, slots=True, kw_only=True)
class HistoryConfig(HistorySettings):
    """How clips are shown what came before them; see `clips/past.py`.

    Attributes:
        max_noise: noise levels are drawn from 0 up to this; serving has `noise_level`.
        first_share: share of clips that a rollout begins with, as every rollout does.
        dropout: probability that a clip within a rollout has no history tokens.
    """

    max_noise: float = 0.3
    first_share: float = 0.3
    dropout: float = 0.1

    def __post_init__(self) -> None:
        HistorySettings.__post_init__(self)
        for name in ('first_share', 'dropout'):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ConfigError(f'history.{name} is {value}; it must be in [0, 1]')
        if not self.noise_level <= self.max_noise < 1:
            raise ConfigError(
                f'history.max_noise is {self.max_noise}; it must be below 1 and at least '
                f'history.noise_level, {self.noise_level}, so that serving shows nothing new'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfRolloutConfig:
    """Clips that start where the model's own rollout ended; see `self_rollout.py`.

    Attributes:
        share: probability of such a clip, where the episode is long enough before it; 0 = off.
        steps: denoising steps of the rollout.
        max_chunks: longest rollout; from 1 on, all lengths are as likely.
        start_step: training step from which on it is done.
    """

    share: float = 0.0
    steps: int = 1
    max_chunks: int = 3
    start_step: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise ConfigError(f'self_rollout.share is {self.share}; it must be in 0 .. 1')
        for name in ('steps', 'max_chunks'):
            if getattr(self, name) < 1:
                raise ConfigError(
                    f'self_rollout.{name} is {getattr(self, name)}; it must be at least 1'
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingConfig:
    """How its checkpoints are sampled where nothing else is said.

    Attributes:
        num_inference_steps: denoising steps.
    """

    num_inference_steps: int = 4

    def __post_init__(self) -> None:
        if self.num_inference_steps < 1:
            raise ConfigError(
                f'sampling.num_inference_steps is {self.num_inference_steps}; it must be at '
                'least 1'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """A whole preset.

    Attributes:
        transformer: arguments of `MultiViewWanTransformer`.
        autoencoder: arguments of the autoencoder.
        scheduler: arguments of the noise schedule.
        video: what the model sees.
        rendering: how trajectory videos look.
        objective: the loss.
        augment: disturbances.
        history: what clips are shown of what came before them; off by default.
        self_rollout: clips that start from the model's own predictions.
        sampling: what its checkpoints are served with.
        lora: what is trained in place of all weights.
        optimizer: steps and rates.
    """

    transformer: dict[str, Any] = field(default_factory=dict)
    autoencoder: dict[str, Any] = field(default_factory=dict)
    scheduler: dict[str, Any] = field(default_factory=dict)
    video: VideoConfig = VideoConfig()
    rendering: TrajectoryVideoConfig = TrajectoryVideoConfig()
    objective: ObjectiveConfig = ObjectiveConfig()
    augment: AugmentConfig = AugmentConfig()
    history: HistoryConfig = HistoryConfig()
    self_rollout: SelfRolloutConfig = SelfRolloutConfig()
    sampling: SamplingConfig = SamplingConfig()
    lora: LoraSettings = LoraSettings()
    optimizer: OptimizerConfig = OptimizerConfig()

    @property
    def spec(self) -> WorldModelSpec:
        """What a model of this configuration takes and gives."""
        return spec_of(self.card({}))

    def with_steps(self, num_clips: int) -> TrainingConfig:
        """Returns the same with the steps that its epochs come to, where it counts in epochs."""
        optimizer = self.optimizer
        if optimizer.epochs is None:
            return self
        steps = max(1, ceil(optimizer.epochs * num_clips / optimizer.batch_size))
        return replace(self, optimizer=replace(optimizer, steps=steps))

    def as_dict(self) -> dict[str, Any]:
        """The configuration as plain values, for the checkpoint's card."""
        return asdict(self)

    def card(self, trained_on: Mapping[str, Any]) -> dict[str, Any]:
        """The checkpoint's card, `world_model.json`; `trained_on` says where weights come from."""
        video = self.video
        return {
            'views': list(video.views),
            'fps': video.fps,
            'num_frames': video.num_frames,
            'width': video.width,
            'height': video.height,
            'robot': video.robot,
            'control': video.control,
            'object_mask': video.object_mask,
            'rendering': self.as_dict()['rendering'],
            **self.history.as_card(),
            'num_inference_steps': self.sampling.num_inference_steps,
            'trained_on': dict(trained_on),
        }


def load_training_config(
    preset: str | Path, overrides: Mapping[str, Any] | None = None
) -> TrainingConfig:
    """Reads a preset by name (`small`) or path, and lays overrides like `optimizer.steps` on it.

    Raises:
        ConfigError: no such preset, or an unknown key (names the nearest known one).
    """
    path = Path(preset)
    if path.suffix not in ('.yaml', '.yml'):
        path = share_path('config', 'models', f'{preset}.yaml')
    values = read_yaml(path, 'preset file', '--preset') or {}
    for dotted, value in (overrides or {}).items():
        section, _, key = dotted.partition('.')
        if not key:
            raise ConfigError(f"override '{dotted}' must look like section.key, e.g. video.fps")
        values.setdefault(section, {})[key] = value
    return _read(TrainingConfig, values, str(path))


def _read(kind: Any, values: Any, where: str) -> Any:
    known = [item.name for item in fields(kind)]
    arguments = {}
    for key, value in check_keys(values, known, (), where).items():
        default = getattr(kind(), key)
        if hasattr(type(default), '__dataclass_fields__'):
            value = _read(type(default), value, f'{where}: {key}')
        elif isinstance(default, tuple):
            value = tuple(value)
        arguments[key] = value
    return kind(**arguments)
