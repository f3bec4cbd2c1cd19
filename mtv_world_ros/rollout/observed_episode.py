"""The real frames of an episode before a plan, which enter the estimate."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Lock

import numpy as np

from mtv_world_ros.core.data_types import Observation
from mtv_world_ros.rollout.options import DEFAULT_OPTIONS, RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.rollout import Rollout
from mtv_world_ros.rollout.state import fit_observation
from mtv_world_ros.success.task import TaskSpec

#: least time between two frames that are kept, as a share of the model's period
_SEEN_SHARE = 0.9
#: most chunks of real frames in the queue; beyond that every second frame is dropped
_MOST_WAITING_CHUNKS = 8


class ObservedEpisode:
    """Real frames of an episode, which every later plan is judged with.

    `see` may be called from another thread than the other methods.

    Args:
        pipeline: pipeline that finds and judges objects in the frames.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._period_ns = round(_SEEN_SHARE / pipeline.spec.fps * 1e9)
        self._lock = Lock()
        self._seen: Rollout | None = None
        self._seen_ns = 0
        self._waiting: list[Observation] = []

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether an observation at this time is kept: one per frame of the model."""
        with self._lock:
            last_ns = self._waiting[-1].stamp_ns if self._waiting else self._seen_ns
            return self._seen is not None and stamp_ns - last_ns >= self._period_ns

    @property
    def is_behind(self) -> bool:
        """True if a whole chunk of observations is queued."""
        with self._lock:
            return len(self._waiting) >= self._pipeline.spec.num_frames

    def see(self, observation: Observation) -> None:
        """Queue a real observation.

        Raises:
            ObservationError: the views are not the model's.
        """
        observation = fit_observation(observation, self._pipeline.spec)
        with self._lock:
            self._waiting.append(observation)
            if len(self._waiting) > _MOST_WAITING_CHUNKS * self._pipeline.spec.num_frames:
                del self._waiting[::2]

    def forget(self) -> None:
        """Drop the episode: the next plan begins a new one."""
        with self._lock:
            self._seen, self._waiting = None, []

    def catch_up(self) -> None:
        """Process the queued observations."""
        with self._lock:
            seen, waiting = self._seen, self._waiting
            self._waiting = []
            self._seen_ns = waiting[-1].stamp_ns if waiting else self._seen_ns
        if seen is not None:
            _look_at(seen, waiting)

    def begin(
        self, observation: Observation, options: RolloutOptions = DEFAULT_OPTIONS
    ) -> Rollout:
        """Return an episode that begins at an observation and remembers what was seen before.

        Another instruction, or other objects, begin a new episode.

        Args:
            observation: real, of V views; not before those that were seen.
            options: options of the episode.

        Raises:
            ObservationError: the views are not the model's.
        """
        start = fit_observation(observation, self._pipeline.spec)
        with self._lock:
            seen, waiting = self._seen, self._waiting
            if seen is None or _task(seen.options) != _task(options):
                seen = self._pipeline.begin(observation, options)
                self._seen, self._seen_ns, waiting = seen, start.stamp_ns, []
            new = [o for o in waiting if o.stamp_ns < start.stamp_ns]
            self._waiting = [o for o in waiting if o.stamp_ns > start.stamp_ns]
            if start.stamp_ns > self._seen_ns:
                new.append(start)
                self._seen_ns = start.stamp_ns
        _look_at(seen, new)
        rollout = seen.branch(observation)
        rollout.options = options
        return rollout


def _task(
    options: RolloutOptions,
) -> tuple[str, tuple[str, ...], tuple[str, ...], TaskSpec | None]:
    """Return the options that another episode differs in."""
    return options.instruction, options.objects, options.stored_objects, options.task


def _look_at(episode: Rollout, observations: Sequence[Observation]) -> None:
    """Let the episode observe these, at the model's size."""
    if observations:
        frames = np.stack([observation.frames for observation in observations], axis=1)
        positions = [episode.observation, *observations]
        episode.observe(
            frames,
            np.stack([observation.positions for observation in positions]),
            observations[-1].cameras,
        )
