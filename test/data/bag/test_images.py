from __future__ import annotations

import cv2
import numpy as np
import pytest

from mtv_world_ros.data.bag.images import compressed_to_ids, compressed_to_rgb, raw_to_rgb
from mtv_world_ros.errors import ObservationError

RED, GREEN = (200, 10, 20), (30, 150, 40)
#: a row of a red and a green pixel in each encoding
ROWS = {
    'rgb8': [200, 10, 20, 30, 150, 40],
    'bgr8': [20, 10, 200, 40, 150, 30],
    'rgba8': [200, 10, 20, 255, 30, 150, 40, 0],
    'bgra8': [20, 10, 200, 255, 40, 150, 30, 0],
}


@pytest.mark.parametrize('padding', [0, 1, 5])
@pytest.mark.parametrize('encoding', ROWS)
def test_every_encoding_becomes_rgb_whatever_the_padding(encoding, padding) -> None:
    row = ROWS[encoding] + [99] * padding
    data = np.array(row * 3, np.uint8)
    image = raw_to_rgb(data, encoding=encoding, height=3, width=2, step=len(row))
    assert image.shape == (3, 2, 3)
    assert image.tolist() == [[list(RED), list(GREEN)]] * 3


def test_grey_becomes_rgb() -> None:
    data = np.array([1, 2, 0, 3, 4, 0], np.uint8)
    image = raw_to_rgb(data, encoding='mono8', height=2, width=2, step=3)
    assert image.tolist() == [[[1, 1, 1], [2, 2, 2]], [[3, 3, 3], [4, 4, 4]]]


def test_the_last_row_needs_no_padding() -> None:
    data = np.array([1, 2, 0, 3, 4], np.uint8)
    image = raw_to_rgb(data, encoding='mono8', height=2, width=2, step=3)
    assert image[1, 1, 0] == 4


def test_the_image_does_not_hang_on_the_message() -> None:
    data = np.array(ROWS['rgb8'], np.uint8)
    image = raw_to_rgb(data, encoding='rgb8', height=1, width=2, step=6)
    data[:] = 0
    assert image[0, 0].tolist() == list(RED)


@pytest.mark.parametrize(
    ('fields', 'reason'),
    [
        ({'encoding': 'yuv422_yuy2'}, "'yuv422_yuy2' is not supported; supported are rgb8, bgr8"),
        ({'encoding': ''}, "encoding '' is not supported"),
        ({'step': 5}, 'step of 5 bytes, expected at least 6'),
        ({'height': 4}, 'has 18 bytes, expected 24'),
        ({'height': 0}, '2x0'),
        ({'width': 0}, '0x3'),
    ],
)
def test_what_cannot_be_an_image_is_refused_with_numbers(fields, reason) -> None:
    layout = {'encoding': 'rgb8', 'height': 3, 'width': 2, 'step': 6, **fields}
    with pytest.raises(ObservationError, match=reason):
        raw_to_rgb(np.zeros(18, np.uint8), **layout)


def test_png_is_exact_and_jpeg_has_its_colours_in_order() -> None:
    rgb = np.zeros((16, 16, 3), np.uint8)
    rgb[:] = RED
    png = cv2.imencode('.png', rgb[..., ::-1])[1].ravel()
    np.testing.assert_array_equal(compressed_to_rgb('png', png), rgb)
    jpeg = cv2.imencode('.jpg', rgb[..., ::-1])[1].ravel()
    assert abs(compressed_to_rgb('bgr8; jpeg compressed bgr8', jpeg) - rgb.astype(int)).max() < 6


def test_a_padded_jpeg_is_read() -> None:
    jpeg = cv2.imencode('.jpg', np.zeros((16, 16, 3), np.uint8))[1].tobytes() + bytes(1000)
    assert compressed_to_rgb('jpeg', np.frombuffer(jpeg, np.uint8)).shape == (16, 16, 3)


@pytest.mark.parametrize('extension', ['.jpg', '.png'])
def test_a_cut_file_is_refused_rather_than_filled_with_grey(extension) -> None:
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
def test_other_formats_are_refused_by_name(layout, data, reason) -> None:
    with pytest.raises(ObservationError, match=reason):
        compressed_to_rgb(layout, np.frombuffer(data, np.uint8))


def test_masks_have_one_channel() -> None:
    ids = np.arange(64, dtype=np.uint8).reshape(8, 8)
    png = cv2.imencode('.png', ids)[1].ravel()
    np.testing.assert_array_equal(compressed_to_ids('mono8; png compressed mono8', png), ids)
    colours = cv2.imencode('.png', np.zeros((8, 8, 3), np.uint8))[1].ravel()
    with pytest.raises(ObservationError, match=r'\(8, 8, 3\) uint8, expected \(H, W\)'):
        compressed_to_ids('rgb8; png compressed bgr8', colours)
