"""Image messages to and from arrays; every image is (H, W, 3) uint8 RGB inside the package."""

from __future__ import annotations

from array import array
from dataclasses import replace

import cv2
import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from mtv_world_ros.cameras.image_window import WHOLE, window_of, windowed_pixels
from mtv_world_ros.core.data_types import ByteArray, CameraModel
from mtv_world_ros.data.bag import image_decoding
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as

#: words in the `format` of compressed images that can be read
_FORMATS = ('jpeg', 'jpg', 'png')


def check(message: Image | CompressedImage) -> None:
    """Refuse an image that cannot be read by its fields and first bytes, without decoding it.

    Raises:
        Rejection: unsupported encoding or format, wrong `step`, short data.
    """
    if isinstance(message, CompressedImage):
        known = any(word in message.format.lower() for word in _FORMATS)
    else:
        known = message.encoding in image_decoding.ENCODINGS
    with rejected_as(Reason.IMAGE_DATA if known else Reason.IMAGE_ENCODING):
        image_decoding.check_image(message)


def to_rgb(message: Image | CompressedImage) -> ByteArray:
    """Return (H, W, 3) uint8 RGB; padding at the rows' ends is dropped.

    Raises:
        Rejection: see `check`; or a compressed image is damaged.
    """
    check(message)
    with rejected_as(Reason.IMAGE_DATA):
        return image_decoding.to_rgb(message)


def _bytes(pixels: ByteArray) -> array[int]:
    """Return fastest type for `data` in rclpy: assigning an ndarray is a thousand times slower."""
    data = array('B')
    data.frombytes(np.ascontiguousarray(pixels).data)
    return data


def to_image(pixels: ByteArray, header: Header) -> Image:
    """Return the image of (H, W, 3) uint8 RGB as rgb8, or of (H, W) uint8 as mono8."""
    channels = 3 if pixels.ndim == 3 else 1
    return Image(
        header=header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding='rgb8' if channels == 3 else 'mono8',
        is_bigendian=0,
        step=pixels.shape[1] * channels,
        data=_bytes(pixels),
    )


def to_compressed(rgb: ByteArray, header: Header, quality: int) -> CompressedImage:
    """Return the JPEG of (H, W, 3) uint8 RGB, with the `format` that image_transport writes."""
    bgr = np.ascontiguousarray(rgb[..., ::-1])
    _, data = cv2.imencode('.jpg', bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return CompressedImage(
        header=header, format='rgb8; jpeg compressed bgr8', data=_bytes(np.asarray(data).ravel())
    )


def info_of_camera(camera: CameraModel, header: Header) -> CameraInfo:
    """Return the CameraInfo of a calibrated camera; P = [K 0]."""
    return CameraInfo(
        header=header,
        width=camera.width,
        height=camera.height,
        distortion_model='plumb_bob'
        if camera.distortion_model == 'none'
        else (camera.distortion_model),
        d=camera.distortion.tolist() or [0.0] * 5,
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([camera.K, np.zeros(3)]).ravel(),
    )


def windowed_camera_info(info: CameraInfo, camera: CameraModel) -> CameraInfo:
    """Return `info` with K and P for the images that were received, without ROI and binning.

    Args:
        info: the received CameraInfo.
        camera: the camera at the images' size.
    """
    window = window_of(info)
    if window == WHOLE and (camera.width, camera.height) == (info.width, info.height):
        return info
    K = np.reshape(info.k, (3, 3))
    full = replace(camera, width=info.width, height=info.height, K=K)
    to_image, _ = windowed_pixels(full, camera.width, camera.height, window)
    return CameraInfo(
        header=info.header,
        width=camera.width,
        height=camera.height,
        distortion_model=info.distortion_model,
        d=info.d,
        k=(to_image @ K).ravel(),
        r=info.r,
        p=(to_image @ np.reshape(info.p, (3, 4))).ravel(),
    )


def scale_camera_info(info: CameraInfo, width: int, height: int, header: Header) -> CameraInfo:
    """Return `info` for the image resized to width x height: K, P and ROI rescaled, D and R kept.

    As image_proc's resize node does, with the half pixel of `geometry.camera.scaled`.
    """
    sx, sy = width / info.width, height / info.height
    resize = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1.0]])
    scaled = CameraInfo(
        header=header,
        width=width,
        height=height,
        distortion_model=info.distortion_model,
        d=info.d,
        k=(resize @ np.reshape(info.k, (3, 3))).ravel(),
        r=info.r,
        p=(resize @ np.reshape(info.p, (3, 4))).ravel(),
    )
    scaled.roi.x_offset = round(info.roi.x_offset * sx)
    scaled.roi.y_offset = round(info.roi.y_offset * sy)
    scaled.roi.width = round(info.roi.width * sx)
    scaled.roi.height = round(info.roi.height * sy)
    scaled.roi.do_rectify = info.roi.do_rectify
    return scaled
