"""Features, columns and files of data sets and folders that no episode has, and why."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mtv_world_ros.importing.lerobot import LeRobotDataset
from mtv_world_ros.importing.mapping import DatasetMapping, Stream

#: columns of a LeRobot data set that number its rows
_ROW_NUMBERS = {'timestamp', 'frame_index', 'episode_index', 'index', 'task_index'}
_NO_KEY = 'no key of the mapping names it'
_NO_JOINT = 'no joint of the mapping has it'
#: files that a note names at most
_MAX_FILES = 8


def unused_features(dataset: LeRobotDataset, mapping: DatasetMapping) -> dict[str, str]:
    """Return why features and columns of a data set are not used, by name."""
    used = {*_ROW_NUMBERS, *mapping.state.features, mapping.outcome_feature}
    used |= set(mapping.action.features if mapping.action else ())
    for source in mapping.views.values():
        used |= {source.feature, *source.features()}
    found = {
        name: _why(name, feature, dataset, mapping)
        for name, feature in dataset.features.items()
        if name not in used
    }
    streams = [mapping.state, *([mapping.action] if mapping.action else [])]
    for stream in streams:
        sizes = {name: _size(dataset.features.get(name, {})) for name in stream.features}
        names = dataset.joined_names(sizes)
        columns = _columns(stream, names, mapping.state)
        found |= unused_columns(stream.label, names, sum(sizes.values()), columns)
    return found


def _why(
    name: str, feature: Mapping[str, Any], dataset: LeRobotDataset, mapping: DatasetMapping
) -> str:
    if feature.get('dtype') in ('video', 'image'):
        has_colours = name in dataset.colour_features()
        return 'images of no view of the mapping' if has_colours else 'no colour images'
    if name.startswith('action') and mapping.action is None:
        return "commands; 'action: state' takes the measured positions that follow"
    return _NO_KEY


def _size(feature: Mapping[str, Any]) -> int:
    """Return the number of columns of a feature."""
    shape = feature.get('shape') or [1]
    return int(shape[0])


def _columns(stream: Stream, names: Sequence[str], state: Stream) -> tuple[int | str, ...]:
    """Return the columns that a stream uses; commands may have those of the state."""
    columns = stream.used_columns()
    if stream is state or set(columns) <= {*names, *range(len(names))}:
        return columns
    return state.used_columns()


def unused_columns(
    label: str, names: Sequence[str], count: int, used: Collection[int | str]
) -> dict[str, str]:
    """Return why columns of a table are not used.

    Args:
        label: name of the table or feature.
        names: names of the columns; empty where they have none.
        count: number of columns.
        used: columns that are used, by name or number.
    """
    rest = [
        names[n] if names else f'column {n}'
        for n in range(count)
        if n not in used and not (n < len(names) and names[n] in used)
    ]
    return {f'{", ".join(rest)} of {label}': _NO_JOINT} if rest else {}


def unused_keys(keys: Iterable[str], used: Collection[str]) -> dict[str, str]:
    """Return why keys or columns of a recording's own table are not used."""
    return {str(key): _NO_KEY for key in keys if key not in used}


def unused_files(folder: Path, used: Collection[Path], out: Path) -> str:
    """Return the line that names the files of a folder that no recording has; empty = none.

    Args:
        folder: folder of the recordings.
        used: files of the recordings.
        out: folder of the episodes, which may lie in it.
    """
    wanted = {path.resolve() for path in used}
    rest = [
        path.relative_to(folder).as_posix()
        for path in sorted(folder.rglob('*'))
        if path.is_file()
        and path.resolve() not in wanted
        and out.resolve() not in path.resolve().parents
        and not any(part.startswith('.') for part in path.relative_to(folder).parts)
    ]
    if not rest:
        return ''
    more = f' and {len(rest) - _MAX_FILES} more' if len(rest) > _MAX_FILES else ''
    names = ', '.join(rest[:_MAX_FILES]).encode(errors='backslashreplace').decode()
    return f'not used: {names}{more} (no recording of the mapping has them)'
