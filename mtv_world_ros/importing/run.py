"""Imports a dataset: episode after episode, what is there is kept, what fails is named."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mtv_world_ros.data.episode_reader import read_info
from mtv_world_ros.errors import ConfigError, EpisodeError, MtvWorldError
from mtv_world_ros.importing.convert import convert_episode, MAPPING_KEY
from mtv_world_ros.importing.lerobot import LeRobotDataset
from mtv_world_ros.importing.mapping import DatasetMapping, load_mapping

Item = TypeVar('Item')


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportSummary:
    """What became of the episodes.

    Attributes:
        made: numbers of those converted now.
        kept: of those that were there already.
        failed: why, by number.
    """

    made: tuple[int, ...]
    kept: tuple[int, ...]
    failed: dict[int, str]


def import_dataset(
    dataset: Path,
    mapping: Path,
    out: Path,
    *,
    episodes: Sequence[int] | None = None,
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> ImportSummary:
    """Converts a LeRobot dataset into episodes `out/episode_<number>`.

    Args:
        dataset: its folder.
        mapping: mapping file, see `load_mapping`.
        out: folder of the episodes.
        episodes: numbers of those wanted; None = all.
        progress: wraps the numbers, e.g. in a progress bar.

    Raises:
        ConfigError, EpisodeError: dataset or mapping cannot be used at all.
    """
    source, chosen = LeRobotDataset(dataset), load_mapping(mapping)
    _check_features(source, chosen)
    wanted = sorted(source.episodes) if episodes is None else list(episodes)
    unknown = [number for number in wanted if number not in source.episodes]
    if unknown:
        known = sorted(source.episodes)
        raise ConfigError(
            f"'{dataset}' has no episode {unknown[0]}; it has {len(known)}, from "
            f'{known[0] if known else "-"} to {known[-1] if known else "-"}'
        )
    made, kept, failed = [], [], {}
    for number in progress(wanted):
        path = out / f'episode_{number:06d}'
        try:
            if _is_there(path, chosen):
                kept.append(number)
            else:
                convert_episode(source, source.episodes[number], chosen, path)
                made.append(number)
        except MtvWorldError as error:
            failed[number] = str(error)
    return ImportSummary(made=tuple(made), kept=tuple(kept), failed=failed)


def _check_features(source: LeRobotDataset, chosen: DatasetMapping) -> None:
    """Finds a wrong name at once, not once an episode."""
    streams = [chosen.state, *([chosen.action] if chosen.action else [])]
    for stream in streams:
        source.feature(stream.feature)
    if chosen.outcome_feature:
        source.feature(chosen.outcome_feature)
    for view in chosen.views.values():
        source.feature(view.feature, ('video', 'image'))
        for name in view.features():
            source.feature(name)


def _is_there(path: Path, chosen: DatasetMapping) -> bool:
    if not path.exists():
        return False
    made_with = read_info(path).metadata.get(MAPPING_KEY, '')
    if made_with != chosen.key:
        raise EpisodeError(
            f"'{path}' was imported with another mapping, calibration or robot; remove it or "
            'choose another --out'
        )
    return True
