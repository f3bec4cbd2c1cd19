"""Clock checks: rates, gaps, skew; joint states and commands against frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.data_types import FloatArray, JointTrajectory
from mtv_world_ros.data.episode import JointStates, Track
from mtv_world_ros.inspection.inspection_report import broken, Finding, suspicious
from mtv_world_ros.robot.model import RobotModel, Tool
from mtv_world_ros.robot.resample import interpolated, match_joints

Stamps = NDArray[np.int64]


#: minimum length of a gap [median periods]
_GAP = 2.5
#: views further apart are refused by the node [s]
_MAX_SKEW_S = 0.05
#: maximum time between a frame and its nearest joint state [s]
_MAX_JOINT_AGE_S = 0.1
#: share of the frames within the joint states; below half of it is broken
_MIN_COVERAGE = 0.95
#: the joints may follow their commands this late [s]
_MAX_RESPONSE_S = 0.5


def check_rate(what: str, stamps_ns: Stamps) -> tuple[dict[str, str], list[Finding]]:
    """Check the median rate and gaps of one stream."""
    if len(stamps_ns) < 2:
        return {}, [broken(f'{what}: {len(stamps_ns)} message, at least 2 are needed')]
    periods = np.diff(stamps_ns) * 1e-9
    period = float(np.median(periods))
    gaps = periods > _GAP * period
    measures = {f'{what} rate': f'{1 / period:.4g} Hz, {len(stamps_ns)} messages'}
    if not gaps.any():
        return measures, []
    at = (stamps_ns[:-1][gaps][periods[gaps].argmax()] - stamps_ns[0]) * 1e-9
    text = (
        f'{what}: {int(gaps.sum())} gaps, the longest of {periods.max():.3g} s at {at:.4g} s '
        f'(the median period is {period:.3g} s)'
    )
    return measures, [suspicious(text)]


def check_skew(view: str, images: Mapping[str, Track]) -> tuple[dict[str, str], list[Finding]]:
    """Measure the time from each frame of a view to the nearest frame of the first view."""
    first = next(iter(images))
    if view == first or not len(images[view].stamps_ns):
        return {}, []
    own, other = images[view].stamps_ns, images[first].stamps_ns
    within = (own >= other[0]) & (own <= other[-1])
    if not within.any():
        return {}, [broken(f"its frames and those of '{first}' are at different times")]
    away = nearest_distance_s(own[within], other)
    measures = {f"skew to '{first}'": f'{np.median(away):.3g} s, at most {away.max():.3g} s'}
    if np.median(away) <= _MAX_SKEW_S:
        return measures, []
    return measures, [
        suspicious(
            f"its frames are {np.median(away):.3g} s away from those of '{first}'; the node "
            f'refuses more than max_view_skew_s = {_MAX_SKEW_S:g} s'
        )
    ]


def check_joint_states(
    stamps_ns: Stamps, joints: JointTrack
) -> tuple[dict[str, str], list[Finding]]:
    """Check the joint states against a view's frames."""
    covered = float(joints.covers(stamps_ns).mean())
    away = nearest_distance_s(stamps_ns, joints.stamps_ns)
    measures = {
        'frames within the joint states': f'{covered:.0%}',
        'nearest joint state': f'{np.median(away):.3g} s, at most {away.max():.3g} s',
    }
    if covered < _MIN_COVERAGE / 2:
        text = (
            f'only {covered:.0%} of the frames are within the joint states: are their stamps of '
            'the same clock?'
        )
        return measures, [broken(text)]
    findings = []
    if covered < _MIN_COVERAGE:
        findings.append(
            suspicious(f'only {covered:.0%} of the frames are within the joint states')
        )
    if away.max() > _MAX_JOINT_AGE_S:
        findings.append(
            suspicious(
                f'a frame is {away.max():.3g} s away from the nearest joint state (more than '
                f'{_MAX_JOINT_AGE_S:g} s)'
            )
        )
    return measures, findings


def check_commands(
    commands: JointTrajectory | None,
    origin_ns: int,
    frames_ns: Stamps,
    joints: JointTrack,
) -> tuple[dict[str, str], list[Finding]]:
    """Check the commands against frames, and how late the joints follow them.

    Args:
        commands: all commands of the recording, in the robot's order; None where there are none.
        origin_ns: time zero of the commands [ns].
        frames_ns: frames of the first view.
        joints: measured joint positions.
    """
    if commands is None:
        return {'commands': 'none'}, [
            suspicious('no joint_trajectory was recorded: training and evaluation need it')
        ]
    seconds = (frames_ns - origin_ns) * 1e-9
    covered = float(((seconds >= -1e-6) & (seconds <= commands.times[-1] + 1e-6)).mean())
    measures = {'frames within the commands': f'{covered:.0%}'}
    if covered < 0.5:
        return measures, [
            broken(f'only {covered:.0%} of the frames are within the commands: same clock?')
        ]
    late, error = response(commands, origin_ns, joints)
    measures['joints follow the commands'] = (
        f'{late:.2f} s late, {error:.3g} rad or m beside them (rms)'
        if np.isfinite(late)
        else 'not measured: nothing moves'
    )
    findings = []
    if abs(late) > _MAX_RESPONSE_S:
        findings.append(
            suspicious(
                f'the joints follow the commands {late:.2f} s late: are their stamps of the same '
                'clock?'
            )
        )
    return measures, findings


def response(
    commands: JointTrajectory, origin_ns: int, joints: JointTrack, *, reach_s: float = 2.0
) -> tuple[float, float]:
    """Return the delay between commands and measured joints [s], and the residual.

    Returns:
        Delay [s] and root mean square of the rest [rad or m]; NaN where the commands stand still.
    """
    times = np.arange(commands.times[0], commands.times[-1], 0.05)
    wanted = _at(times, commands)
    moving = wanted.std(axis=0) > 1e-3
    if len(times) < 10 or not moving.any():
        return float('nan'), float('nan')
    delays = np.arange(-reach_s, reach_s + 1e-9, 0.02)
    rests = []
    for delay in delays:
        stamps = origin_ns + np.round((times + delay) * 1e9).astype(np.int64)
        inside = joints.covers(stamps)
        apart = joints.at(stamps)[inside][:, moving] - wanted[inside][:, moving]
        enough = inside.mean() > 0.3
        rests.append(float(np.sqrt((apart**2).mean())) if enough else np.inf)
    best = int(np.argmin(rests))
    return float(delays[best]), rests[best]


def nearest_distance_s(stamps_ns: Stamps, others_ns: Stamps) -> FloatArray:
    """Return (N,) distance of each stamp to the nearest of others [s]."""
    right = np.searchsorted(others_ns, stamps_ns).clip(0, len(others_ns) - 1)
    left = (right - 1).clip(0)
    away = np.minimum(np.abs(others_ns[right] - stamps_ns), np.abs(others_ns[left] - stamps_ns))
    return np.asarray(away * 1e-9, np.float64)


def _at(times: FloatArray, commands: JointTrajectory) -> FloatArray:
    columns: Sequence[FloatArray] = list(commands.positions.T)
    return np.stack([np.interp(times, commands.times, c) for c in columns], axis=1)


class JointTrack:
    """Joint states of a recording, interpolated.

    Args:
        states: recorded joint states.
        robot: whose joints are picked.

    Attributes:
        stamps_ns: (N,) int64, increasing.
        positions: (N, J) positions in the robot's order [rad or m].

    Raises:
        TrajectoryError: a joint of the robot is missing.
    """

    def __init__(self, states: JointStates, robot: RobotModel) -> None:
        self.stamps_ns = np.asarray(states.stamps_ns, np.int64)
        matched = match_joints(
            JointTrajectory(
                joint_names=states.joint_names,
                times=(self.stamps_ns - self.stamps_ns[0]) * 1e-9,
                positions=states.positions,
            ),
            robot,
        )
        self.positions = matched.positions
        self._is_endless = robot.is_endless

    def at(self, stamps_ns: NDArray[np.int64]) -> FloatArray:
        """Return (len(stamps_ns), J) positions; the first or last one beyond the ends."""
        wanted = np.asarray(stamps_ns - self.stamps_ns[0], float)
        have = np.asarray(self.stamps_ns - self.stamps_ns[0], float)
        return interpolated(wanted, have, self.positions, self._is_endless)

    def swapped(self, robot: RobotModel, tool: Tool) -> JointTrack:
        """Return the track with open and closed of a gripper swapped."""
        other = copy(self)
        column = robot.joint_names.index(tool.gripper_joint)
        other.positions = self.positions.copy()
        both = tool.gripper_open + tool.gripper_closed
        other.positions[:, column] = both - self.positions[:, column]
        return other

    def shifted(self, robot: RobotModel, joint: str, offset: float) -> JointTrack:
        """Return the track with another zero of a joint.

        Args:
            robot: robot whose order of joints is used.
            joint: name of the joint.
            offset: added to its positions [rad or m].
        """
        other = copy(self)
        other.positions = self.positions.copy()
        other.positions[:, robot.joint_names.index(joint)] += offset
        return other

    def covers(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return True for each stamp (N,) within the recorded joint states."""
        return (stamps_ns >= self.stamps_ns[0]) & (stamps_ns <= self.stamps_ns[-1])
