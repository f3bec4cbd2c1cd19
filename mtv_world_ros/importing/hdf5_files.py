"""Arrays and images of HDF5 files, as ALOHA, DROID and robomimic write them.

T rows, C columns. A file may refer to others (external links, external and virtual data sets);
these are refused, because a recording must not lead out of its folder.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import math
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.bounded_input import (
    check_limit,
    LimitError,
    placeholder,
    require_regular,
)
from mtv_world_ros.core.data_types import ByteArray, FloatArray
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.core.extras import needs_text
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.bag.image_decoding import check_image, to_rgb
from mtv_world_ros.importing.number_tables import NumberTable

#: a file, and a group or data set in it
_INSIDE = re.compile(r'(?P<file>.*\.(?:hdf5|h5)):(?P<path>.+)')
#: errors that h5py raises for damaged files
_DAMAGED = (OSError, RuntimeError, LookupError, ValueError, TypeError, MemoryError)
#: soft links that are followed one after the other
_MOST_LINKS = 16
#: chunks of a file that are kept in memory [bytes]
_CACHE_BYTES = 64 * 2**20
#: names that are listed in an error at most
_MOST_NAMES = 40
#: data sets, and levels of groups, that are looked at for names
_MOST_LISTED, _DEEPEST = 200, 8


def split_inside(pattern: str) -> tuple[str, str]:
    """Return the file and the path inside of it, of `FILE.hdf5:PATH`; empty = the whole file."""
    match = _INSIDE.fullmatch(pattern)
    return (match['file'], match['path'].strip('/')) if match else (pattern, '')


def is_hdf5(pattern: str) -> bool:
    """Return True for the path of an HDF5 file, or of something in one."""
    return Path(split_inside(pattern)[0]).suffix in ('.hdf5', '.h5')


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open a file.

    Raises:
        EpisodeError: h5py is missing, or it is no HDF5 file, or a damaged one.
    """
    file = _open(path)
    try:
        yield file
    except _DAMAGED as error:
        if isinstance(error, MtvWorldError):
            raise
        raise EpisodeError(f"'{path}' cannot be read: {error}") from error
    finally:
        file.close()


def _open(path: Path) -> Any:
    try:
        import h5py
    except ImportError as error:
        raise EpisodeError(needs_text(f"'{path}'", 'h5py')) from error
    if problem := placeholder(path):
        raise EpisodeError(f"'{path}' {problem}")
    try:
        require_regular(path)
        return h5py.File(path, 'r', rdcc_nbytes=_CACHE_BYTES)
    except OSError as error:
        raise EpisodeError(f"'{path}' is no HDF5 file, or a damaged one: {error}") from error


def find_item(group: Any, path: str, where: str) -> Any:
    """Return the group or data set at a path below a group of the same file.

    Raises:
        EpisodeError: it is not there, or a link leads to another file.
    """
    parts = [part for part in path.split('/') if part]
    found, followed = group, 0
    while parts:
        part = parts.pop(0)
        link = _link(found, part, where)
        kind = type(link).__name__
        if kind == 'ExternalLink':
            raise EpisodeError(f"{where}: '{part}' is a link to '{link.filename}'; other files "
                               'are not read')  # fmt: skip
        if kind == 'SoftLink':
            followed += 1
            if followed > _MOST_LINKS:
                raise EpisodeError(
                    f"{where}: '{path}' leads through more than {_MOST_LINKS} links"
                )
            found = found.file['/'] if link.path.startswith('/') else found
            parts = [*(name for name in link.path.split('/') if name), *parts]
            continue
        found = found[part]
    return found


def _link(group: Any, name: str, where: str) -> Any:
    is_group = hasattr(group, 'keys')
    link = group.get(name, getlink=True) if is_group and name in set(group.keys()) else None
    if link is None:
        known = [str(name) for name in group][:_MOST_NAMES] if is_group else []
        raise EpisodeError.unknown(
            f'{where} has no', name, known, is_not=f" in '{group.name}'", listed='; it has'
        )
    return link


def _checked(item: Any, where: str) -> Any:
    """Return a data set that holds its own values, in chunks of a limited size.

    Raises:
        EpisodeError: it is none.
    """
    if not hasattr(item, 'shape') or item.shape is None:
        raise EpisodeError(f"{where}: '{item.name}' is no data set; name one in it")
    if item.is_virtual or item.external:
        raise EpisodeError(f"{where}: the values of '{item.name}' are in other files, which are "
                           'not read')  # fmt: skip
    if item.chunks:
        _within('chunk_bytes', math.prod(item.chunks) * item.dtype.itemsize, item, where)
    return item


def _within(limit: str, size: int, item: Any, where: str) -> None:
    try:
        check_limit(limit, size, f"'{item.name}'")
    except LimitError as error:
        raise EpisodeError(f'{where}: {error}') from error


class Hdf5Keys(Mapping[str, Any]):
    """Attributes and small data sets of a recording by name, read when they are asked for.

    Args:
        path: file.
        inside: group of the recording in it.
    """

    def __init__(self, path: Path, inside: str) -> None:
        self._path, self._inside = path, inside

    def __getitem__(self, key: str) -> Any:
        where = f"'{self._path}'"
        with open_hdf5(self._path) as file:
            group = find_item(file, self._inside, where)
            if key in group.attrs:
                return _plain(group.attrs[key])
            try:
                found = find_item(group, key, where)
            except EpisodeError:
                found = None
            if found is not None:
                item = _checked(found, where)
                size = max(item.size or 0, 1) * item.dtype.itemsize
                _within('array_bytes', size, item, where)
                return _plain(item[()])
        raise KeyError(key)

    def __iter__(self) -> Iterator[str]:
        with open_hdf5(self._path) as file:
            group = find_item(file, self._inside, f"'{self._path}'")
            return iter([*group.attrs, *group])

    def __len__(self) -> int:
        return len(list(iter(self)))


def _plain(value: Any) -> Any:
    """Return a value of an attribute or data set in plain Python."""
    if isinstance(value, bytes):
        return value.decode(errors='replace')
    if isinstance(value, np.ndarray):
        return [_plain(one) for one in value.tolist()]
    return value.item() if isinstance(value, np.generic) else value


def read_hdf5_table(path: Path, inside: str, features: list[str]) -> NumberTable:
    """Return the columns of data sets side by side; their columns have numbers for names.

    Args:
        path: file.
        inside: group of the recording in it; empty = the whole file.
        features: paths of data sets (T,) or (T, C) below that group.

    Raises:
        EpisodeError: one is not there, holds no numbers, or they have not as many rows.
    """
    with open_hdf5(path) as file:
        group = find_item(file, inside, f"'{path}'")
        tables = [_numbers(group, feature, path) for feature in features]
    lengths = {name: len(table) for name, table in zip(features, tables, strict=True)}
    if len(set(lengths.values())) > 1:
        raise EpisodeError(f"'{path}': rows by data set are {lengths}, must be as many")
    return NumberTable(
        path=path,
        values=np.concatenate(tables, axis=1),
        names=(),
        keys=Hdf5Keys(path, inside),
    )


def _numbers(group: Any, feature: str, path: Path) -> FloatArray:
    item = _checked(find_item(group, feature, f"'{path}'"), f"'{path}'")
    if item.dtype.kind not in 'fiub' or len(item.shape) not in (1, 2) or item.shape[0] < 2:
        raise EpisodeError(
            f"'{path}': '{feature}' is {item.shape} of {item.dtype}, must be (rows, columns) of "
            'numbers, two rows or more'
        )
    _within('array_bytes', item.size * item.dtype.itemsize, item, f"'{path}'")
    table = np.asarray(item[()], np.float64)
    return table[:, None] if table.ndim == 1 else table


def group_names(path: Path, inside: str) -> list[str]:
    """Return the names of the groups in a group."""
    with open_hdf5(path) as file:
        group = find_item(file, inside, f"'{path}'")
        names = list(group.keys()) if hasattr(group, 'keys') else []
        return [name for name in names if group.get(name, getclass=True).__name__ == 'Group']


def data_set_names(path: Path, inside: str) -> dict[str, bool]:
    """Return the paths of the data sets below a group, and whether each has the shape of images.

    Links are not followed; of a file with very many data sets the first are returned.
    """
    found: dict[str, bool] = {}
    with open_hdf5(path) as file:
        left = [('', find_item(file, inside, f"'{path}'"))]
        while left and len(found) < _MOST_LISTED:
            prefix, group = left.pop(0)
            for name in group:
                if type(group.get(name, getlink=True)).__name__ != 'HardLink':
                    continue
                item = group[name]
                if hasattr(item, 'shape'):
                    shape = item.shape or ()
                    found[f'{prefix}{name}'] = len(shape) == 4 and shape[-1] == 3
                elif len(left) < _MOST_LISTED and prefix.count('/') < _DEEPEST:
                    left.append((f'{prefix}{name}/', item))
    return found


class Hdf5Frames:
    """Frames of a data set: (T, H, W, 3) pixels, or (T, N) or (T,) JPEG or PNG files.

    Attributes:
        times: None, as the file has no times of frames.
        note: empty, as frames are not changed.

    Args:
        path: file.
        inside: path of the data set in it.
        is_bgr: blue is the first channel, as OpenCV has it.

    Raises:
        EpisodeError: it is not there, or holds no images.
    """

    def __init__(self, path: Path, inside: str, *, is_bgr: bool = False) -> None:
        self._path, self._where, self._is_bgr = path, f"'{path}'", is_bgr
        self.times: FloatArray | None = None
        self.note = ''
        self._file = _open(path)
        try:
            item = _checked(find_item(self._file, inside, self._where), self._where)
        except _DAMAGED as error:
            if isinstance(error, MtvWorldError):
                raise
            raise EpisodeError(f"'{path}' cannot be read: {error}") from error
        self._item, shape = item, item.shape
        self._is_raw = len(shape) == 4
        is_pixels = self._is_raw and shape[-1] == 3 and item.dtype.str == '|u1'
        is_files = len(shape) == 2 and item.dtype.kind in 'ui' and item.dtype.itemsize == 1
        is_files = is_files or len(shape) == 1 and item.dtype.kind in 'OSV'
        if not (is_pixels or is_files) or not shape[0]:
            raise EpisodeError(
                f"{self._where}: '{item.name}' is {shape} of {item.dtype}, must be (frames, "
                'height, width, 3) of uint8, or a JPEG or PNG file a frame'
            )
        if self._is_raw:
            _within('image_pixels', shape[1] * shape[2], item, self._where)
        elif len(shape) == 2:
            _within('image_bytes', shape[1], item, self._where)
        self._numbers = np.arange(shape[0])

    def chosen(self, numbers: NDArray[np.int64]) -> Hdf5Frames:
        """Return some of the frames, by their increasing numbers."""
        found = Hdf5Frames.__new__(Hdf5Frames)
        found.__dict__.update(self.__dict__)
        found._numbers = self._numbers[numbers]
        return found

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: Any) -> ByteArray:
        if isinstance(index, slice):
            return np.stack([self._frame(i) for i in range(*index.indices(len(self)))])
        if np.ndim(index):
            return np.stack([self._frame(int(i)) for i in index])
        return self._frame(int(index))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return self[:]

    def _frame(self, index: int) -> ByteArray:
        index += len(self) if index < 0 else 0
        if not 0 <= index < len(self):
            raise IndexError(index)
        number = int(self._numbers[index])
        try:
            stored = self._item[number]
            pixels = np.asarray(stored, np.uint8) if self._is_raw else self._decoded(stored)
        except _DAMAGED as error:
            what = f"{self._where}: frame {number} of '{self._item.name}'"
            raise EpisodeError(f'{what}: {error}') from error
        return np.ascontiguousarray(pixels[..., ::-1] if self._is_bgr else pixels)

    def _decoded(self, stored: Any) -> ByteArray:
        data = stored if isinstance(stored, bytes) else np.asarray(stored).tobytes()
        message = messages.make_compressed(0, '', data, 'jpeg')
        try:
            check_image(message)
            return to_rgb(message)
        except MtvWorldError as error:
            raise ValueError(str(error)) from error
