"""Solids that look like objects: boxes and upright cylinders, from masks in calibrated views.

V views, H W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import re

import cv2
import numpy as np
from scipy.optimize import least_squares

from mtv_world_ros.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.geometry.camera import project

#: directions in the image along which outlines are compared
_ANGLES = np.linspace(0, 2 * np.pi, 48, endpoint=False)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
#: a pixel reaches this far beyond its centre, along each of them [px]
_PIXEL = np.abs(_DIRECTIONS).sum(1) / 2
#: corners of outlines, for a size of 1
_ROUND, _SQUARE = _DIRECTIONS / 2, np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
#: turns to begin with [rad]; least size [m]; how well it is known that things stand [m]
_TURNS, _LEAST_M, _STANDS_M = (0.0, 0.4, 0.8, 1.2), 0.008, 0.002
#: a box must fit by so much better than a cylinder, which has two numbers less
_BETTER = 0.9
_MAX_EVALUATIONS = 60
#: relative step of finite differences
_DIFFERENCE = float(np.sqrt(np.finfo(float).eps))
#: words for what is hollow and open at the top
_VESSEL = re.compile(r'\b(basket|bin|bowl|bucket|cup|dish|glass|jar|mug|plate|pot|tray|vase)s?\b')


@dataclass(frozen=True, slots=True, kw_only=True)
class Solid:
    """A box or an upright cylinder.

    Attributes:
        centre: (3,) of its bounding box [m].
        size: (3,) along its own x, y and z [m].
        yaw: about z [rad].
        is_round: a cylinder.
        is_open: at the top, and hollow.
        error_px: by how much its outline misses those of the masks, root mean square.
    """

    centre: FloatArray
    size: FloatArray
    yaw: float = 0.0
    is_round: bool = False
    is_open: bool = False
    error_px: float = 0.0


def is_vessel(name: str) -> bool:
    """Tells whether what is called so is hollow and open at the top, which no mask shows."""
    return _VESSEL.search(name.lower()) is not None


def fit_solid(
    masks: BoolArray,
    point: FloatArray,
    cameras: Sequence[CameraModel],
    poses: Sequence[FloatArray],
    floor: float = 0.0,
    *,
    is_open: bool = False,
) -> Solid | None:
    """Returns the solid whose outlines are nearest to those of an object.

    Of a block whose masks are whole at 384 x 288, place and size are found to half a millimetre.
    What a mask does not show (hidden parts, hollows) the solid does not have, but `is_open`.

    Args:
        masks: (V, H, W) of one frame.
        point: (3,) where it is, roughly [m].
        cameras: V cameras at the masks' size.
        poses: V of T_base_camera (4, 4).
        floor: height on which things stand, most of them [m].
        is_open: see `Solid`.

    Returns:
        None where no two views see it.
    """
    seen = [view for view in range(len(masks)) if masks[view].any()]
    if len(seen) < 2 or not np.isfinite(point).all():
        return None
    wanted = [_reach(_corners(masks[view])) + _PIXEL for view in seen]

    def misses(numbers: FloatArray, outline: FloatArray) -> FloatArray:
        corners = _in_space(numbers, outline)
        found = [_reach(project(cameras[view], poses[view], corners)[0]) for view in seen]
        stands = (numbers[..., -1:] - floor) / _STANDS_M
        away = np.nan_to_num(np.concatenate(found, -1) - np.concatenate(wanted), nan=1e3)
        return np.concatenate([away, stands], -1)

    def slopes(numbers: FloatArray, outline: FloatArray) -> FloatArray:
        steps = _DIFFERENCE * np.maximum(1.0, np.abs(numbers))
        rows = misses(np.concatenate([numbers[None], numbers + np.diag(steps)]), outline)
        return ((rows[1:] - rows[0]) / steps[:, None]).T

    height = max(2 * (float(point[2]) - floor), 2 * _LEAST_M)
    best = None
    for outline, turns in ((_ROUND, (None,)), (_SQUARE, _TURNS)):
        for turn in turns:
            first = [0.05, height, floor] if turn is None else [turn, 0.05, 0.04, height, floor]
            given = np.array([point[0], point[1], *first])
            sizes = slice(2 if turn is None else 3, -1)
            least = np.full(len(given), -np.inf)
            least[sizes] = _LEAST_M
            found = least_squares(
                misses,
                given,
                # all differences at once: a fit takes half of the time
                jac=slopes,  # type: ignore[arg-type]
                bounds=(least, np.inf),
                x_scale=np.where(np.isfinite(least), 0.01, 0.1),
                loss='soft_l1',
                max_nfev=_MAX_EVALUATIONS,
                args=(outline,),
            )
            is_round = best is not None and best[1].is_round
            if best is None or found.cost < best[0] * (_BETTER if is_round else 1.0):
                error = float(np.sqrt(np.mean(found.fun[:-1] ** 2)))
                best = found.cost, _solid(found.x, turn is None, error)
    assert best is not None
    return replace(best[1], is_open=is_open)


def _solid(numbers: FloatArray, is_round: bool, error_px: float) -> Solid:
    x, y, *turn, height, bottom = numbers
    yaw, wide, long = (0.0, turn[0], turn[0]) if is_round else turn
    return Solid(
        centre=np.array([x, y, bottom + height / 2]),
        size=np.array([wide, long, height]),
        yaw=float(yaw),
        is_round=is_round,
        error_px=error_px,
    )


def _in_space(numbers: FloatArray, outline: FloatArray) -> FloatArray:
    """(..., 2 N, 3) the outline (N, 2) at the bottom and the top, of numbers (..., 5 or 7)."""
    x, y, *turn, height, bottom = np.moveaxis(numbers, -1, 0)[..., None]
    yaw, wide, long = (np.zeros_like(x), *turn * 2) if len(turn) == 1 else turn
    along, across = wide * outline[:, 0], long * outline[:, 1]
    cos, sin = np.cos(yaw), np.sin(yaw)
    flat = (x + cos * along - sin * across, y + sin * along + cos * across)
    ends = [(*flat, np.broadcast_to(z, flat[0].shape)) for z in (bottom, bottom + height)]
    return np.concatenate([np.stack(end, -1) for end in ends], -2)


def _corners(mask: BoolArray) -> FloatArray:
    rows, columns = np.nonzero(mask)
    return cv2.convexHull(np.stack([columns, rows], 1).astype(np.int32))[:, 0].astype(float)


def _reach(points: FloatArray) -> FloatArray:
    """How far points (..., N, 2) reach along each direction [px]."""
    return (points @ _DIRECTIONS.T).max(-2)
