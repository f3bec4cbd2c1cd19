"""What is trained, and how: sections of training presets."""

from __future__ import annotations

from dataclasses import dataclass

from mtv_world_ros.errors import ConfigError


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
