"""Masks of squares, for scores that are known by arithmetic."""

import numpy as np

from mtv_world_ros.core.data_types import ObjectMasks


def square(x, y, size=27, shape=(60, 90)):
    mask = np.zeros(shape, bool)
    mask[y : y + size, x : x + size] = True
    return mask


def objects(masks, status=None, names=('red block', 'blue block')):
    masks = np.asarray(masks, bool)
    status = status or (('ok',) * masks.shape[1],) * masks.shape[0]
    return ObjectMasks(names=names[: masks.shape[1]], masks=masks, status=status)
