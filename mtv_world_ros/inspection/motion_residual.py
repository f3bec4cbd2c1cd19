"""Calibration check without markers: offset between the projected robot and the moving pixels.

P pairs of frames, J joints, H W pixels of the shrunk images, R the search radius.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.cameras.camera import camera_poses
from mtv_world_ros.cameras.silhouettes import project_part
from mtv_world_ros.core.data_types import CameraModel, FloatArray
from mtv_world_ros.data.episode import Track
from mtv_world_ros.inspection.camera_pose import shrunk_camera
from mtv_world_ros.inspection.clocks import JointTrack
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import fill, LinkShape, moving_links

FloatImage = NDArray[np.float32]

#: minimum area of drawn motion in a pair of frames; smaller areas show no motion [px]
_LEAST_AREA_PX = 20
#: share of the drawn motion that must stay in the image under a shift
_LEAST_INSIDE = 0.5
#: share of the most motion seen over all shifts that counts at least, where less is seen
_LEAST_ENERGY = 0.25
#: width to which images are shrunk [px]
_WIDTH_PX = 384
#: width to which images are shrunk to search for delays and for changes of the camera [px]
_COARSE_WIDTH_PX = 192
#: time between the two frames of a pair [s]
_STEP_S = 0.5
#: search radius, as a share of the image width
REACH = 0.08
#: standard deviation that both motions are blurred by [px]
_BLUR_PX = 1.5
#: grey levels from which a pixel counts as moving, so that one that changes more counts no more
_SATURATION = 25.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualSearch:
    """Search space of the residual's measurement.

    Attributes:
        max_pairs: pairs of frames, spread over the recording.
        lags_s: delays of the images against the joint states, 0 among them [s].
        rolls_deg: turns of the camera about its axis.
        zooms: factors of the focal length.
    """

    max_pairs: int = 45
    lags_s: tuple[float, ...] = (-0.8, -0.4, -0.2, -0.1, 0.0, 0.1, 0.2, 0.4, 0.8)
    rolls_deg: tuple[float, ...] = (-30.0, -10.0, 10.0, 30.0)
    zooms: tuple[float, ...] = (0.75, 0.9, 1.1, 1.33)


WHOLE_SEARCH = ResidualSearch()


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionResidual:
    """Offset of the moving pixels from the projected robot.

    Attributes:
        shift_px: (x, y) shift from the drawn robot to the moving pixels, in pixels of the recorded
            images; NaN where it could not be measured.
        match: mean correlation of drawn and seen motion under that shift, -1 .. 1.
        match_here: correlation where the robot is drawn.
        contrast: z-score of the best shift among all shifts.
        lag_s: delay of the images against the joint states at which the motions fit best [s].
        lag_gain: improvement of the fit by that delay, as a fraction, in the half of the recording
            in which it is less; below zero where a half fits worse.
        best_change: change of the camera that fits best among those tried, and its match.
        num_pairs: pairs of frames in which the robot moves.
        links: links that move within the image, which are what was compared.
        reason: reason why it could not be measured; empty if it was.
    """

    shift_px: tuple[float, float] = (float('nan'), float('nan'))
    match: float = float('nan')
    match_here: float = float('nan')
    contrast: float = float('nan')
    lag_s: float = float('nan')
    lag_gain: float = 0.0
    best_change: tuple[str, float] = ('', float('nan'))
    num_pairs: int = 0
    links: frozenset[str] = frozenset()
    reason: str = ''


def measure_residual(
    track: Track,
    camera: CameraModel,
    robot: RobotModel,
    shapes: Sequence[LinkShape],
    joints: JointTrack,
    search: ResidualSearch = WHOLE_SEARCH,
) -> MotionResidual:
    """Compare the motion predicted from joint states and calibration with that in the images.

    For pairs of frames half a second apart, each link's silhouettes at both times are drawn; where
    they differ the image should have changed, unless the robot covers the place in both. The maps
    of all pairs are correlated with the images' differences over shifts, for each link on its
    own. All links have the same weight, so that a link whose drawn shape is wrong does not decide;
    a calibration error moves all links.

    Args:
        track: frames of a camera that stands still.
        camera: calibration of the camera at the size of the frames.
        robot: robot whose link poses are drawn.
        shapes: shapes of the links.
        joints: measured joint positions.
        search: limits of the search.
    """
    if camera.mount_link in moving_links(robot):
        return MotionResidual(
            reason=f"the camera moves with '{camera.mount_link}' (`mtv-world fit camera` "
            'estimates its pose: compare)'
        )
    pairs = _pairs(track.stamps_ns, joints, search.max_pairs)
    if len(pairs) == 0:
        return MotionResidual(
            reason=f'no two frames {_STEP_S:g} s apart with joint states and motion'
        )
    small, coarse = shrunk_camera(camera, _WIDTH_PX), shrunk_camera(camera, _COARSE_WIDTH_PX)
    some, changed = pairs[::3], _changes(coarse, search)
    seen = _seen_motion(track, some, coarse) if changed or len(search.lags_s) > 1 else []

    def match(drawn_by: CameraModel, lag_s: float = 0.0, part: slice = slice(None)) -> float:
        stamps_ns = track.stamps_ns[some[part]].ravel() - round(lag_s * 1e9)
        return _top(_surface(seen[part], joints.at(stamps_ns), drawn_by, robot, shapes)[0])

    positions = joints.at(track.stamps_ns[pairs].ravel())
    now, links = _surface(_seen_motion(track, pairs, small), positions, small, robot, shapes)
    if now is None:
        return MotionResidual(reason='no link moves within the image')
    shift = _peak(now) * camera.width / small.width
    spread = float(now.std())
    changes = {name: match(other) for name, other in changed.items()}
    gain = float(now.max()) - match(coarse) if changes else 0.0
    best = max(changes, key=changes.__getitem__, default='')
    lag_s, lag_gain = _delay(search.lags_s, match, len(some), coarse)
    return MotionResidual(
        shift_px=(float(shift[0]), float(shift[1])),
        match=float(now.max()),
        match_here=float(now[len(now) // 2, len(now) // 2]),
        contrast=float((now.max() - now.mean()) / spread) if spread > 0 else 0.0,
        lag_s=lag_s,
        lag_gain=lag_gain,
        best_change=(best, changes[best] + gain) if best else ('', float('nan')),
        num_pairs=len(pairs),
        links=links,
    )


def _delay(
    lags_s: Sequence[float], match: Callable[..., float], count: int, camera: CameraModel
) -> tuple[float, float]:
    """Return delay at which both halves of the recording together fit best, and its least gain."""
    if len(lags_s) == 1:
        return lags_s[0], 0.0
    halves = [slice(0, count // 2), slice(count // 2, count)]
    fits = {lag_s: [match(camera, lag_s, part) for part in halves] for lag_s in lags_s}
    fits = {lag_s: [fit for fit in row if np.isfinite(fit)] for lag_s, row in fits.items()}
    lag_s = max(fits, key=lambda each: float(np.sum(fits[each])))
    still = fits.get(0.0, fits[lag_s])
    gains = [there / max(here, 1e-6) - 1 for there, here in zip(fits[lag_s], still, strict=False)]
    return lag_s, min(gains, default=0.0)


def _changes(camera: CameraModel, search: ResidualSearch) -> dict[str, CameraModel]:
    """Return the cameras that are rolled, or have another focal length, by name."""
    found = {}
    for degrees in search.rolls_deg:
        turn = np.eye(4)
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turn[:2, :2] = [[c, -s], [s, c]]
        found[f'the camera rolled by {degrees:+g} degrees'] = replace(
            camera, T_mount_camera=camera.T_mount_camera @ turn
        )
    for factor in search.zooms:
        K = camera.K.copy()
        K[:2, :2] *= factor
        found[f'{factor:g} times the focal length'] = replace(camera, K=K)
    return found


def _top(surface: FloatArray | None) -> float:
    return -np.inf if surface is None else float(surface.max())


def _pairs(stamps_ns: NDArray[np.int64], joints: JointTrack, count: int) -> np.ndarray:
    """Return (P, 2) indices of frames between which a joint moves."""
    later = np.searchsorted(stamps_ns, stamps_ns + round(_STEP_S * 1e9) - 1000)
    first = np.flatnonzero(later < len(stamps_ns))
    pairs = np.stack([first, later[first]], axis=-1)
    span = (stamps_ns[pairs[:, 1]] - stamps_ns[pairs[:, 0]]) * 1e-9
    pairs = pairs[span < 2 * _STEP_S]
    pairs = pairs[joints.covers(stamps_ns[pairs]).all(axis=1)] if len(pairs) else pairs
    if len(pairs) == 0:
        return pairs
    moved = np.abs(np.diff(joints.at(stamps_ns[pairs].ravel()).reshape(*pairs.shape, -1), axis=1))
    pairs = pairs[(moved[:, 0] > 1e-3).any(axis=1)]
    chosen = np.linspace(0, len(pairs) - 1, min(count, len(pairs)))
    return pairs[np.unique(chosen.round().astype(int))]


def _seen_motion(track: Track, pairs: np.ndarray, small: CameraModel) -> list[FloatImage]:
    """Return the change of each pixel in each pair of frames, 0 .. 1; NaN outside of the image."""
    grey = {int(i): _grey(track.frames[int(i)], small) for i in np.unique(pairs)}
    return [_softened(np.abs(grey[int(j)] - grey[int(i)])) for i, j in pairs]


def _grey(frame: NDArray[np.uint8], small: CameraModel) -> FloatImage:
    resized = cv2.resize(frame, (small.width, small.height), interpolation=cv2.INTER_AREA)
    summed = cv2.transform(resized.astype(np.float32), np.ones((1, 3), np.float32))
    return np.asarray(summed / 3, np.float32)  # 30 times as fast as NumPy's mean of an axis of 3


def _softened(change: FloatImage) -> FloatImage:
    blurred = cv2.GaussianBlur(change, (0, 0), _BLUR_PX)
    moving = np.minimum(blurred / np.float32(_SATURATION), 1)
    rim = _radius(change.shape[1])
    return np.pad(moving, rim, constant_values=np.nan)


def _radius(width: int) -> int:
    return max(2, round(REACH * width))


def _surface(
    seen: Sequence[FloatImage],
    positions: FloatArray,
    small: CameraModel,
    robot: RobotModel,
    shapes: Sequence[LinkShape],
) -> tuple[FloatArray | None, frozenset[str]]:
    """Return (2R + 1, 2R + 1) mean correlation of the links over shifts, and the links that move.

    None where none moves.
    """
    poses = robot.forward_kinematics(positions)
    T_base_camera = camera_poses(small, robot, positions)
    radius = _radius(small.width)
    parts: dict[str, list[FloatArray]] = {}
    for shape in shapes:
        pixels = project_part(shape, poses[shape.link], small, T_base_camera)
        parts.setdefault(shape.link, []).append(pixels)
    whole = fill([pixels for link in parts.values() for pixels in link], small)
    total, weights = np.zeros((2 * radius + 1,) * 2), 0.0
    moving = []
    for name, link in parts.items():
        surface, count = _correlate(seen, fill(link, small), whole, radius)
        total += np.sqrt(count) * surface
        weights += np.sqrt(count)
        moving += [name] if count else []
    return (total / weights if weights else None), frozenset(moving)


def _correlate(
    seen: Sequence[FloatImage],
    drawn: NDArray[np.uint8],
    whole: NDArray[np.uint8],
    radius: int,
) -> tuple[FloatArray, int]:
    """Return one link's normalised correlation over shifts, and the pairs in which it moves.

    Only pixels that tell are compared: those that the link leaves or enters and the rest of the
    robot does not cover, which should change, and those without the robot in both frames, which
    should not. Where the robot stays in front of itself, or another link moves, a change says
    nothing about this link.

    Args:
        seen: change of each pixel, a pair of frames each, with a rim.
        drawn: (2 P, H, W) silhouettes of the link in the frames of the pairs.
        whole: (2 P, H, W) silhouettes of the whole robot in the same frames.
        radius: radius of the search [px].
    """
    size = (2 * radius + 1,) * 2
    total, energy_seen, energy_drawn = np.zeros(size), np.zeros(size), np.zeros(size)
    count = 0
    for change, link, robot in zip(seen, _pairwise(drawn), _pairwise(whole), strict=True):
        differs = (link[0] ^ link[1]) & (robot[0] ^ robot[1])
        if cv2.countNonZero(differs) < _LEAST_AREA_PX:
            continue
        telling = differs | (1 - (robot[0] | robot[1]))
        products = _products(differs, telling, change, radius)
        total += products[0]
        energy_seen += products[1]
        energy_drawn += products[2]
        count += 1
    if count == 0:
        return total, 0
    enough = energy_drawn > _LEAST_INSIDE * energy_drawn.max()
    norm = energy_seen.clip(_LEAST_ENERGY * energy_seen.max()) * energy_drawn.clip(0)
    return np.where(enough, total / np.sqrt(norm + 1e-12), 0.0), count


def _pairwise(silhouettes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return (P, 2, H, W) of (2 P, H, W)."""
    return silhouettes.reshape(-1, 2, *silhouettes.shape[1:])


def _products(
    differs: NDArray[np.uint8], telling: NDArray[np.uint8], change: FloatImage, radius: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return covariance of drawn and seen motion over shifts, and the variance of each, as sums.

    Over the telling pixels around the drawn motion that a shift leaves in the image: else a robot
    that is drawn too far inside would seem to be nearer than it is.
    """
    rim = round(5 * _BLUR_PX)
    left, top, width, height = cv2.boundingRect(differs)
    right, bottom = left + width + rim, top + height + rim
    left, top = max(left - rim, 0), max(top - rim, 0)
    weight = telling[top:bottom, left:right].astype(np.float32)
    motion = differs[top:bottom, left:right].astype(np.float32)
    motion = weight * cv2.GaussianBlur(motion, (0, 0), _BLUR_PX)
    height, width = weight.shape
    window = change[top : top + height + 2 * radius, left : left + width + 2 * radius]
    inside = np.isfinite(window)
    window = np.where(inside, window, np.float32(0))
    if inside.all():
        area, drawn, drawn_squares = (np.float64(x.sum()) for x in (weight, motion, motion**2))
    else:
        masks = inside.astype(np.float32)
        area, drawn, drawn_squares = (_over_shifts(masks, x) for x in (weight, motion, motion**2))
    area = np.maximum(area, 1.0)
    there = _over_shifts(window, weight)
    return (
        _over_shifts(window, motion) - drawn * there / area,
        _over_shifts(window**2, weight) - there**2 / area,
        np.broadcast_to(drawn_squares - drawn**2 / area, there.shape),
    )


def _over_shifts(window: FloatImage, template: FloatImage) -> FloatArray:
    return np.asarray(cv2.matchTemplate(window, template, cv2.TM_CCORR), np.float64)


def _peak(surface: FloatArray) -> FloatArray:
    """Return (x, y) of the maximum from the centre, refined by a parabola [px]."""
    radius = len(surface) // 2
    row, column = np.unravel_index(int(surface.argmax()), surface.shape)
    x = _refined(surface[row], int(column)) - radius
    return np.array([x, _refined(surface[:, column], int(row)) - radius])


def _refined(line: FloatArray, at: int) -> float:
    """Return the vertex of the parabola through the maximum and its neighbours."""
    if not 0 < at < len(line) - 1:
        return float(at)
    before, top, after = line[at - 1 : at + 2]
    bend = float(before - 2 * top + after)
    return at + 0.5 * float(before - after) / bend if bend < 0 else float(at)
