"""Inspects a recording: all checks of all views, with overlay pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from mtv_world_ros.cameras.camera import camera_poses, project
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.cameras.silhouettes import draw_silhouettes
from mtv_world_ros.control.trajectory_video import (
    arm_colour,
    render_trajectory_video,
    TrajectoryVideoConfig,
)
from mtv_world_ros.core.data_types import ByteArray, CameraModel, FloatArray, JointTrajectory
from mtv_world_ros.core.errors import EpisodeError, MtvWorldError
from mtv_world_ros.core.transforms import inverse
from mtv_world_ros.data.episode import Episode, Track
from mtv_world_ros.data.recording import stitch
from mtv_world_ros.inspection.clocks import (
    check_commands,
    check_joint_states,
    check_rate,
    check_skew,
    JointTrack,
)
from mtv_world_ros.inspection.image_checks import (
    check_frozen,
    check_lengths,
    Orientation,
    ORIENTATIONS,
    turned_back,
)
from mtv_world_ros.inspection.inspection_report import (
    broken,
    Finding,
    Inspection,
    not_checked,
    part_not_checked,
    Section,
    suspicious,
)
from mtv_world_ros.inspection.motion_residual import (
    measure_residual,
    MotionResidual,
    REACH,
    ResidualSearch,
    WHOLE_SEARCH,
)
from mtv_world_ros.inspection.places import keeps_place
from mtv_world_ros.inspection.stored_masks import check_masks
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.resample import match_joints
from mtv_world_ros.robot.shape import (
    arm_links,
    gripper_links,
    LinkShape,
    load_shape,
    moving_links,
    RobotShape,
)

#: why nothing is compared
_MOVES = (
    'calibration not checked against the images: the camera moves by itself, with the poses of /tf'
)
_UNKNOWN = '{0} not known: mtv-world fit camera FOLDER --view {1}'
Checked = tuple[dict[str, str], list[Finding]]
#: share of the frames in which at least one tool should be in the image
_LEAST_IN_IMAGE = 0.5
#: recorded joint states overshoot by this much [rad or m]
_LIMIT_TOLERANCE = 1e-3
#: distance of drawn robot and moving pixels above which a view is suspicious [fraction of image
#: width]
_SUSPICIOUS_DISTANCE = 0.012
#: distance of drawn robot and moving pixels above which a view is broken [fraction of image width]
_BROKEN_DISTANCE = 0.03
#: factor on both distances for a robot of unknown shape, which is drawn as rods
_RODS_FACTOR = 6.0
#: correlation of drawn and seen motion below which they are unrelated
_MIN_MATCH = 0.12
#: relative gain of that correlation above which another camera position is reported
_BETTER_PLACE = 0.05
#: relative gain of that correlation above which another roll or focal length is reported
_BETTER_MATCH = 0.1
#: delay of the images against the joint states above which a view is suspicious [s]
_MAX_LAG_S = 0.1
#: relative gain of the correlation above which a delay is measured reliably
_LAG_GAIN = 0.03
#: relative gain of the correlation above which a delay of one frame is measured reliably
_LAG_GAIN_OF_A_FRAME = 0.1
#: what else may be wrong, and by how much more drawn and seen motion then correlate
_TURNED = (
    'the drawn robot moves like the image {}: the camera or its driver shows it so; switch that '
    'off, or calibrate these images'
)
_SWAPPED = "fingers move like those of '{}' with open and closed swapped"
_MIRRORED_GAIN = 0.02
#: factor on the best match by any other change of the camera, above which turned or mirrored
#: images are the one fault: other findings would follow from it
_TURNED_FACTOR = 1.3
#: match from which a view is not turned, and turns are not tried
_UPRIGHT_MATCH = 0.3
#: the same of what a gripper moves: on ten real recordings, two views each, right ones lost .073
#: to .229, and swapped ones gain as much
_SWAPPED_GAIN = 0.04
#: zeros of joints that are tried where all views are off [rad]
_ZEROS_RAD = (-0.25, -0.1, 0.1, 0.25)
#: relative gain of the summed correlation above which a joint's zero is named
_ZERO_GAIN = 0.15
#: settings of the comparison of zeros
_ZERO_SEARCH = ResidualSearch(max_pairs=8, lags_s=(0.0,), rolls_deg=(), zooms=())
_ALONE = ResidualSearch(lags_s=(0.0,), rolls_deg=(), zooms=())


class Inspector:
    """Inspector of the recordings of one robot.

    Args:
        robot: the robot.
        shape: shapes of the robot's links.
        search: search range of the residual.
    """

    def __init__(
        self, robot: RobotModel, shape: RobotShape, search: ResidualSearch = WHOLE_SEARCH
    ) -> None:
        self.robot, self.shape, self._search = robot, shape, search
        factor = 1.0 if shape.is_known else _RODS_FACTOR
        self._suspicious, self._broken = factor * _SUSPICIOUS_DISTANCE, factor * _BROKEN_DISTANCE

    def inspect(
        self, episode: Episode, progress: Callable[[Sequence[str]], Iterable[str]] = iter
    ) -> Inspection:
        """Check an episode that was read with its cameras.

        Args:
            episode: the recording.
            progress: wraps the views, e.g. in a progress bar.

        Raises:
            EpisodeError: the episode has no joint states.
            TrajectoryError: the joint states lack a joint of the robot.
        """
        states = episode.joint_states
        if states is None:
            raise EpisodeError(
                f"'{episode.info.path}' has no joint_states: nothing can be projected; record "
                'the topic joint_states too'
            )
        joints = JointTrack(states, self.robot)
        residuals = {
            view: self._residual(episode, view, joints)
            for view in progress(episode.views)
            if view not in (*episode.camera_tracks, *episode.unknown)
        }
        measured = {v: r for v, r in residuals.items() if isinstance(r, MotionResidual)}
        turned = {v: self._turned(episode, v, joints, r) for v, r in measured.items()}
        late = delays(
            {
                view: (found, episode.images[view])
                for view, found in measured.items()
                if not any(sure for _, sure in turned[view])
            }
        )
        return Inspection(
            episode=episode.info.path,
            robot=self.robot.name,
            views=tuple(
                self._view(
                    episode,
                    view,
                    joints,
                    residuals.get(view),
                    late.get(view, []),
                    turned.get(view, []),
                )
                for view in episode.views
            ),
            recording=self._recording(
                episode, joints, self._joint_zero(episode, joints, measured, turned)
            ),
        )

    def _joint_zero(
        self,
        episode: Episode,
        joints: JointTrack,
        measured: Mapping[str, MotionResidual],
        turned: Mapping[str, list[tuple[Finding, bool]]],
    ) -> list[Finding]:
        """Return the joint whose zero may be off, where all views are off alike.

        A wrong camera puts one view off; a wrong zero puts off all that see the arm.
        """
        views = {view: found for view, found in measured.items() if not found.reason}
        is_off = [bool(self._distance(r, episode.cameras[v])) for v, r in views.items()]
        if len(views) < 2 or not all(is_off) or any(turned.get(view) for view in views):
            return []

        def match(states: JointTrack) -> float:
            return sum(
                measure_residual(
                    episode.images[view], episode.cameras[view], self.robot, self.shape.parts,
                    states, _ZERO_SEARCH,
                ).match_here
                for view in views
            )  # fmt: skip

        here = match(joints)
        fits = {
            (joint, offset): match(joints.shifted(self.robot, joint, offset))
            for joint in self._zero_candidates(views.values())
            for offset in _ZEROS_RAD
        }
        joint, offset = max(fits, key=lambda key: np.nan_to_num(fits[key], nan=-1.0))
        best = fits[joint, offset]
        count = len(views)
        if not best > max(here * (1 + _ZERO_GAIN), count * _MIN_MATCH):
            return []
        text = (
            f"all {count} views are off alike, and fit better with the zero of joint '{joint}' "
            f'{offset:+g} rad from where it is (mean match {best / count:.2f}, as it is '
            f"{here / count:.2f}): check the joint's zero before the cameras"
        )
        return [suspicious(text)]

    def _zero_candidates(self, compared: Iterable[MotionResidual]) -> list[str]:
        """Return the joints that carry a compared link, without those of grippers."""
        links = {link for residual in compared for link in residual.links}
        model = self.robot.pinocchio_model
        above = {
            model.names[joint]
            for frame in model.frames
            if frame.name in links
            for joint in model.supports[frame.parentJoint]
        }
        grippers = {tool.gripper_joint for tool in self.robot.tools}
        return [name for name in self.robot.joint_names if name in above - grippers]

    def picture(self, episode: Episode, view: str) -> ByteArray:
        """Return the overlay picture of a view, (H, W, 3) RGB; bare where its pose is unknown."""
        assert episode.joint_states is not None
        joints = JointTrack(episode.joint_states, self.robot)
        drawn = view not in episode.unknown
        return overlay_picture(
            episode, view, self.robot, self.shape.parts, joints, with_robot=drawn
        )

    def _view(
        self,
        episode: Episode,
        view: str,
        joints: JointTrack,
        residual: MotionResidual | Finding | None,
        late: list[Finding],
        turned: list[tuple[Finding, bool]],
    ) -> Section:
        track, camera = episode.images[view], episode.cameras[view]
        measured: Checked
        notes: tuple[str, ...] = ()
        visibility = [
            check_visibility(
                camera,
                self.robot,
                joints.at(track.stamps_ns),
                episode.camera_tracks.get(view),
            )
        ]
        if view in episode.unknown:
            visibility, measured = (
                [],
                ({}, [not_checked(_UNKNOWN.format(episode.unknown[view], view))]),
            )
        elif residual is None:
            measured = {}, [not_checked(_MOVES)]
        else:
            measured, notes = self._measured(episode, view, joints, residual, turned)
        section = _section(
            view,
            [
                *visibility,
                measured,
                ({}, late),
                check_rate('frames', track.stamps_ns),
                check_frozen(track, joints),
                check_lengths(track.stamps_ns, joints),
                check_skew(view, episode.images),
                check_joint_states(track.stamps_ns, joints),
            ],
            notes,
        )
        return replace(section, numbers=_numbers(residual))

    def _measured(
        self,
        episode: Episode,
        view: str,
        joints: JointTrack,
        residual: MotionResidual | Finding,
        turned: list[tuple[Finding, bool]],
    ) -> tuple[Checked, tuple[str, ...]]:
        if isinstance(residual, Finding):
            return ({}, [residual]), ()
        measured, notes = self._judge(residual, episode.cameras[view])
        if sure := [finding for finding, is_sure in turned if is_sure]:
            return (measured[0], sure), notes  # what else seems wrong follows from it
        findings = [
            *(finding for finding, _ in turned),
            *measured[1],
            *self._alternatives(episode, view, joints, residual),
        ]
        return (measured[0], findings), notes

    def stands_still(self, episode: Episode, view: str) -> bool:
        """Return True if a view's camera is not on the arm and was not moved.

        A camera of unknown pose is judged by its images.
        """
        if view in episode.unknown:
            return keeps_place(episode.images[view])
        on_arm = episode.cameras[view].mount_link in moving_links(self.robot)
        return not on_arm and view not in episode.camera_tracks

    def _match(
        self, track: Track, camera: CameraModel, joints: JointTrack, parts: Sequence[LinkShape]
    ) -> float:
        """Return the correlation of drawn and seen motion where the robot is drawn."""
        return measure_residual(track, camera, self.robot, parts, joints, _ALONE).match_here

    def _turned(
        self, episode: Episode, view: str, joints: JointTrack, residual: MotionResidual
    ) -> list[tuple[Finding, bool]]:
        """Return turned or mirrored frames where they fit much better, and whether that is sure.

        They are looked for before lengths and clocks: these fit by chance in frames that are
        turned.
        """
        if residual.reason or not self.shape.is_known:
            return []
        track, camera = episode.images[view], episode.cameras[view]
        found: dict[Orientation, float] = {}
        for orientation in ORIENTATIONS:
            is_turn = orientation.quarters > 0
            if is_turn and residual.match_here >= _UPRIGHT_MATCH:
                continue
            if orientation.quarters % 2 and camera.width != camera.height:
                continue
            seen = turned_back(track, camera, orientation)
            found[orientation] = self._match(*seen, joints, self.shape.parts)
        best = max(found, key=found.__getitem__)
        if not found[best] > max(residual.match_here + _MIRRORED_GAIN, _MIN_MATCH):
            return []
        finding = broken(_instead(_TURNED.format(best.text), found[best], residual.match_here))
        others = np.nanmax([residual.match, residual.best_change[1], 0.0])
        return [(finding, bool(found[best] > _TURNED_FACTOR * others))]

    def _alternatives(
        self, episode: Episode, view: str, joints: JointTrack, residual: MotionResidual
    ) -> list[Finding]:
        """A gripper that opens the other way, where that fits much better."""
        if residual.reason or not self.shape.is_known:
            return []
        track, camera = episode.images[view], episode.cameras[view]
        found = []
        for tool in self.robot.tools:
            moved = gripper_links(self.robot, tool)
            fingers = [part for part in self.shape.parts if part.link in moved]
            if not fingers:
                continue
            here = self._match(track, camera, joints, fingers)
            there = self._match(track, camera, joints.swapped(self.robot, tool), fingers)
            if there > max(here + _SWAPPED_GAIN, _MIN_MATCH):
                text = _SWAPPED.format(tool.gripper_joint)
                found.append(suspicious(_instead(text, there, here)))
        return found

    def _residual(
        self, episode: Episode, view: str, joints: JointTrack
    ) -> MotionResidual | Finding:
        try:
            return measure_residual(
                episode.images[view],
                episode.cameras[view],
                self.robot,
                self.shape.parts,
                joints,
                self._search,
            )
        except EpisodeError as error:
            return broken(f'its images cannot be read: {error}')

    def _judge(
        self, residual: MotionResidual, camera: CameraModel
    ) -> tuple[Checked, tuple[str, ...]]:
        if residual.reason:
            text = f'calibration not checked against the images: {residual.reason}'
            return ({'residual': 'not measured'}, [not_checked(text)]), ()
        x, y = residual.shift_px
        measures = {
            'residual': f'{np.hypot(x, y):.1f} px (x {x:+.1f}, y {y:+.1f}) from the drawn robot '
            f'to the moving pixels',
            'motion match': f'{residual.match:.2f} over {residual.num_pairs} pairs of frames',
            'image delay': f'{residual.lag_s:+.1f} s against the joint states',
        }
        findings = [
            *self._distance(residual, camera),
            *self._better_fit(residual),
            *self._unseen_arms(residual),
        ]
        if not self.shape.is_known:
            text = (
                f'only gross errors were looked for: the robot is drawn with {self.shape.source}'
            )
            findings.append(not_checked(text))
        return (measures, findings), (f'the robot is drawn with {self.shape.source}',)

    def _unseen_arms(self, residual: MotionResidual) -> list[Finding]:
        """Return the arms of a robot with several that were not compared in a view."""
        return [
            part_not_checked(
                f"arm '{arm}' is not compared with the images: it does not move in this view, or "
                'is not in it'
            )
            for arm, links in (arm_links(self.robot) if len(self.robot.tools) > 1 else {}).items()
            if links.isdisjoint(residual.links)
        ]

    def _distance(self, residual: MotionResidual, camera: CameraModel) -> list[Finding]:
        if residual.match < _MIN_MATCH:
            text = (
                f'what moves in the images does not move like the drawn robot (match '
                f'{residual.match:.2f}, at least {_MIN_MATCH:g} is expected): wrong '
                'camera, pose or robot'
            )
            return [broken(text)]
        x, y = residual.shift_px
        distance = float(np.hypot(x, y))
        text = (
            f'the robot is drawn {distance:.1f} px beside the moving pixels (they are at '
            f'{x:+.1f}, {y:+.1f}): check K, T_mount_camera and the tool offset (`mtv-world '
            'fit camera` estimates the pose)'
        )
        if residual.match <= residual.match_here * (1 + _BETTER_PLACE):
            return []
        border = max(abs(x), abs(y)) >= REACH * camera.width - 1
        if border or distance > self._broken * camera.width:
            return [broken(text)]
        return [suspicious(text)] if distance > self._suspicious * camera.width else []

    def _better_fit(self, residual: MotionResidual) -> list[Finding]:
        """Return a finding if another roll or focal length fits the seen motion clearly better."""
        name, match = residual.best_change
        if not self.shape.is_known or not match > residual.match * (1 + _BETTER_MATCH):
            return []
        text = (
            f'the drawn robot fits the moving pixels better with {name} (match {match:.2f}, as it '
            f'is {residual.match:.2f}): check the rotation in T_mount_camera, and whether K is '
            'for this image size'
        )
        return [suspicious(text)]

    def _recording(
        self, episode: Episode, joints: JointTrack, zero: Sequence[Finding] = ()
    ) -> Section:
        frames_ns = episode.images[episode.views[0]].stamps_ns
        origin = int(frames_ns[0])
        checks = [
            check_limits('measured', self.robot, joints.positions),
            check_rate('joint states', joints.stamps_ns),
            check_masks(episode),
        ]
        try:
            commands = self._commands(episode, origin)
            if commands is not None:
                checks.append(check_limits('commanded', self.robot, commands.positions))
            checks.append(check_commands(commands, origin, frames_ns, joints))
        except MtvWorldError as error:
            checks.append(({}, [broken(f'commands: {error}')]))
        warnings = [suspicious(text) for text in (*episode.warnings, *self.shape.doubts)]
        return _section('recording', [*checks, ({}, [*zero, *warnings])], ())

    def _commands(self, episode: Episode, origin_ns: int) -> JointTrajectory | None:
        if not episode.trajectories:
            return None
        matched = [(s, match_joints(t, self.robot)) for s, t in episode.trajectories]
        return stitch(matched, origin_ns)


def _numbers(residual: MotionResidual | Finding | None) -> dict[str, float]:
    """Return the numbers of a view that were measured, by the keys of `NUMBERS`."""
    if not isinstance(residual, MotionResidual) or residual.reason:
        return {}
    found = {
        'residual_px': float(np.hypot(*residual.shift_px)),
        'match': residual.match,
        'delay_s': residual.lag_s,
    }
    return {key: value for key, value in found.items() if np.isfinite(value)}


def _instead(text: str, there: float, here: float) -> str:
    return f'{text} (match {there:.2f}, as it is {here:.2f})'


def delays(measured: Mapping[str, tuple[MotionResidual, Track]]) -> dict[str, list[Finding]]:
    """Return the delays of the images that the data show, by view.

    Both halves of a recording must fit better with the delay, and no view may say the contrary.
    A delay of one frame must stand out: on real recordings at 5 Hz, motions fitted better one
    frame earlier in one view and one later in another.

    Args:
        measured: residual and frames of each view.
    """
    told = {}
    for view, (residual, track) in measured.items():
        if residual.reason or len(track.stamps_ns) < 2:
            continue
        period_s = float(np.median(np.diff(track.stamps_ns))) * 1e-9
        frames = abs(residual.lag_s) / period_s
        least = _LAG_GAIN if frames > 1.5 else _LAG_GAIN_OF_A_FRAME
        if abs(residual.lag_s) > _MAX_LAG_S - 1e-9 and frames > 0.99 and residual.lag_gain > least:
            told[view] = residual.lag_s
    if len({lag_s > 0 for lag_s in told.values()}) > 1:
        return {}
    text = (
        'the images fit the joint states best {:+.1f} s later: their clocks differ, or the camera '
        'is that slow'
    )
    return {view: [suspicious(text.format(lag_s))] for view, lag_s in told.items()}


def load_inspector(robot_file: Path, search: ResidualSearch = WHOLE_SEARCH) -> Inspector:
    """Return the inspector of a robot YAML.

    Raises:
        ConfigError, RobotError: the robot cannot be used.
    """
    robot = load_robot(robot_file)
    return Inspector(robot, load_shape(robot), search)


def _section(name: str, checks: Iterable[Checked], notes: Sequence[str]) -> Section:
    measures: dict[str, str] = {}
    findings: list[Finding] = []
    for measured, found in checks:
        measures.update(measured)
        findings += found
    return Section(name=name, measures=measures, findings=tuple(findings), notes=tuple(notes))


@dataclass(frozen=True, slots=True, kw_only=True)
class ToolVisibility:
    """Shares of the frames, for each arm (A,).

    Attributes:
        behind: the tool point is not in front of the camera.
        outside: the tool is in front of the camera but not in the image.
    """

    behind: FloatArray
    outside: FloatArray


def tool_visibility(
    camera: CameraModel,
    robot: RobotModel,
    positions: FloatArray,
    T_mount_camera: FloatArray | None = None,
) -> ToolVisibility:
    """Count where the tool points fall for positions (T, J).

    `T_mount_camera` (T, 4, 4) are the poses of a camera that moves by itself.
    """
    points = robot.tool_poses(positions)[..., :3, 3]
    poses = camera_poses(camera, robot, positions)
    if T_mount_camera is not None:
        poses = poses @ inverse(camera.T_mount_camera) @ T_mount_camera
    pixels, depth = project(camera, poses, points)
    behind = depth <= 0
    size = np.array([camera.width, camera.height])
    inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=-1)  # NaN is not inside
    return ToolVisibility(behind=behind.mean(axis=1), outside=(~inside & ~behind).mean(axis=1))


def check_visibility(
    camera: CameraModel,
    robot: RobotModel,
    positions: FloatArray,
    T_mount_camera: FloatArray | None = None,
) -> tuple[dict[str, str], list[Finding]]:
    """Return the shares of tool points behind the camera and outside the image, and findings."""
    seen = tool_visibility(camera, robot, positions, T_mount_camera)
    measures = {
        f"tool '{tool.arm}'": f'{seen.behind[i]:.0%} behind the camera, '
        f'{seen.outside[i]:.0%} off the image'
        for i, tool in enumerate(robot.tools)
    }
    best = float((1 - seen.behind - seen.outside).max())
    fixed = camera.mount_link not in moving_links(robot)
    if fixed and seen.behind.min() > 0.5:
        return measures, [
            broken(
                'every tool is behind the camera most of the time: is T_mount_camera inverted, '
                'or does its z axis not point ahead?'
            )
        ]
    if best == 0:
        return measures, [broken('no tool is ever in the image')]
    if best < _LEAST_IN_IMAGE:
        return measures, [suspicious(f'no tool is in the image in more than {best:.0%} of frames')]
    return measures, []


def check_limits(
    what: str, robot: RobotModel, positions: FloatArray
) -> tuple[dict[str, str], list[Finding]]:
    """Check positions (T, J) against the robot's limits, one finding a joint."""
    beyond = np.maximum(robot.lower - positions, positions - robot.upper)
    share = (beyond > _LIMIT_TOLERANCE).mean(axis=0)
    findings = []
    for joint in np.flatnonzero(share):
        row = int(beyond[:, joint].argmax())
        text = (
            f"{what}: joint '{robot.joint_names[joint]}' is outside its limits "
            f'{robot.lower[joint]:.4g} .. {robot.upper[joint]:.4g} in {share[joint]:.1%} of the '
            f'rows, at worst {positions[row, joint]:.4g} (degrees, another zero or sign, or '
            'another gripper range?)'
        )
        findings.append(broken(text) if share[joint] > 0.2 else suspicious(text))
    if not np.isfinite(positions).all():
        findings.append(broken(f'{what}: some positions are not finite'))
    counted = f'{int((share > 0).sum())} of {len(share)} joints leave theirs'
    return {f'limits, {what}': counted}, findings


#: frames of a picture, side by side in rows of two
_NUM_FRAMES = 4
#: width of one frame in the picture [px]
_WIDTH = 640
#: duration of the longest trail that is drawn [s]
_TRAIL_S = 2.0
#: points of a trail per second [Hz]
_TRAIL_HZ = 20


def overlay_picture(
    episode: Episode,
    view: str,
    robot: RobotModel,
    shapes: Sequence[LinkShape],
    joints: JointTrack,
    *,
    with_robot: bool = True,
) -> ByteArray:
    """Return (H, W, 3) RGB: frames of a view with the projected robot drawn over them.

    Per arm the fading trail of the last seconds and a cross at the tool point; white the outline
    of the robot. Frames without joint states, or without `with_robot`, are drawn as they are.
    """
    track = episode.images[view]
    covered = np.flatnonzero(joints.covers(track.stamps_ns))
    indices = covered if len(covered) else np.arange(len(track.stamps_ns))
    chosen = indices[np.linspace(0, len(indices) - 1, _NUM_FRAMES + 2).astype(int)[1:-1]]
    tiles = [
        _tile(track, int(i), episode.camera(view, int(i)), robot, shapes, joints, with_robot)
        for i in chosen
    ]
    rows = [np.hstack(tiles[i : i + 2]) for i in range(0, len(tiles), 2)]
    return np.ascontiguousarray(np.vstack(rows))


def _tile(
    track: Track,
    index: int,
    camera: CameraModel,
    robot: RobotModel,
    shapes: Sequence[LinkShape],
    joints: JointTrack,
    with_robot: bool,
) -> ByteArray:
    stamp = int(track.stamps_ns[index])
    frame = np.array(track.frames[index])
    if with_robot and joints.covers(np.array([stamp])).all():
        positions = joints.at(np.array([stamp]))
        frame = _with_trails(frame, stamp, camera, robot, joints)
        outline = draw_silhouettes(shapes, camera, robot, positions)[0]
        contours, _ = cv2.findContours(outline, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(frame, contours, -1, (255, 255, 255), 1)
        _draw_crosses(frame, camera, robot, positions)
    height = round(frame.shape[0] * _WIDTH / frame.shape[1])
    tile = np.asarray(cv2.resize(frame, (_WIDTH, height)), np.uint8)
    seconds = (stamp - int(track.stamps_ns[0])) * 1e-9
    cv2.putText(tile, f'{seconds:.2f} s', (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 0))
    return tile


def _with_trails(
    frame: ByteArray, stamp_ns: int, camera: CameraModel, robot: RobotModel, joints: JointTrack
) -> ByteArray:
    start = max(stamp_ns - round(_TRAIL_S * 1e9), int(joints.stamps_ns[0]))
    count = max(2, round((stamp_ns - start) * 1e-9 * _TRAIL_HZ))
    stamps = np.linspace(start, stamp_ns, count).astype(np.int64) if stamp_ns > start else None
    if stamps is None:
        return frame
    video = render_trajectory_video(
        motion=Motion.of(robot, (camera,), joints.at(stamps)),
        times=np.asarray((stamps - start) * 1e-9, np.float64),
        object_masks=None,
        config=TrajectoryVideoConfig(half_life_s=1.0, point_radius_m=0.006, max_gap_m=0.005),
    )
    trails = video.frames[0, -1]
    share = trails.max(axis=-1, keepdims=True) / 255.0
    return np.asarray(frame * (1 - share) + trails, np.uint8)


def _draw_crosses(
    frame: ByteArray, camera: CameraModel, robot: RobotModel, positions: FloatArray
) -> None:
    motion = Motion.of(robot, (camera,), positions)
    pixels, _ = project(camera, motion.camera_poses[0, 0], motion.tool_points[:, 0])
    size = max(7, camera.width // 40)
    for arm, pixel in enumerate(pixels):
        if np.isfinite(pixel).all() and (np.abs(pixel) < 10 * camera.width).all():
            colour = tuple(int(255 * c) for c in arm_colour(arm, len(pixels)))
            at = (round(float(pixel[0])), round(float(pixel[1])))
            cv2.drawMarker(frame, at, (0, 0, 0), cv2.MARKER_CROSS, size + 2, 3)
            cv2.drawMarker(frame, at, colour, cv2.MARKER_CROSS, size, 1)
