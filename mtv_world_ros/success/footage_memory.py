"""The estimator's input of a chunk, and its memory of the chunks before, imagined or real."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.mask_geometry import axis_lean, centroids, locate_all
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.core.data_types import BoolArray, CameraModel, FloatArray, ObjectMasks

#: maximum number of frames with kept positions; the start is always kept
MAX_FRAMES = 2000
#: maximum number of kept grasps
MAX_GRASPS = 64
#: decrease of the opening at which a gripper has grasped [fraction of its range]
CLOSES_BY = 0.15
#: increase of the opening at which a gripper has released [fraction of its range]
OPENS_BY = 0.1
#: opening at the start below which a gripper may already hold an object [fraction of its range]
HOLDING_BELOW = 0.8
#: minimum distance of a moved object from where it was [m]
MOVED_M = 0.03
#: minimum visible area of an object that is not hidden [fraction of its largest area]
UNHIDDEN_SHARE = 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class Footage:
    """A chunk of V views, O objects, A arms and T predicted frames; row 0 is the start frame.

    Attributes:
        masks: masks of the T predicted frames.
        start_masks: start masks of the frame before them (T = 1).
        cameras: V cameras at the masks' size.
        poses: (V, 1 + T, 4, 4) T_base_camera.
        tools: (A, 1 + T, 3) commanded positions of the tools [m]; None = not known.
        openings: (A, 1 + T) openings of the grippers, 0 closed to 1 open; None = not known.
    """

    masks: ObjectMasks
    start_masks: ObjectMasks
    cameras: Sequence[CameraModel]
    poses: FloatArray
    tools: FloatArray | None = None
    openings: FloatArray | None = None

    @property
    def num_frames(self) -> int:
        """Number of predicted frames, T."""
        return self.masks.masks.shape[2]

    def frame_masks(self, frame: int) -> BoolArray:
        """Return (V, O, H, W) masks of a frame, 0 = the start frame."""
        return self.start_masks.masks[:, :, 0] if frame == 0 else self.masks.masks[:, :, frame - 1]

    def known(self, frame: int) -> BoolArray:
        """Return (V, O) whether an object's mask is not empty and its status `ok`."""
        status = self.start_masks.status if frame == 0 else self.masks.status
        ok = np.array([[word == 'ok' for word in row] for row in status], np.bool_)
        masks = self.frame_masks(frame)
        return ok.reshape(masks.shape[:2]) & masks.any((-2, -1))


def footage_of(motion: Motion, start_masks: ObjectMasks, masks: ObjectMasks) -> Footage:
    """Return the footage of a chunk of 1 + T states, the first at the start masks."""
    return Footage(
        masks=masks,
        start_masks=start_masks,
        cameras=motion.cameras,
        poses=motion.camera_poses,
        tools=motion.tool_points,
        openings=motion.openings,
    )


class ObservedGrasp(NamedTuple):
    """A gripper that closed.

    Attributes:
        arm: index of the arm.
        closed_at: (3,) position of the tool when it closed [m].
        gaps_m: (O,) distance of the tool from an object's last unhidden mask, the largest over the
            views [m]; negative = inside, NaN = not known.
        points: (O, 3) places at which the objects were last seen unhidden, or now if that is
            clearly elsewhere [m].
        released_at: (3,) position of the tool when it opened [m]; None = it has not.
    """

    arm: int
    closed_at: FloatArray
    gaps_m: FloatArray
    points: FloatArray
    released_at: FloatArray | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FootageMemory:
    """Memory of an episode's chunks, imagined or real: V views, O objects, A arms, N frames.

    Attributes:
        start_masks: start masks of the episode's first frame (T = 1).
        points: (O, N, 3) centres, NaN where fewer than two views know one [m].
        leans: (O, N, 2) x and y of unit vectors along the objects' long axes, NaN where no view
            knows one.
        seen_masks: (V, O, H, W) last masks in which an object was not hidden.
        seen_points: (O, 3) positions of the objects then [m].
        largest: (V, O) largest area of each mask in these frames [px].
        grasps: grasps in order.
        levels: (A,) opening since which a gripper's closing or opening counts.
        closed: (A,) whether a gripper has closed since it last opened.
    """

    start_masks: ObjectMasks
    points: FloatArray
    leans: FloatArray
    seen_masks: BoolArray
    seen_points: FloatArray
    largest: FloatArray
    grasps: tuple[ObservedGrasp, ...] = ()
    levels: FloatArray | None = None
    closed: BoolArray | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the O objects."""
        return self.start_masks.names

    @property
    def num_frames(self) -> int:
        """Number of frames until now, N."""
        return self.points.shape[1]

    def start_point(self, item: int) -> FloatArray:
        """Return where an object was in the episode's first frame (3,) [m], NaN = not known."""
        return self.points[item, 0]


def remember(memory: FootageMemory | None, footage: Footage) -> FootageMemory:
    """Return the memory after a chunk.

    Args:
        memory: memory before the chunk; None = the chunk is the first, as it is where the objects
            have changed.
        footage: masks and poses of the chunk.
    """
    if memory is None or memory.names != footage.masks.names:
        memory = _begin(footage)
    for frame in range(1, footage.num_frames + 1):
        memory = _followed(memory, footage, frame)
    return memory


def _begin(footage: Footage) -> FootageMemory:
    masks = footage.frame_masks(0)
    points, leans = _points(footage, 0), _leans(footage, 0)
    memory = FootageMemory(
        start_masks=footage.start_masks,
        points=points[:, None],
        leans=leans[:, None],
        seen_masks=masks,
        seen_points=points,
        largest=masks.sum((-2, -1)).astype(np.float64),
    )
    if footage.openings is None or footage.tools is None:
        return memory
    openings = footage.openings[:, 0]
    closed = openings < HOLDING_BELOW
    memory = replace(memory, levels=openings.copy(), closed=closed)
    for arm in np.flatnonzero(closed):
        memory = _grasped(memory, footage, 0, int(arm))
    return memory


def _followed(memory: FootageMemory, footage: Footage, frame: int) -> FootageMemory:
    """Return the memory after one more frame."""
    if footage.openings is not None and footage.tools is not None and memory.levels is not None:
        for arm, opening in enumerate(footage.openings[:, frame]):
            memory = _with_gripper(memory, footage, frame, arm, float(opening))
    masks, known = footage.frame_masks(frame), footage.known(frame)
    points, area = _points(footage, frame), masks.sum((-2, -1)).astype(np.float64)
    largest = np.maximum(memory.largest, np.where(known, area, 0.0))
    unhidden = known.all(0) & (area >= UNHIDDEN_SHARE * largest).all(0)
    unhidden &= np.isfinite(points[:, 0])
    trail = np.concatenate([memory.points, points[:, None]], axis=1)
    leans = np.concatenate([memory.leans, _leans(footage, frame)[:, None]], axis=1)
    if trail.shape[1] > MAX_FRAMES:  # drops the oldest but the start
        trail, leans = np.delete(trail, 1, axis=1), np.delete(leans, 1, axis=1)
    return replace(
        memory,
        points=trail,
        leans=leans,
        largest=largest,
        seen_masks=np.where(unhidden[None, :, None, None], masks, memory.seen_masks),
        seen_points=np.where(unhidden[:, None], points, memory.seen_points),
    )


def _with_gripper(
    memory: FootageMemory, footage: Footage, frame: int, arm: int, opening: float
) -> FootageMemory:
    """Return the memory after a gripper's opening in one more frame."""
    assert memory.levels is not None and memory.closed is not None and footage.tools is not None
    levels, closed = memory.levels.copy(), memory.closed.copy()
    level = levels[arm]
    memory = replace(memory, levels=levels, closed=closed)
    if opening < level - CLOSES_BY:
        levels[arm], closed[arm] = opening, True
        return _grasped(memory, footage, frame, arm)
    if closed[arm] and opening > level + OPENS_BY:
        levels[arm], closed[arm] = opening, False
        return _released(memory, arm, footage.tools[arm, frame])
    levels[arm] = min(level, opening) if closed[arm] else max(level, opening)
    return memory


def _grasped(memory: FootageMemory, footage: Footage, frame: int, arm: int) -> FootageMemory:
    assert footage.tools is not None
    tool, now = footage.tools[arm, frame], memory.points[:, -1]
    # an object that is clearly elsewhere was moved, however much of it is hidden since
    has_moved = np.linalg.norm(now - memory.seen_points, axis=-1) > MOVED_M
    known = footage.known(frame).all(0)
    shown = np.where(
        (has_moved & known)[None, :, None, None], footage.frame_masks(frame), memory.seen_masks
    )
    gaps = np.array(
        [
            _gap(footage.cameras, footage.poses[:, frame], masks, tool)
            for masks in shown.swapaxes(0, 1)
        ]
    )
    points = np.where((has_moved & known)[:, None], now, memory.seen_points)
    grasp = ObservedGrasp(arm, tool, gaps, points)
    return replace(memory, grasps=(*memory.grasps, grasp)[-MAX_GRASPS:])


def _released(memory: FootageMemory, arm: int, tool: FloatArray) -> FootageMemory:
    """End all open grasps of the arm; a gripper that closes in steps has several."""
    ended = tuple(
        grasp._replace(released_at=tool)
        if grasp.arm == arm and grasp.released_at is None
        else grasp
        for grasp in memory.grasps
    )
    return replace(memory, grasps=ended)


def _gap(
    cameras: Sequence[CameraModel], poses: FloatArray, masks: BoolArray, tool: FloatArray
) -> float:
    """Return the largest distance over views of the tool from an object's (V, H, W) masks [m]."""
    gaps = []
    for camera, pose, mask in zip(cameras, poses, masks, strict=True):
        pixel, depth = project(camera, pose, tool)
        if not mask.any() or not np.isfinite(pixel).all():
            continue
        gaps.append(_outside_px(mask, pixel) * float(depth) / camera.K[0, 0])
    return max(gaps, default=float('nan'))


def _outside_px(mask: BoolArray, pixel: FloatArray) -> float:
    """Return the distance of a pixel from the mask's edge [px], negative inside."""
    x, y = pixel
    height, width = mask.shape
    inside = 0 <= round(x) < width and 0 <= round(y) < height and mask[round(y), round(x)]
    rows, columns = np.nonzero(~np.pad(mask, 1) if inside else mask)
    shift = 1 if inside else 0
    nearest = float(np.hypot(columns - shift - x, rows - shift - y).min())
    return 0.5 - nearest if inside else nearest - 0.5


def _points(footage: Footage, frame: int) -> FloatArray:
    """Return (O, 3) centres, NaN where fewer than two views know one."""
    pixels = np.where(
        footage.known(frame)[..., None], centroids(footage.frame_masks(frame)), np.nan
    )
    return locate_all(footage.cameras, tuple(footage.poses[:, frame]), pixels)


def _leans(footage: Footage, frame: int) -> FloatArray:
    """Return (O, 2) leans of the long axes, NaN where no view knows one."""
    masks, known = footage.frame_masks(frame), footage.known(frame)
    leans = np.full((known.shape[1], 2), np.nan)
    for item in map(int, np.flatnonzero(known.any(0))):
        views = np.flatnonzero(known[:, item])
        cameras = [footage.cameras[int(view)] for view in views]
        leans[item] = axis_lean(
            cameras, list(footage.poses[views, frame]), list(masks[views, item])
        )
    return leans
