"""Messages that are small for what they make a decoder do."""

import struct


def empty_points(count: int, stamp_ns: int = 0, *, order: str = '<') -> bytes:
    """Return the CDR bytes of a plan of `count` points without values, 24 bytes each.

    Args:
        count: number of points.
        stamp_ns: stamp of the plan [ns].
        order: byte order, `<` or `>`.
    """
    sec, nanosec = divmod(stamp_ns, 10**9)
    begin = b'\0\1\0\0' if order == '<' else b'\0\0\0\0'
    # stamp, the empty frame with its end, no joint names, the number of points
    head = struct.pack(f'{order}iII4sII', sec, nanosec, 1, b'', 0, count)
    return begin + head + bytes(24 * count)
