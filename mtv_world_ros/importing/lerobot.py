"""Reads rows and frames of LeRobot datasets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mtv_world_ros.core.bounded_input import (
    placeholder,
    read_bytes,
    require_regular,
)
from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import (
    EpisodeError,
    ObservationError,
)
from mtv_world_ros.data.bag.image_decoding import compressed_to_rgb
from mtv_world_ros.data.bag.image_orientation import exif_orientation, turned_upright, UPRIGHT
from mtv_world_ros.importing.lerobot_metadata import EpisodeEntry, INFO, LeRobotMetadata, PICTURES
from mtv_world_ros.importing.parquet_tables import pyarrow_modules, read_table
from mtv_world_ros.importing.video_frames import frames_at, times_in_video, video_note

#: bytes 24 and 25 of a PNG: 16 bits, grey
_PNG_DEPTH = bytes([16, 0])
#: columns that LeRobot adds to every table
_OWN_COLUMNS = ('timestamp', 'frame_index', 'episode_index', 'index', 'task_index')
#: maximum time between a video frame and its row [periods]
_TIME_TOLERANCE = 0.25


class LeRobotDataset(LeRobotMetadata):
    """A dataset with its rows and frames: a folder with `meta/`, `data/` and `videos/`."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._video_notes: dict[Path, str] = {}
        self._turns: dict[tuple[int, str], str] = {}
        self._matches: dict[tuple[int, str], str] = {}

    def video_note(self, entry: EpisodeEntry, feature: str) -> str:
        """Describe the changes made to the frames of a view, with reasons; empty = none.

        Call it when the frames have been read.

        Raises:
            EpisodeError: the video is missing or damaged.
        """
        if self.feature(feature, PICTURES)['dtype'] == 'image':
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
        if self.feature(feature, PICTURES)['dtype'] == 'image':
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

    def _table(self, entry: EpisodeEntry, columns: Sequence[str]) -> Any:
        if not entry.data_file.is_file():
            raise EpisodeError(
                f"'{entry.data_file}' is not there{self._stale(entry) or ', but in the metadata'}"
            )
        only = [('episode_index', '==', entry.index)] if 'episode_index' in columns else None
        table = read_table(entry.data_file, columns=columns, filters=only)
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
            f"; '{alike[0].relative_to(self.root)}' is: correct 'video_path' in '{INFO}', which "
            f"is '{self.video_path}'"
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
                column = read_table(file, columns=['episode_index']).column('episode_index')
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


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that no system has
        return False
