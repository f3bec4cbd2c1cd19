"""One plan imagined with several seeds: the first one's frames, the mean of all estimates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from mtv_world_ros.data_types import JointTrajectory, Observation
from mtv_world_ros.pipeline import Pipeline
from mtv_world_ros.prediction import Prediction
from mtv_world_ros.success.seeds import combine

#: seeds lie so far apart that those of their chunks never meet
SEED_STEP = 1_000_003


def imagine_seeds(
    pipeline: Pipeline,
    observation: Observation,
    trajectory: JointTrajectory,
    *,
    num_seeds: int,
    seed: int = 0,
    **options: Any,
) -> Iterator[Prediction]:
    """Yields the chunks of the first seed; see `Pipeline.imagine` for the rest.

    Every seed chains its own chunks. What goes on from a prediction goes on from the first
    seed's, for all of them.

    Args:
        pipeline: imagines.
        observation: as for `Pipeline.imagine`.
        trajectory: as for `Pipeline.imagine`.
        num_seeds: rollouts; each takes as long as one.
        seed: of the first; rollout k uses `seed + k * SEED_STEP`.
        **options: of `Pipeline.imagine`.
    """
    rollouts = [
        pipeline.imagine(observation, trajectory, seed=seed + SEED_STEP * k, **options)
        for k in range(num_seeds)
    ]
    for chunks in zip(*rollouts, strict=True):
        seconds: Counter[str] = Counter()
        for chunk in chunks:
            seconds.update(chunk.seconds)
        yield replace(
            chunks[0],
            success=combine([chunk.success for chunk in chunks]),
            seconds=MappingProxyType(dict(seconds)),
        )
