"""EXIF orientation of JPEG and PNG files.

Decoders differ. ROS's (`compressed_image_transport`, OpenCV with IMREAD_UNCHANGED) and Pillow
show pixels as they are stored. Hugging Face's `datasets` (LeRobot's reader) and OpenCV by
default turn them.
"""

from __future__ import annotations

import io
import warnings

import numpy as np
from PIL import Image

from mtv_world_ros.core.data_types import ByteArray

#: value of an image whose pixels are stored as they are shown
UPRIGHT = 1
_ORIENTATION = 0x0112
#: orientation -> whether rows and columns are exchanged, then whether x and y are flipped
_TURNS = {
    2: (False, True, False),
    3: (False, True, True),
    4: (False, False, True),
    5: (True, False, False),
    6: (True, True, False),
    7: (True, True, True),
    8: (True, False, True),
}
#: marks of the metadata in a JPEG and in a PNG file
_MARKS = (b'Exif\x00\x00', b'eXIf')


def exif_orientation(content: bytes) -> int:
    """Return the EXIF orientation of an image file, 1 to 8; 1 = as stored, or none is stated."""
    if not any(mark in content for mark in _MARKS):
        return UPRIGHT
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of damaged metadata
            with Image.open(io.BytesIO(content)) as image:
                found = image.getexif().get(_ORIENTATION, UPRIGHT)
    except Exception:  # damaged metadata say nothing; the decoder judges the pixels
        return UPRIGHT
    return found if found in _TURNS else UPRIGHT


def turned_upright(image: ByteArray, orientation: int) -> ByteArray:
    """Return an (H, W, 3) image as its EXIF orientation asks for."""
    if orientation not in _TURNS:
        return image
    swaps, flips_x, flips_y = _TURNS[orientation]
    turned = image.swapaxes(0, 1) if swaps else image
    turned = turned[:, ::-1] if flips_x else turned
    return np.ascontiguousarray(turned[::-1] if flips_y else turned)


def stored_note(content: bytes) -> str:
    """Return a note on an image of a ROS topic whose EXIF orientation is not applied, or ''."""
    orientation = exif_orientation(content)
    if orientation == UPRIGHT:
        return ''
    return (
        f'images state EXIF orientation {orientation} and are shown as they are stored, as by '
        'ROS image_transport; CameraInfo must be of the stored pixels'
    )
