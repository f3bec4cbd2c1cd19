"""The newest images, camera infos and joint states, and the observation they make up.

The first CameraInfo of a view holds until a reset; a change is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from math import prod, sqrt
from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState

from mtv_world_ros.cameras.camera import scaled
from mtv_world_ros.cameras.camera_info import Intrinsics as InfoIntrinsics
from mtv_world_ros.cameras.camera_info import read_camera_info
from mtv_world_ros.cameras.image_window import window_of, windowed_camera
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray, Observation
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.data.bag.image_orientation import stored_note
from mtv_world_ros.data.gripper_sources import GripperWatch, travels
from mtv_world_ros.data.measured_joints import JointReach, ReachWatch
from mtv_world_ros.data.transform_tree import Mount
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.ros.messages import image_messages
from mtv_world_ros.ros.messages.conversions import check_sample, NANO, to_ns, to_sample, to_stamp
from mtv_world_ros.ros.messages.rejection import Reason, rejected_as, Rejection
from mtv_world_ros.ros.parameters import ObservationSettings
from mtv_world_ros.ros.sensing.samples import NodeTime, Samples

AnyImage = Image | CompressedImage
#: images kept a view, so that views that arrive one after the other, or lose some, find partners
_NUM_IMAGES = 8
#: joint samples kept a joint; at 1 kHz this reaches back a quarter of a second
_NUM_SAMPLES = 256
#: more pixels tell no more about where objects are, and take time
_MOST_PIXELS = 640 * 480
#: images whose sides are below this fraction of the model's frame show no objects
_LEAST_SIDE_FRACTION = 0.5
_AGE_LIMITS = {
    Reason.IMAGE_STALE: 'max_image_age_s',
    Reason.JOINT_STATE_STALE: 'max_joint_state_age_s',
}


_INFO_FIELDS = tuple(CameraInfo.get_fields_and_field_types())
#: fields whose change makes another camera of it
_COMPARED = ('width', 'height', 'distortion_model', 'k', 'd', 'p', 'binning_x', 'binning_y')


@dataclass(frozen=True, slots=True, kw_only=True)
class SensedScene:
    """Observation with its CameraInfo messages and stamp.

    Attributes:
        observation: frames and cameras at the model's size, positions in the robot's order.
        camera_infos: CameraInfo of each view's images as received, with their frame_id.
        source_stamp_ns: stamp of the real frames that it is derived from [ns].
    """

    observation: Observation
    camera_infos: tuple[CameraInfo, ...]
    source_stamp_ns: int


class ObservationBuffer:
    """Buffer of the newest messages, from which observations are made.

    Args:
        cameras: calibrated cameras of the V views, in the model's order.
        robot: names the J joints, and limits how far they move between two samples.
        width: width of the model's frames [px]. Observations are of the images' own size, which
            shows better where objects are, but for very large ones that are larger than these.
        height: height of the model's frames [px].
        limits: asked at every observation, so that they may change.
        on_image: also gets every image that is stored.
        pose: asked with view, frame and stamp [ns] of an image for what carries the camera; None
            = the calibrated pose.
        time: time of the node; None = samples are not compared with a clock when they arrive.

    Attributes:
        image_hint: returns for a view of which no image came, or none came lately, where its
            images may be; empty = it is not known.
    """

    def __init__(
        self,
        *,
        cameras: Sequence[CameraModel],
        robot: RobotModel,
        width: int,
        height: int,
        limits: Callable[[], ObservationSettings],
        on_image: Callable[[str, AnyImage], None] | None = None,
        pose: Callable[[str, str, int], Mount | None] | None = None,
        time: NodeTime | None = None,
    ) -> None:
        self.image_hint: Callable[[str], str] = lambda view: ''
        self._intrinsics = Intrinsics(cameras, lambda: bool(limits().calibration_file))
        self._pose = pose
        self._size = (width, height)
        self._limits, self._on_image, self._time = limits, on_image, time
        self._images: dict[str, Samples[AnyImage]] = {
            camera.view: Samples(_NUM_IMAGES) for camera in cameras
        }
        self._reach = ReachWatch(JointReach(robot))
        self._grippers = GripperWatch(travels(robot))
        #: frame of the images of each view, as they came first
        self._frames: dict[str, str] = {}
        #: note on the EXIF orientation of the images of each view
        self._turns: dict[str, str] = {}
        #: note on the messages without a stamp, by what they are
        self._unstamped: dict[str, str] = {}
        self._joints: dict[str, Samples[float]] = {
            name: Samples(_NUM_SAMPLES) for name in robot.joint_names
        }

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views, in the model's order."""
        return tuple(self._images)

    @property
    def newest_stamp_ns(self) -> int:
        """The newest moment that every view has seen [ns]; 0 = none yet."""
        return min(images.newest[0] if images else 0 for images in self._images.values())

    @property
    def awaits_first(self) -> bool:
        """True if no image of a view, or no state of a joint, was ever received."""
        samples = (*self._images.values(), *self._joints.values())
        return any(not one and not one.refusal for one in samples)

    def add_image(self, view: str, message: AnyImage) -> None:
        """Store an image.

        Raises:
            Rejection: the image cannot be read, comes from the future, or is stale while a newer
                one is not.
        """
        image_messages.check(message)
        self._stamp(f"images of view '{view}'", message)
        images, stamp_ns = self._images[view], to_ns(message.header.stamp)
        limit_s = self._limits().max_image_age_s
        what = f"an image of view '{view}'"
        images.refusal = _refusal(images, what, stamp_ns, self._now_ns(), limit_s)
        if images.refusal:
            raise Rejection(Reason.IMAGE_STALE, images.refusal)
        if view not in self._turns and isinstance(message, CompressedImage):
            self._turns[view] = stored_note(bytes(message.data))
        images.add(stamp_ns, message)
        if self._on_image is not None:
            self._on_image(view, message)

    def _stamp(self, what: str, message: AnyImage | JointState) -> None:
        """Stamp a message that has none with the time of receipt, as recordings are read."""
        now_ns = self._now_ns()
        if now_ns and not to_ns(message.header.stamp):
            message.header.stamp = to_stamp(now_ns)
            self._unstamped.setdefault(what, f'{what} have no stamp: the time of receipt is taken')

    def _now_ns(self) -> int:
        """Return the node's time [ns]; 0 = there is none."""
        return self._time.now_ns() if self._time is not None else 0

    def add_camera_info(
        self, view: str, message: CameraInfo, *, is_rectified: bool = False
    ) -> None:
        """Store the first CameraInfo of a view and watches the later ones.

        Args:
            view: name of the view.
            message: CameraInfo of the view.
            is_rectified: whether the view's images are; their intrinsics are P.

        Raises:
            Rejection: the view is not calibrated, or its calibration just changed.
        """
        self._intrinsics.add(view, message, is_rectified=is_rectified)

    def add_joint_state(self, message: JointState) -> None:
        """Store positions; several publishers may each give some of the joints.

        A joint without a position that can be used does not take the others with it, and joints
        that are not the robot's do not matter.

        Raises:
            Rejection: no positions, not one a name, a joint of the robot has none or jumps, or the
                message comes from the future, or is stale while newer states are not.
        """
        self._stamp('joint states', message)
        stamp_ns, now_ns = to_ns(message.header.stamp), self._now_ns()
        limit_s = self._limits().max_joint_state_age_s
        sample = to_sample(message, self._joints.keys())
        faults = dict(sample.faults)
        stale = ''
        for name, position in sample.positions.items():
            joint = self._joints[name]
            what = f"a state of joint '{name}'"
            joint.refusal = _refusal(joint, what, stamp_ns, now_ns, limit_s)
            stale = stale or joint.refusal
            if joint.refusal:
                continue
            self._grippers.add(name, stamp_ns / NANO, position)
            jump = self._reach.add(name, stamp_ns, position)
            if jump:
                faults[name] = jump
            else:
                joint.add(stamp_ns, position)
        for name, fault in faults.items():
            self._joints[name].refusal = fault
        check_sample(sample._replace(faults=faults))
        if stale:
            raise Rejection(Reason.JOINT_STATE_STALE, stale)

    def use_robot(self, robot: RobotModel) -> None:
        """Use the limits of the robot's own description."""
        self._reach = ReachWatch(JointReach(robot))
        self._grippers = GripperWatch(travels(robot))

    def clear(self) -> None:
        """Forget images and joint states (the clock jumped); camera infos stay."""
        for samples in (*self._images.values(), *self._joints.values()):
            samples.clear()
        self._reach.clear()
        self._grippers.clear()
        self._frames.clear()
        self._turns.clear()
        self._unstamped.clear()

    def accept_cameras(self, cameras: Sequence[CameraModel]) -> None:
        """Accept changed camera infos as valid.

        Args:
            cameras: calibrated cameras of the V views.

        Raises:
            Rejection: a new one is not calibrated.
        """
        self._intrinsics.accept(cameras)
        self._frames.clear()

    def ages(self, now_ns: int) -> Mapping[str, float]:
        """Return the age [s] of the newest image of each view and of the oldest joint.

        NaN = none yet.
        """
        ages = {
            f'image_age_s.{view}': _age(images, now_ns) for view, images in self._images.items()
        }
        ages['joint_state_age_s'] = float(
            np.max([_age(samples, now_ns) for samples in self._joints.values()])
        )
        return ages

    @property
    def notes(self) -> list[str]:
        """Assumptions about images and joint states that the messages do not settle, as text."""
        turns = [f"view '{view}': {note}" for view, note in self._turns.items() if note]
        cameras = [note for note in self._intrinsics.notes.values() if note]
        return [*turns, *cameras, *self._unstamped.values()]

    def problems(self, now_ns: int) -> list[str]:
        """Return what is missing or too old for an observation, as text."""
        limits, missing = self._limits(), []
        for view, images in self._images.items():
            missing += _freshness(
                f"images of view '{view}'", images, now_ns, limits.max_image_age_s
            )
            missing += self._intrinsics.missing(view)
        old = {
            name: _freshness('', samples, now_ns, limits.max_joint_state_age_s)
            for name, samples in self._joints.items()
        }
        names = [name for name, text in old.items() if text]
        if names:
            missing.append(f'no fresh joint_states of {", ".join(names)}')
        if contradiction := self._contradiction():
            missing.append(contradiction)
        return missing

    def _contradiction(self) -> str:
        """Return which joints are reported at two places in turn, or an empty text."""
        return self._reach.contradiction() or self._grippers.contradiction()

    def observe(self, now_ns: int) -> SensedScene:
        """Make an observation of the newest images that belong together.

        Raises:
            Rejection: something is missing, stale, out of sync or changed.
        """
        limits = self._limits()
        images = self._pick_images(now_ns, limits)
        self._check_frames([message.header.frame_id for _, message in images])
        stamp_ns = min(stamp for stamp, _ in images)
        shown = [image_messages.to_rgb(message) for _, message in images]
        self._check_sizes(shown)
        size = _common_size(shown, self._size)
        cameras, frames, infos = [], [], []
        for view, (_, message), frame in zip(self.views, images, shown, strict=True):
            camera = self._intrinsics.camera(view, width=frame.shape[1], height=frame.shape[0])
            info = self._intrinsics.info(view, message.header.frame_id)
            infos.append(image_messages.windowed_camera_info(info, camera))
            cameras.append(scaled(self._posed(camera, message), *size))
            frames.append(resize_frames(frame[None], *size)[0])
        observation = Observation(
            cameras=tuple(cameras),
            frames=np.stack(frames),
            positions=self._positions(stamp_ns, now_ns, limits),
            stamp_ns=stamp_ns,
            place=limits.place,
        )
        return SensedScene(
            observation=observation, camera_infos=tuple(infos), source_stamp_ns=stamp_ns
        )

    def _check_sizes(self, frames: Sequence[ByteArray]) -> None:
        """Refuse images that are too small to show objects."""
        least = [round(_LEAST_SIDE_FRACTION * side) for side in self._size]
        for view, frame in zip(self.views, frames, strict=True):
            height, width = frame.shape[:2]
            if width < least[0] or height < least[1]:
                raise Rejection(
                    Reason.IMAGE_DATA,
                    f"images of view '{view}' have {width}x{height} pixels; the model needs at "
                    f'least {least[0]}x{least[1]}',
                )

    def _check_frames(self, frames: Sequence[str]) -> None:
        """Refuse images that come from another camera than those before, as after a swap."""
        for view, frame in zip(self.views, frames, strict=True):
            before = self._frames.setdefault(view, frame)
            if frame != before:
                raise Rejection(
                    Reason.CAMERA_POSE_CHANGED,
                    f"images of view '{view}' are in the frame '{frame}' now, before in "
                    f"'{before}': was another camera connected? call ~/reset to accept it",
                )

    def _posed(self, camera: CameraModel, image: AnyImage) -> CameraModel:
        """Return the camera with its pose at the image's time."""
        if self._pose is None:
            return camera
        frame = self._intrinsics.info(camera.view, image.header.frame_id).header.frame_id
        mount = self._pose(camera.view, frame, to_ns(image.header.stamp))
        if mount is None:
            return camera
        return replace(camera, mount_link=mount.link, T_mount_camera=mount.T_link_frame)

    def _why(self, view: str) -> str:
        """Return why no image of a view may have come."""
        return self.image_hint(view) or (
            f"is its camera running, and does the parameter 'camera_topics.{view}' name it?"
        )

    def _pick_images(self, now_ns: int, limits: ObservationSettings) -> list[tuple[int, AnyImage]]:
        """Return per view the image nearest to the newest moment that every view has seen.

        Where these are too far apart, because images were lost, the newest ones that are not.
        """
        for view, images in self._images.items():
            if not images:
                raise Rejection(
                    Reason.IMAGE_STALE if images.refusal else Reason.IMAGE_MISSING,
                    images.refusal or f"no image of view '{view}' was received; {self._why(view)}",
                )
        newest = {view: images.newest[0] for view, images in self._images.items()}
        for view, stamp in newest.items():
            what = f"the newest image of view '{view}'"
            hint = partial(self.image_hint, view)
            _check_age(Reason.IMAGE_STALE, what, stamp, now_ns, limits.max_image_age_s, hint=hint)
        picked = self._picked(now_ns, limits)
        stamps = [stamp for stamp, _ in picked]
        skew = _skew_s(picked)
        if skew > limits.max_view_skew_s:
            apart = ', '.join(
                f'{view} {(stamp - min(stamps)) / NANO:.3f} s'
                for view, stamp in zip(self.views, stamps, strict=True)
            )
            raise Rejection(
                Reason.VIEWS_OUT_OF_SYNC,
                f'the views are {skew:.3f} s apart ({apart} after the oldest); '
                f"'max_view_skew_s' allows {limits.max_view_skew_s:g} s",
            )
        return picked

    def are_views_apart(self, now_ns: int) -> bool:
        """Return True if all views have fresh images, but no set of one moment exists."""
        limits = self._limits()
        if not all(self._images.values()):
            return False
        fresh_ns = now_ns - round(limits.max_image_age_s * NANO)
        if min(images.newest[0] for images in self._images.values()) < fresh_ns:
            return False
        return _skew_s(self._picked(now_ns, limits)) > limits.max_view_skew_s

    def _picked(self, now_ns: int, limits: ObservationSettings) -> list[tuple[int, AnyImage]]:
        """Return per view the image of the newest moment at which the views are together.

        Where all views have images of one stamp, as those of synchronised cameras, these are
        taken, unless others that belong together are newer by more than the skew that is allowed.
        """
        common = min(images.newest[0] for images in self._images.values())
        earliest_ns = now_ns - round(limits.max_image_age_s * NANO)
        moments = {stamp for images in self._images.values() for stamp in images.stamps}
        earlier = sorted((m for m in moments if earliest_ns <= m < common), reverse=True)
        shared = set.intersection(*(set(images.stamps) for images in self._images.values()))
        oldest_ns = max(earliest_ns, common - round(limits.max_view_skew_s * NANO))
        same = sorted((m for m in shared if oldest_ns <= m <= common), reverse=True)[:1]
        choices = [
            [images.nearest(moment) for images in self._images.values()]
            for moment in (*same, common, *earlier)
        ]
        return next((c for c in choices if _skew_s(c) <= limits.max_view_skew_s), choices[0])

    def _positions(self, stamp_ns: int, now_ns: int, limits: ObservationSettings) -> FloatArray:
        """Return (J,) positions nearest in time to the images."""
        missing = [name for name, samples in self._joints.items() if not samples]
        if missing:
            why = next((w for name in missing if (w := self._joints[name].refusal)), '')
            raise Rejection(
                Reason.JOINT_STATE_MISSING,
                f'no joint state of {missing} was received{_because(why)}',
            )
        if contradiction := self._contradiction():
            raise Rejection(Reason.JOINT_STATE_INVALID, contradiction)
        for name, samples in self._joints.items():
            what, limit = f"the newest state of joint '{name}'", limits.max_joint_state_age_s
            stamp = samples.newest[0]
            _check_age(Reason.JOINT_STATE_STALE, what, stamp, now_ns, limit, samples.refusal)
        return np.array([samples.nearest(stamp_ns)[1] for samples in self._joints.values()])


def _refusal(samples: Samples[Any], what: str, stamp_ns: int, now_ns: int, limit_s: float) -> str:
    """Return why a sample is rejected by its stamp; empty if it is taken."""
    why = samples.refuse_reason(stamp_ns, now_ns, limit_s) if now_ns else ''
    return f'{what} {why}; do the clocks of its sender and this node agree?' if why else ''


def _because(refusal: str) -> str:
    """Return the reason why newer samples were refused, to be appended to a text."""
    return f'; the last one was refused: {refusal}' if refusal else ''


def _skew_s(images: Sequence[tuple[int, AnyImage]]) -> float:
    """Time between the oldest and the newest image [s]."""
    stamps = [stamp for stamp, _ in images]
    return (max(stamps) - min(stamps)) / NANO


def _common_size(frames: Sequence[ByteArray], least: tuple[int, int]) -> tuple[int, int]:
    """Return the width and height of the largest frame, shrunk to at most `_MOST_PIXELS`."""
    height, width = max((frame.shape[:2] for frame in frames), key=prod)
    shrink = min(1.0, sqrt(max(_MOST_PIXELS, prod(least)) / (width * height)))
    return max(round(shrink * width), 1), max(round(shrink * height), 1)


class Intrinsics:
    """Camera intrinsics from the received CameraInfo messages.

    Attributes:
        notes: assumptions about images that CameraInfo does not settle, by view.

    Args:
        cameras: calibrated cameras of the V views; their poses are used.
        is_given: asked whether their intrinsics are those of the views' cameras (of a calibration
            file that the user named), so that they stand in for a CameraInfo that is not
            calibrated.
    """

    def __init__(
        self, cameras: Sequence[CameraModel], is_given: Callable[[], bool] = lambda: False
    ) -> None:
        self._calibrated = {camera.view: camera for camera in cameras}
        self._is_given = is_given
        self._rectified: set[str] = set()
        self._uncalibrated: set[str] = set()
        self._infos: dict[str, CameraInfo] = {}
        self._shown: dict[str, CameraInfo] = {}
        self._cameras: dict[str, CameraModel] = {}
        self._changed: dict[str, tuple[CameraInfo, str]] = {}
        self._sources: dict[str, str] = {}
        self.notes: dict[str, str] = {}

    def add(self, view: str, message: CameraInfo, *, is_rectified: bool = False) -> None:
        """Store the first info of a view and watches the later ones.

        An info that is not calibrated is the same as none.

        Raises:
            Rejection: the view is not calibrated, or its calibration just changed.
        """
        if is_rectified:
            self._rectified.add(view)
        found = self._read(view, message)
        if found is None:
            self._add_uncalibrated(view, message)
            return
        if view not in self._infos:
            self._take(view, message, found)
            return
        differences = _differences(self._infos[view], message)
        if not differences:
            self._changed.pop(view, None)
            return
        is_news = view not in self._changed
        text = f"camera_info of view '{view}' changed: {differences}; call ~/reset to accept it"
        self._changed[view] = (message, text)
        if is_news:
            raise Rejection(Reason.CAMERA_INFO_CHANGED, text)

    def accept(self, cameras: Sequence[CameraModel]) -> None:
        """Accept changed camera infos as valid.

        Args:
            cameras: calibrated cameras of the views. Where they are others than before, the
                infos belong to those: the next ones are awaited.

        Raises:
            Rejection: a new one is not calibrated.
        """
        if not _are_equal(self._calibrated.values(), cameras):
            self._calibrated = {camera.view: camera for camera in cameras}
            for stored in (
                self._infos, self._shown, self._cameras, self._changed, self._uncalibrated,
                self._sources,
            ):  # fmt: skip
                stored.clear()
        for view, (message, _) in list(self._changed.items()):
            found = self._read(view, message)
            if found is not None:
                self._take(view, message, found)
            del self._changed[view]

    def camera(self, view: str, *, width: int, height: int) -> CameraModel:
        """Return the view's camera, for images of this size.

        Raises:
            Rejection: its info is missing, changed, or for another size.
        """
        if view not in self._infos:
            if view in self._uncalibrated:
                raise Rejection(Reason.CAMERA_INFO_INVALID, self._not_calibrated(view))
            raise Rejection(
                Reason.CAMERA_INFO_MISSING,
                f"no camera_info of view '{view}' was received; publish it beside the images",
            )
        if view in self._changed:
            raise Rejection(Reason.CAMERA_INFO_CHANGED, self._changed[view][1])
        with rejected_as(Reason.CAMERA_INFO_INVALID):
            if view not in self._cameras:
                self._size(view, width, height)
            window = window_of(self._shown[view])
            camera, note = windowed_camera(self._cameras[view], width, height, window)
        self.notes[view] = '; '.join(filter(None, (self._sources.get(view, ''), note)))
        return camera

    def has(self, view: str) -> bool:
        """Return whether a usable CameraInfo of the view was received."""
        return view in self._infos

    def missing(self, view: str) -> list[str]:
        """Return what is missing of the view's info, as text."""
        if self.has(view):
            return []
        if view in self._uncalibrated:
            return [self._not_calibrated(view)]
        return [f"no camera_info of view '{view}'"]

    def info(self, view: str, frame_id: str) -> CameraInfo:
        """Return the view's info, with the image's frame where the image names one."""
        info = self._shown[view]
        if frame_id in ('', info.header.frame_id):
            return info
        return _copied(info, header=type(info.header)(stamp=info.header.stamp, frame_id=frame_id))

    def _read(self, view: str, message: CameraInfo) -> InfoIntrinsics | None:
        with rejected_as(Reason.CAMERA_INFO_INVALID):
            return read_camera_info(view, message, is_rectified=view in self._rectified)

    def _take(self, view: str, message: CameraInfo, found: InfoIntrinsics) -> None:
        self._cameras.pop(view, None)
        if found.width and found.height:  # else that of the images
            with rejected_as(Reason.CAMERA_INFO_INVALID):
                self._cameras[view] = found.camera(self._calibrated[view])
        self._infos[view] = self._shown[view] = message
        self._sources.pop(view, None)
        self._uncalibrated.discard(view)

    def _size(self, view: str, width: int, height: int) -> None:
        """Set the size of the images where the info has none."""
        message = self._infos[view]
        found = self._read(view, message)
        assert found is not None
        self._cameras[view] = found.sized(width, height).camera(self._calibrated[view])
        self._shown[view] = _copied(message, width=width, height=height)
        self._sources[view] = (
            f"view '{view}': its camera_info has no size: taken as that of the images, "
            f'{width}x{height}'
        )

    def _add_uncalibrated(self, view: str, message: CameraInfo) -> None:
        """Take the calibration file's intrinsics in place of an info without any.

        Raises:
            Rejection: there is no such file; at the first of these infos.
        """
        if view in self._infos:
            return
        if self._is_given():
            camera = self._calibrated[view]
            self._cameras[view] = camera
            self._infos[view] = message
            self._shown[view] = image_messages.info_of_camera(camera, message.header)
            self._sources[view] = (
                f"view '{view}': its camera_info is not calibrated: the intrinsics of "
                "'calibration_file' are used"
            )
        elif view not in self._uncalibrated:
            self._uncalibrated.add(view)
            raise Rejection(Reason.CAMERA_INFO_INVALID, self._not_calibrated(view))

    def _not_calibrated(self, view: str) -> str:
        field = 'P' if view in self._rectified else 'K'
        return (
            f"camera_info of view '{view}' is not calibrated ({field}[0] = 0), which is the same "
            "as none: calibrate the camera, or give its intrinsics in 'calibration_file'"
        )


def _copied(info: CameraInfo, **changes: object) -> CameraInfo:
    copied = CameraInfo(**{name: getattr(info, name) for name in _INFO_FIELDS})
    for name, value in changes.items():
        setattr(copied, name, value)
    return copied


def _age(samples: Samples[Any], now_ns: int) -> float:
    return (now_ns - samples.newest[0]) / NANO if samples else float('nan')


def _freshness(what: str, samples: Samples[Any], now_ns: int, limit: float) -> list[str]:
    if not samples:
        return [f'no {what}{_because(samples.refusal)}']
    age = _age(samples, now_ns)
    if abs(age) <= limit:
        return []
    return [f'{what} are {age:.1f} s old{_because(samples.refusal)}']


def _check_age(
    reason: Reason,
    what: str,
    stamp_ns: int,
    now_ns: int,
    limit: float,
    refusal: str = '',
    hint: Callable[[], str] = str,
) -> None:
    age = (now_ns - stamp_ns) / NANO
    if abs(age) <= limit:
        return
    when = f'{age:.3f} s old' if age > 0 else f'stamped {-age:.3f} s in the future'
    where = f'{found}; ' if (found := hint()) else ''
    raise Rejection(
        reason,
        f"{what} is {when}{_because(refusal)}; {where}'{_AGE_LIMITS[reason]}' allows {limit:g} s "
        "(for recorded data at its own time set 'use_sim_time' and play with a clock)",
    )


def _are_equal(before: Iterable[CameraModel], now: Iterable[CameraModel]) -> bool:
    def key(camera: CameraModel) -> tuple[object, ...]:
        values = (getattr(camera, field.name) for field in fields(camera))
        return tuple(v.tolist() if isinstance(v, np.ndarray) else v for v in values)

    return list(map(key, before)) == list(map(key, now))


def _differences(first: CameraInfo, later: CameraInfo) -> str:
    """Return the differences between two infos of one camera, as text; empty = none."""
    changes = []
    for field in _COMPARED:
        before, now = getattr(first, field), getattr(later, field)
        if not np.array_equal(before, now):
            changes.append(f'{field} from {_short(before)} to {_short(now)}')
    if not changes and window_of(first) != window_of(later):
        changes.append(f'{window_of(first)} to {window_of(later)}')
    return ', '.join(changes)


def _short(value: object) -> str:
    if isinstance(value, (str, int)):
        return str(value)
    return '[' + ' '.join(f'{x:g}' for x in value) + ']'  # type: ignore[attr-defined]
