"""Boxes and upright cylinders fitted to objects' masks in calibrated views.

V views, H W pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
import re
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from mtv_world_ros.cameras.camera import project, project_from, unproject
from mtv_world_ros.cameras.mask_geometry import centroids
from mtv_world_ros.core.data_types import BoolArray, CameraModel, FloatArray
from mtv_world_ros.core.transforms import about_z, inverse

#: directions in the image along which outlines are compared
_ANGLES = np.linspace(0, 2 * np.pi, 48, endpoint=False)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
#: half extent of a pixel along each direction [px]
_PIXEL = np.abs(_DIRECTIONS).sum(1) / 2
#: corners of the outline of a cylinder of size 1
_ROUND = _DIRECTIONS / 2
#: corners of the outline of a box of size 1
_SQUARE = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
#: initial yaw angles of a fit [rad]
YAW_GUESSES_RAD = (0.0, 0.4, 0.8, 1.2)
#: smallest extent of a solid [m]
MIN_SIZE_M = 0.008
#: prior standard deviation of the height of a standing solid [m]
STANDING_HEIGHT_STD_M = 0.002
#: largest ratio of the cost of a box to that of a cylinder (two parameters fewer) at which the box
#: is chosen, and of the cost of a larger turn to that of a smaller one
MAX_COST_RATIO = 0.9
#: further initial yaw angles of a solid that was moved [rad]
MOVED_YAW_GUESSES_RAD = (0.5, -0.5, 1.0, -1.0)
#: largest overhang of masks beyond the outline of a solid that is found again [px]
MAX_OVERHANG_PX = 1.0
#: the same limit as a multiple of the overhang when the solid was whole
MAX_OVERHANG_RATIO = 1.5
#: smallest fraction of the outline within that distance of the masks
MIN_VISIBLE_FRACTION = 0.4
#: fill of the outline, relative to the fill before, below which a mask is partly hidden
MIN_FILL_RATIO = 0.9
#: largest residual of a solid that has not moved [px]
_STAYED_PX = 1.0
_MAX_EVALUATIONS = 60
#: outlines that are fitted: a cylinder, and boxes of several turns
_OUTLINES = ((_ROUND, (None,)), (_SQUARE, YAW_GUESSES_RAD))
#: residual below which no other initial turn is tried [px]
_EXACT_PX = 0.35
#: smallest area of a part of a mask, as a fraction of its largest part
MIN_PART_FRACTION = 0.2
#: relative step of finite differences
_DIFFERENCE = float(np.sqrt(np.finfo(float).eps))
#: names of boxes, and of vessels: hollow and open at the top
_BOX = re.compile(r'\b(block|book|box|brick|cube|laptop)\b')
_VESSEL = re.compile(r'\b(basket|bin|bowl|bucket|cup|dish|glass|jar|mug|plate|pot|tray|vase)s?\b')


@dataclass(frozen=True, slots=True, kw_only=True)
class Solid:
    """A box or an upright cylinder.

    Attributes:
        centre: (3,) centre of its bounding box [m].
        size: (3,) extents along its own x, y and z [m].
        yaw: rotation about z [rad].
        is_round: whether the solid is a cylinder.
        is_open: whether the solid is hollow and open at the top.
        is_hidden: whether something hid a part of it when it was found again.
        fills: (V,) fraction of the outline that the mask fills in each view; 0 = not seen.
        error_px: root mean square distance of its outline from those of the masks.
        error_m: standard deviation of where it is, beyond that of the fit: what was seen of it
            last is old [m].
        is_held: whether fingers hold it.
    """

    centre: FloatArray
    size: FloatArray
    yaw: float = 0.0
    is_round: bool = False
    is_open: bool = False
    is_hidden: bool = False
    fills: FloatArray = field(default_factory=lambda: np.zeros(0))
    error_px: float = 0.0
    error_m: float = 0.0
    is_held: bool = False

    @property
    def bottom(self) -> float:
        """Height of its lower face [m]."""
        return float(self.centre[2] - self.size[2] / 2)

    def moved_by(self, T: FloatArray) -> Solid:
        """Return the solid after a rigid motion (4, 4) in the base frame; it stays upright."""
        yaw = self.yaw + float(np.arctan2(T[1, 0], T[0, 0]))
        return replace(self, centre=T[:3, :3] @ self.centre + T[:3, 3], yaw=yaw)

    def turn_to(self, now: Solid) -> FloatArray:
        """Return its rotation matrix (3, 3)."""
        return about_z(now.yaw - self.yaw)


def is_vessel(name: str) -> bool:
    """Return whether a name is that of a vessel: hollow and open at the top."""
    return _VESSEL.search(name.lower()) is not None


def is_box(name: str) -> bool:
    """Return whether an object of this name has edges, which small masks hardly show."""
    return _BOX.search(name.lower()) is not None


def bottom_of(
    masks: BoolArray,
    point: FloatArray,
    cameras: Sequence[CameraModel],
    poses: Sequence[FloatArray],
    name: str,
    floor: float = 0.0,
    fits: int = 2,
) -> float:
    """Return the height of an object's lowest point [m]; NaN = not seen by two views.

    Args:
        masks: see `fit_solid`; so are the others.
        point: (3,) approximate position of the solid [m].
        cameras: the V cameras at the masks' size.
        poses: T_base_camera (4, 4) of each view.
        name: name of the object.
        floor: height of a surface below it [m]; the fit is drawn to it.
        fits: each is drawn to where the one before ended.
    """
    for _ in range(fits):
        solid = fit_solid(masks, point, cameras, poses, floor, is_vessel(name), is_box(name))
        if solid is None:
            return float('nan')
        floor = solid.bottom
    return floor


def fit_solid(
    masks: BoolArray,
    point: FloatArray,
    cameras: Sequence[CameraModel],
    poses: Sequence[FloatArray],
    floor: float = 0.0,
    is_open: bool = False,
    is_box: bool = False,
) -> Solid | None:
    """Fit a box or cylinder to the outlines of an object.

    The place and size of a block with whole masks at 384 x 288 are found to half a millimetre.
    The solid lacks what no mask shows (hidden parts, hollows), apart from `is_open`.

    Args:
        masks: (V, H, W) masks of the object in one frame.
        point: (3,) approximate position of the object [m].
        cameras: V cameras at the masks' size.
        poses: T_base_camera (4, 4) of each view.
        floor: height of the surface on which most objects stand [m].
        is_open: see `Solid`.
        is_box: whether the object is known to be no cylinder.

    Returns:
        None where no two views see it.
    """
    seen = [view for view in range(len(masks)) if masks[view].any()]
    if len(seen) < 2 or not np.isfinite(point).all():
        return None
    outlines = _Outlines.of(masks, cameras, poses)

    def residuals(numbers: FloatArray, outline: FloatArray) -> FloatArray:
        stands = (numbers[..., -1:] - floor) / STANDING_HEIGHT_STD_M
        return np.concatenate([outlines.residuals(_in_space(numbers, outline)), stands], -1)

    height = max(2 * (float(point[2]) - floor), 2 * MIN_SIZE_M)
    best = None
    for outline, turns in _OUTLINES[is_box:]:
        for turn in turns:
            first = [0.05, height, floor] if turn is None else [turn, 0.05, 0.04, height, floor]
            given = np.array([point[0], point[1], *first])
            sizes = slice(2 if turn is None else 3, -1)
            least = np.full(len(given), -np.inf)
            least[sizes] = MIN_SIZE_M
            found = _least_squares(
                partial(residuals, outline=outline),
                given,
                bounds=(least, np.inf),
                x_scale=np.where(np.isfinite(least), 0.01, 0.1),
                loss='soft_l1',
            )
            is_round = best is not None and best[1].is_round
            if best is None or found.cost < best[0] * (MAX_COST_RATIO if is_round else 1.0):
                error = float(np.sqrt(np.mean(found.fun[:-1] ** 2)))
                best = found.cost, _solid(found.x, turn is None, error)
            if turn is not None and best[1].error_px < _EXACT_PX:
                break  # good enough
    assert best is not None
    solid = replace(best[1], is_open=is_open)
    return replace(solid, fills=_fills(solid, masks, cameras, poses))


def find_solid(
    solid: Solid,
    masks: BoolArray,
    point: FloatArray,
    cameras: Sequence[CameraModel],
    poses: Sequence[FloatArray],
    floor: float = 0.0,
) -> Solid | None:
    """Return the pose of a solid of known size that may be partly hidden.

    Most of its outline is that of the masks; a robust loss leaves the hidden part out.

    Args:
        solid: the object's solid from a frame in which nothing hid it.
        masks: (V, H, W) masks of what is seen of it now.
        point: (3,) the middle of that; NaN = not known, as of one view: then where it would look
            as large as it does there [m].
        cameras: V cameras at the masks' size.
        poses: T_base_camera (4, 4) of each view.
        floor: height under which nothing is [m].

    Returns:
        None where no view sees it, or where it does not look as it did: it lies on its side.
    """
    if not masks.any():
        return None
    outlines, outline = _Outlines.of(masks, cameras, poses), _SQUARE
    wide, long, height = size = solid.size
    if solid.is_round:
        outline, size = _ROUND, np.array([wide, height])

    def residuals(places: FloatArray) -> FloatArray:
        sizes = np.broadcast_to(size, (*places.shape[:-1], len(size)))
        numbers = np.concatenate([places[..., :-1], sizes, places[..., -1:]], -1)
        return outlines.residuals(_in_space(numbers, outline))

    is_known = bool(np.isfinite(point).all())
    likely = point if is_known else _at_size(solid, masks, cameras, poses)
    best = None
    for centre, turn in _starts(solid, likely):
        given = [] if solid.is_round else [solid.yaw + turn]
        given = np.array([*centre[:2], *given, max(centre[2] - height / 2, floor)])
        least = [*[-np.inf] * (len(given) - 1), floor - STANDING_HEIGHT_STD_M]
        scale = [0.01, 0.01, *([] if solid.is_round else [0.1]), 0.01]
        found = _least_squares(
            residuals, given, bounds=(least, np.inf), x_scale=scale, loss='cauchy'
        )
        # a square looks the same after a quarter turn: the smallest turn is taken
        if best is None or found.cost < MAX_COST_RATIO * best.cost:
            best = found
        if np.abs(found.fun).max() < _STAYED_PX:
            break
    assert best is not None
    error = float(np.sqrt(np.mean(np.minimum(best.fun, 0.0) ** 2)))
    enough = max(MAX_OVERHANG_PX, MAX_OVERHANG_RATIO * solid.error_px)
    if error > enough or np.mean(np.abs(best.fun) < enough) < MIN_VISIBLE_FRACTION:
        return None
    now = _solid(np.concatenate([best.x[:-1], size, best.x[-1:]]), solid.is_round, error)
    now = replace(now, is_open=solid.is_open)
    fills = _fills(now, masks, cameras, poses)
    return replace(
        now, fills=solid.fills, is_hidden=bool((fills < MIN_FILL_RATIO * solid.fills).any())
    )


def _at_size(
    solid: Solid,
    masks: BoolArray,
    cameras: Sequence[CameraModel],
    poses: Sequence[FloatArray],
) -> FloatArray:
    """Return (3,) where a solid looks as large as the largest mask.

    NaN = it was not seen there whole.
    """
    view = int(np.argmax(masks.sum((-2, -1))))
    camera, pose, mask = cameras[view], poses[view], masks[view]
    _, depth = project(camera, pose, solid.centre)
    fills = _fills(solid, mask[None], [camera], [pose])
    if not fills[0] or not solid.fills[view]:
        return np.full(3, np.nan)
    # nearer than the old place by this factor
    nearer = np.sqrt(fills[0] / solid.fills[view])
    ray = unproject(camera, centroids(mask)) @ pose[:3, :3].T
    return np.asarray(pose[:3, 3] + ray / (ray @ pose[:3, 2]) * float(depth) / nearer)


def _fills(
    solid: Solid,
    masks: BoolArray,
    cameras: Sequence[CameraModel],
    poses: Sequence[FloatArray],
) -> FloatArray:
    """Return (V,) share of a solid's outline that its masks (V, H, W) fill.

    0 = it is in no picture.
    """
    wide, long, height = solid.size
    sizes = [wide] if solid.is_round else [solid.yaw, wide, long]
    x, y, z = solid.centre
    numbers = np.array([x, y, *sizes, height, z - height / 2])
    corners = _in_space(numbers, _ROUND if solid.is_round else _SQUARE)
    fills = []
    for mask, camera, pose in zip(masks, cameras, poses, strict=True):
        pixels = project(camera, pose, corners)[0]
        known = np.isfinite(pixels).all()
        area = cv2.contourArea(cv2.convexHull(pixels.astype(np.float32))) if known else 0.0
        fills.append(mask.sum() / area if area > 0 else 0.0)
    return np.array(fills)


def _starts(solid: Solid, point: FloatArray) -> Iterator[tuple[FloatArray, float]]:
    """Yield the initial guesses: where it was, then where it is seen, with several yaw angles."""
    yield solid.centre, 0.0
    if np.isfinite(point).all():
        for turn in (0.0,) if solid.is_round else (0.0, *MOVED_YAW_GUESSES_RAD):
            yield point, turn


@dataclass(frozen=True, slots=True)
class _Outlines:
    """Return the masks of the views that see a part of the object.

    Attributes:
        views: camera and T_camera_base of each.
        reach: (N,) extent of the outlines along each direction in each view [px].
    """

    views: tuple[tuple[CameraModel, FloatArray], ...]
    reach: FloatArray

    @classmethod
    def of(
        cls, masks: BoolArray, cameras: Sequence[CameraModel], poses: Sequence[FloatArray]
    ) -> _Outlines:
        seen = [view for view, mask in enumerate(masks) if mask.any()]
        reach = np.concatenate([_reach(_corners(masks[view])) + _PIXEL for view in seen])
        return cls(tuple((cameras[view], inverse(poses[view])) for view in seen), reach)

    def residuals(self, corners: FloatArray) -> FloatArray:
        """Return (..., N) how far the outline of points (..., M, 3) reaches beyond them [px]."""
        found = [_reach(project_from(camera, pose, corners)[0]) for camera, pose in self.views]
        beyond = np.concatenate(found, -1) - self.reach
        return beyond if np.isfinite(beyond).all() else np.nan_to_num(beyond, nan=1e3)


def _least_squares(
    residuals: Callable[[FloatArray], FloatArray], given: FloatArray, **how: Any
) -> Any:
    """Return the least squares from initial parameters (N,); finite differences in one batch.

    Values and differences at one point are computed together: where a point is not taken,
    differences are computed in vain, which costs less than a second call where it is.
    """
    at, rows = np.full(len(given), np.nan), np.zeros((0, 0))

    def evaluate(numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the steps (N,) and the residuals (1 + N, M) at a point and beside it."""
        nonlocal at, rows
        steps = _DIFFERENCE * np.maximum(1.0, np.abs(numbers))
        if not np.array_equal(at, numbers):
            rows = residuals(np.concatenate([numbers[None], numbers + np.diag(steps)]))
            at = numbers.copy()
        return steps, rows

    def slopes(numbers: FloatArray) -> FloatArray:
        steps, found = evaluate(numbers)
        return ((found[1:] - found[0]) / steps[:, None]).T

    return least_squares(
        lambda numbers: evaluate(numbers)[1][0],
        given,
        jac=slopes,  # type: ignore[arg-type]
        max_nfev=_MAX_EVALUATIONS,
        **how,
    )


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
    count = len(outline)
    corners = np.empty((*numbers.shape[:-1], 2, count, 3))
    corners[..., 0] = (x + cos * along - sin * across)[..., None, :]
    corners[..., 1] = (y + sin * along + cos * across)[..., None, :]
    corners[..., 0, :, 2] = bottom
    corners[..., 1, :, 2] = bottom + height
    return corners.reshape(*numbers.shape[:-1], 2 * count, 3)


def _corners(mask: BoolArray) -> FloatArray:
    """Return (N, 2) of the hull of its parts but small ones, which belong to what looks alike."""
    _, parts, sizes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = sizes[1:, cv2.CC_STAT_AREA]
    rows, columns = np.nonzero(
        np.isin(parts, 1 + np.flatnonzero(areas >= MIN_PART_FRACTION * areas.max()))
    )
    return cv2.convexHull(np.stack([columns, rows], 1).astype(np.int32))[:, 0].astype(float)


def _reach(points: FloatArray) -> FloatArray:
    """Return the extent of points (..., N, 2) along each direction [px]."""
    return (points @ _DIRECTIONS.T).max(-2)
