"""Reads LeRobot datasets, formats v2.0, v2.1 and v3.0.

Layout as in huggingface/lerobot (`src/lerobot/datasets/utils.py`, `io_utils.py` and
`scripts/convert_dataset_v21_to_v30.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import (
    check_limit,
    fill_template,
    LimitError,
    limits,
    parse_json,
    placeholder,
    read_bytes,
    read_json,
    read_text,
    require_regular,
)
from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import (
    ConfigError,
    EpisodeError,
    MissingPackageError,
    ObservationError,
)
from mtv_world_ros.data.bag.image_decoding import compressed_to_rgb
from mtv_world_ros.data.bag.image_orientation import exif_orientation, turned_upright, UPRIGHT
from mtv_world_ros.data.other_formats import conversion_hint
from mtv_world_ros.importing.video_frames import frames_at, times_in_video, video_note

VERSIONS = ('v2.0', 'v2.1', 'v3.0')
_PICTURES = ('video', 'image')
#: bytes 24 and 25 of a PNG: 16 bits, grey
_PNG_DEPTH = bytes([16, 0])
_INFO = Path('meta/info.json')
#: columns that LeRobot adds to every table
_OWN_COLUMNS = ('timestamp', 'frame_index', 'episode_index', 'index', 'task_index')
#: maximum time between a video frame and its row [periods]
_TIME_TOLERANCE = 0.25
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


class LeRobotDataset:
    """A dataset: a folder with `meta/`, `data/` and `videos/`.

    Attributes:
        root: folder of the dataset.
        version: version of the format.
        fps: rows a second [Hz].
        features: types and shapes of the columns, by name.
        episodes: entries by number.
        tasks: texts by number.

    Raises:
        EpisodeError: the folder is no LeRobot dataset, or of another version.
        ConfigError: pyarrow is not installed.
    """

    def __init__(self, root: Path) -> None:
        pyarrow_modules()
        self.root = root
        self._video_notes: dict[Path, str] = {}
        self._turns: dict[tuple[int, str], str] = {}
        self._matches: dict[tuple[int, str], str] = {}
        info = self._info()
        self.version = str(info.get('codebase_version', ''))
        if self.version not in VERSIONS:
            raise EpisodeError(
                f"'{root / _INFO}' is of format '{self.version}'; readable are "
                f'{", ".join(VERSIONS)} (LeRobot itself converts older ones)'
            )
        try:
            self.fps = float(info['fps'])
            if not 0 < self.fps <= _MOST_HZ:
                raise ValueError(f'fps is {self.fps:g}; it must be above 0, at most {_MOST_HZ:g}')
            self.features: dict[str, dict[str, Any]] = dict(info['features'])
            self._data_path = info['data_path']
            self._video_path = info.get('video_path') or ''
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
        found = self.feature(name, _PICTURES)
        if _is_depth_map(found):
            raise ConfigError(
                f"'{self.root}': feature '{name}' is a depth map (is_depth_map), no picture of "
                f'the scene; those are {", ".join(self.colour_features()) or "none"}'
            )
        return found

    def colour_features(self) -> tuple[str, ...]:
        """Return the names of videos and images that are no depth maps."""
        cameras = {n: f for n, f in self.features.items() if f.get('dtype') in _PICTURES}
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

    def video_note(self, entry: EpisodeEntry, feature: str) -> str:
        """Describe the changes made to the frames of a view, with reasons; empty = none.

        Call it when the frames have been read.

        Raises:
            EpisodeError: the video is missing or damaged.
        """
        if self.feature(feature, _PICTURES)['dtype'] == 'image':
            return self._turns.get((entry.index, feature), '')
        file = entry.videos[feature].file
        if file not in self._video_notes:
            self._video_notes[file] = video_note(file)
        notes = (self._video_notes[file], self._matches.get((entry.index, feature), ''))
        return '; '.join(filter(None, notes))

    def rows(self, entry: EpisodeEntry, features: Sequence[str]) -> dict[str, FloatArray]:
        """Return the numbers of an episode by feature, (T, ...) each, in order.

        Raises:
            EpisodeError: the file cannot be read, or does not hold what the metadata say.
            ConfigError: a feature is not there.
        """
        for name in features:
            if name not in _OWN_COLUMNS:  # converters leave these out of meta/info.json
                self.feature(name)
        wanted = list(dict.fromkeys([*features, 'frame_index', 'episode_index']))
        there = self._columns(entry)
        absent = {name for name in wanted if name in _OWN_COLUMNS and name not in there}
        table = self._table(entry, [name for name in wanted if name not in absent])
        try:
            arrays = {
                name: np.array(table.column(name).to_pylist(), dtype=float)
                for name in wanted
                if name not in absent
            }
            arrays |= self._stand_ins(entry, absent)
        except (TypeError, ValueError) as error:
            raise EpisodeError(
                f"'{entry.data_file}': a feature among {list(features)} does not hold numbers "
                f'of one shape ({error})'
            ) from error
        order = np.argsort(arrays['frame_index'].ravel(), kind='stable')
        return {name: arrays[name][order] for name in features}

    def _columns(self, entry: EpisodeEntry) -> set[str]:
        """Return the names of a table's columns; empty where the table cannot be read."""
        pyarrow, parquet = pyarrow_modules()
        try:
            require_regular(entry.data_file)
            return set(parquet.read_schema(entry.data_file).names)
        except (OSError, pyarrow.ArrowException):
            return set()  # the reader of the rows says why

    def _stand_ins(self, entry: EpisodeEntry, absent: Collection[str]) -> dict[str, FloatArray]:
        """Return the values of LeRobot's own columns that a table does not have.

        Raises:
            EpisodeError: the episode has several tasks, and no column says which row has which.
        """
        frames = np.arange(entry.length, dtype=float)
        found = {'frame_index': frames, 'index': frames, 'timestamp': frames / self.fps}
        if 'task_index' in absent:
            numbers = [n for n, text in self.tasks.items() if text in entry.tasks]
            numbers = numbers or (list(self.tasks) if len(self.tasks) == 1 else [])
            if len(numbers) != 1:
                raise EpisodeError(
                    f"'{entry.data_file}' has no column 'task_index', and episode {entry.index} "
                    f'has {len(numbers)} of the {len(self.tasks)} tasks of the metadata; give '
                    "'instruction' in the mapping"
                )
            found['task_index'] = np.full(entry.length, numbers[0], float)
        return {name: values for name, values in found.items() if name in absent}

    def frames(
        self, entry: EpisodeEntry, feature: str, timestamps: FloatArray
    ) -> Iterator[ByteArray]:
        """Yield the (H, W, 3) RGB frames of an episode's rows at `timestamps` (T,) [s].

        Raises:
            EpisodeError: a frame is missing or damaged.
        """
        if self.feature(feature, _PICTURES)['dtype'] == 'image':
            yield from self._images(entry, feature)
            return
        part = entry.videos[feature]
        tolerance = _TIME_TOLERANCE / self.fps
        times = timestamps + part.start_s
        try:
            is_alone = self._num_episodes[part.file] == 1
            found, how = times_in_video(part.file, times, tolerance, is_alone=is_alone)
            self._matches[entry.index, feature] = how
            yield from frames_at(part.file, found, tolerance)
        except EpisodeError as error:
            hint = self._stale_video(feature) or self._video_elsewhere(part.file)
            raise EpisodeError(f'{error}{hint}') from error

    def _info(self) -> Mapping[str, Any]:
        file = self.root / _INFO
        if not file.is_file():
            raise EpisodeError(
                f"'{self.root}' is no LeRobot dataset: '{_INFO}' is not there"
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
                        file=self._file(self._video_path, {**place, 'video_key': key}), start_s=0.0
                    )
                    for key in self._video_keys()
                },
            )

    def _episodes_v3(self) -> Iterator[EpisodeEntry]:
        files = sorted((self.root / 'meta/episodes').glob('*/*.parquet'))
        if not files:
            raise EpisodeError(f"'{self.root / 'meta/episodes'}' holds no parquet file")
        for file in files:
            for row in _read_table(file).to_pylist():
                videos = {}
                for key in self._video_keys():
                    place = {'video_key': key, **_place(row, f'videos/{key}')}
                    videos[key] = VideoPart(
                        file=self._file(self._video_path, place),
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
        table = _read_table(self.root / 'meta/tasks.parquet')
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
                f"'{self.root / _INFO}': '{key}' is {repr(template)[:_MOST_SHOWN]}: {error}"
            ) from error
        if relative.is_absolute() or '..' in relative.parts:
            raise EpisodeError(f"'{self.root / _INFO}' names '{relative}', outside the dataset")
        return self.root / relative

    def _table(self, entry: EpisodeEntry, columns: Sequence[str]) -> Any:
        if not entry.data_file.is_file():
            raise EpisodeError(
                f"'{entry.data_file}' is not there{self._stale(entry) or ', but in the metadata'}"
            )
        only = [('episode_index', '==', entry.index)] if 'episode_index' in columns else None
        table = _read_table(entry.data_file, columns=columns, filters=only)
        if table.num_rows != entry.length:
            raise EpisodeError(
                f"'{entry.data_file}' has {table.num_rows} rows of episode {entry.index}, the "
                f'metadata say {entry.length}{self._stale(entry)}'
            )
        return table

    def _stale(self, entry: EpisodeEntry) -> str:
        """Return a text on the other files with the episode's rows; empty if there is none."""
        files = [f for f in self._files_by_episode.get(entry.index, ()) if f != entry.data_file]
        if not files:
            return ''
        named = ', '.join(f"'{file.relative_to(self.root)}'" for file in files)
        return (
            f'; rows of it are in {named}: the file index in meta/ is of an earlier state of the '
            "dataset (the columns 'data/chunk_index' and 'data/file_index' of meta/episodes in "
            'v3.0); write it again, or merge or convert the dataset anew with LeRobot'
        )

    def _video_elsewhere(self, file: Path) -> str:
        """Return a text on a file that is called like a missing video; empty if none is."""
        if file.is_file():
            return ''
        end = file.relative_to(self.root).parts[1:]
        alike = [
            found
            for found in sorted(self.root.rglob(file.name))
            if found.relative_to(self.root).parts[-len(end) :] == end
        ]
        if not alike:
            return ''
        return (
            f"; '{alike[0].relative_to(self.root)}' is: correct 'video_path' in '{_INFO}', which "
            f"is '{self._video_path}'"
        )

    def _stale_video(self, feature: str) -> str:
        """Return a text on the video files that no episode refers to; empty if there is none."""
        named = {entry.videos[feature].file for entry in self.episodes.values()}
        there = {f for f in (self.root / 'videos').rglob('*.mp4') if feature in f.parts}
        others = sorted(there - named)
        if not others:
            return ''
        shown = ', '.join(f"'{other.relative_to(self.root)}'" for other in others)
        return (
            f'; no episode names {shown}: the video index in meta/ is of an earlier state of the '
            f"dataset (the columns 'videos/{feature}/chunk_index', 'file_index' and "
            "'from_timestamp' of meta/episodes in v3.0); write it again, or merge or convert the "
            'dataset anew with LeRobot'
        )

    @cached_property
    def _num_episodes(self) -> Counter[Path]:
        """Number of episodes with frames in a video file."""
        return Counter(part.file for e in self.episodes.values() for part in e.videos.values())

    @cached_property
    def _files_by_episode(self) -> dict[int, list[Path]]:
        """Data files by the number of the episodes that have rows in them."""
        found: dict[int, list[Path]] = {}
        for file in sorted((self.root / 'data').rglob('*.parquet')):
            try:
                column = _read_table(file, columns=['episode_index']).column('episode_index')
            except EpisodeError:
                continue  # the file that is asked for is what is reported
            for index in column.unique().to_pylist():
                found.setdefault(int(index), []).append(file)
        return found

    def _images(self, entry: EpisodeEntry, feature: str) -> Iterator[ByteArray]:
        table = self._table(entry, [feature, 'frame_index', 'episode_index'])
        order = np.argsort(table.column('frame_index').to_pylist(), kind='stable')
        column = table.column(feature)
        for number in order:
            try:
                cell = column[int(number)].as_py()
            except UnicodeDecodeError as error:  # pyarrow decodes the path next to the bytes
                raise EpisodeError(
                    f"'{entry.data_file}': an image of '{feature}' is damaged: {error}"
                ) from error
            yield self._decoded(cell, entry, feature)

    def _image_bytes(self, cell: Any, entry: EpisodeEntry, feature: str) -> bytes:
        """Return the encoded image of a cell: bytes, a path, or both by key.

        Raises:
            EpisodeError: the cell holds none, or the file that it names cannot be read.
        """
        data, path = (
            (cell.get('bytes'), cell.get('path')) if isinstance(cell, Mapping) else (cell, None)
        )
        if isinstance(data, str):
            data, path = None, data
        if isinstance(data, list) and all(isinstance(n, int) and 0 <= n < 256 for n in data):
            data = bytes(data)
        if isinstance(data, bytes):
            return data
        if data is None and isinstance(path, str):
            return self._image_file(path, entry, feature)
        kind = type(cell).__name__ if not isinstance(cell, Mapping) else f'keys {sorted(cell)}'
        raise EpisodeError(
            f"'{entry.data_file}': a cell of '{feature}' holds {kind}, must be an encoded image, "
            'or the path of one'
        )

    def _image_file(self, path: str, entry: EpisodeEntry, feature: str) -> bytes:
        """Return the content of an image file; paths of another machine are taken by their end."""
        parts = [part for part in PurePosixPath(path.replace('\\', '/')).parts if part != '/']
        if not parts or '..' in parts:
            raise EpisodeError(
                f"'{entry.data_file}': an image of '{feature}' is '{path}', outside the dataset"
            )
        ends = [Path(*parts[k:]) for k in range(len(parts))]
        bases = (
            self.root,
            entry.data_file.parent,
            self.root / 'images' / feature / f'episode_{entry.index:06d}',
        )
        files = (base / end for end in ends for base in bases)
        found = next((file for file in files if _is_file(file)), None)
        if found is None:
            raise EpisodeError(
                f"'{entry.data_file}': an image of '{feature}' is '{path}', which is not there, "
                f"neither in '{self.root}' nor beside the table"
            )
        if problem := placeholder(found):
            raise EpisodeError(f"image '{found}' {problem}")
        try:
            return read_bytes(found, 'image_bytes')
        except (OSError, ValueError) as error:
            raise EpisodeError(f"image '{found}' cannot be read: {error}") from error

    def _decoded(self, cell: Any, entry: EpisodeEntry, feature: str) -> ByteArray:
        """Return the RGB image of a cell, upright as Hugging Face's `datasets` shows it."""
        data = self._image_bytes(cell, entry, feature)
        if data[:4] == b'\x89PNG' and data[24:26] == _PNG_DEPTH:
            raise EpisodeError(
                f"'{entry.data_file}': '{feature}' has 16-bit images of one channel, as of depth; "
                'a view needs colours'
            )
        layout = 'png' if data[:4] == b'\x89PNG' else 'jpeg'
        try:
            image = compressed_to_rgb(layout, np.frombuffer(data, np.uint8))
            orientation = exif_orientation(data)
            if orientation != UPRIGHT:
                self._turns[entry.index, feature] = (
                    f'images are turned upright (EXIF orientation {orientation}), as LeRobot '
                    'shows them'
                )
            return turned_upright(image, orientation)
        except ObservationError as error:
            raise EpisodeError(
                f"'{entry.data_file}': an image of '{feature}' is damaged: {error}"
            ) from error


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


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that no system has
        return False


def _is_depth_map(feature: Mapping[str, Any]) -> bool:
    """Return True if a feature is marked as a depth map, under any key that LeRobot has used."""
    places = (feature, feature.get('info'), feature.get('video_info'))
    keys = ('is_depth_map', 'video.is_depth_map')
    return any(bool(p.get(key)) for p in places if isinstance(p, Mapping) for key in keys)


def _place(row: Mapping[str, Any], prefix: str) -> dict[str, int]:
    return {key: int(row[f'{prefix}/{key}']) for key in ('chunk_index', 'file_index')}


def _read_table(file: Path, **options: Any) -> Any:
    pyarrow, parquet = pyarrow_modules()
    try:
        require_regular(file)
        _check_table(parquet.read_metadata(file), file, options.get('columns'))
        return parquet.read_table(file, **options)
    except (OSError, pyarrow.ArrowException) as error:
        reason = placeholder(file) or ' '.join(str(error).split())
        raise EpisodeError(f"cannot read '{file}': {reason}") from error


def _check_table(metadata: Any, file: Path, columns: Sequence[str] | None) -> None:
    """Check the size of a table: a few kilobytes may state billions of equal values or texts.

    Raises:
        EpisodeError: there are too many.
    """
    parts = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    read = [
        column
        for part in parts
        for column in map(part.column, range(part.num_columns))
        if columns is None or _is_of(column.path_in_schema, columns)
    ]
    count = sum(column.num_values for column in read)
    texts = [column for column in read if column.physical_type == 'BYTE_ARRAY']
    least = sum(column.total_uncompressed_size for column in texts)
    repeated = [c for c in texts if c.has_dictionary_page]
    most = least + sum(c.num_values * c.total_uncompressed_size for c in repeated)
    try:
        check_limit('table_values', count, f"'{file}'")
        check_limit('table_bytes', least, f"'{file}'")
        if most > limits().table_bytes:
            paths = sorted({column.path_in_schema for column in texts})
            check_limit('table_bytes', _text_bytes(file, paths), f"'{file}'")
    except LimitError as error:
        raise EpisodeError(str(error)) from error


def _is_of(path: str, columns: Sequence[str]) -> bool:
    """Return True if a path in the schema belongs to a column; names of columns may have dots."""
    return any(path == name or path.startswith(f'{name}.') for name in columns)


def _text_bytes(file: Path, paths: Sequence[str]) -> int:
    """Return the size of texts and images in these columns of a table.

    A table stores a repeated text once. It is read that way here, as reading it row by row fills
    the memory.
    """
    _, parquet = pyarrow_modules()
    table = parquet.ParquetFile(file, read_dictionary=list(paths))
    batches = table.iter_batches(columns=list(paths))
    return sum(_array_bytes(column) for batch in batches for column in batch.columns)


def _array_bytes(array: Any) -> int:
    """Return the size of the texts in an array, and in the arrays that it consists of."""
    pyarrow, _ = pyarrow_modules()
    compute: Any = import_module('pyarrow.compute')
    types, kind = pyarrow.types, array.type
    if types.is_dictionary(kind):
        lengths = compute.binary_length(array.dictionary)
        return int(compute.sum(lengths.take(array.indices.drop_null())).as_py() or 0)
    if types.is_struct(kind):
        return sum(_array_bytes(array.field(number)) for number in range(kind.num_fields))
    if types.is_list(kind) or types.is_large_list(kind):
        return _array_bytes(array.flatten())
    if any(check(kind) for check in (types.is_string, types.is_binary)):
        return int(compute.sum(compute.binary_length(array.cast(pyarrow.binary()))).as_py() or 0)
    return 0


def pyarrow_modules() -> tuple[Any, Any]:
    """Return `pyarrow` and `pyarrow.parquet`, which are optional."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingPackageError('a LeRobot data set', 'pyarrow') from error
    return pyarrow, parquet
