"""Training presets, and a training as a whole: preset, data, where and how it runs."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, InstanceOf, model_validator

from mtv_world_ros.control.control import ControlOptions
from mtv_world_ros.control.registry import check_control_name, CONTROLS, TRAJECTORY_VIDEO
from mtv_world_ros.control.trajectory_video import TrajectoryVideoConfig
from mtv_world_ros.core.config import (
    Count,
    expected,
    Factor,
    ListOf,
    read_yaml,
    Schema,
    Share,
    validated,
    Wait,
)
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.core.files import bundled
from mtv_world_ros.data.bag_mapping import EpisodeSource
from mtv_world_ros.model.card import CheckpointCard, HistorySettings
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.robot.model import RobotModel

#: in a loss
Weight = Annotated[float, Field(ge=0, le=1000)]


class VideoConfig(Schema):
    """Video that the model sees and predicts: views, size, rate, robot."""

    section: ClassVar = 'video'
    basic: ClassVar = ('views', 'fps', 'num_frames', 'width', 'height', 'robot', 'control')

    views: ListOf[str] = Field(default=('low', 'high'), description='names of the views')
    fps: float = Field(default=5.0, gt=0, le=1000, description='frames a second')
    num_frames: Count = Field(default=16, description='T, predicted frames of a chunk')
    width: Count = Field(default=96, description='width of a frame [px]')
    height: Count = Field(default=72, description='height of a frame [px]')
    robot: str = Field(default='yam_bimanual', description='bundled robot, or a robot YAML')
    control: Annotated[str, AfterValidator(check_control_name)] = Field(
        default=TRAJECTORY_VIDEO,
        description=f'how a plan enters the model: {", ".join(CONTROLS)}, the name of an entry '
        "point of mtv_world.controls, or module:Class; the first is the paper's method",
    )
    object_mask: bool = Field(
        default=True, description="the trajectory video carries the objects' masks"
    )
    clip_stride_s: Wait = Field(
        default=0.0,
        description='time between starts of training clips [s]; 0 = one from every frame',
    )


class ObjectiveConfig(Schema):
    """The loss: see `objective.py`."""

    section: ClassVar = 'objective'

    sigma_shift: Factor = Field(default=5.0, description='draws noise levels towards high noise')
    full_noise_share: Share = Field(
        default=0.25, description='share of samples at noise level 1, where sampling starts'
    )
    sigma_weighting: Literal['uniform', 'middle'] = Field(
        default='uniform',
        description="weight of a sample by its noise level; `middle` is DiffSynth-Studio's",
    )
    huber_delta: Annotated[
        float | None, Field(gt=0, le=1000), expected('positive, or null for the squared error')
    ] = Field(default=0.1, description='in units of the latents; null = squared error, as Wan')
    change_weight: Weight = Field(
        default=4.0, description='extra weight of pixels that differ from the start frame'
    )
    object_weight: Weight = Field(default=6.0, description='extra weight of pixels on objects')
    moved_weight: Weight = Field(
        default=10.0, description='extra weight of pixels where objects came or went'
    )
    attempt_weight: Weight = Field(
        default=0.0,
        description='extra weight of pixels where an object was that a gripper closes at, and '
        'where it would carry it; unlike the three above it is the same for a grasp and a miss, '
        'so that an imagined grasp gains nothing',
    )


class AugmentConfig(Schema):
    """Disturbances of the start frame and of colours, and which episodes are seen how often."""

    section: ClassVar = 'augment'
    removed: ClassVar = {
        'start_noise_std': 'it is 0.04 in every training; `start_noise` is its probability'
    }

    start_noise: Share = Field(
        default=0.5, description='probability of a start frame that is blurred and noisy'
    )
    colour_permutation: Share = Field(
        default=0.3, description='probability of exchanged colour channels'
    )
    failure_share: Share | None = Field(
        default=None,
        description='share of clips drawn from failed episodes alone, on top of those that come '
        'by chance: they are few, and a model that rarely sees a miss imagines grasps instead',
    )
    name_dropout: Share = Field(
        default=0.0,
        description='probability of a clip of which only some objects, or none, are named, so '
        'that what an instruction does not name stays in the picture',
    )
    control_dropout: Share = Field(
        default=0.0, description='probability of a sample without its trajectory video'
    )
    reference_dropout: Share = Field(
        default=0.0, description='probability of a sample without its reference image'
    )
    start_dropout: Share = Field(
        default=0.0, description="probability of a sample without its start image's channel slot"
    )
    image_dropout: Share = Field(
        default=0.0, description="probability of a sample without its start image's CLIP tokens"
    )


class HistoryConfig(HistorySettings):
    """Conditioning of clips on the frames before them; see `clips/clip_controls.py`."""

    max_noise: Annotated[float, Field(ge=0, lt=1)] = Field(
        default=0.3,
        description='noise levels are drawn from 0 to this; serving uses `noise_level`',
    )
    first_share: Share = Field(
        default=0.3,
        description='share of clips that start a rollout, without anything before them',
    )
    dropout: Share = Field(
        default=0.1, description='probability that a clip within a rollout has no history tokens'
    )

    @model_validator(mode='after')
    def _serving_shows_nothing_new(self) -> Self:
        if self.noise_level > self.max_noise:
            raise ValueError(
                f'max_noise is {self.max_noise}; it must be below 1 and at least '
                f'history.noise_level, {self.noise_level}, so that serving shows nothing new'
            )
        return self


class SelfRolloutConfig(Schema):
    """Clips that start from the end of the model's own rollout; see `self_rollout.py`."""

    section: ClassVar = 'self_rollout'

    share: Share = Field(
        default=0.0,
        description="probability of a clip that starts where the model's own rollout of the "
        'chunks before it ends, if the episode is long enough; 0 = off',
    )
    max_chunks: Count = Field(
        default=2, description='longest rollout [chunks]; all lengths from 1 on are equally likely'
    )
    start_step: int = Field(default=0, ge=0, description='first training step with such clips')


class SamplingConfig(Schema):
    """Default sampling settings of the checkpoint."""

    section: ClassVar = 'sampling'
    basic: ClassVar = ('num_inference_steps',)

    num_inference_steps: Count = Field(default=4, description='denoising steps')
    guidance_scale: float = Field(
        default=1.0,
        ge=-1000,
        le=1000,
        description='guidance on the text, and on a control that samples were trained without '
        '(ee_mlp); 1 = none, which halves the time',
    )
    negative_prompt: str = Field(default='', description='text that guidance leads away from')
    scene_memory: bool = Field(
        default=False,
        description='what neither the robot nor a named object that it may have moved covers '
        'stays as real frames of the rollout showed it (cameras that stand still)',
    )


class OptimizerConfig(Schema):
    """AdamW with warm-up, a constant stretch and a linear decay to zero."""

    section: ClassVar = 'optimizer'
    basic: ClassVar = ('steps', 'batch_size', 'learning_rate')

    learning_rate: float = Field(default=6e-4, ge=0, le=100, description='after the warm-up')
    weight_decay: Weight = Field(default=0.01, description='weight decay of AdamW')
    warmup_steps: int = Field(
        default=200, description='steps of the warm-up; at most a fifth of all steps'
    )
    decay_share: Share = Field(
        default=0.35, description='share of the steps in which the rate decays'
    )
    max_grad_norm: float = Field(
        default=1.0, gt=0, le=1e6, description='longer gradients are scaled down to it'
    )
    ema_decay: Share = Field(
        default=0.999, description='decay of the averaged weights, which become the checkpoint'
    )
    batch_size: int = Field(
        default=4, description='clips of a step, over all processes and accumulated parts'
    )
    accumulation: int = Field(
        default=1,
        description='parts that a process computes one after the other; more take less memory',
    )
    gradient_checkpointing: bool = Field(
        default=False, description='recompute blocks in the backward pass instead of keeping them'
    )
    fully_shard: bool = Field(
        default=False,
        description='every process holds a share of weights, gradients and averages (FSDP2), for '
        'models that are too large for one device; several processes, no self-rollout',
    )
    compile: bool = Field(
        default=False, description="compile the transformer's repeated block; minutes on a CPU"
    )
    steps: int = Field(default=5000, description='number of training steps')
    epochs: Annotated[float | None, expected('positive, or null')] = Field(
        default=None,
        gt=0,
        le=1e6,
        description='instead of `steps`: a multiple of the number of clips',
    )

    @property
    def warmup(self) -> int:
        """Steps of the warm-up, shorter than `warmup_steps` in a short training."""
        return min(self.warmup_steps, self.steps // 5)

    @model_validator(mode='after')
    def _parts_have_clips(self) -> Self:
        if not 1 <= self.accumulation <= self.batch_size:
            raise ValueError(
                f'accumulation is {self.accumulation}, must be 1 to '
                f'optimizer.batch_size, {self.batch_size}'
            )
        return self


class LoraSettings(Schema):
    """A LoRA adapter on frozen weights, see `lora.py`."""

    section: ClassVar = 'lora'

    rank: Annotated[int, expected('positive, at most 4096, or 0 for none')] = Field(
        default=0, ge=0, le=4096, description='0 = all weights are trained'
    )
    alpha: Factor = Field(default=32.0, description='scale of the adapter; divided by `rank`')


class TrainingConfig(Schema):
    """A whole preset."""

    section: ClassVar = ''

    transformer: dict[str, Any] = Field(
        default={}, description='arguments of `MultiViewWanTransformer`'
    )
    autoencoder: dict[str, Any] = Field(default={}, description='arguments of the autoencoder')
    scheduler: dict[str, Any] = Field(default={}, description='arguments of the noise schedule')
    video: VideoConfig = Field(default=VideoConfig(), description='views, size, rate, robot')
    rendering: TrajectoryVideoConfig = Field(
        default=TrajectoryVideoConfig(), description='appearance of the trajectory video'
    )
    objective: ObjectiveConfig = Field(default=ObjectiveConfig(), description='loss')
    augment: AugmentConfig = Field(default=AugmentConfig(), description='data augmentation')
    history: HistoryConfig = Field(default=HistoryConfig(), description='earlier frames')
    self_rollout: SelfRolloutConfig = Field(
        default=SelfRolloutConfig(), description="clips from the model's own rollouts"
    )
    sampling: SamplingConfig = Field(
        default=SamplingConfig(), description='sampling settings of the checkpoint'
    )
    lora: LoraSettings = Field(default=LoraSettings(), description='LoRA adapter')
    optimizer: OptimizerConfig = Field(default=OptimizerConfig(), description='optimiser')

    @model_validator(mode='after')
    def _shared_weights_do_not_imagine(self) -> Self:
        if self.optimizer.fully_shard and self.self_rollout.share:
            raise ValueError(
                f'optimizer.fully_shard is true and self_rollout.share {self.self_rollout.share}; '
                'only whole weights imagine clips: set one of them to false or 0'
            )
        return self

    @property
    def spec(self) -> WorldModelSpec:
        """Inputs and outputs of a model of this configuration."""
        return self.card({}).spec

    def control_options(self, robot: RobotModel) -> ControlOptions:
        """Return the options that the control is created with."""
        return ControlOptions(
            robot=robot,
            rendering=self.rendering.model_dump(),
            object_mask=self.video.object_mask,
            num_frames=self.video.num_frames,
        )

    def with_steps(self, num_clips: int) -> TrainingConfig:
        """Return a copy with `epochs` converted to steps, if it counts in epochs."""
        optimizer = self.optimizer
        if optimizer.epochs is None:
            return self
        steps = max(1, ceil(optimizer.epochs * num_clips / optimizer.batch_size))
        return self.replace(optimizer=optimizer.replace(steps=steps))

    def card(self, trained_on: Mapping[str, Any], **text: Any) -> CheckpointCard:
        """Return the checkpoint's card; `trained_on` says where weights come from."""
        if self.sampling.scene_memory:
            text['scene_memory'] = True
        return CheckpointCard(
            **self.video.model_dump(mode='json', exclude={'clip_stride_s'}),
            rendering=self.rendering.model_dump(),
            **self.history.as_card(),
            num_inference_steps=self.sampling.num_inference_steps,
            trained_on=dict(trained_on),
            **text,
        )


def _opened(checkpoint: Any) -> Checkpoint | None:
    """Return the checkpoint of a name or path; one that was opened before stays as it is."""
    return None if checkpoint is None else Checkpoint.open(checkpoint)


class TrainingRun(Schema):
    """A training as a whole: preset, data, device, saving."""

    section: ClassVar = ''

    config: TrainingConfig = Field(description='the preset')
    dataset: Path | ListOf[Path] = Field(description='folder of episodes, or the episode folders')
    out: Path = Field(
        description='gets `state/` (to resume), `log.jsonl`, TensorBoard events and `checkpoint/`'
    )
    num_episodes: Count | None = Field(
        default=None, description='use this many episodes, spread evenly over the data set'
    )
    broken: dict[str, str] = Field(
        default={}, description='episodes to leave out, and why, by path'
    )
    source: EpisodeSource = Field(
        default=EpisodeSource(),
        description="how episodes are read that are not this package's own",
    )
    initial: Annotated[InstanceOf[Checkpoint] | None, BeforeValidator(_opened)] = Field(
        default=None,
        description='checkpoint whose weights a new run starts from; a resumed run has its own. '
        'For an adapter or a model with text, its other parts are used too, also when resumed',
    )
    seed: int = Field(default=0, description='of weights, noise and batches')
    device: str = Field(default='cpu', description='e.g. `cpu`, `cuda`')
    dtype: str = Field(
        default='float32', description='of forward and backward, of `runtime.choose_dtype`'
    )
    save_every: Count = Field(default=250, description='steps between saved states')
    save_minutes: float = Field(
        default=10.0, ge=0, le=1e5, description='longest time between saved states [min]'
    )
    cache: Path | None = Field(
        default=None,
        description="keeps the recordings at the model's size; default: `out/cache`. Runs may "
        'share it',
    )
    latent_cache: Path | None = Field(
        default=None,
        description='keeps what the encoders make of the clips; None = encode in every step',
    )
    data_workers: int = Field(
        default=0, ge=0, description='processes that prepare clips; 0 = a thread of this one'
    )
    peak_tflops: float | None = Field(
        default=None,
        ge=0,
        le=1e6,
        description="peak rate of a process's device [10^12 operations/s], for the utilisation in "
        'the log; 0 = measure it, None = log no utilisation',
    )


def load_training_config(
    preset: str | Path, overrides: Mapping[str, Any] | None = None
) -> TrainingConfig:
    """Read a preset by name (`small`) or path, and lay overrides like `optimizer.steps` on it.

    Raises:
        ConfigError: no such preset, an unknown key (names the nearest known one) or wrong value.
    """
    path = bundled('models', preset, '--preset')
    values = read_yaml(path, 'preset file', '--preset') or {}
    for dotted, value in (overrides or {}).items():
        section, _, key = dotted.partition('.')
        if not key:
            raise ConfigError(f"override '{dotted}' must look like section.key, e.g. video.fps")
        values.setdefault(section, {})[key] = value
    return validated(TrainingConfig, values, str(path))
