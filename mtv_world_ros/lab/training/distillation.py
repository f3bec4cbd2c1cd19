"""`mtv-world distill`: a student that samples in a few steps what its teacher does in many.

Each of the student's n steps has to reach what the teacher reaches in m steps of its own. A step
of training draws noise, follows the teacher down all n * m noise levels, and trains the student,
at each of the n levels where it will be evaluated, to predict the straight flow to the next one.
With every line learned, n Euler steps of the student end where n * m of the teacher do; sampler,
schedule and the model's form stay what they are.

Followed: PeRFlow (Yan et al. 2024, arXiv:2405.07510), which straightens a flow within windows; and
FlowSteer (arXiv:2511.18834), which found that PeRFlow fell behind because its windows begin at
noised data, which sampling does not meet, and begins them on the teacher's own path from noise, as
is done here. A guided teacher is followed with its guidance, so that the student needs none (Meng
et al. 2023, arXiv:2210.03142).

Not followed: DMD2 (arXiv:2405.14867; FastWan, LightX2V) and rCM (arXiv:2510.08431), with which the
public 4-step Wan models were made. DMD2 trains a second network for the score of the student's
samples and pulls them towards likely ones (FastWan: 64 H200 for 12 hours); rCM takes derivatives
through the attention kernels and adds that loss. Both match a distribution, where a world model is
asked for the one video that its actions lead to; lines need the teacher and nothing else.

Shape letters: B batch, n the student's steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
import json
from pathlib import Path
from typing import Any, Self

from diffusers import FlowMatchEulerDiscreteScheduler
from pydantic import Field, model_validator
import torch
from torch import Tensor

from mtv_world_ros.bounded_input import read_json
from mtv_world_ros.config import Schema
from mtv_world_ros.errors import TrainingError
from mtv_world_ros.files import write_whole
from mtv_world_ros.geometry.robot.model import RobotModel
from mtv_world_ros.lab.training.clips.batches import Batch
from mtv_world_ros.lab.training.encoding import encode_batch, Encoders
from mtv_world_ros.lab.training.objective import Draws, Loss, sample_loss
from mtv_world_ros.lab.training.trainer import Trainer
from mtv_world_ros.lab.training.training_config import (
    LoraSettings,
    TrainingConfig,
    TrainingRun,
    VideoConfig,
)
from mtv_world_ros.lab.training.training_run import train
from mtv_world_ros.model.card import CheckpointCard
from mtv_world_ros.model.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from mtv_world_ros.model.conditioning import Conditioning
from mtv_world_ros.model.lora import Adapters
from mtv_world_ros.model.parts import build_scheduler, Scheduler
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.sampler import denoise, flow_of, set_timesteps
from mtv_world_ros.model.transformer.transformer import copy_of
from mtv_world_ros.rendering.trajectory_video import TrajectoryVideoConfig
from mtv_world_ros.vision.describers.describer import Describer
from mtv_world_ros.vision.segmenters.segmenter import Segmenter

_SETTINGS = 'distillation.json'


class DistillConfig(Schema):
    """Numbers of denoising steps."""

    num_steps: int = Field(default=4, description="the student's")
    teacher_steps: int = Field(default=32, description="the teacher's, a multiple of `num_steps`")

    @model_validator(mode='after')
    def _steps_divide(self) -> Self:
        if self.num_steps < 1:
            raise ValueError(f'--steps is {self.num_steps}; the student needs at least 1')
        if self.teacher_steps < self.num_steps or self.teacher_steps % self.num_steps:
            raise ValueError(
                f'--teacher-steps is {self.teacher_steps}; it must be a multiple of --steps, '
                f'e.g. {8 * self.num_steps}'
            )
        return self

    @property
    def substeps(self) -> int:
        """Teacher steps per student step."""
        return self.teacher_steps // self.num_steps


class DistillTrainer(Trainer):
    """Trains a student that starts from its teacher's weights.

    Args:
        teacher: to distil; guided if its card has a guidance scale.
        distill: numbers of steps.
        options: those of `Trainer`.
    """

    def __init__(self, *args: Any, teacher: Checkpoint, distill: DistillConfig, **options: Any):
        super().__init__(*args, **options)
        self.parts, self.distill = teacher, distill
        if teacher.adapter is not None:
            Adapters(teacher.transformer, fuse=True).use(teacher.adapter)
        # before it takes the number format of forward and backward
        self._first = {n: t.clone() for n, t in teacher.transformer.state_dict().items()}
        dtype = self.weights.worker.dtype
        self.teacher = place(copy_of(teacher.transformer), self.device, dtype).eval()
        self.teacher.requires_grad_(False)
        self.autoencoder = place(teacher.autoencoder, self.device, torch.float32)
        self.guidance = teacher.card.guidance_scale
        self.encoders = self._encoders(teacher)
        self._negative = self._text(teacher.card.negative_prompt) if self.guidance != 1.0 else None
        self._sigmas = path_sigmas(teacher.scheduler, distill.num_steps, distill.substeps)

    def _encoders(self, teacher: Checkpoint) -> Encoders:
        if teacher.image_encoder is not None:
            teacher.image_encoder.to(self.device, self.weights.worker.dtype)
        return Encoders(
            autoencoder=self.autoencoder,
            text=self._text(teacher.card.prompt),
            image=teacher.image_encoder,
            history=self.config.history,
        )

    def _text(self, text: str) -> Tensor | None:
        """Tokens of a text; None in models without text."""
        encoder = self.parts.text_encoder
        if encoder is None:
            return None
        # a copy: what encoding gives takes no part in gradients
        return encoder.encode(text, self.device).clone()

    def start_from(self, folder: Path) -> None:
        """Takes the teacher's weights, its adapter merged."""
        del folder
        self.weights.worker.load_state_dict(self._first)
        self.weights.load(self._first)
        self.weights.ema.shadow_params = [p.detach().clone() for p in self.weights.parameters]

    def loss(self, batch: Batch) -> Loss:
        """The loss of all student steps along one path of the teacher per clip."""
        encoded = encode_batch(self.encoders, batch, self.config.objective, self.device)
        condition = encoded.conditioning
        if self.weights.worker.start_image == 'either':
            condition = condition.with_one_start()
        condition = condition.in_dtype(self.weights.worker.dtype)
        draws = Draws(self.seed, batch.step, batch.numbers)
        noise = draws.normal(*encoded.clean.shape[1:]).to(self.device)
        if condition.history is not None:
            noisy = draws.normal(*condition.history.shape[1:]).to(self.device)
            condition = condition.with_noisy_history(noisy)
        sigmas = self._sigmas.to(self.device)
        points = follow(
            lambda latents, sigma: self._teacher_flow(latents, sigma, condition),
            noise,
            sigmas,
            self.distill.substeps,
        )
        levels = sigmas[:: self.distill.substeps]
        losses = [
            self._line_loss(latents, sigma, flow, condition, encoded.weights)
            for latents, sigma, flow in zip(
                points[:-1], levels[:-1], straight_flows(points, levels), strict=True
            )
        ]
        return Loss(
            torch.stack([loss.total for loss in losses]).sum(),
            torch.stack([loss.weight for loss in losses]).sum(),
        )

    def _line_loss(
        self,
        latents: Tensor,
        sigma: Tensor,
        flow: Tensor,
        condition: Conditioning,
        weights: Tensor,
    ) -> Loss:
        student = self.weights.worker
        target = as_predicted(student.prediction, flow, latents, sigma)
        predicted = denoise(student, latents, 1000 * sigma, condition, condition.text)
        return sample_loss(predicted, target, weights, self.config.objective.huber_delta)

    def _teacher_flow(self, latents: Tensor, sigma: Tensor, condition: Conditioning) -> Tensor:
        out = denoise(self.teacher, latents, 1000 * sigma, condition, condition.text)
        if self._negative is not None:
            negative = self._negative.to(self.teacher.dtype).expand(len(latents), -1, -1)
            away = denoise(self.teacher, latents, 1000 * sigma, condition, negative)
            out = away + self.guidance * (out - away)
        return flow_of(self.teacher, out, latents, sigma)

    def export(self, folder: Path, *, dtype: torch.dtype = torch.float16) -> None:
        """Writes the averaged student with the teacher's other parts as a checkpoint."""
        trained_on = {
            **self.trained_on,
            'steps': self.step,
            'seed': self.seed,
            'distilled': self.distill.model_dump(),
            'teacher': self.parts.card.trained_on,
        }
        card = {
            **self.parts.card.plain(),
            'num_inference_steps': self.distill.num_steps,
            'trained_on': trained_on,
        }
        card.pop('guidance_scale', None)  # the student has learned guidance
        student = replace(
            self.parts,
            transformer=self.weights.averaged(),
            scheduler=straight_scheduler(self.parts.scheduler),
            card=CheckpointCard(**card),
            adapter=None,
            robot=self.robot or self.parts.robot,
        )
        save_checkpoint(student, folder, dtype=dtype)


def distill(
    checkpoint: Path,
    run: TrainingRun,
    settings: DistillConfig,
    *,
    robot: RobotModel,
    segmenter: Segmenter,
    describer: Describer | None = None,
) -> Path:
    """Distils a checkpoint, resuming what `run.out` holds; returns the student's folder.

    Args:
        checkpoint: the teacher.
        run: the training. Start frames and actions of its episodes are inputs, later frames only
            give pixel weights. Optimizer, objective and augmentation of its preset are used; the
            rest is the teacher's.
        settings: numbers of steps.
        robot: of the episodes.
        segmenter: finds the objects of the first frames.
        describer: names them; None = the episodes, else their instructions.

    Raises:
        CheckpointError: the teacher cannot be loaded.
        TrainingError: `out` holds another distillation; see also `train`.
    """
    teacher = load_checkpoint(checkpoint)
    _check_same(run.out, {**settings.model_dump(), 'teacher': teacher.card.trained_on})
    return train(
        run.replace(config=student_config(run.config, teacher), initial=checkpoint),
        robot=robot,
        segmenter=segmenter,
        describer=describer,
        make_trainer=partial(DistillTrainer, teacher=teacher, distill=settings),
    )


def student_config(config: TrainingConfig, teacher: Checkpoint) -> TrainingConfig:
    """Returns a configuration with the teacher's architecture, video and rendering."""
    card, spec = teacher.card, teacher.card.spec
    return config.replace(
        transformer=_arguments(teacher.transformer.config),
        autoencoder=_with_class(getattr(teacher.autoencoder, 'vae', teacher.autoencoder)),
        scheduler=_with_class(teacher.scheduler),
        video=VideoConfig(
            views=spec.views,
            fps=spec.fps,
            num_frames=spec.num_frames,
            width=spec.width,
            height=spec.height,
            robot=spec.robot,
            control=card.control,
            object_mask=card.object_mask,
        ),
        rendering=TrajectoryVideoConfig(**card.rendering),
        history=config.history.replace(**dict(card.history)),
        lora=LoraSettings(),  # all of the student is trained
    )


def _arguments(config: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in config.items() if not name.startswith('_')}


def _with_class(part: Any) -> dict[str, Any]:
    return {**_arguments(part.config), '_class_name': type(part).__name__}


def _check_same(out: Path, settings: Mapping[str, Any]) -> None:
    file = out / _SETTINGS
    wanted = json.loads(json.dumps(settings))
    if file.is_file():
        try:
            found = dict(read_json(file))
        except (OSError, ValueError, TypeError) as error:
            raise TrainingError(f"'{file}' cannot be read: {error}; give another --out") from error
        different = [key for key in wanted if found.get(key) != wanted[key]]
        if different:
            raise TrainingError(
                f"'{out}' holds another distillation: its {', '.join(different)} differ; give "
                'the same teacher and steps, or another --out'
            )
    write_whole(file, json.dumps(wanted, indent=2) + '\n')


#: (B, ...) noisy latents and their noise level -> the flow (noise - clean)
Flow = Callable[[Tensor, Tensor], Tensor]


def straight_scheduler(scheduler: Scheduler) -> FlowMatchEulerDiscreteScheduler:
    """Returns the Euler schedule with another one's shift; straight lines need no more."""
    config = scheduler.config
    shift = config['shift'] if 'shift' in config else config['flow_shift']
    return build_scheduler({'shift': shift})  # type: ignore[return-value]


def path_sigmas(scheduler: Scheduler, num_steps: int, substeps: int) -> Tensor:
    """Returns (num_steps * substeps + 1,) noise levels from 1 to 0, as sampling has them.

    Every `substeps`-th one is a level of sampling in `num_steps` steps.
    """
    euler = straight_scheduler(scheduler)
    set_timesteps(euler, num_steps * substeps, torch.device('cpu'))
    return torch.as_tensor(euler.sigmas)


@torch.no_grad()
def follow(flow: Flow, noise: Tensor, sigmas: Tensor, substeps: int) -> list[Tensor]:
    """Returns the n + 1 points of the path from noise to a sample where a line starts or ends.

    Args:
        flow: the teacher.
        noise: (B, ...) at noise level 1.
        sigmas: of `path_sigmas`.
        substeps: Euler steps between two points.
    """
    points = [noise]
    latents = noise
    for index, (now, after) in enumerate(zip(sigmas[:-1], sigmas[1:], strict=True), 1):
        latents = latents + (after - now) * flow(latents, now)
        if index % substeps == 0:
            points.append(latents)
    return points


def straight_flows(points: Sequence[Tensor], sigmas: Tensor) -> list[Tensor]:
    """Returns the n flows that lead from each point to the next one in one Euler step.

    Args:
        points: n + 1 of them.
        sigmas: (n + 1,) their noise levels.
    """
    return [
        (start - end) / (sigma - after)
        for start, end, sigma, after in zip(
            points[:-1], points[1:], sigmas[:-1], sigmas[1:], strict=True
        )
    ]


def as_predicted(prediction: str, flow: Tensor, latents: Tensor, sigma: Tensor) -> Tensor:
    """Returns a flow in the form in which the transformer predicts it: itself, or the sample.

    Args:
        prediction: `flow` or `sample`.
        flow: noise - clean.
        latents: at noise level `sigma`.
        sigma: > 0.
    """
    return flow if prediction == 'flow' else latents - sigma * flow
