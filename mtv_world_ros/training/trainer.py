"""The trainer: one loop, resumable at any step, in one process or many; its loss and export."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
import math
from pathlib import Path
import time
from typing import Any

import torch
from torch import nn
from torch.distributed.tensor import DTensor

from mtv_world_ros.control.control import Control
from mtv_world_ros.control.registry import control_class
from mtv_world_ros.control.trajectory_video import TrajectoryVideo
from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.core.progress import Progress
from mtv_world_ros.model.card import OBJECT_MOTION_FOLDER, OPTIONAL_KEYS, ROBOT_FOLDER
from mtv_world_ros.model.checkpoint import Checkpoint
from mtv_world_ros.model.conditioning import check_history
from mtv_world_ros.model.parts import build_autoencoder, build_scheduler
from mtv_world_ros.model.runtime import keep_freed_memory, place
from mtv_world_ros.model.serving import compile_blocks
from mtv_world_ros.model.trained_model import load_trained_model, save_trained_model, TrainedModel
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.training.adapter import save_adapter
from mtv_world_ros.training.averaged_weights import AveragedWeights, ShardedWeights
from mtv_world_ros.training.base_checkpoint import Base
from mtv_world_ros.training.clips.batches import BatchSource, ClipBatch
from mtv_world_ros.training.clips.encoding import (
    drop_conditions,
    encode_batch,
    EncodedBatch,
    Encoders,
)
from mtv_world_ros.training.clips.latent_cache import CachedSource
from mtv_world_ros.training.clips.self_rollout import SelfRollout
from mtv_world_ros.training.distributed import memory_errors_named, Processes
from mtv_world_ros.training.objective import (
    add_noise,
    draw_sigmas,
    Loss,
    NoiseDraws,
    sample_loss,
    sigma_weights,
)
from mtv_world_ros.training.resume import (
    architecture,
    check_card,
    load_state,
    read_card,
    save_state,
    STATE,
)
from mtv_world_ros.training.training_config import OptimizerConfig, TrainingConfig

#: losses averaged for the progress bar and the log
_WINDOW = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class StepReport:
    """Report of a step.

    Attributes:
        step: number of the step, from 1.
        loss: loss over all clips of the step, of all processes.
        average: average of the recent losses.
        learning_rate: learning rate of the step.
        grad_norm: norm of the gradient before clipping.
        seconds: duration of the step, waiting included [s].
        waited: part of the duration spent waiting for the batch [s].
    """

    step: int
    loss: float
    average: float
    learning_rate: float
    grad_norm: float
    seconds: float = math.nan
    waited: float = math.nan


def learning_rate(step: int, config: OptimizerConfig) -> float:
    """Rate of a step (from 0): warm-up, constant, then linear to zero over the last share."""
    warm = min(1.0, (step + 1) / max(config.warmup, 1))
    decay_steps = max(1, round(config.decay_share * config.steps))
    left = (config.steps - step) / decay_steps
    return config.learning_rate * min(warm, max(0.0, min(1.0, left)))


def check_processes(settings: OptimizerConfig, processes: Processes) -> None:
    """Check that the settings fit the number of processes.

    Raises:
        TrainingError: fewer clips per step than processes times accumulated parts, or weights
            that are shared out in one process.
    """
    count, parts = processes.count, settings.accumulation
    if settings.batch_size < count * parts:
        raise TrainingError(
            f'optimizer.batch_size is {settings.batch_size}, less than {count} processes x '
            f'{parts} accumulated parts; raise it, or start fewer processes'
        )
    if settings.fully_shard and count == 1:
        raise TrainingError(
            'optimizer.fully_shard shares weights out over several processes, this is one; '
            'start it with torchrun, or set it to false'
        )


class Trainer:
    """Trainer of the transformer of a preset.

    Every process computes the clips of `clips`, a share of each step's; torch averages gradients
    over the processes during the backward pass, so that all make the same step.

    Args:
        config: the preset.
        folder: folder of the training's state, logs and checkpoints.
        seed: seed of weights, noise and batches.
        device: PyTorch device, e.g. `cpu`, `cuda`.
        dtype: dtype of forward and backward; master weights stay float32.
        trained_on: entry of the checkpoint's card.
        processes: processes that train together; None: those that the launcher started.
        base: checkpoint to train on top of; None: all weights are new.
        control: control of the model; None = the paper's.

    Raises:
        TrainingError: see `check_processes`.
    """

    def __init__(
        self,
        config: TrainingConfig,
        folder: Path,
        *,
        seed: int,
        device: str,
        dtype: torch.dtype,
        trained_on: dict[str, object],
        processes: Processes | None = None,
        base: Base | None = None,
        control: Control | None = None,
    ) -> None:
        torch.manual_seed(seed)
        drawn = TrajectoryVideo(config=config.rendering, object_mask=config.video.object_mask)
        self.control = control or drawn
        settings = config.optimizer
        self.processes = processes or Processes(device)
        check_processes(settings, self.processes)
        self.clips = self.processes.share(settings.batch_size)
        self.config, self.folder, self.seed = config, Path(folder), seed
        self.device = self.processes.device
        self.trained_on, self.base = trained_on, base
        if base is None:
            autoencoder = place(build_autoencoder(config.autoencoder), self.device, torch.float32)
            self.encoders = Encoders(autoencoder=autoencoder, history=config.history)
            transformer = MultiViewWanTransformer(
                **config.transformer, **self.control.layout.transformer_arguments()
            )
        else:
            self.encoders, transformer = base.encoders, base.checkpoint.transformer
        check_history(config.history, self.encoders.autoencoder, transformer.config)
        if settings.gradient_checkpointing:
            transformer.enable_gradient_checkpointing()
        kind = ShardedWeights if settings.fully_shard else AveragedWeights
        self.weights = kind(transformer, self.processes, dtype, settings.ema_decay)
        if settings.compile:
            compile_blocks(self.weights.worker, self.device)
        self.optimizer = torch.optim.AdamW(
            self.weights.parameters,
            lr=settings.learning_rate,
            betas=(0.9, 0.95),
            weight_decay=settings.weight_decay,
        )
        self.step = 0
        self._object_motion: Path | None = None
        self._recent: deque[float] = deque(maxlen=_WINDOW)

    def start_from(self, checkpoint: Checkpoint) -> None:
        """Load the weights of a checkpoint of the same architecture; the optimizer state is new.

        Its physics (`object_motion/`) comes along where robot and views are the same and
        `rendering.object_motion` is on.

        Raises:
            CheckpointError: the weights cannot be read.
            TrainingError: its transformer is of another shape.
        """
        folder, loaded = checkpoint.folder, load_trained_model(checkpoint)
        theirs, video = loaded.card, self.config.video
        if not self.control.shows_objects:
            self._object_motion = None  # its trajectory videos will not show what is foreseen
        elif (theirs.robot, len(theirs.spec.views)) == (video.robot, len(video.views)):
            self._object_motion = loaded.object_motion
        elif loaded.object_motion is not None and self.processes.is_main:
            Progress.write(
                f"what foresees objects in '{folder}' is left out: it is of robot "
                f"'{theirs.robot}' with {len(theirs.spec.views)} views; run fit contact"
            )
        given = loaded.transformer.state_dict()
        shapes = [
            {name: tuple(tensor.shape) for name, tensor in held.items()}
            for held in (given, self.weights.worker.state_dict())
        ]
        if shapes[0] != shapes[1]:
            there, here = dict(loaded.transformer.config), dict(self.weights.worker.config)
            differ = [
                f'{name} is {there.get(name)} there and {value} here'
                for name, value in here.items()
                if not name.startswith('_') and there.get(name) != value
            ]
            names = sorted(
                n for n in {*shapes[0], *shapes[1]} if shapes[0].get(n) != shapes[1].get(n)
            )
            raise TrainingError(
                f"'{folder}' does not fit the preset's transformer: "
                f'{"; ".join(differ) or f"weights such as {names[0]}"}. '
                'Give --preset the one it was trained with, set what differs '
                '(--set transformer.NAME=VALUE), or leave --init out'
            )
        self.weights.start_from(given)

    def run(
        self,
        source: BatchSource | CachedSource,
        *,
        save_every: int,
        on_save: Callable[[int], None],
        save_seconds: float = math.inf,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> Iterator[StepReport]:
        """Train to `config.optimizer.steps`, yielding a report for each step.

        When `should_stop` says so in any of the processes, the state is saved and the reports
        end early.

        Args:
            source: source of the batches of `clips`.
            save_every: steps between saved states.
            on_save: called with the step after each save, in all processes.
            save_seconds: longest time between saved states [s].
            should_stop: asked after each step.

        Raises:
            TrainingError: the loss is not finite, the device is out of memory, a state cannot be
                written, or another process is gone; the last saved state stays whole.
        """
        if self.device.type == 'cpu':
            keep_freed_memory()
        rollout = self._self_rollout(source)
        saved, stops = time.monotonic(), False
        while self.step < self.config.optimizer.steps and not stops:
            started = time.perf_counter()
            batch = source.batch(self.step)
            waited = time.perf_counter() - started
            if rollout is not None and isinstance(batch, ClipBatch) and any(batch.lead_ins):
                with self.weights.averaged_worker() as transformer:
                    batch = rollout.apply(batch, transformer)
            with memory_errors_named(self.device):
                report = self.train_step(batch)
            self.step += 1
            yield replace(report, seconds=time.perf_counter() - started, waited=waited)
            is_late = time.monotonic() - saved >= save_seconds
            stops, is_late = self.processes.any(should_stop(), is_late)
            due = self.step % save_every == 0 or self.step == self.config.optimizer.steps
            if due or stops or is_late:
                self.save_state()
                on_save(self.step)
                saved = time.monotonic()

    def _self_rollout(self, source: BatchSource | CachedSource) -> SelfRollout | None:
        """Return the rollout that imagines start frames of clips; None if all are recorded."""
        if not self.config.self_rollout.share or not isinstance(source, BatchSource):
            return None
        return SelfRollout(
            source.controls,
            self.encoders,
            build_scheduler(self.config.scheduler),
            num_inference_steps=self.config.sampling.num_inference_steps,
            seed=self.seed,
            device=self.device,
        )

    def loss(self, batch: ClipBatch | EncodedBatch) -> Loss:
        """Return the loss of a batch, or of a part of one."""
        draws = NoiseDraws(self.seed, batch.step, batch.numbers)
        weights = self.weights
        return batch_loss(
            weights.worker,
            self.encoders,
            batch,
            self.config,
            draws,
            self.device,
            model=weights.model,
            dtype=weights.dtype,
        )

    def gradients(self, batch: ClipBatch | EncodedBatch) -> float:
        """Leave the gradients of a step in the float32 weights and return the step's loss.

        Raises:
            TrainingError: the loss is not finite, or another process is gone.
        """
        sums = torch.zeros(2, device=self.device)
        for parameter in self.weights.parameters:
            parameter.grad = None
        for part in batch.parts(self.config.optimizer.accumulation):
            loss = self.loss(part)
            sums += torch.stack([loss.total.detach(), loss.weight]).float()
            loss.total.backward()
            self.weights.collect()
        total, weight = self.processes.summed(sums).tolist()
        if not math.isfinite(total / weight):
            raise TrainingError(
                f'the loss is {total / weight} at step {self.step}; the last good state is in '
                f"'{self.folder / STATE}'; lower optimizer.learning_rate"
            )
        found = [p.grad for p in self.weights.parameters if p.grad is not None]
        # torch averages over the processes, whose shares may differ: back to sums over all clips
        torch._foreach_mul_(found, self.processes.count / weight)
        return total / weight

    def train_step(self, batch: ClipBatch | EncodedBatch) -> StepReport:
        """Make a step with this process's part of its clips."""
        loss = self.gradients(batch)
        settings, parameters = self.config.optimizer, self.weights.parameters
        norm = torch.nn.utils.clip_grad_norm_(parameters, settings.max_grad_norm)
        rate = learning_rate(self.step, settings)
        for group in self.optimizer.param_groups:
            group['lr'] = rate
        self.optimizer.step()
        self.weights.ema.step(parameters)
        self.weights.share()
        self._recent.append(loss)
        return StepReport(
            step=self.step + 1,
            loss=loss,
            average=math.fsum(self._recent) / len(self._recent),
            learning_rate=rate,
            grad_norm=(norm.full_tensor() if isinstance(norm, DTensor) else norm).item(),
        )

    def save_state(self) -> None:
        """Write everything a resumed run needs, atomically; all processes have to call this."""
        card = {'step': self.step, 'recent': list(self._recent), **self._identity()}
        save_state(self.folder, self.weights, self.optimizer, card, self.processes)

    def _identity(self) -> dict[str, Any]:
        """Return the values that must be the same in a resumed run."""
        return {
            **architecture(self.config),
            'seed': self.seed,
            'base': self.base and self.base.digest,
        }

    def load_state(self) -> bool:
        """Continue from the saved state; return whether there was one.

        All processes have to call this; their number may be another than that which saved.

        Raises:
            TrainingError: the state is damaged, or of another model, seed or base.
        """
        with self.processes.main_first():
            card = read_card(self.folder)
        if card is None:
            return False
        check_card(self.folder, card, self._identity())
        load_state(self.folder, self.weights, self.optimizer, self.processes)
        self._recent.extend(card.get('recent', []))
        self.step = card['step']
        return True

    @property
    def result(self) -> Path:
        """Folder of the result: a checkpoint, or an adapter for the base."""
        return self.folder / ('adapter' if self.config.lora.rank else 'checkpoint')

    def export(self, folder: Path, *, dtype: torch.dtype = torch.float16) -> None:
        """Write a checkpoint with the averaged weights and all its other parts.

        The main process writes; all have to call this. An adapter's folder has its factors
        (float32), the weights that are trained whole, and the card.
        """
        base = self.base
        theirs = base.checkpoint.card.plain() if base else {}  # prompt and guidance
        card = self.config.card({**self.trained_on, 'steps': self.step, 'seed': self.seed})
        card = card.replace(**{name: theirs[name] for name in OPTIONAL_KEYS if name in theirs})
        if self.config.lora.rank:
            averages = self.weights.averages()
            if not self.processes.is_main:
                return
            return save_adapter(
                self.weights.worker, folder, weights=averages, card=card, control=self.control
            )
        # what `fit contact` put there stays
        mine, transformer = folder / OBJECT_MOTION_FOLDER, self.weights.averaged()
        if transformer is None:
            return
        parts = TrainedModel(
            transformer=transformer,
            autoencoder=self.encoders.autoencoder,
            scheduler=build_scheduler(self.config.scheduler),
            card=card,
            object_motion=mine if mine.is_dir() else self._object_motion,
            robot=self.robot,
            control=self.control,
            text_encoder=base and base.checkpoint.text_encoder,
            image_encoder=base and base.checkpoint.image_encoder,
        )
        save_trained_model(parts, folder, dtype=dtype)

    @property
    def robot(self) -> Path | None:
        """Folder of the robot that checkpoints carry, where `train` has put one."""
        folder = self.folder / ROBOT_FOLDER
        return folder if folder.is_dir() else None


def batch_loss(
    transformer: MultiViewWanTransformer,
    encoders: Encoders,
    batch: ClipBatch | EncodedBatch,
    config: TrainingConfig,
    draws: NoiseDraws,
    device: torch.device,
    *,
    model: nn.Module | None = None,
    dtype: torch.dtype | None = None,
) -> Loss:
    """Return the loss of a batch, or of what a latent cache holds of one, as sums over its clips.

    Transformer and encoders are on the device; noise levels, noise and what is dropped are drawn
    for each clip.

    Args:
        transformer: the transformer.
        encoders: frozen encoders.
        batch: clips, or what a latent cache holds of them.
        config: the preset.
        draws: random numbers of the clips.
        device: device of the computation.
        model: what is called in place of the transformer, such as torch's wrapper; None = itself.
        dtype: number format of its inputs; None = the transformer's.
    """
    objective, dtype = config.objective, dtype or transformer.dtype
    if isinstance(batch, ClipBatch):
        batch = encode_batch(encoders, batch, objective, device)
    clean = batch.clean
    sigmas = draw_sigmas(draws, objective)
    noise = draws.normal(*clean.shape[1:]).to(device)
    noisy = add_noise(clean, noise, sigmas.to(device))
    cond = batch.conditioning
    if transformer.start_image == 'either':
        cond = cond.with_one_start()
    dropout = control_class(config.video.control).dropout
    cond = drop_conditions(cond, config.augment, draws, dropout)
    if cond.history is not None:
        cond = cond.with_noisy_history(draws.normal(*cond.history.shape[1:]).to(device))
    cond = cond.in_dtype(dtype)
    predicted = (model or transformer)(
        noisy.to(dtype),
        (sigmas * 1000).to(device),
        control=cond.control,
        start=cond.start,
        reference=cond.reference,
        start_control=cond.start_control,
        encoder_hidden_states=None if cond.text is None else cond.text.to(dtype),
        encoder_hidden_states_image=None if cond.image is None else cond.image.to(dtype),
        anchor=cond.anchor,
        history=cond.history,
        history_timestep=cond.history_timestep,
        control_context=cond.context,
        control_frame=cond.frame,
        control_kept=cond.control_kept,
    )
    target = clean if transformer.prediction == 'sample' else noise - clean
    by_sigma = sigma_weights(sigmas, objective).to(device)
    return sample_loss(predicted, target, batch.weights, objective.huber_delta, by_sigma)
