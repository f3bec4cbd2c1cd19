"""Train on twins: each pair of clips shows one scene and one time, in a missed and a made grasp.

    torchrun --nproc-per-node 2 experiments/twins.py data/train --preset paper --out runs/twins ...

takes the words of `mtv-world train`. Clips 2 k and 2 k + 1 of a step are twins: an episode that
failed, and one of the same scene that succeeded, from the same start and with the same
disturbances. What tells them apart is how the gripper goes, so that is what the gradient of their
step is about. Scenes are the same where a task's objects begin at the same poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import sys
from typing import Any

import numpy as np

from mtv_world_ros.cli import main as mtv_world
from mtv_world_ros.core.errors import TrainingError
from mtv_world_ros.training import training_run
from mtv_world_ros.training.clips.batches import BatchSource
from mtv_world_ros.training.clips.episode_index import IndexedEpisode

#: objects that begin this near are at the same place [m]
SAME_M = 1e-3
Pair = tuple[IndexedEpisode, IndexedEpisode]


class TwinSource(BatchSource):
    """Source of batches whose clips are twins; see the module.

    Raises:
        TrainingError: no scene has both outcomes.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._pairs = twins(self.episodes)
        self._number = 0
        if not self._pairs:
            raise TrainingError(
                f'of {len(self.episodes)} episodes no two show one scene, one failed and one '
                'successful; collect the same seed with several policies'
            )
        print(f'{len(self._pairs)} pairs of twins', flush=True)

    def _clip(self, step: int, number: int) -> Any:
        self._number = number
        return super()._clip(step, number - number % 2)  # twins draw the same

    def _choose(self, rng: np.random.Generator) -> IndexedEpisode:
        return self._pairs[rng.integers(len(self._pairs))][self._number % 2]


def twins(episodes: Sequence[IndexedEpisode]) -> list[Pair]:
    """Return pairs of a failed and a successful episode of one scene, with the starts of both."""
    scenes: dict[tuple[Any, ...], dict[str, list[IndexedEpisode]]] = {}
    for episode in episodes:
        poses = episode.recording().object_poses
        if poses is None:
            continue
        places = np.round(poses[0, :, :3, 3] / SAME_M).astype(int)
        key = (episode.task, episode.camera_keys, tuple(places.ravel().tolist()))
        scenes.setdefault(key, {}).setdefault(episode.outcome, []).append(episode)
    return [
        (replace(failed, starts=starts), replace(made, starts=starts))
        for found in scenes.values()
        for failed in found.get('failure', ())
        for made in found.get('success', ())
        if (starts := tuple(sorted({*failed.starts} & {*made.starts})))
    ]


def main(words: Sequence[str] | None = None) -> int:
    """Run `mtv-world train` on twins; return its exit status."""
    training_run.BatchSource = TwinSource  # type: ignore[misc]
    return mtv_world(['train', *(sys.argv[1:] if words is None else words)])


if __name__ == '__main__':
    sys.exit(main())
