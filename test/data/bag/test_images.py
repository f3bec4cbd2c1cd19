from __future__ import annotations

import io
from types import SimpleNamespace

import cv2
import numpy as np
from PIL import Image, ImageOps
import pytest

from mtv_world_ros.core.errors import ObservationError
from mtv_world_ros.data.bag import image_decoding
from mtv_world_ros.data.bag.image_decoding import compressed_to_ids, compressed_to_rgb
from mtv_world_ros.data.bag.image_orientation import (
    exif_orientation,
    stored_note,
    turned_upright,
    UPRIGHT,
)

RED, GREEN = (200, 10, 20), (30, 150, 40)
#: a row of a red and a green pixel in each encoding
ROWS = {
    'rgb8': [200, 10, 20, 30, 150, 40],
    'bgr8': [20, 10, 200, 40, 150, 30],
    'rgba8': [200, 10, 20, 255, 30, 150, 40, 0],
    'bgra8': [20, 10, 200, 255, 40, 150, 30, 0],
}


def raw_to_rgb(data, **fields):
    message = SimpleNamespace(**{'is_bigendian': 0, 'data': data, **fields})
    return image_decoding.raw_to_rgb(message)


@pytest.mark.parametrize('padding', [0, 1, 5])
@pytest.mark.parametrize('encoding', ROWS)
def test_every_encoding_becomes_rgb_whatever_the_padding(encoding, padding):
    row = ROWS[encoding] + [99] * padding
    data = np.array(row * 3, np.uint8)
    image = raw_to_rgb(data, encoding=encoding, height=3, width=2, step=len(row))
    assert image.shape == (3, 2, 3)
    assert image.tolist() == [[list(RED), list(GREEN)]] * 3


def test_grey_becomes_rgb():
    data = np.array([1, 2, 0, 3, 4, 0], np.uint8)
    image = raw_to_rgb(data, encoding='mono8', height=2, width=2, step=3)
    assert image.tolist() == [[[1, 1, 1], [2, 2, 2]], [[3, 3, 3], [4, 4, 4]]]


def picture() -> np.ndarray:
    """(24, 32, 3) RGB with a colour in each quarter; edges are where sampling blurs."""
    rgb = np.zeros((24, 32, 3), np.uint8)
    rgb[:12, :16], rgb[:12, 16:] = RED, GREEN
    rgb[12:, :16], rgb[12:, 16:] = (20, 40, 210), (180, 170, 30)
    return rgb


INSIDE = np.s_[3:9, 4:12], np.s_[3:9, 20:28], np.s_[15:21, 4:12], np.s_[15:21, 20:28]


def agrees(image: np.ndarray, tolerance: int) -> bool:
    """Whether colours agree inside the quarters."""
    apart = np.abs(image.astype(int) - picture())
    return all(apart[part].max() <= tolerance for part in INSIDE)


@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_patterns_become_rgb(pattern):
    rgb = picture()
    mosaic = np.zeros(rgb.shape[:2], np.uint8)
    for place, letter in enumerate(pattern):
        rows, columns = np.s_[place // 2 :: 2], np.s_[place % 2 :: 2]
        mosaic[rows, columns] = rgb[rows, columns, 'rgb'.index(letter)]
    data = np.pad(mosaic, ((0, 0), (0, 5))).ravel()
    image = raw_to_rgb(data, encoding=f'bayer_{pattern}8', height=24, width=32, step=37)
    assert agrees(image, 0)


@pytest.mark.parametrize(
    ('encoding', 'order'), [('uyvy', 'uyvy'), ('yuv422', 'uyvy'), ('yuyv', 'yuyv'),
                            ('yuv422_yuy2', 'yuyv')]
)  # fmt: skip
def test_packed_yuv_becomes_rgb(encoding, order):
    y, u, v = luma_and_colours()
    packed = np.zeros((24, 16, 4), np.uint8)
    lumas = iter((y[:, ::2], y[:, 1::2]))
    for place, letter in enumerate(order):
        packed[..., place] = next(lumas) if letter == 'y' else {'u': u, 'v': v}[letter][:, ::2]
    data = np.pad(packed.reshape(24, 64), ((0, 0), (0, 3))).ravel()
    assert agrees(raw_to_rgb(data, encoding=encoding, height=24, width=32, step=67), 3)


@pytest.mark.parametrize(('encoding', 'order'), [('nv12', 'uv'), ('nv21', 'vu')])
def test_planar_yuv_becomes_rgb(encoding, order):
    y, u, v = luma_and_colours()
    colours = [{'u': u, 'v': v}[letter][::2, ::2] for letter in order]
    data = np.concatenate([y, np.stack(colours, -1).reshape(12, 32)])
    padded = np.pad(data, ((0, 0), (0, 8))).ravel()
    assert agrees(raw_to_rgb(padded, encoding=encoding, height=24, width=32, step=40), 3)


def luma_and_colours() -> list[np.ndarray]:
    """Y, U, V (24, 32) of the picture by the formula of BT.601, limited range."""
    r, g, b = np.moveaxis(picture().astype(float), -1, 0)
    y = 16 + (65.481 * r + 128.553 * g + 24.966 * b) / 255
    u = 128 + (-37.797 * r - 74.203 * g + 112.0 * b) / 255
    v = 128 + (112.0 * r - 93.786 * g - 18.214 * b) / 255
    return [plane.round().astype(np.uint8) for plane in (y, u, v)]


def test_the_last_row_needs_no_padding():
    data = np.array([1, 2, 0, 3, 4], np.uint8)
    image = raw_to_rgb(data, encoding='mono8', height=2, width=2, step=3)
    assert image[1, 1, 0] == 4


def test_the_image_does_not_hang_on_the_message():
    data = np.array(ROWS['rgb8'], np.uint8)
    image = raw_to_rgb(data, encoding='rgb8', height=1, width=2, step=6)
    data[:] = 0
    assert image[0, 0].tolist() == list(RED)


@pytest.mark.parametrize(
    ('fields', 'reason'),
    [
        ({'encoding': '32FC1'}, "'32FC1' is not supported; supported are rgb8, bgr8"),
        ({'encoding': 'nv12', 'width': 3}, 'needs an even width'),
        ({'encoding': 'nv12', 'step': 6}, 'has 18 bytes, expected 26'),
        ({'encoding': ''}, "encoding '' is not supported"),
        ({'step': 5}, 'step of 5 bytes, expected at least 6'),
        ({'height': 4}, 'has 18 bytes, expected 24'),
        ({'height': 0}, '2x0'),
        ({'width': 0}, '0x3'),
    ],
)
def test_what_cannot_be_an_image_is_refused_with_numbers(fields, reason):
    layout = {'encoding': 'rgb8', 'height': 3, 'width': 2, 'step': 6, **fields}
    with pytest.raises(ObservationError, match=reason):
        raw_to_rgb(np.zeros(18, np.uint8), **layout)


def test_png_is_exact_and_jpeg_has_its_colours_in_order():
    rgb = np.zeros((16, 16, 3), np.uint8)
    rgb[:] = RED
    png = cv2.imencode('.png', rgb[..., ::-1])[1].ravel()
    np.testing.assert_array_equal(compressed_to_rgb('png', png), rgb)
    jpeg = cv2.imencode('.jpg', rgb[..., ::-1])[1].ravel()
    assert abs(compressed_to_rgb('bgr8; jpeg compressed bgr8', jpeg) - rgb.astype(int)).max() < 6


def test_a_padded_jpeg_is_read():
    jpeg = cv2.imencode('.jpg', np.zeros((16, 16, 3), np.uint8))[1].tobytes() + bytes(1000)
    assert compressed_to_rgb('jpeg', np.frombuffer(jpeg, np.uint8)).shape == (16, 16, 3)


@pytest.mark.parametrize('extension', ['.jpg', '.png'])
def test_a_cut_file_is_refused_rather_than_filled_with_grey(extension):
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    data = cv2.imencode(extension, noise)[1].ravel()
    for length in (5, 100, len(data) // 2, len(data) - 30):
        with pytest.raises(ObservationError, match='is cut off'):
            compressed_to_rgb('x', data[:length])


@pytest.mark.parametrize(
    ('layout', 'data', 'reason'),
    [
        ('h264', b'\0\0\0\1\x67', "'h264' is not supported .starts with 00000001.|'h264'"),
        ('16UC1; compressedDepth png', b'\0\0\0\0\x89PNG', 'compressedDepth'),
        ('jpeg', b'', 'no data'),
        ('jpeg', b'\xff\xd8\xff\xe0' + b'x' * 50 + b'\xff\xd9', 'is damaged'),
        ('16UC1; png compressed 16UC1', b'\x89PNG....IEND', 'holds depth'),
    ],
)
def test_other_formats_are_refused_by_name(layout, data, reason):
    with pytest.raises(ObservationError, match=reason):
        compressed_to_rgb(layout, np.frombuffer(data, np.uint8))


def test_masks_have_one_channel():
    ids = np.arange(64, dtype=np.uint8).reshape(8, 8)
    png = cv2.imencode('.png', ids)[1].ravel()
    np.testing.assert_array_equal(compressed_to_ids('mono8; png compressed mono8', png), ids)
    colours = cv2.imencode('.png', np.zeros((8, 8, 3), np.uint8))[1].ravel()
    with pytest.raises(ObservationError, match=r'\(8, 8, 3\) uint8, expected \(H, W\)'):
        compressed_to_ids('rgb8; png compressed bgr8', colours)


@pytest.mark.parametrize('is_bigendian', [0, 1])
@pytest.mark.parametrize('encoding', ['rgb16', 'bgr16', 'mono16', 'bayer_rggb16'])
def test_sixteen_bits_become_eight(encoding, is_bigendian):
    eight = {'rgb16': 'rgb8', 'bgr16': 'bgr8', 'mono16': 'mono8', 'bayer_rggb16': 'bayer_rggb8'}
    channels = 3 if 'b16' in encoding[1:5] or encoding == 'bgr16' else 1
    values = np.random.default_rng(0).integers(0, 2**16, (4, 6 * channels), np.uint16)
    data = values.astype('>u2' if is_bigendian else '<u2').view(np.uint8)
    size = {'height': 4, 'width': 6}
    wanted = raw_to_rgb(
        (values >> 8).astype(np.uint8).ravel(),
        encoding=eight[encoding], step=6 * channels, **size,
    )  # fmt: skip
    step = 12 * channels
    found = raw_to_rgb(
        data.ravel(), encoding=encoding, step=step, is_bigendian=is_bigendian, **size
    )
    assert np.array_equal(found, wanted)


def jpeg(image, orientation=None):
    """A JPEG file by Pillow, with the EXIF orientation."""
    exif, file = Image.Exif(), io.BytesIO()
    if orientation is not None:
        exif[0x0112] = orientation
    Image.fromarray(image).save(file, 'jpeg', quality=95, exif=exif)
    return file.getvalue()


def corners():
    """An image whose four corners differ."""
    image = np.full((16, 24, 3), 120, np.uint8)
    image[:8, :8], image[:8, -8:], image[-8:, :8] = (220, 20, 20), (20, 220, 20), (20, 20, 220)
    return image


@pytest.mark.parametrize('orientation', range(1, 9))
def test_exif_orientation_is_read_and_applied_as_pillow_does(orientation):
    content = jpeg(corners(), orientation)
    assert exif_orientation(content) == orientation
    stored = compressed_to_rgb('jpeg', np.frombuffer(content, np.uint8))
    expected = np.asarray(ImageOps.exif_transpose(Image.open(io.BytesIO(content))).convert('RGB'))
    turned = turned_upright(stored, orientation)
    assert turned.shape == expected.shape
    assert np.abs(turned.astype(int) - expected).mean() < 3


@pytest.mark.parametrize(
    'content',
    [
        jpeg(corners()),
        jpeg(corners(), 77),
        b'\xff\xd8\xff\xe1\x00\x10Exif\x00\x00II*\x00\xff\xff\xff\xff' + b'\xff\xd9',
        b'',
    ],
    ids=['none', 'unknown', 'damaged', 'empty'],
)
def test_without_a_usable_orientation_pixels_are_as_stored(content):
    assert exif_orientation(content) == UPRIGHT and stored_note(content) == ''


def test_images_of_topics_are_shown_as_stored_and_it_is_said():
    """As ROS' decoder does: CameraInfo is of the stored pixels."""
    content = jpeg(corners(), 6)
    assert compressed_to_rgb('jpeg', np.frombuffer(content, np.uint8)).shape == (16, 24, 3)
    assert 'EXIF orientation 6' in stored_note(content)
