"""Metadata of LeRobot datasets, formats v2.0, v2.1 and v3.0.

Layout as in huggingface/lerobot (`src/lerobot/datasets/utils.py`, `io_utils.py` and
`scripts/convert_dataset_v21_to_v30.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mtv_world_ros.core.bounded_input import (
    fill_template,
    parse_json,
    read_json,
    read_text,
)
from mtv_world_ros.core.errors import (
    ConfigError,
    EpisodeError,
)
from mtv_world_ros.data.other_formats import conversion_hint
from mtv_world_ros.importing.parquet_tables import pyarrow_modules, read_table

VERSIONS = ('v2.0', 'v2.1', 'v3.0')
#: types of the features that are seen by a camera
PICTURES = ('video', 'image')
INFO = Path('meta/info.json')
#: rows a second that no recording exceeds [Hz]
_MOST_HZ = 10_000.0
#: characters of a wrong value in an error
_MOST_SHOWN = 120


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoPart:
    """A video file with an episode's frames, and the time at which the episode starts in it."""

    file: Path
    start_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeEntry:
    """One episode of a dataset.

    Attributes:
        index: number of the episode.
        length: number of rows.
        data_file: parquet file with the episode's rows, maybe among others'.
        videos: videos by feature.
        tasks: instructions of the episode.
    """

    index: int
    length: int
    data_file: Path
    videos: Mapping[str, VideoPart]
    tasks: tuple[str, ...] = ()


class LeRobotMetadata:
    """Metadata of a dataset: a folder with `meta/`.

    Args:
        root: folder of the dataset.

    Attributes:
        root: folder of the dataset.
        version: version of the format.
        fps: rows a second [Hz].
        features: types and shapes of the columns, by name.
        episodes: entries by number.
        tasks: texts by number.
        video_path: template of the paths of videos.

    Raises:
        EpisodeError: the folder is no LeRobot dataset, or of another version.
        ConfigError: pyarrow is not installed.
    """

    def __init__(self, root: Path) -> None:
        pyarrow_modules()
        self.root = root
        info = self._info()
        self.version = str(info.get('codebase_version', ''))
        if self.version not in VERSIONS:
            raise EpisodeError(
                f"'{root / INFO}' is of format '{self.version}'; readable are "
                f'{", ".join(VERSIONS)} (LeRobot itself converts older ones)'
            )
        try:
            self.fps = float(info['fps'])
            if not 0 < self.fps <= _MOST_HZ:
                raise ValueError(f'fps is {self.fps:g}; it must be above 0, at most {_MOST_HZ:g}')
            self.features: dict[str, dict[str, Any]] = dict(info['features'])
            self._data_path = info['data_path']
            self.video_path = info.get('video_path') or ''
            self._chunk = int(info.get('chunks_size', 1000))
            read = self._episodes_v3 if self.version == 'v3.0' else self._episodes_v2
            self.episodes = {entry.index: entry for entry in read()}
            self.tasks = self._tasks_v3() if self.version == 'v3.0' else self._tasks_v2()
        except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
            raise EpisodeError(
                f"'{root / 'meta'}' is not what format {self.version} has there: "
                f'{type(error).__name__}: {error}'
            ) from error

    def feature(self, name: str, kinds: Sequence[str] = ()) -> dict[str, Any]:
        """Return the description of a feature in the dataset's metadata.

        Raises:
            ConfigError: there is none of that name and (if any are given) kinds.
        """
        known = [n for n, f in self.features.items() if not kinds or f.get('dtype') in kinds]
        if name not in known:
            what = 'image or video feature' if kinds else 'feature'
            raise ConfigError.unknown(
                f"'{self.root}' has no {what}", name, known, listed='; it has'
            )
        return self.features[name]

    def colour_feature(self, name: str) -> dict[str, Any]:
        """Return the description of a camera's video or images in the dataset's metadata.

        Raises:
            ConfigError: there is no such feature, or it is a depth map.
        """
        found = self.feature(name, PICTURES)
        if _is_depth_map(found):
            raise ConfigError(
                f"'{self.root}': feature '{name}' is a depth map (is_depth_map), no picture of "
                f'the scene; those are {", ".join(self.colour_features()) or "none"}'
            )
        return found

    def colour_features(self) -> tuple[str, ...]:
        """Return the names of videos and images that are no depth maps."""
        cameras = {n: f for n, f in self.features.items() if f.get('dtype') in PICTURES}
        return tuple(name for name, f in cameras.items() if not _is_depth_map(f))

    def column_names(self, feature: str) -> list[str]:
        """Return the names of a feature's columns, empty where it has none.

        They are a list, a list in a list, lists under keys (`motors`), which follow each other, or
        numbers of columns by name.
        """
        names = self.feature(feature).get('names')
        if isinstance(names, Mapping) and _are_numbers(list(names.values())):
            names = sorted(names, key=names.__getitem__)
        return _flat_names(names)

    def joined_names(self, sizes: Mapping[str, int]) -> list[str]:
        """Return one name a column of several features side by side.

        Args:
            sizes: numbers of columns by feature, in their order.

        A column keeps its own name where no other feature has it, else it is FEATURE/NAME. One
        without a name is FEATURE/NUMBER, or FEATURE where it is the only one. Columns of a single
        feature keep their names; there are none where the feature names none.
        """
        own = {feature: self.column_names(feature) for feature in sizes}
        if len(sizes) == 1:
            return own[next(iter(sizes))]
        counts = Counter(name for names in own.values() for name in names)
        found = []
        for feature, size in sizes.items():
            names = own[feature]
            if len(names) != size:
                names = []
            for k in range(size):
                if names and counts[names[k]] == 1:
                    found.append(names[k])
                else:
                    part = names[k] if names else str(k)
                    found.append(feature if size == 1 and not names else f'{feature}/{part}')
        return found

    def _info(self) -> Mapping[str, Any]:
        file = self.root / INFO
        if not file.is_file():
            raise EpisodeError(
                f"'{self.root}' is no LeRobot dataset: '{INFO}' is not there"
                f'{conversion_hint(self.root)}'
            )
        try:
            info = read_json(file)
        except (OSError, ValueError) as error:
            raise EpisodeError(f"'{file}' is not JSON: {error}") from error
        if not isinstance(info, Mapping):
            raise EpisodeError(f"'{file}' must hold keys and values")
        return info

    def _video_keys(self) -> list[str]:
        return [name for name, f in self.features.items() if f.get('dtype') == 'video']

    def _episodes_v2(self) -> Iterator[EpisodeEntry]:
        for row in self._lines('meta/episodes.jsonl'):
            index = int(row['episode_index'])
            chunk = index // self._chunk  # converters also call it as v3.0 does
            place = {'episode_index': index, 'episode_chunk': chunk, 'chunk_index': chunk}
            yield EpisodeEntry(
                index=index,
                length=int(row['length']),
                tasks=_texts(row.get('tasks')),
                data_file=self._file(self._data_path, place),
                videos={
                    key: VideoPart(
                        file=self._file(self.video_path, {**place, 'video_key': key}), start_s=0.0
                    )
                    for key in self._video_keys()
                },
            )

    def _episodes_v3(self) -> Iterator[EpisodeEntry]:
        files = sorted((self.root / 'meta/episodes').glob('*/*.parquet'))
        if not files:
            raise EpisodeError(f"'{self.root / 'meta/episodes'}' holds no parquet file")
        for file in files:
            for row in read_table(file).to_pylist():
                videos = {}
                for key in self._video_keys():
                    place = {'video_key': key, **_place(row, f'videos/{key}')}
                    videos[key] = VideoPart(
                        file=self._file(self.video_path, place),
                        start_s=float(row[f'videos/{key}/from_timestamp']),
                    )
                yield EpisodeEntry(
                    index=int(row['episode_index']),
                    length=int(row['length']),
                    tasks=_texts(row.get('tasks')),
                    data_file=self._file(self._data_path, _place(row, 'data')),
                    videos=videos,
                )

    def _tasks_v2(self) -> dict[int, str]:
        return {int(r['task_index']): str(r['task']) for r in self._lines('meta/tasks.jsonl')}

    def _tasks_v3(self) -> dict[int, str]:
        table = read_table(self.root / 'meta/tasks.parquet')
        # pandas' index: its name, or `__index_level_0__` where it had none
        texts = next(name for name in table.column_names if name != 'task_index')
        rows = zip(table.column('task_index').to_pylist(), table.column(texts).to_pylist(),
                   strict=True)  # fmt: skip
        return {int(index): str(text) for index, text in rows}

    def _lines(self, name: str) -> Iterator[dict[str, Any]]:
        file = self.root / name
        try:
            lines = read_text(file, 'json_bytes').splitlines()
            return iter([parse_json(line, f"'{file}'") for line in lines if line.strip()])
        except (OSError, ValueError) as error:
            raise EpisodeError(f"cannot read '{file}': {error}") from error

    def _file(self, template: object, place: Mapping[str, int | str]) -> Path:
        try:
            relative = Path(fill_template(template, place))
        except ValueError as error:
            key = 'data_path' if template == self._data_path else 'video_path'
            raise EpisodeError(
                f"'{self.root / INFO}': '{key}' is {repr(template)[:_MOST_SHOWN]}: {error}"
            ) from error
        if relative.is_absolute() or '..' in relative.parts:
            raise EpisodeError(f"'{self.root / INFO}' names '{relative}', outside the dataset")
        return self.root / relative


def _texts(value: Any) -> tuple[str, ...]:
    """Return the texts of a list; empty if it is none."""
    return tuple(map(str, value)) if isinstance(value, list) else ()


def _are_numbers(values: list[Any]) -> bool:
    """Return True if the values are the numbers 0 .. N - 1, in any order."""
    is_whole = all(isinstance(value, int) for value in values)
    return bool(values) and is_whole and sorted(values) == list(range(len(values)))


def _flat_names(names: Any) -> list[str]:
    """Return the texts of nested lists and keys, in order; empty where there are none."""
    if isinstance(names, Mapping):
        names = list(names.values())
    if not isinstance(names, list):
        return []
    if any(isinstance(name, list | Mapping) for name in names):
        return [text for part in names for text in _flat_names(part)]
    return [str(name) for name in names]


def _is_depth_map(feature: Mapping[str, Any]) -> bool:
    """Return True if a feature is marked as a depth map, under any key that LeRobot has used."""
    places = (feature, feature.get('info'), feature.get('video_info'))
    keys = ('is_depth_map', 'video.is_depth_map')
    return any(bool(p.get(key)) for p in places if isinstance(p, Mapping) for key in keys)


def _place(row: Mapping[str, Any], prefix: str) -> dict[str, int]:
    return {key: int(row[f'{prefix}/{key}']) for key in ('chunk_index', 'file_index')}
