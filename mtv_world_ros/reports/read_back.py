"""An evaluation read back from its folder, without the model."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import read_json
from mtv_world_ros.core.data_types import WorldModelSpec
from mtv_world_ros.core.errors import ConfigError
from mtv_world_ros.evaluation.evaluation_summary import EvaluationSummary
from mtv_world_ros.evaluation.metrics.jaccard_scores import DISTANCES, episode_means
from mtv_world_ros.evaluation.metrics.statistics import Estimate
from mtv_world_ros.evaluation.results import EpisodeResult
from mtv_world_ros.evaluation.settings import EvaluationConfig
from mtv_world_ros.vision.jaccard import mean_of_known

_SETTINGS = (*EvaluationConfig.model_fields, 'topics', 'calibration', 'segmenter')
_NEEDED = {'name', 'provenance', 'model', 'views', 'overall', 'tasks', 'failed', 'success'}


def read_evaluations(folder: Path) -> list[EvaluationSummary]:
    """Read what `mtv-world evaluate --out FOLDER` wrote: one evaluation, or one per checkpoint.

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
    found = [part for part in parts if part.label in labels]
    return sorted(found, key=lambda part: labels.index(part.label))


def check_evaluation(folder: Path) -> str:
    """Return the command that makes an evaluation in a folder, for other errors.

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


def _read(folder: Path, metrics: dict[str, Any]) -> EvaluationSummary:
    missing = sorted(_NEEDED - set(metrics))
    if missing:
        raise ConfigError(
            f"the evaluation in '{folder}' was written by another version (metrics.json lacks "
            f'{", ".join(missing)}); evaluate again into another --out'
        )
    model = metrics['model']
    groups = {None: metrics, **metrics.get('zero_shot', {})}
    return EvaluationSummary(
        folder=folder,
        name=metrics['name'],
        label=metrics.get('label', ''),
        spec=WorldModelSpec(**{**model, 'views': tuple(model['views'])}),
        settings={name: metrics[name] for name in _SETTINGS if name in metrics},
        results=[_result(folder, name) for name in metrics['episodes']],
        failed=metrics['failed'],
        provenance=metrics['provenance'],
        distances={
            (name, view): _distances(numbers)
            for name, group in groups.items()
            for view, numbers in group['views'].items()
        },
    )


def _distances(numbers: dict[str, Any]) -> dict[str, Estimate]:
    """Return the measured distances among FID and FVD, by name."""
    measured = [name for name in DISTANCES if numbers.get(name) is not None]
    return {
        name: Estimate(
            value=numbers[name],
            interval=(nan, nan) if low is None else (low, high),
            num_episodes=numbers['num_episodes_with'][name],
        )
        for name in measured
        for low, high in [numbers['intervals'][name]]
    }


def _result(folder: Path, episode: str) -> EpisodeResult:
    file = folder / 'episodes' / f'{episode}.json'
    return EpisodeResult.from_json(read_json(file)['result'])


def scores(evaluated: EvaluationSummary, key: str) -> dict[str, float]:
    """Return a number of `scores.MEANS` by episode, over all views; unknown ones left out."""
    means = {r.episode: episode_means(r.rows, None)[key] for r in evaluated.results}
    return {name: value for name, value in means.items() if np.isfinite(value)}


def ranked_by(evaluations: Sequence[EvaluationSummary]) -> tuple[str, str, dict[str, float]]:
    """Return the measure that episodes are ranked by: its words, its name, its mean by episode.

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


def picks(evaluations: Sequence[EvaluationSummary]) -> dict[str, str]:
    """Return titles of the best, the median and the worst episode by name; see `ranked_by`."""
    means = ranked_by(evaluations)[2]
    ranked = sorted(means, key=lambda name: (-means[name], name))
    chosen = {0: 'Best', len(ranked) // 2: 'Median', len(ranked) - 1: 'Worst'}
    if len(ranked) < 3:
        chosen = ({}, {0: 'The only one'}, {0: 'Best', 1: 'Worst'})[len(ranked)]
    return {ranked[place]: title for place, title in chosen.items()}
