"""Rigid motions of objects, and the pictures that show them.

V views, O objects, T frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Any, Protocol

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.core.data_types import BoolArray, ByteArray, CameraModel, FloatArray
from mtv_world_ros.physics.contact_settings import ContactSettings
from mtv_world_ros.physics.grips import FingerState
from mtv_world_ros.physics.sights import KeptPose
from mtv_world_ros.robot.model import RobotModel

#: displacement below which an object stands still [m]
_STILL_M = 0.004
#: rotation below which an object stands still [rad]
_STILL_RAD = 0.08
#: distance between two ends beyond which all distances count the same [m]
_ELSEWHERE_M = 0.05
#: lever arm that turns a rotation into a distance [m]
_RADIUS_M = 0.02
#: duration of the blend from one motion to another in the pictures [s]
_PASSAGE_S = 1.0
#: entries of equal poses differ by less
_SAME_POSE = 1e-4
#: least ratio of widths at which one object can stand in or on the other
_AS_WIDE = 1.25


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectMotion:
    """Rigid motions of objects, relative to their reference poses.

    Attributes:
        reference: (O, 3) centres of the objects at the reference [m]; NaN = not known.
        points: (T, O, 3) centres of the objects [m].
        rotations: (T, O, 3, 3) rotations from the reference.
        openings: (T, A) openings of the grippers, 0 closed to 1 open, which what they touch may
            stop; None = not foreseen.
        weight: relative weight among the motions of the same plan.
    """

    reference: FloatArray
    points: FloatArray
    rotations: FloatArray
    openings: FloatArray | None = None
    weight: float = 1.0

    def moves(self) -> BoolArray:
        """Return (T, O) True where an object is displaced by more than the position error."""
        turned = np.einsum('toii->to', self.rotations) < 1 + 2 * np.cos(_STILL_RAD)
        return (np.linalg.norm(self.displacements, axis=-1) > _STILL_M) | turned

    @property
    def displacements(self) -> FloatArray:
        """Displacements (T, O, 3) from the reference [m]."""
        return self.points - self.reference

    def then(self, motion: ObjectMotion) -> ObjectMotion:
        """Return this motion followed by another; its row 0 is the last row of this one."""
        rows = zip(self._rows, motion._rows, strict=True)
        return self._of([np.concatenate([before, after[1:]]) for before, after in rows])

    def __getitem__(self, frames: slice | np.ndarray) -> ObjectMotion:
        """Return some of the frames, with the same reference."""
        return self._of([rows[frames] for rows in self._rows])

    def blended_from(self, last: ObjectMotion, steps: int) -> ObjectMotion:
        """Return the motion blended from the last row of another into itself within `steps`."""
        left = np.clip(1 - np.arange(len(self.points)) / steps, 0.0, 1.0)
        way = np.nan_to_num(last.displacements[-1] - self.displacements[0])
        turns = Rotation.from_matrix(self.rotations[0].swapaxes(-1, -2) @ last.rotations[-1])
        parts = left[:, None, None] * turns.as_rotvec()
        turned = Rotation.from_rotvec(parts.reshape(-1, 3)).as_matrix()
        return replace(
            self,
            points=self.points + left[:, None, None] * way,
            rotations=self.rotations @ turned.reshape(self.rotations.shape),
        )

    @property
    def _rows(self) -> list[FloatArray]:
        """The arrays with a row a frame."""
        rows = [self.points, self.rotations]
        return rows if self.openings is None else [*rows, self.openings]

    def _of(self, rows: Sequence[FloatArray]) -> ObjectMotion:
        points, rotations, *openings = rows
        return replace(
            self, points=points, rotations=rotations, openings=openings[0] if openings else None
        )


class TrackedObjects(Protocol):
    """Tracked objects; the state that one chunk hands to the next."""

    @property
    def step_s(self) -> float:
        """Time between the rows of a motion [s]."""
        ...

    @property
    def commands_a_step(self) -> int:
        """Number of joint positions that `advance` takes per step."""
        ...

    @property
    def sizes(self) -> FloatArray:
        """Upright extents (K, O, 3) of the objects in each motion [m]."""
        ...

    @property
    def doubts(self) -> Mapping[int, str]:
        """Reason why no motion is simulated, by index of the object."""
        ...

    @property
    def reasons(self) -> tuple[str, ...]:
        """Doubts about the simulated motions, in words."""
        ...

    @property
    def refusal(self) -> str:
        """Reason why the simulated motions allow no verdict; empty if they do."""
        ...

    @property
    def is_fitted(self) -> bool:
        """Return True if contact parameters were fitted in this robot cell."""
        ...

    def simulated_by(self, model: Any) -> TrackedObjects:
        """Return the objects as they were found, to be simulated by another model."""
        ...

    @property
    def fingers(self) -> FingerState | None:
        """Motion of the fingers until now; None = not known."""
        ...

    def with_fingers(self, fingers: FingerState | None) -> TrackedObjects:
        """Return the objects with the motion of the fingers before the first plan."""
        ...

    def advance(
        self, positions: FloatArray, should_stop: Callable[[], bool] = lambda: False
    ) -> tuple[tuple[ObjectMotion, ...], TrackedObjects]:
        """Simulate T steps; return the motion at 1 + T rows, and the objects at its end.

        The first motion is the expected one; the others, if any, start from poses and sizes within
        the error of the masks. Row 0 is the present.

        Args:
            positions: (1 + T * `commands_a_step`, J) commanded positions [rad or m].
            should_stop: True ends the computation; called often.

        Raises:
            RolloutPreempted: `should_stop` returned True.
        """
        ...


class ObjectMotionModel(Protocol):
    """Simulates object motion under joint commands.

    Attributes:
        is_fitted: contact parameters were fitted in the robot cell, or confirmed there.
        settings: contact parameters.
    """

    is_fitted: bool
    settings: ContactSettings

    def find(
        self,
        names: Sequence[str],
        masks: BoolArray,
        cameras: Sequence[CameraModel],
        poses: Sequence[FloatArray],
    ) -> TrackedObjects:
        """Find the objects of O names in masks (V, O, H, W) of cameras at T_base_camera (4, 4)."""
        ...

    def find_again(
        self,
        whole: Any,
        names: Sequence[str],
        masks: BoolArray,
        cameras: Sequence[CameraModel],
        poses: Sequence[FloatArray],
        kept: Sequence[KeptPose | None] = (),
        held: Sequence[bool] = (),
    ) -> tuple[TrackedObjects, BoolArray, BoolArray]:
        """Return the objects in a frame in which they may be partly hidden.

        Args:
            whole: result of `find` for a frame in which nothing hid the objects.
            names: see `find`.
            masks: visible parts of the objects, see `find`.
            cameras: cameras of the V views.
            poses: T_base_camera of each view, (4, 4) [m].
            kept: pose of each object by the last frame that showed it free; None, or an empty
                sequence: the masks alone say where it is.
            held: whether frames until then showed each object to go along with stopped fingers;
                an empty sequence: none was.

        Returns:
            The objects; mask (O,) of the objects found with certainty, at their former size; mask
            (O,) of the partly hidden ones, whose motion counts from the frame of `whole`.
        """
        ...

    def with_robot(self, robot: RobotModel) -> ObjectMotionModel:
        """Return the model for a robot with the same joints and tools."""
        ...

    def at_place(self, place: str) -> ObjectMotionModel:
        """Return the model for a robot cell, with wide priors if it was fitted elsewhere."""
        ...

    def as_fitted(self) -> ObjectMotionModel:
        """Return the model with the fitted parameters in place of the prior around them."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundObjects:
    """Named objects: their pictures in a real frame, and their present poses.

    Attributes:
        names: names of the O objects.
        cuts: (V, O, H, W, 4) `cut_outs` of the frame that shows each best, at the model's size.
        poses: (V, O, 4, 4) T_base_camera then.
        tracked: current poses of the objects.
        motions: motions since that frame, rows `tracked.step_s` apart; row 0 has the places and
            sizes of the masks.
        positions: (N, J) joint positions at these rows [rad or m].
        part_row: row at which the last part of a plan begins.
        shown: index of the motion that the pictures show.
        shown_before: index of the motion that the pictures of the part before showed.
        is_whole: whether all were seen whole, now or before.
    """

    names: tuple[str, ...]
    cuts: ByteArray
    poses: FloatArray
    tracked: TrackedObjects
    motions: tuple[ObjectMotion, ...] = ()
    positions: FloatArray | None = None
    part_row: int = 0
    shown: int = 0
    shown_before: int = 0
    is_whole: bool = False

    @classmethod
    def at(
        cls,
        names: tuple[str, ...],
        frames: ByteArray,
        masks: BoolArray,
        poses: FloatArray,
        tracked: TrackedObjects,
    ) -> FoundObjects:
        """Return objects from masks (V, O, H, W) in frames (V, H, W, 3), cameras at (V, 4, 4)."""
        of_each = np.repeat(poses[:, None], len(names), axis=1)
        return cls(names=names, cuts=cut_outs(frames, masks), poses=of_each, tracked=tracked)

    def shown_as(self, whole: FoundObjects, hidden: BoolArray) -> FoundObjects:
        """Return the objects; those of `hidden` (O,) keep their pictures from before."""
        cuts = np.where(hidden[:, None, None, None], whole.cuts, self.cuts)
        poses = np.where(hidden[:, None, None], whole.poses, self.poses)
        return replace(self, cuts=cuts, poses=poses)

    def simulated_by(self, model: ObjectMotionModel) -> FoundObjects:
        """Return the objects as they were found, to be simulated by another model."""
        tracked = self.tracked.simulated_by(model)
        return replace(self, tracked=tracked, motions=(), positions=None, part_row=0)

    def foresee(self, parts: Iterable[FloatArray]) -> tuple[FoundObjects, ...]:
        """Simulate the parts of a plan; return the objects at the end, the shown motion kept.

        Args:
            parts: (1 + T * `tracked.commands_a_step`, J) joint positions of each part [rad or m],
                evenly spaced; row 0 where the robot is by then.
        """
        found: list[FoundObjects] = []
        for positions in parts:
            found.append((found[-1] if found else self).after(positions))
        return tuple(found)

    @property
    def futures_key(self) -> str:
        """Digest of the scene in each future where the motions begin; empty = nothing moved yet.

        Plans with equal keys meet common futures: the same objects, places, sizes and contact.
        """
        if not self.motions:
            return ''
        starts = np.stack([motion.points[0] for motion in self.motions])
        scene = np.concatenate([starts.ravel(), np.ravel(self.tracked.sizes)])
        rounded = np.nan_to_num(np.rint(scene * 1e6), nan=-1.0).astype(np.int64)
        words = '\0'.join((*self.names, str(self.tracked.is_fitted)))
        return sha256(words.encode() + rounded.tobytes()).hexdigest()[:16]

    def medoid(self, among: BoolArray | None = None) -> int:
        """Return the index of the medoid motion: its end is closest to those of all.

        Args:
            among: (K,) mask of the motions to choose from, one or more; None = all.
        """
        weights = [motion.weight for motion in self.motions]
        unlike = _apart(self.motions).sum(-1) @ np.array(weights)
        return int(np.argmin(unlike if among is None else np.where(among, unlike, np.inf)))

    def pictures(
        self, times: FloatArray, cameras: Sequence[CameraModel], poses: FloatArray
    ) -> ByteArray:
        """Return pictures (V, T, H, W, 4) of the objects in the last part of the plan.

        Where the part shows another motion than the one before, objects pass to it gradually.

        Args:
            times: (T,) times from its row 0 on [s].
            cameras: V cameras at the masks' size.
            poses: (V, T, 4, 4) T_base_camera at these times.
        """
        motion = self.motions[self.shown][self.part_row :]
        if self.shown != self.shown_before:
            last = self.motions[self.shown_before][: self.part_row + 1]
            motion = motion.blended_from(last, round(_PASSAGE_S / self.tracked.step_s))
        rows = np.rint(times / self.tracked.step_s).astype(int)
        shown = motion[np.minimum(rows, len(motion.points) - 1)]
        return moved_pictures(self.cuts, shown, cameras, self.poses, poses)

    def after(
        self, positions: FloatArray, should_stop: Callable[[], bool] = lambda: False
    ) -> FoundObjects:
        """Simulate one part of a plan; return the objects at its end, the shown motion kept.

        Args:
            positions: (1 + T * `tracked.commands_a_step`, J) [rad or m], evenly spaced.
            should_stop: True ends the computation; called often.

        Raises:
            RolloutPreempted: `should_stop` returned True.
        """
        motions, tracked = self.tracked.advance(positions, should_stop)
        positions = positions[:: self.tracked.commands_a_step]
        if self.positions is None:
            return replace(self, tracked=tracked, motions=motions, positions=positions)
        pairs = zip(self.motions, motions, strict=True)
        return replace(
            self,
            tracked=tracked,
            motions=tuple(before.then(after) for before, after in pairs),
            positions=np.concatenate([self.positions, positions[1:]]),
            part_row=len(self.positions) - 1,
        )


def _apart(motions: Sequence[ObjectMotion]) -> FloatArray:
    """Return (K, K, O) how far poses are apart at the ends of motions [m].

    Those not known are not.
    """
    turns = np.stack([motion.rotations[-1].reshape(-1, 9) for motion in motions])
    ways = np.stack([motion.displacements[-1] for motion in motions])
    ends = np.concatenate([ways, _RADIUS_M * turns], axis=-1)
    apart = np.linalg.norm(ends[:, None] - ends[None], axis=-1)
    return np.nan_to_num(np.minimum(apart, _ELSEWHERE_M))


def cut_outs(frames: ByteArray, masks: BoolArray) -> ByteArray:
    """Return cut-outs (V, O, H, W, 4): RGB of each object, and its mask as alpha, 0 or 255.

    Args:
        frames: (V, H, W, 3) uint8 RGB.
        masks: (V, O, H, W) masks in them.
    """
    cover = np.where(masks, 255, 0).astype(np.uint8)[..., None]
    colours = np.where(masks[..., None], frames[:, None], 0).astype(np.uint8)
    return np.concatenate([colours, cover], axis=-1)


def moved_pictures(
    cuts: ByteArray,
    motion: ObjectMotion,
    cameras: Sequence[CameraModel],
    reference_poses: FloatArray,
    poses: FloatArray,
) -> ByteArray:
    """Return pictures of the moving objects (V, T, H, W, 4), uint8 RGB and alpha.

    Each object is warped like a plane through its centre that faces the camera: shifted by the
    projected displacement, scaled by the ratio of depths, turned about the line of sight. Near
    objects cover far ones, but an object covers the one it stands in or on, whose nearer wall
    hides it only in part. Objects of unknown pose, behind the camera, or at rest before a camera
    at rest keep their picture.

    Args:
        cuts: (V, O, H, W, 4) cut-outs of the reference frame, see `cut_outs`.
        motion: motion of T frames.
        cameras: V cameras at the pictures' size.
        reference_poses: (V, O or 1, 4, 4) T_base_camera at the reference.
        poses: (V, T, 4, 4) T_base_camera.
    """
    num_frames = len(motion.points)
    views, _, height, width, _ = cuts.shape
    shown = np.zeros((views, num_frames, height, width, 4), np.uint8)
    moves = motion.moves()
    holders = _holders(motion, _widths(cuts, motion, cameras, reference_poses))
    for view, camera in enumerate(cameras):
        before, depth = project(camera, reference_poses[view], motion.reference)
        after, depths = project(camera, poses[view][:, None], motion.points)
        turns = _turns(motion.rotations, poses[view])
        shifted = moves | _pans(reference_poses[view], poses[view])
        for frame in range(num_frames):
            for item in _from_behind(depths[frame], holders[frame]):
                picture = cuts[view, item]
                if (
                    shifted[frame, item]
                    and np.isfinite([*after[frame, item], *before[item]]).all()
                ):
                    zoom = float(depth[item] / depths[frame, item])
                    turn = float(turns[frame, item])
                    picture = _warped(picture, before[item], after[frame, item], zoom, turn)
                _lay(shown[view, frame], picture)
    return shown


def _pans(reference_poses: FloatArray, poses: FloatArray) -> BoolArray:
    """(T, O or 1) whether a camera is elsewhere at (T, 4, 4) than before, at (O or 1, 4, 4)."""
    return np.asarray((np.abs(poses[:, None] - reference_poses) > _SAME_POSE).any((-2, -1)))


def _widths(
    cuts: ByteArray, motion: ObjectMotion, cameras: Sequence[CameraModel], poses: FloatArray
) -> FloatArray:
    """Return (O,) sides of squares as large as the objects look in the views that show most [m].

    But not wider than they look: a bottle is high.
    """
    found = []
    for cut, camera, pose in zip(cuts[..., 3] > 0, cameras, poses, strict=True):
        side = np.minimum(np.sqrt(cut.sum((-2, -1))), cut.any(-2).sum(-1))
        found.append(side * project(camera, pose, motion.reference)[1] / camera.K[0, 0])
    return np.asarray(np.nan_to_num(np.max(found, axis=0)))


def _holders(motion: ObjectMotion, widths: FloatArray) -> BoolArray:
    """Return (T, O, O) which objects stand in or on which: within their width, and smaller."""
    across = np.linalg.norm(motion.points[:, :, None, :2] - motion.points[:, None, :, :2], axis=-1)
    return np.asarray((across < widths / 2) & (_AS_WIDE * widths[:, None] < widths))


def _from_behind(depths: FloatArray, holders: BoolArray) -> list[int]:
    """Return the items in drawing order, far ones first; those of unknown depth last, on top."""
    far = np.nan_to_num(depths, nan=-np.inf)
    nearest = np.where(holders, far, np.inf).min(1, initial=np.inf)
    front, held = np.minimum(far, nearest), holders.sum(1)
    return sorted(range(len(far)), key=lambda item: (-float(front[item]), int(held[item])))


def _lay(image: ByteArray, picture: ByteArray) -> None:
    """Lay a picture, already weighed by its cover, over an (H, W, 4) image."""
    rows, columns = np.nonzero(picture[..., 3])
    if not len(rows):
        return
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    part, rest = picture[box], 255 - picture[box][..., 3:].astype(np.uint16)
    image[box] = part + ((image[box] * rest + 127) // 255).astype(np.uint8)


def _warped(
    picture: ByteArray, before: FloatArray, after: FloatArray, zoom: float, turn: float
) -> ByteArray:
    cos, sin = zoom * np.cos(turn), zoom * np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]])
    affine = np.column_stack([linear, after - linear @ before])
    size = picture.shape[1::-1]
    return cv2.warpAffine(picture, affine, size, flags=cv2.INTER_LINEAR).astype(np.uint8)


def _turns(rotations: FloatArray, poses: FloatArray) -> FloatArray:
    """Return (T, O) angles [rad] about the optical axis, positive from the image's x to its y."""
    local = np.swapaxes(poses[:, None, :3, :3], -1, -2) @ rotations @ poses[:, None, :3, :3]
    return np.arctan2(local[..., 1, 0] - local[..., 0, 1], local[..., 0, 0] + local[..., 1, 1])
