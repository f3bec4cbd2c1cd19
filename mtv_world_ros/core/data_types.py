"""Frozen data passed between stages; arrays are checked and read-only, units SI, images RGB.

V views, T frames, J joints, A arms, O objects, H W pixels; `p_a = T_a_b @ p_b`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.errors import (
    CalibrationError,
    MtvWorldError,
    ObservationError,
    TrajectoryError,
)
from mtv_world_ros.core.estimate_words import trust_of

FloatArray = NDArray[np.float64]
ByteArray = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]

#: largest distance of a camera from the link that carries it [m]
FARTHEST_M = 1000.0
#: distortion models of sensor_msgs/CameraInfo and how many coefficients OpenCV reads for each
DISTORTION_MODELS = {
    'none': (0,),
    'plumb_bob': (4, 5),
    'rational_polynomial': (8, 12, 14),
    'equidistant': (4,),
}


def freeze_array(
    owner: Any,
    field: str,
    shape: tuple[int | None, ...],
    dtype: type,
    error: type[MtvWorldError] = MtvWorldError,
) -> None:
    """Cast an array field of a frozen dataclass, check its shape and make it read-only.

    Args:
        owner: the instance, in its `__post_init__`.
        field: name of the field.
        shape: expected shape; None = any length.
        dtype: type of the numbers.
        error: raised where the field is no such array.
    """
    given = getattr(owner, field)
    try:
        array = np.asarray(given, dtype=dtype)
    except (TypeError, ValueError) as why:
        name = f'{type(owner).__name__}.{field}'
        raise error(f'{name} is {str(given)[:100]}, expected numbers: {why}') from why
    fits = array.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        wanted = tuple('any' if n is None else n for n in shape)
        raise error(f'{type(owner).__name__}.{field} has shape {array.shape}, expected {wanted}')
    view = array.view()
    view.flags.writeable = False
    object.__setattr__(owner, field, view)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraModel:
    """One calibrated view.

    Attributes:
        view: name of the view, e.g. `low`.
        width: image width [px].
        height: image height [px].
        K: (3, 3) intrinsic matrix [px].
        distortion_model: `none`, `plumb_bob`, `rational_polynomial` or `equidistant` (fisheye).
        distortion: coefficients in OpenCV order (k1 k2 p1 p2 k3 ..., equidistant k1 k2 k3 k4);
            empty for `none`.
        mount_link: robot link that carries the camera; the base link for a fixed camera.
        T_mount_camera: (4, 4) pose of the optical frame (x right, y down, z ahead) [m].
        error_px: standard error of where a point is drawn, in x and in y, as the calibration
            states it [px]; None = it states none.
    """

    view: str
    width: int
    height: int
    K: FloatArray
    distortion_model: str = 'none'
    distortion: FloatArray = ()  # type: ignore[assignment]
    mount_link: str
    T_mount_camera: FloatArray
    error_px: float | None = None

    def __post_init__(self) -> None:
        freeze_array(self, 'K', (3, 3), np.float64, CalibrationError)
        freeze_array(self, 'T_mount_camera', (4, 4), np.float64, CalibrationError)
        freeze_array(self, 'distortion', (None,), np.float64, CalibrationError)
        if self.width < 1 or self.height < 1:
            raise CalibrationError(
                f"camera '{self.view}' has size {self.width}x{self.height}; both must be positive"
            )
        if self.distortion_model not in DISTORTION_MODELS:
            raise CalibrationError(
                f"camera '{self.view}' has distortion_model '{self.distortion_model}'; known are "
                f'{sorted(DISTORTION_MODELS)}'
            )
        if len(self.distortion) not in DISTORTION_MODELS[self.distortion_model]:
            raise CalibrationError(
                f"camera '{self.view}' has {len(self.distortion)} coefficients for "
                f"'{self.distortion_model}', expected one of "
                f'{DISTORTION_MODELS[self.distortion_model]}'
            )
        for name in ('T_mount_camera', 'distortion'):
            if not np.isfinite(getattr(self, name)).all():
                raise CalibrationError(
                    f"camera '{self.view}' has {name} {getattr(self, name).tolist()}; every value "
                    'must be finite'
                )
        if (np.abs(self.T_mount_camera[:3, 3]) > FARTHEST_M).any():
            raise CalibrationError(
                f"camera '{self.view}' is at {self.T_mount_camera[:3, 3].tolist()} m from "
                f"'{self.mount_link}'; no camera is further away than {FARTHEST_M:g} m"
            )
        if not (np.isfinite(self.K).all() and self.K[0, 0] > 0 and self.K[1, 1] > 0):
            raise CalibrationError(
                f"camera '{self.view}' is not calibrated: K = {self.K.tolist()}; fx and fy must "
                'be positive (set them in CameraInfo or the calibration file)'
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class JointTrajectory:
    """Joint positions over time.

    Attributes:
        joint_names: J names.
        times: (T,) increasing [s], relative to the trajectory's start.
        positions: (T, J) [rad or m].
        velocities: (T, J) [rad/s or m/s], or None where not given.
    """

    joint_names: tuple[str, ...]
    times: FloatArray
    positions: FloatArray
    velocities: FloatArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, 'joint_names', tuple(self.joint_names))
        num_joints = len(self.joint_names)
        freeze_array(self, 'times', (None,), np.float64, TrajectoryError)
        num_points = len(self.times)
        freeze_array(self, 'positions', (num_points, num_joints), np.float64, TrajectoryError)
        if self.velocities is not None:
            freeze_array(self, 'velocities', (num_points, num_joints), np.float64, TrajectoryError)
        if num_points == 0:
            raise TrajectoryError('the trajectory is empty: it needs at least one point')
        if not np.isfinite(self.times).all() or (np.diff(self.times) <= 0).any():
            bad = int(np.argmax(np.diff(self.times) <= 0)) + 1 if num_points > 1 else 0
            raise TrajectoryError(
                f'time_from_start is not increasing at point {bad}: '
                f'{self.times[max(bad - 1, 0) : bad + 1].tolist()} s'
            )
        if not np.isfinite(self.positions).all():
            point, joint = np.argwhere(~np.isfinite(self.positions))[0]
            raise TrajectoryError(
                f"joint '{self.joint_names[joint]}' is not finite at point {point}"
            )

    def points(self, rows: np.ndarray, times: FloatArray) -> JointTrajectory:
        """Return some of the points (`rows` numbers or marks them), at other times (T,) [s]."""
        return replace(
            self,
            times=times[rows],
            positions=self.positions[rows],
            velocities=None if self.velocities is None else self.velocities[rows],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """Camera frames and joint positions at one instant.

    Attributes:
        cameras: calibrated cameras of the V views, in the model's order, for the size of `frames`.
        frames: (V, H, W, 3) uint8 RGB.
        positions: (J,) positions in the robot's joint order [rad or m].
        stamp_ns: time of the frames [ns].
        place: name of the robot cell, see `EpisodeInfo.place`; empty = not stated.
    """

    cameras: tuple[CameraModel, ...]
    frames: ByteArray
    positions: FloatArray
    stamp_ns: int
    place: str = ''

    def __post_init__(self) -> None:
        object.__setattr__(self, 'cameras', tuple(self.cameras))
        freeze_array(
            self, 'frames', (len(self.cameras), None, None, 3), np.uint8, ObservationError
        )
        freeze_array(self, 'positions', (None,), np.float64, ObservationError)
        height, width = self.frames.shape[1:3]
        for camera in self.cameras:
            if (camera.width, camera.height) != (width, height):
                raise ObservationError(
                    f"view '{camera.view}' has frames of {width}x{height} but a camera model of "
                    f'{camera.width}x{camera.height}'
                )

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views, in order."""
        return tuple(camera.view for camera in self.cameras)


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """The frames of a rollout before the frame that its next chunk starts from.

    Attributes:
        anchor: (V, H, W, 3) uint8 RGB, the first frame of the rollout: the observed one.
        frames: (V, N, H, W, 3) uint8 RGB, the last frames before the chunk's start frame, oldest
            first, on the model's clock; N = 0 at the first chunk.
    """

    anchor: ByteArray
    frames: ByteArray

    def __post_init__(self) -> None:
        views, *image = self.anchor.shape
        if self.frames.ndim != 5 or (views, *image) != (len(self.frames), *self.frames.shape[2:]):
            raise ObservationError(
                f'a history has an anchor of shape {self.anchor.shape} and frames of shape '
                f'{self.frames.shape}; expected (V, H, W, 3) and (V, N, H, W, 3)'
            )

    @staticmethod
    def begin(start_frame: ByteArray) -> History:
        """Return the empty history of a rollout that begins at a frame (V, H, W, 3)."""
        return History(anchor=start_frame, frames=start_frame[:, None][:, :0])

    def after(self, start_frame: ByteArray, predicted: ByteArray, num_kept: int) -> History:
        """Return the history of the next chunk, which starts from the last predicted frame.

        Args:
            start_frame: (V, H, W, 3) frame that the chunk started from.
            predicted: (V, T, H, W, 3) frames of the chunk.
            num_kept: most frames to keep.
        """
        newest = predicted[:, max(predicted.shape[1] - 1 - num_kept, 0) : -1]
        frames = np.concatenate([self.frames, start_frame[:, None], newest], axis=1)
        return History(anchor=self.anchor, frames=frames[:, max(frames.shape[1] - num_kept, 0) :])

    def filled(self, num_frames: int) -> ByteArray:
        """Return (V, num_frames, H, W, 3) frames; where there are fewer, the oldest is repeated.

        A rollout has fewer than N frames until its N-th predicted one, but a causal autoencoder
        needs N. Zeros if there are no frames.
        """
        count = self.frames.shape[1]
        if not count:
            return np.zeros_like(self.anchor[:, None]).repeat(num_frames, axis=1)
        return self.frames[:, [max(count - num_frames + k, 0) for k in range(num_frames)]]


@dataclass(frozen=True, slots=True, kw_only=True)
class MultiViewVideo:
    """Observed, trajectory or predicted frames of all views on one clock.

    Attributes:
        views: names of the V views.
        times: (T,) [s], relative to the observation the video belongs to.
        frames: (V, T, H, W, 3) uint8 RGB.
    """

    views: tuple[str, ...]
    times: FloatArray
    frames: ByteArray

    def __post_init__(self) -> None:
        object.__setattr__(self, 'views', tuple(self.views))
        freeze_array(self, 'times', (None,), np.float64)
        freeze_array(self, 'frames', (len(self.views), len(self.times), None, None, 3), np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectMasks:
    """Masks of named objects in a video.

    Attributes:
        names: names of the O objects.
        masks: (V, O, T, H, W) bool.
        status: V tuples of O words: `ok`, or why the mask is not to be trusted: never seen
            (`absent`), seen and then missing (`lost`; `out_of_view` from the image's edge on),
            seen as a sliver (`barely_visible`), one of several or of no known colour
            (`ambiguous`, `out_of_palette`), found without certainty (`low_confidence`), jumps
            (`area_jump`, `teleport`), a frame that the simulator's masks do not cover
            (`not_recorded`).
    """

    names: tuple[str, ...]
    masks: BoolArray
    status: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, 'names', tuple(self.names))
        object.__setattr__(self, 'status', tuple(tuple(row) for row in self.status))
        freeze_array(
            self, 'masks', (len(self.status), len(self.names), None, None, None), np.bool_
        )
        if any(len(row) != len(self.names) for row in self.status):
            raise MtvWorldError(f'status has rows of other length than {len(self.names)} objects')

    def last(self) -> ObjectMasks:
        """Return the masks of the last frame (T = 1)."""
        return ObjectMasks(names=self.names, masks=self.masks[:, :, -1:], status=self.status)

    def filled_from(self, other: ObjectMasks) -> ObjectMasks:
        """Return the masks; missing ones are filled from other masks that are trusted.

        Args:
            other: masks of the same names and shape.
        """
        ok = np.array([[word == 'ok' for word in row] for row in other.status], np.bool_)
        ok = ok.reshape(self.masks.shape[:2])
        missing = ok & other.masks.any((-3, -2, -1)) & ~self.masks.any((-3, -2, -1))
        if not missing.any():
            return self
        pairs = zip(self.status, missing.tolist(), strict=True)
        return ObjectMasks(
            names=self.names,
            masks=np.where(missing[..., None, None, None], other.masks, self.masks),
            status=tuple(
                tuple('ok' if lacks else word for word, lacks in zip(row, view, strict=True))
                for row, view in pairs
            ),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FutureEvidence:
    """Outcomes of a task in simulated futures, and the estimate that rests on them alone.

    Attributes:
        outcomes: outcome in each of K futures; None = the future was lost.
        probability: probability of success without imagined frames, in [0, 1].
        interval: 95 % interval (low, high) of the probability.
        is_fitted: contact parameters were fitted in this robot cell; False = futures are drawn
            from the prior.
        share: share of the futures that succeed, by their weights; NaN = not known.
    """

    outcomes: tuple[bool | None, ...]
    probability: float
    interval: tuple[float, float]
    is_fitted: bool
    share: float = np.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class SuccessEstimate:
    """Probability that the task succeeds, given the world model.

    Attributes:
        probability: probability in [0, 1]; NaN = abstains.
        interval: (low, high); NaN where it abstains.
        jaccard: (V, O) Jaccard index, NaN where absent.
        reasons: grounds of the estimate, or why it abstains; one of them is `trust`.
        features: inputs of the calibration by name; empty where the estimate abstains.
        is_calibrated: whether the probability is a fitted one.
        num_seeds: rollouts that it is the mean of.
        spread: standard deviation of their probabilities; NaN for one.
        futures: evidence of simulated futures; None = no motion was simulated.
    """

    probability: float
    interval: tuple[float, float]
    jaccard: FloatArray
    reasons: tuple[str, ...]
    features: Mapping[str, float] = field(default_factory=dict)
    is_calibrated: bool = False
    num_seeds: int = 1
    spread: float = np.nan
    futures: FutureEvidence | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, 'reasons', tuple(self.reasons))
        object.__setattr__(self, 'features', MappingProxyType(dict(self.features)))
        freeze_array(self, 'jaccard', (None, None), np.float64)

    @property
    def trust(self) -> str:
        """One sentence on the trust in the estimate.

        It begins with `fitted here`, `not fitted here` or `cannot tell, because`.
        """
        return trust_of(self.reasons)


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldModelSpec:
    """Input and output of a world model: views, size, frame rate, length of a chunk.

    Attributes:
        views: names of the V views, in order.
        fps: predicted frames a second [Hz].
        num_frames: T, predicted frames a chunk (the observed frame comes on top).
        width: frame width [px].
        height: frame height [px].
        robot: name of the robot it was trained with.
        num_inference_steps: denoising steps it is made for.
        num_history: most frames before the start frame that it makes use of.
    """

    views: tuple[str, ...]
    fps: float
    num_frames: int
    width: int
    height: int
    robot: str
    num_inference_steps: int = 4
    num_history: int = 0

    @property
    def chunk_seconds(self) -> float:
        """Duration of a chunk [s]."""
        return self.num_frames / self.fps
