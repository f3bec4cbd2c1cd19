"""Large arrays of .npz files mapped into memory: a data set may be larger than memory."""

from __future__ import annotations

from io import BytesIO
from math import prod
from pathlib import Path
import struct
from typing import BinaryIO
from zipfile import BadZipFile, ZIP_STORED, ZipFile, ZipInfo

import numpy as np
import torch

from mtv_world_ros.core.bounded_input import check_limit, read_arrays, require_regular

#: arrays of fewer bytes are read: a mapping takes whole pages
MAPPED_BYTES = 1 << 16
#: size of the fixed part of a member's header in a zip file [bytes]
_HEADER_BYTES = 30
#: place of the two lengths in that header [bytes]
_LENGTHS_AT = 26
#: bytes from which the header of an array is read; NumPy writes 128
_ARRAY_HEADER_BYTES = 4096


def read_mapped(path: Path | str, limit: str = 'array_bytes') -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name, like `read_arrays`; large images are mapped.

    A mapped array takes no memory of its own: the system reads its pages when they are used and
    drops them when memory is short, and processes share them. It stays valid when the file is
    replaced or removed. Writing to it does not change the file. No file stays open, whose number
    is limited. Compressed members, small ones and arrays of other types than bytes are read. The
    checksums of mapped members are not verified.

    Args:
        path: path of the file.
        limit: field of `Limits` for the size of all arrays.

    Raises:
        OSError: the file cannot be read, or is no regular file.
        ValueError: it is too large, damaged, or holds objects (pickles).
    """
    try:
        require_regular(path)
        with ZipFile(path) as archive:
            members = archive.infolist()
        large = [m for m in members if _is_mapped(m)]
        found = read_arrays(path, limit, without=[m.filename for m in large])
        check_limit(limit, sum(m.file_size for m in members), f"'{path}'")
        return found | (_mapped(Path(path), large) if large else {})
    except (BadZipFile, struct.error, EOFError, RuntimeError, SyntaxError) as error:
        raise ValueError(f'{type(error).__name__}: {error}') from error


def _is_mapped(member: ZipInfo) -> bool:
    return member.compress_type == ZIP_STORED and member.file_size >= MAPPED_BYTES


def _mapped(path: Path, members: list[ZipInfo]) -> dict[str, np.ndarray]:
    require_regular(path)
    size = path.stat().st_size
    # unlike mmap of Python, torch closes the file once it is mapped
    whole = torch.from_file(str(path), shared=False, size=size, dtype=torch.uint8).numpy()
    found = {}
    with path.open('rb') as file:
        for member in members:
            start, shape, dtype, is_fortran = _place(file, member)
            stop = start + prod(shape) * dtype.itemsize
            if stop > size or dtype.hasobject or min(shape, default=0) < 0:
                raise ValueError(f"'{member.filename}' is an array of shape {shape}, type {dtype}")
            values = whole[start:stop].view(dtype)
            if dtype.itemsize > 1:  # members of a zip file are not aligned
                values = values.copy()
            name = member.filename.removesuffix('.npy')
            found[name] = values.reshape(shape, order='F' if is_fortran else 'C')
    return found


def _place(file: BinaryIO, member: ZipInfo) -> tuple[int, tuple[int, ...], np.dtype, bool]:
    """Return where an array's values begin in a zip file, its shape, type and order."""
    file.seek(member.header_offset)
    lengths = struct.unpack_from('<HH', file.read(_HEADER_BYTES), _LENGTHS_AT)
    begin = member.header_offset + _HEADER_BYTES + sum(lengths)
    file.seek(begin)
    stream = BytesIO(file.read(_ARRAY_HEADER_BYTES))
    is_first = np.lib.format.read_magic(stream) == (1, 0)
    formats = np.lib.format
    read = formats.read_array_header_1_0 if is_first else formats.read_array_header_2_0
    shape, is_fortran, dtype = read(stream)
    if stream.tell() + prod(shape) * dtype.itemsize != member.file_size:
        raise ValueError(f"'{member.filename}': {member.file_size} bytes for shape {shape}")
    return begin + stream.tell(), shape, dtype, is_fortran
