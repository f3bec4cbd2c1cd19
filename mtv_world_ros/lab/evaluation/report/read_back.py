"""An evaluation read back from its folder, without the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.bounded_input import read_json
from mtv_world_ros.data.stored_rollout import load_rollout, StoredRollout
from mtv_world_ros.errors import ConfigError
from mtv_world_ros.lab.evaluation.metrics.scores import episode_means
from mtv_world_ros.lab.evaluation.results import EpisodeResult, rollout_path
from mtv_world_ros.vision.jaccard import mean_of_known

_NEEDED = {'name', 'provenance', 'model', 'views', 'overall', 'tasks', 'failed', 'success'}


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluated:
    """What an evaluation left in its folder.

    Attributes:
        folder: of the evaluation.
        metrics: metrics.json.
        results: scores by name of the episode.
    """

    folder: Path
    metrics: dict[str, Any]
    results: dict[str, EpisodeResult]

    @property
    def name(self) -> str:
        """Of the checkpoint: what the user calls it, and its fingerprint."""
        name, label = self.metrics['name'], self.metrics.get('label', '')
        return ' · '.join(part for part in (label, name) if part) if label not in name else name

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views."""
        return tuple(self.metrics['views'])

    def rollout(self, episode: str) -> StoredRollout | None:
        """Returns the frames of a scored episode; None where they were not kept.

        Raises:
            EpisodeError: the frames cannot be read.
        """
        path = rollout_path(self.folder, episode)
        return load_rollout(path) if episode in self.results and path.is_file() else None


def read_evaluations(folder: Path) -> list[Evaluated]:
    """Reads what `mtv-world evaluate --out FOLDER` wrote: one evaluation, or one per checkpoint.

    Raises:
        ConfigError: the folder holds no evaluation, or one of another version.
    """
    folder = Path(folder)
    hint = check_evaluation(folder)
    try:
        metrics = read_json(folder / 'metrics.json')
        if 'methods' not in metrics:
            return [_read(folder, metrics)]
        parts = [read_evaluations(file.parent)[0] for file in folder.glob('*/metrics.json')]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"the evaluation in '{folder}' cannot be read "
            f'({type(error).__name__}: {error}); {hint}'
        ) from error
    labels = list(metrics['methods'])
    found = [part for part in parts if part.metrics.get('label') in labels]
    return sorted(found, key=lambda part: labels.index(part.metrics['label']))


def check_evaluation(folder: Path) -> str:
    """Returns the command that makes an evaluation in a folder, for other errors.

    Raises:
        ConfigError: the folder holds none.
    """
    hint = f"run 'mtv-world evaluate CHECKPOINT DATASET --out {folder}'"
    if (folder / 'metrics.json').is_file():
        return hint
    if any(folder.glob('episodes/*.json')):
        raise ConfigError(
            f"the evaluation in '{folder}' is not finished (no metrics.json); run its command "
            'again: it goes on where it stopped'
        )
    raise ConfigError(f"'{folder}' holds no evaluation (metrics.json); {hint}")


def _read(folder: Path, metrics: dict[str, Any]) -> Evaluated:
    missing = sorted(_NEEDED - set(metrics))
    if missing:
        raise ConfigError(
            f"the evaluation in '{folder}' was written by another version (metrics.json lacks "
            f'{", ".join(missing)}); evaluate again into another --out'
        )
    results = {name: _result(folder, name) for name in metrics['episodes']}
    return Evaluated(folder=folder, metrics=metrics, results=results)


def _result(folder: Path, episode: str) -> EpisodeResult:
    file = folder / 'episodes' / f'{episode}.json'
    return EpisodeResult.from_json(read_json(file)['result'])


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodePick:
    """An episode worth looking at.

    Attributes:
        title: why.
        episode: its name.
        score: mean over the evaluations.
    """

    title: str
    episode: str
    score: float


def scores(evaluated: Evaluated, key: str) -> dict[str, float]:
    """Returns a number of `statistics.MEANS` by episode, over all views; unknown ones left out."""
    means = {n: episode_means(r.rows, None)[key] for n, r in evaluated.results.items()}
    return {name: value for name, value in means.items() if np.isfinite(value)}


def ranked_by(evaluations: Sequence[Evaluated]) -> tuple[str, str, dict[str, float]]:
    """Returns what episodes are ranked by: words, the number's name, its mean by episode.

    J of the objects that move, where any episode has it, else J of all objects; the mean over the
    evaluations that scored the episode.
    """
    words, key = 'the objects that move', 'j_moving'
    found = [scores(item, key) for item in evaluations]
    if not any(found):
        words, key = 'all objects', 'j_object_mean'
        found = [scores(item, key) for item in evaluations]
    names = sorted({name for part in found for name in part})
    means = {
        name: float(mean_of_known(np.array([part.get(name, np.nan) for part in found])))
        for name in names
    }
    return words, key, means


def picks(evaluations: Sequence[Evaluated]) -> list[EpisodePick]:
    """Returns the best, the median and the worst episode; see `ranked_by`."""
    means = ranked_by(evaluations)[2]
    ranked = sorted(means, key=lambda name: (-means[name], name))
    chosen = {0: 'Best', len(ranked) // 2: 'Median', len(ranked) - 1: 'Worst'}
    if len(ranked) < 3:
        chosen = ({}, {0: 'The only one'}, {0: 'Best', 1: 'Worst'})[len(ranked)]
    return [
        EpisodePick(title=title, episode=ranked[place], score=means[ranked[place]])
        for place, title in chosen.items()
    ]


def has_objects(found: Evaluated) -> bool:
    """Returns whether any episode names an object; else only pictures are compared."""
    return any(numbers.get('num_rows', 1) for numbers in found.metrics['views'].values())
