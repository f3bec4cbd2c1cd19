"""The trainer: one loop, resumable at any step, with averaged weights and honest logs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import json
import math
from pathlib import Path

from diffusers.training_utils import EMAModel
from safetensors.torch import load_file, save_file
import torch
from torch import Tensor

from mtv_world_ros.errors import TrainingError
from mtv_world_ros.model.actions import ActionEncoding
from mtv_world_ros.model.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from mtv_world_ros.model.parts import build_autoencoder, build_scheduler
from mtv_world_ros.model.runtime import place
from mtv_world_ros.model.transformer import copy_of, MultiViewWanTransformer
from mtv_world_ros.training.actions import transformer_arguments
from mtv_world_ros.training.batches import Batch, BatchSource
from mtv_world_ros.training.config import OptimizerConfig, TrainingConfig
from mtv_world_ros.training.encoding import Encoders
from mtv_world_ros.training.loss import batch_loss
from mtv_world_ros.training.self_rollout import SelfRollout


@dataclass(frozen=True, slots=True, kw_only=True)
class StepReport:
    """What a step did: its number (from 1), loss, learning rate and gradient norm."""

    step: int
    loss: float
    learning_rate: float
    grad_norm: float


def learning_rate(step: int, config: OptimizerConfig) -> float:
    """Rate of a step (from 0): warm-up, constant, then linear to zero over the last share."""
    warm = min(1.0, (step + 1) / max(config.warmup_steps, 1))
    decay_steps = max(1, round(config.decay_share * config.steps))
    left = (config.steps - step) / decay_steps
    return config.learning_rate * min(warm, max(0.0, min(1.0, left)))


class Trainer:
    """Trains the transformer of a preset.

    Args:
        config: the preset.
        folder: where state, logs and checkpoints go.
        seed: of weights, noise and batches.
        device: e.g. `cpu`, `cuda`.
        dtype: of forward and backward; master weights stay float32.
        trained_on: what stands in the checkpoint's card.
        actions: how positions become actions, where the preset's control does not draw them.
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
        actions: ActionEncoding | None = None,
    ) -> None:
        torch.manual_seed(seed)
        self.config, self.folder, self.seed = config, Path(folder), seed
        self.device = torch.device(device)
        self.trained_on, self.actions = trained_on, actions
        autoencoder = build_autoencoder(config.autoencoder)
        self.autoencoder = place(autoencoder, self.device, torch.float32)
        self.encoders = Encoders(autoencoder=self.autoencoder)
        transformer = MultiViewWanTransformer(**transformer_arguments(config, actions))
        self.master = place(transformer, self.device, torch.float32)
        self.worker = place(copy_of(self.master), self.device, dtype)
        self.ema = EMAModel(
            self.master.parameters(),
            decay=config.optimizer.ema_decay,
            use_ema_warmup=True,
            power=0.75,
        )
        self.optimizer = torch.optim.AdamW(
            self.master.parameters(),
            lr=config.optimizer.learning_rate,
            betas=(0.9, 0.95),
            weight_decay=config.optimizer.weight_decay,
        )
        self.step = 0
        self._share_weights()

    def start_from(self, folder: Path) -> None:
        """Takes the weights of a checkpoint of the same architecture; the optimizer starts anew.

        Raises:
            CheckpointError: the folder holds no checkpoint.
            TrainingError: its transformer is of another shape.
        """
        weights = load_checkpoint(folder).transformer.state_dict()
        try:
            self.master.load_state_dict(weights)
        except RuntimeError as error:
            raise TrainingError(
                f"'{folder}' does not fit the preset's transformer: {error}; give --preset the "
                'one it was trained with, or leave --init out'
            ) from error
        self.ema.shadow_params = [p.detach().clone() for p in self.master.parameters()]
        self._share_weights()

    def run(
        self, source: BatchSource, *, save_every: int, on_save: Callable[[int], None]
    ) -> Iterator[StepReport]:
        """Trains to `config.optimizer.steps`, yielding a report a step.

        Raises:
            TrainingError: the loss is not finite; the last saved state stays whole.
        """
        rollout = SelfRollout(
            source.controls,
            self.encoders,
            build_scheduler(self.config.scheduler),
            num_inference_steps=self.config.self_rollout.steps,
            seed=self.seed,
            device=self.device,
        )
        while self.step < self.config.optimizer.steps:
            batch = source.batch(self.step)
            if any(batch.leads):
                with self.averaged() as transformer:
                    batch = rollout.apply(batch, self.step, transformer)
            report = self._train_step(batch)
            self.step += 1
            yield report
            if self.step % save_every == 0 or self.step == self.config.optimizer.steps:
                self.save_state()
                on_save(self.step)

    @contextmanager
    def averaged(self) -> Iterator[MultiViewWanTransformer]:
        """Lends the worker with averaged weights, which are those that will serve."""
        parameters = list(self.worker.parameters())
        self.ema.store(parameters)
        self.ema.copy_to(parameters)
        try:
            yield self.worker
        finally:
            self.ema.restore(parameters)

    def loss(self, batch: Batch, step: int) -> Tensor:
        """The loss of a batch with the noise of a step."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + step)
        return batch_loss(self.worker, self.encoders, batch, self.config, generator, self.device)

    def _train_step(self, batch: Batch) -> StepReport:
        loss = self.loss(batch, self.step)
        if not torch.isfinite(loss):
            raise TrainingError(
                f'the loss is {loss.item()} at step {self.step}; the last good state is in '
                f"'{self.folder / 'state'}'; lower optimizer.learning_rate"
            )
        loss.backward()
        for master, worker in zip(self.master.parameters(), self.worker.parameters(), strict=True):
            master.grad = None if worker.grad is None else worker.grad.float()
            worker.grad = None
        settings = self.config.optimizer
        norm = torch.nn.utils.clip_grad_norm_(self.master.parameters(), settings.max_grad_norm)
        rate = learning_rate(self.step, settings)
        for group in self.optimizer.param_groups:
            group['lr'] = rate
        self.optimizer.step()
        self.ema.step(self.master.parameters())
        self._share_weights()
        return StepReport(
            step=self.step + 1, loss=loss.item(), learning_rate=rate, grad_norm=norm.item()
        )

    @torch.no_grad()
    def _share_weights(self) -> None:
        for worker, master in zip(self.worker.parameters(), self.master.parameters(), strict=True):
            worker.copy_(master)

    def save_state(self) -> None:
        """Writes everything a resumed run needs, whole or not at all."""
        target = self.folder / 'state'
        partial = self.folder / 'state.partial'
        partial.mkdir(parents=True, exist_ok=True)
        tensors = {f'master.{k}': v.contiguous() for k, v in self.master.state_dict().items()}
        tensors |= {f'ema.{i}': p.contiguous() for i, p in enumerate(self.ema.shadow_params)}
        for index, state in self.optimizer.state_dict()['state'].items():
            tensors |= {f'adam.{index}.{k}': v.contiguous() for k, v in state.items()}
        save_file(tensors, partial / 'state.safetensors')
        card = {
            'step': self.step,
            'ema_step': self.ema.optimization_step,
            'seed': self.seed,
            'control': self.config.video.control,
        }
        (partial / 'state.json').write_text(json.dumps(card))
        _swap(partial, target)

    def load_state(self) -> bool:
        """Continues from the saved state; returns whether there was one."""
        folder = self.folder / 'state'
        if not (folder / 'state.json').is_file():
            return False
        card = json.loads((folder / 'state.json').read_text())
        if card['seed'] != self.seed:
            raise TrainingError(
                f"'{folder}' was trained with seed {card['seed']}, this run has {self.seed}; "
                'give --seed the same, or another --out'
            )
        trained, control = card.get('control', 'trajectory_video'), self.config.video.control
        if trained != control:
            raise TrainingError(
                f"'{folder}' was trained with control '{trained}', this run has '{control}'; "
                'give --control the same, or another --out'
            )
        tensors = load_file(folder / 'state.safetensors')
        self.master.load_state_dict(
            {k[7:]: v for k, v in tensors.items() if k.startswith('master.')}
        )
        self.ema.shadow_params = [
            tensors[f'ema.{i}'].to(self.device) for i in range(len(self.ema.shadow_params))
        ]
        self.ema.optimization_step = card['ema_step']
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith('adam.'):
                _, index, name = key.split('.')
                state.setdefault(int(index), {})[name] = value
        whole = self.optimizer.state_dict()
        self.optimizer.load_state_dict({'state': state, 'param_groups': whole['param_groups']})
        self.step = card['step']
        self._share_weights()
        return True

    def export(self, folder: Path, *, dtype: torch.dtype = torch.float16) -> None:
        """Writes the averaged weights as a checkpoint."""
        averaged = copy_of(self.master)
        self.ema.copy_to(averaged.parameters())
        card = self.config.card({**self.trained_on, 'steps': self.step, 'seed': self.seed})
        scheduler = build_scheduler(self.config.scheduler)
        parts = Checkpoint(
            transformer=averaged,
            autoencoder=self.autoencoder,
            scheduler=scheduler,
            card=card,
            actions=self.actions,
        )
        save_checkpoint(parts, folder, dtype=dtype)


def _swap(partial: Path, target: Path) -> None:
    """Puts a finished folder under its name; the old one stays whole until then."""
    old = target.with_name(target.name + '.old')
    if target.exists():
        target.rename(old)
    partial.rename(target)
    if old.exists():
        for file in old.iterdir():
            file.unlink()
        old.rmdir()


def mean_loss(losses: list[float]) -> float:
    """Mean of the recent losses; NaN where there is none."""
    return math.fsum(losses) / len(losses) if losses else math.nan
