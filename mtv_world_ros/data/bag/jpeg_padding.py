"""JPEG files with surplus bytes before their restart markers, as many webcams write them.

Decoders skip such bytes and warn. A damaged file gives the same warning where a part of it ends
early, and a decoder reports its first warning alone: each part between two restart markers
(ITU-T T.81, sections B.1.1.3 and E.1.4) is therefore decoded as an image of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
import re
import struct

import simplejpeg

#: largest number of surplus bytes before a marker [bytes]; webcams are reported with 1 to 10
MAX_PADDING_BYTES = 10
#: text of the decoder's warning about surplus bytes
_SURPLUS = re.compile(r'(\d+) extraneous bytes before marker 0xd([0-79])')
#: side length of the largest image that a JPEG decoder takes [px]
_MAX_SIDE_PX = 65500
_RESTART = re.compile(rb'\xff[\xd0-\xd7]')
_END = b'\xff\xd9'
#: last digit of the marker that ends a file, in warnings
_END_DIGIT = '9'
#: codes of markers: frame headers of sequential Huffman coding, restart interval, scan
_FRAMES = (0xC0, 0xC1)
_INTERVAL = 0xDD
_SCAN = 0xDA
#: size of a block [px]
_BLOCK_PX = 8


@dataclass(frozen=True, slots=True)
class _Layout:
    """Layout of a file with one scan and restart markers.

    Attributes:
        head: bytes up to the first entropy-coded one.
        size_at: place of height and width in `head`.
        unit: width and height of a coded unit (MCU) [px].
        columns: number of units in a row of the image.
        units: number of units in the image.
        interval: number of units between two restart markers.
    """

    head: bytes
    size_at: int
    unit: tuple[int, int]
    columns: int
    units: int
    interval: int

    def part(self, data: bytes, units: int) -> bytes:
        """Return a file whose image is one part of the entropy-coded data.

        Raises:
            ValueError: no image has this number of units.
        """
        rows = units // self.columns if units % self.columns == 0 else 1
        width, height = units // rows * self.unit[0], rows * self.unit[1]
        if width > _MAX_SIDE_PX:
            raise ValueError(f'{width} px')
        size = struct.pack('>HH', height, width)
        head = self.head[: self.size_at] + size + self.head[self.size_at + 4 :]
        return head + data + _END


def is_only_padded(content: bytes, warning: str) -> bool:
    """Return True if surplus bytes before markers are the only fault of a JPEG file.

    Args:
        content: bytes of a JPEG file.
        warning: first warning of its decoder.
    """
    surplus = _SURPLUS.search(warning)
    if surplus is None:
        return False
    if surplus[2] == _END_DIGIT:  # nothing was wrong before the end
        end, count = content.rindex(_END), int(surplus[1])
        return count <= MAX_PADDING_BYTES or len(set(content[end - count : end])) == 1
    try:
        layout = _read_layout(content)
        body = content[len(layout.head) : content.rindex(_END)]
        parts, markers = _RESTART.split(body), _RESTART.findall(body)
        numbers = [marker[1] & 7 for marker in markers]
        if numbers != [n % 8 for n in range(-(-layout.units // layout.interval) - 1)]:
            return False
        last = layout.units - layout.interval * len(markers)
        counts = [layout.interval] * len(markers) + [last]
        return all(
            _is_whole(layout.part(part, count)) for part, count in zip(parts, counts, strict=True)
        )
    except (ValueError, IndexError, struct.error, ZeroDivisionError):
        return False


def _is_whole(content: bytes) -> bool:
    """Return True if a part decodes without a warning but that of a few surplus bytes."""
    try:
        simplejpeg.decode_jpeg(content, 'GRAY', min_height=1, min_width=1, min_factor=8)
    except ValueError as error:
        surplus = _SURPLUS.search(str(error))
        return surplus is not None and int(surplus[1]) <= MAX_PADDING_BYTES
    return True


def _read_layout(content: bytes) -> _Layout:
    """Return the layout of a file.

    Raises:
        ValueError, IndexError, struct.error: it has no restart markers, several scans, or another
            coding.
    """
    at, interval, size_at = 2, 0, 0
    sampling: list[tuple[int, int]] = []
    while True:
        mark, code, length = struct.unpack_from('>BBH', content, at)
        if mark != 0xFF:
            raise ValueError(f'no marker at byte {at}')
        if code == _INTERVAL:
            (interval,) = struct.unpack_from('>H', content, at + 4)
        elif code in _FRAMES:
            size_at = at + 5
            count = content[at + 9]
            factors = [content[at + 11 + 3 * n] for n in range(count)]
            sampling = [(factor >> 4, factor & 15) for factor in factors]
        at += 2 + length
        if code == _SCAN:
            break
    if not interval or not sampling or content[at - length + 2] != len(sampling):
        raise ValueError('not one scan with restart markers')
    height, width = struct.unpack_from('>HH', content, size_at)
    unit = [_BLOCK_PX * max(factor[axis] for factor in sampling) for axis in (0, 1)]
    if len(sampling) == 1:  # a single component is not interleaved: its units are blocks
        unit = [_BLOCK_PX, _BLOCK_PX]
    columns, rows = -(-width // unit[0]), -(-height // unit[1])
    return _Layout(
        head=content[:at],
        size_at=size_at,
        unit=(unit[0], unit[1]),
        columns=columns,
        units=columns * rows,
        interval=interval,
    )
