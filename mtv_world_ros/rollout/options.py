"""Options of a rollout: what is asked for, how it is computed, and when it stops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mtv_world_ros.core.data_types import SuccessEstimate
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.robot.plan import ChunkPlan, PlanLimits
from mtv_world_ros.success.doubts import ContactTrust
from mtv_world_ros.success.task import TaskSpec


def never() -> bool:
    """Return False: nothing stops the rollout."""
    return False


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutOptions:
    """Options of a rollout.

    Attributes:
        instruction: text for the robot; names the objects unless they are given.
        objects: names of the objects; empty = the pipeline's, else its describer's, which is
            asked once for each instruction, else `stored_objects`, else those of the instruction.
        stored_objects: names of the objects that are stored with the recorded episode.
        task: task that the recorded episode defines, which is judged unless the pipeline was
            given another one; None = a task that the instruction matches.
        seed: seed of the noise; chunk k of seed r uses `seed + k + r * SEED_STEP`.
        num_seeds: number of rollouts with different noise, whose mean the estimate is; the run
            time grows linearly.
        num_inference_steps: denoising steps a chunk; 0 = those the model is made for.
        limits: limits within which plans are accepted.
        should_stop: called between denoising steps and between chunks; True = the rollout stops.
        doubt: reason why the fitted physics does not hold here, which widens the estimate; empty
            = no contradiction was observed.
        contact: evidence on contact parameters that were fitted in another robot cell.
        on_foreseen: called with each chunk and its estimate once futures tell it, before frames
            are imagined; the estimate with the frames can only be wider. The estimate is None
            where the frames are needed for one. None = not wanted.
    """

    instruction: str = ''
    objects: tuple[str, ...] = ()
    stored_objects: tuple[str, ...] = ()
    task: TaskSpec | None = None
    seed: int = 0
    num_seeds: int = 1
    num_inference_steps: int = 0
    limits: PlanLimits = PlanLimits()
    should_stop: Callable[[], bool] = never
    doubt: str = ''
    contact: ContactTrust = ContactTrust()
    on_foreseen: Callable[[ChunkPlan, SuccessEstimate | None], None] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, 'objects', tuple(self.objects))
        object.__setattr__(self, 'stored_objects', tuple(self.stored_objects))
        if self.num_seeds < 1 or self.num_inference_steps < 0:
            raise ConfigError(
                f'{self.num_seeds} seeds and {self.num_inference_steps} denoising steps: give at '
                'least one seed (num_seeds), and 0 steps or more (num_inference_steps; 0 = those '
                'the model is made for)'
            )


#: options of a rollout without an instruction
DEFAULT_OPTIONS = RolloutOptions()
