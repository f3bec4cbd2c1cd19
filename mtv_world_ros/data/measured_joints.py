"""Measured joint positions: one check of JointState messages for recordings and the live node.

A JointState is per joint: one that has no number, or two, does not take the others with it.
N samples, J joints.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.episode import JointStates
from mtv_world_ros.data.gripper_sources import settle_grippers
from mtv_world_ros.robot.model import RobotModel

Stamps = NDArray[np.int64]
NANO = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ReachSettings:
    """Thresholds beyond which a measured joint cannot have moved between two samples."""

    #: noise of an encoder [rad or m], and the same as a fraction of the joint's range
    noise: float = 0.05
    noise_of_range: float = 0.1
    #: measured speed that is still possible, in speed limits of the joint
    speed_factor: float = 3.0
    #: speed limit of a joint whose description gives none [rad/s or m/s]
    default_speed: float = 2 * math.pi
    #: longest run of samples that counts as a glitch [s]
    glitch_s: float = 0.5
    #: fraction of the samples up to which those out of reach are glitches
    glitch_ratio: float = 0.05
    #: fraction of the samples of the largest source up to which all is taken as of a wrong unit
    scattered_ratio: float = 0.3
    #: motion below which the joints of a publisher stand still [rad or m]
    still: float = 1e-3
    #: maximum number of publishers that are distinguished
    num_publishers: int = 32
    #: a fast step belongs to a motion if a neighbouring step has the same sign and this
    #: fraction of its speed
    smooth_ratio: float = 0.2
    #: fraction of a joint's steps up to which fast ones are taken as motion; of a wrong unit more
    #: are
    fast_ratio: float = 0.3
    #: time between two neighbouring steps of a joint [s]
    beside_s: float = 0.2
    #: longest time for which a sample repeats the joint's last measurement [s]
    repeated_s: float = 0.25
    #: live: number of newest samples of a joint that are tested, and number of jumps among
    #: these samples that means two publishers
    window: int = 64
    least_turns: int = 4


REACH = ReachSettings()
#: a joint's last position is held in silence for up to this time [s] and number of its periods
HELD_S = 2.0
HELD_PERIODS = 5.0
#: joints that a warning names at most
MAX_NAMES = 8


class JointSample(NamedTuple):
    """Positions that one JointState gives.

    Attributes:
        positions: positions by joint name [rad or m]; those that can be used.
        faults: reason by name of each joint whose position cannot.
    """

    positions: dict[str, float]
    faults: dict[str, str]


def read_sample(
    names: Sequence[str], positions: Sequence[float], joints: Collection[str] | None = None
) -> JointSample:
    """Return the positions of a JointState by joint.

    Args:
        names: names of the joints in the message.
        positions: position of each name [rad or m].
        joints: names of the joints that are read; others are ignored, whatever their positions.
            None = all.
    """
    found: dict[str, float] = {}
    faults: dict[str, str] = {}
    for name, value in zip(names, positions, strict=True):
        if joints is not None and name not in joints:
            continue
        if not math.isfinite(value):
            faults[name] = f'its position is {value}'
        elif name in found and found[name] != value:
            faults[name] = f'it is named twice, at {found[name]:g} and at {value:g}'
        found.setdefault(name, value)
    return JointSample({n: v for n, v in found.items() if n not in faults}, faults)


class JointReach:
    """Limits of how far the joints of a robot move between two samples.

    Args:
        robot: the robot; its grippers are left out, because drivers of grippers report steps.

    Attributes:
        noise: (J,) [rad or m]; inf for grippers.
        speed: (J,) [rad/s or m/s].
        is_endless: (J,) joints that turn without end: positions a turn apart are equal.
    """

    def __init__(self, robot: RobotModel, settings: ReachSettings = REACH) -> None:
        self.settings = settings
        self.names = robot.joint_names
        ranges = robot.upper - robot.lower
        self.is_endless = robot.is_endless.copy()
        self.noise = np.minimum(settings.noise, settings.noise_of_range * ranges)
        given = np.isfinite(robot.velocity_limits) & (robot.velocity_limits > 0)
        limits = np.where(given, robot.velocity_limits, settings.default_speed)
        self.speed = settings.speed_factor * limits
        grippers = {tool.gripper_joint for tool in robot.tools}
        self.noise[[name in grippers for name in self.names]] = np.inf
        # plain numbers: samples arrive one by one at up to 1 kHz
        limits_each = (self.noise.tolist(), self.speed.tolist(), self.is_endless.tolist())
        self._limits = list(zip(*limits_each, strict=True))

    def distance(
        self, before: FloatArray, after: FloatArray, chosen: Any = slice(None)
    ) -> FloatArray:
        """Return (..., K) the distances between positions of `chosen` joints [rad or m]."""
        moved = np.abs(after - before)
        turned = np.abs((moved + np.pi) % (2 * np.pi) - np.pi)
        return np.asarray(np.where(self.is_endless[chosen], turned, moved), np.float64)

    def with_speeds(self, speeds: FloatArray) -> JointReach:
        """Return a copy in which joints have at least these speeds (J,) [rad/s or m/s]."""
        other = copy(self)
        other.speed = np.maximum(self.speed, speeds)
        return other

    def with_repeats(self, times: FloatArray, positions: FloatArray) -> JointReach:
        """Return a copy for samples (N, J) that repeat the last measurement of a slower joint.

        Such a joint moves for several samples and shows it in one.
        """
        other, period = copy(self), np.median(np.diff(times)) if len(times) > 1 else 0.0
        other.noise = self.noise.copy()
        for joint in np.flatnonzero(np.isfinite(self.noise)):
            given = np.isfinite(positions[:, joint])
            values, seconds = positions[given, joint], times[given]
            gaps = np.diff(seconds[1:][np.diff(values) != 0])
            if len(gaps):  # some gaps are longer for rests
                held_s = min(float(np.quantile(gaps, 0.25)), self.settings.repeated_s)
                other.noise[joint] += self.speed[joint] * max(held_s - period, 0.0)
        return other

    def allows(self, joint: int, before: float, after: float, seconds: float) -> bool:
        """Return whether a joint can move from one position to another in this time [s]."""
        noise, speed, is_endless = self._limits[joint]
        moved = abs(after - before)
        if is_endless:
            moved = abs((moved + math.pi) % (2 * math.pi) - math.pi)
        return moved <= noise + speed * abs(seconds)


@dataclass(slots=True)
class _Course:
    """Samples of one joint while they arrive.

    Attributes:
        stamp_ns, position: stamp [ns] and position [rad or m] of the last sample that was taken.
        other: stamp of the first and the last sample of a course out of reach [ns], and its last
            position; None = there is none.
        jumps: one entry for each of the newest samples: whether it was out of reach.
        step, step_s: last step that was taken [rad or m], [s].
    """

    stamp_ns: int
    position: float
    jumps: deque[bool]
    other: tuple[int, int, float] | None = None
    step: float = 0.0
    step_s: float = 0.0


class ReachWatch:
    """The limits of `JointReach` for samples that arrive one by one, as in the live node.

    A sample out of reach is refused. Where those out of reach go on for longer than a glitch and
    agree with each other, the joint has been moved, and they are taken. Where samples within and
    out of reach take turns, two publishers contradict each other: see `contradiction`.

    Args:
        reach: limits of the robot's joints.
    """

    def __init__(self, reach: JointReach) -> None:
        self._reach = reach
        self._numbers = {name: number for number, name in enumerate(reach.names)}
        self._courses: dict[str, _Course] = {}

    def clear(self) -> None:
        """Forget all samples."""
        self._courses.clear()

    def add(self, name: str, stamp_ns: int, position: float) -> str:
        """Take a sample of a joint of the robot; return why it is out of reach, or ''."""
        course = self._courses.get(name)
        if course is None:
            jumps: deque[bool] = deque(maxlen=self._reach.settings.window)
            self._courses[name] = _Course(stamp_ns, position, jumps)
            return ''
        number = self._numbers[name]
        seconds = (stamp_ns - course.stamp_ns) / NANO
        step = position - course.position
        if self._reach.allows(number, course.position, position, seconds):
            self._settle(course, number, stamp_ns, position)
        elif self._is_steady(course.step, course.step_s, step, seconds):
            course.jumps.append(False)
        elif self._has_lasted(course, number, stamp_ns, position):
            _, last_ns, last = course.other or (0, course.stamp_ns, course.position)
            step, seconds = position - last, (stamp_ns - last_ns) / NANO
            course.jumps.clear()
            course.other = None
        else:
            course.jumps.append(True)
            return (
                f'it jumps from {course.position:g} to {position:g} in {seconds:.4f} s, which no '
                'joint can'
            )
        course.stamp_ns, course.position = stamp_ns, position
        course.step, course.step_s = step, seconds
        return ''

    def contradiction(self) -> str:
        """Return which joints are reported at two places in turn, or ''."""
        names = [name for name, course in self._courses.items() if self._takes_turns(course)]
        if not names:
            return ''
        more = f' and {len(names) - MAX_NAMES} more' if len(names) > MAX_NAMES else ''
        course = self._courses[names[0]]
        return (
            f'joint states contradict each other: {", ".join(names[:MAX_NAMES])}{more} are at two '
            f'places in turn ({sum(course.jumps)} of the last {len(course.jumps)} samples of '
            f"'{names[0]}' are out of reach of the others); do two nodes publish them?"
        )

    def _settle(self, course: _Course, number: int, stamp_ns: int, position: float) -> None:
        """Note a sample within reach; those before it that lead to it were motion, no jumps."""
        if course.other is not None:
            _, last_ns, last = course.other
            if self._reach.allows(number, last, position, (stamp_ns - last_ns) / NANO):
                while course.jumps and course.jumps[-1]:
                    course.jumps.pop()
            course.other = None
        course.jumps.append(False)

    def _takes_turns(self, course: _Course) -> bool:
        settings, num_jumps = self._reach.settings, sum(course.jumps)
        return (
            num_jumps >= settings.least_turns
            and num_jumps > settings.glitch_ratio * len(course.jumps)
            and not all(course.jumps)
        )

    def _has_lasted(self, course: _Course, number: int, stamp_ns: int, position: float) -> bool:
        """Return whether a course out of reach is motion, or has gone on longer than a glitch."""
        first_ns = stamp_ns
        if course.other is not None:
            begun_ns, last_ns, last = course.other
            seconds = (stamp_ns - last_ns) / NANO
            before_s = (last_ns - course.stamp_ns) / NANO
            if self._is_steady(last - course.position, before_s, position - last, seconds):
                return True
            if self._reach.allows(number, last, position, seconds):
                first_ns = begun_ns
        if (stamp_ns - first_ns) / NANO > self._reach.settings.glitch_s:
            return True
        course.other = (first_ns, stamp_ns, position)
        return False

    def _is_steady(self, first: float, first_s: float, second: float, second_s: float) -> bool:
        """Return whether two steps in a row are one fast motion: same sign, similar speed."""
        settings = self._reach.settings
        if not (0 < first_s <= settings.beside_s and 0 < second_s <= settings.beside_s):
            return False
        slower, faster = sorted((first / first_s, second / second_s), key=abs)
        if abs(faster) > settings.speed_factor * settings.default_speed:
            return False
        return slower * faster > 0 and abs(slower) >= settings.smooth_ratio * abs(faster)


class Unreachable(NamedTuple):
    """Samples that the joints cannot have reached.

    Attributes:
        rows: (N,) True for an unreachable sample.
        text: joint, size, time and number of the unreachable samples; empty if there is none.
        fast: joints that move faster than their speed limit; empty if there is none.
    """

    rows: BoolArray
    text: str
    fast: str = ''

    @property
    def texts(self) -> list[str]:
        """The notes that are not empty."""
        return [text for text in (self.fast, self.text) if text]


def find_unreachable(
    topic: str,
    stamps_ns: Stamps,
    positions: FloatArray,
    reach: JointReach,
    items: str = 'messages',
) -> Unreachable:
    """Return the samples that no joint can have moved to: glitches, or a second publisher.

    Samples are sorted into sources within which every step is possible. Short and rare stretches
    are glitches. Of sources that take turns, the one that moves is the robot. A jump after which
    the joint stays is named, and all samples are kept. So is a joint that moves steadily, but
    faster than its speed limit: the limit of the robot's description is too low.

    Args:
        topic: topic, for texts.
        stamps_ns: (N,) stamps in increasing order.
        positions: (N, J) positions in the order of `reach` [rad or m]; NaN = not in the message.
        reach: reach of the robot.
        items: word for the samples, for texts.

    Raises:
        EpisodeError: it cannot be told which samples are the robot's.
    """
    times = (stamps_ns - stamps_ns[0]) * 1e-9 if len(stamps_ns) else np.zeros(0)
    speeds = _steady_speeds(times, positions, reach)
    fast = _fast_text(topic, speeds, reach)
    reach = reach.with_speeds(speeds).with_repeats(times, positions)
    first = _first_jump(times, positions, reach)
    if first is None:
        return Unreachable(np.zeros(len(times), bool), '', fast)
    row, before, joint = first
    step = (
        f"joint '{reach.names[joint]}' jumps from {positions[before, joint]:.4g} to "
        f'{positions[row, joint]:.4g} within {times[row] - times[before]:.4g} s at '
        f'{times[row]:.4g} s, which no joint can'
    )
    sources = _sources(times, positions, reach)
    settings = reach.settings
    if np.bincount(sources[sources >= 0]).max() <= settings.scattered_ratio * len(times):
        text = f"'{topic}': {step}; nearly every step does (degrees instead of radians?)"
        return Unreachable(np.zeros(len(times), bool), text, fast)
    is_short = _short_runs(times, sources, settings)
    if is_short.mean() <= settings.glitch_ratio:
        lasting = set(sources[~is_short].tolist())
        what = 'glitches of a sensor, or a second publisher'
        if len(lasting) > 1:
            what = (
                'an encoder whose zero changed, a time in which nothing was recorded, or a joint '
                "that is faster than its speed limit: 'speed_limits' of the robot's YAML"
            )
        kept = ~is_short
    else:
        begin = f"'{topic}': {step}"
        kept = sources == _robot_source(begin, items, times, positions, sources, settings)
        what = 'a second publisher that stands still'
    count = int((~kept).sum())
    handled = (
        f'{count} of {len(times)} {items} are out of reach of the others and were '
        f'{"left out" if items == "messages" else "made of those around them"}'
        if count
        else f'all {items} are kept; cut the recording there where its images do not fit'
    )
    return Unreachable(~kept, f"'{topic}': {step} ({what}); {handled}", fast)


def _steady_speeds(times: FloatArray, positions: FloatArray, reach: JointReach) -> FloatArray:
    """Return (J,) the speeds of joints that move steadily beyond their reach; 0 = they do not.

    A glitch or another publisher goes forth and back, and a changed zero is a single step. The
    steps of a motion have neighbours of the same sign. Repeated positions are left out:
    tables may have more rows than the joint has measurements.
    """
    settings, found = reach.settings, np.zeros(positions.shape[1])
    fastest = settings.speed_factor * settings.default_speed
    for joint in np.flatnonzero(np.isfinite(reach.noise)):
        values, given = positions[:, joint], np.isfinite(positions[:, joint])
        given[1:] &= values[1:] != values[:-1]
        at, values = times[given], values[given]
        steps, seconds = np.diff(values), np.maximum(np.diff(at), 1e-9)
        if reach.is_endless[joint]:
            steps = (steps + np.pi) % (2 * np.pi) - np.pi
        is_fast = np.abs(steps) > reach.noise[joint] + reach.speed[joint] * seconds
        if not is_fast.any() or is_fast.sum() > settings.fast_ratio * len(times):
            continue
        speeds = steps / seconds
        beside = np.where(seconds <= settings.beside_s, speeds, 0.0)
        beside = np.stack([np.append(0.0, beside[:-1]), np.append(beside[1:], 0.0)])
        ahead = (beside * np.sign(speeds)).max(axis=0)
        is_steady = ahead >= settings.smooth_ratio * np.abs(speeds)
        top = float(np.abs(speeds[is_fast]).max())
        if is_steady[is_fast].all() and top <= fastest:
            found[joint] = top
    return found


def _fast_text(topic: str, speeds: FloatArray, reach: JointReach) -> str:
    """Return the note on joints that move faster than their limit, and the remedy."""
    joints = np.flatnonzero(speeds)
    if not len(joints):
        return ''
    worst = int(joints[np.argmax(speeds[joints] / reach.speed[joints])])
    limit = reach.speed[worst] / reach.settings.speed_factor
    limits = ', '.join(f'{reach.names[n]}: {np.ceil(speeds[n] * 10) / 10:g}' for n in joints)
    return (
        f"'{topic}': joint '{reach.names[worst]}' moves at up to {speeds[worst]:.3g} a second, "
        f"its speed limit is {limit:.3g}: taken as motion; correct the robot's YAML: "
        f"'speed_limits: {{{limits}}}'"
    )


def _short_runs(
    times: FloatArray, sources: NDArray[np.intp], settings: ReachSettings
) -> BoolArray:
    """Return (N,) samples of runs of one source that are too short for a robot."""
    edges = np.flatnonzero(np.diff(sources)) + 1
    is_short = np.zeros(len(times), bool)
    for first, last in zip([0, *edges], [*edges, len(times)], strict=True):
        is_short[first:last] = times[last - 1] - times[first] <= settings.glitch_s
    return is_short | (sources < 0)


def _first_jump(
    times: FloatArray, positions: FloatArray, reach: JointReach
) -> tuple[int, int, int] | None:
    """Return the row, the row before it and the joint of the first step that is out of reach."""
    found: list[tuple[int, int, int]] = []
    for joint in np.flatnonzero(np.isfinite(reach.noise)):
        given = np.flatnonzero(np.isfinite(positions[:, joint]))
        values, seconds = positions[given, joint], np.diff(times[given])
        moved = reach.distance(values[:-1], values[1:], joint)
        jumps = np.flatnonzero(moved > reach.noise[joint] + reach.speed[joint] * seconds)
        if len(jumps):
            found.append((int(given[jumps[0] + 1]), int(given[jumps[0]]), int(joint)))
    return min(found, default=None)


def _sources(times: FloatArray, positions: FloatArray, reach: JointReach) -> NDArray[np.intp]:
    """Return (N,) number of the source of each sample: the nearest of those that reach it.

    -1 = none.
    """
    found = np.full(len(times), -1, np.intp)
    last = np.full((0, positions.shape[1]), np.nan)
    last_s = np.zeros_like(last)
    for row, (seconds, values) in enumerate(zip(times, positions, strict=True)):
        given = np.isfinite(values)
        moved = np.nan_to_num(reach.distance(last[:, given], values[given], given))
        allowed = reach.noise[given] + reach.speed[given] * (seconds - last_s[:, given])
        fits = (moved <= allowed).all(axis=1)
        if fits.any():
            away = np.where(fits, (moved / reach.noise[given]).max(axis=1, initial=0.0), np.inf)
            found[row] = away.argmin()
        elif len(last) < reach.settings.num_publishers:
            found[row] = len(last)
            last = np.vstack([last, np.full_like(values, np.nan)])
            last_s = np.vstack([last_s, np.full_like(values, seconds)])
        else:
            continue
        last[found[row], given], last_s[found[row], given] = values[given], seconds
    return found


def _robot_source(
    begin: str,
    items: str,
    times: FloatArray,
    positions: FloatArray,
    sources: NDArray[np.intp],
    settings: ReachSettings,
) -> int:
    """Return the source that is the robot: of those that last, the only one that moves.

    Raises:
        EpisodeError: none moves, or several do.
    """
    numbers, counts = np.unique(sources[sources >= 0], return_counts=True)
    lasting = numbers[counts > settings.glitch_ratio * len(times)]
    moving = [int(n) for n in lasting if _moves(positions[sources == n], settings)]
    if len(moving) != 1:
        each = ' and '.join(str(count) for count in sorted(counts, reverse=True)[:4])
        remedy = (
            "two publishers? Leave one out: give the topic of the robot's own as 'joint_states' "
            'in the mapping (--topics), or record again'
        )
        if items != 'messages':
            remedy = (
                'two recordings in one? Leave rows out, or, where the joint is that fast, give '
                "the robot's YAML 'speed_limits'"
            )
        raise EpisodeError(
            f'{begin}; {each} of {len(times)} {items} belong together, and it cannot be told '
            f'which are the robot: {remedy}'
        )
    return moving[0]


def _moves(positions: FloatArray, settings: ReachSettings) -> bool:
    """Return True if a tenth of the samples or more differ from the median position."""
    with np.errstate(invalid='ignore'):
        away = np.nan_to_num(np.abs(positions - np.nanmedian(positions, axis=0)))
    return bool(np.quantile(away.max(axis=1), 0.9) > settings.still)


def mend_rows(
    what: str, times: FloatArray, positions: FloatArray, robot: RobotModel
) -> tuple[FloatArray, list[str]]:
    """Return measured positions (T, J) for the rows of a table, and notes on repairs.

    A joint without a number, and a row that no joint can have moved to, has a position between
    those of the rows around it.

    Args:
        what: name of the table or feature, for texts.
        times: (T,) times of the rows [s].
        positions: (T, J) positions in the robot's order [rad or m].
        robot: robot whose joint names and limits are used.

    Raises:
        EpisodeError: a joint has no position at all, or see `find_unreachable`.
    """
    mended, notes = positions.copy(), []
    stamps = np.round((times - times[0]) * 1e9).astype(np.int64)
    mended[~np.isfinite(mended)] = np.nan
    missing: dict[str, list[str]] = {}
    for joint in np.flatnonzero(np.isnan(mended).any(axis=0)):
        count, name = int(np.isnan(mended[:, joint]).sum()), robot.joint_names[joint]
        text = f'not finite in {count} of {len(times)} rows'
        if count == len(times):
            raise EpisodeError(f"'{what}': joint '{name}' is {text}: it has no position at all")
        missing.setdefault(text, []).append(name)
    notes += [_stands_in(what, joints, text) for text, joints in missing.items()]
    found = find_unreachable(what, stamps, mended, JointReach(robot), 'rows')
    notes += found.texts
    mended[found.rows] = np.nan
    alike = [robot.joint_names] * len(times)
    notes += settle_grippers(what, stamps, robot.joint_names, mended, alike, robot)
    for joint in np.flatnonzero(np.isnan(mended).any(axis=0)):
        known = np.flatnonzero(np.isfinite(mended[:, joint]))
        mended[:, joint] = np.interp(times, times[known], mended[known, joint])
    return mended, notes


@dataclass(frozen=True, slots=True)
class _Names:
    """Columns of the names of a message; `doubled` = (column, positions of it in the message)."""

    columns: NDArray[np.intp]
    first: NDArray[np.intp]
    doubled: tuple[tuple[int, list[int]], ...]


def _no_change(names: Sequence[str]) -> Sequence[str]:
    return names


def merge_joint_states(
    topic: str,
    messages: Sequence[tuple[int, Any]],
    warnings: list[str],
    robot: RobotModel | None = None,
    renamed: Callable[[Sequence[str]], Sequence[str]] = _no_change,
    constants: Mapping[str, float] | None = None,
) -> JointStates | None:
    """Return one table of JointState messages, also of several publishers.

    Joints that a message does not name, or without a finite position in it, keep their last
    position. Rows before every joint has one are left out; only a gripper has its first position
    from the start. Each repair is a line in `warnings`.

    Args:
        topic: topic, for texts.
        messages: (stamp [ns], sensor_msgs/JointState), in the order received.
        warnings: list that repairs and oddities are added to, one line each.
        robot: samples that its joints cannot have moved to are left out; None = not checked.
        renamed: function that returns the robot's names of recorded names.
        constants: positions of joints that are not recorded [rad or m].

    Returns:
        None where no row is left.

    Raises:
        EpisodeError: samples contradict each other, see `find_unreachable`; a joint of the robot
            is named but never has a position.
    """
    ordered = sorted(messages, key=lambda item: item[0])
    whole = [(s, m) for s, m in ordered if len(m.name) == len(m.position) > 0]
    if len(whole) < len(ordered):
        count = len(ordered) - len(whole)
        warnings.append(f"'{topic}': {count} messages without a position per joint were left out")
    if not whole:
        return None
    constants = constants or {}
    given = [message for _, message in whole]
    names, table = _table(topic, given, renamed, warnings, robot, constants)
    names, table = _own_columns(names, table, robot, constants)
    stamps = np.array([stamp for stamp, _ in whole], np.int64)
    senders = [tuple(message.name) for message in given]
    if robot is not None and set(names) >= set(robot.joint_names):
        columns = [names.index(name) for name in robot.joint_names]
        found = find_unreachable(topic, stamps, table[:, columns], JointReach(robot))
        warnings += found.texts
        stamps, table = stamps[~found.rows], table[~found.rows]
        senders = [each for each, is_out in zip(senders, found.rows, strict=True) if not is_out]
    if robot is not None:
        warnings += settle_grippers(topic, stamps, names, table, senders, robot)
    tools = () if robot is None else robot.tools
    grippers = tuple(tool.gripper_joint for tool in tools if tool.gripper_joint)
    _warn_of_repeats(topic, stamps, np.isfinite(table), warnings)
    stamps, table = _filled(topic, stamps, names, table, grippers, warnings)
    is_last = np.append(np.diff(stamps) > 0, True)[: len(stamps)]
    stamps, table = stamps[is_last], table[is_last]
    if not len(stamps):
        return None
    return JointStates(stamps_ns=stamps, joint_names=names, positions=table)


def _table(
    topic: str,
    messages: Sequence[Any],
    renamed: Callable[[Sequence[str]], Sequence[str]],
    warnings: list[str],
    robot: RobotModel | None,
    constants: Collection[str],
) -> tuple[tuple[str, ...], FloatArray]:
    """Return the joint names, and positions (N, J).

    NaN where a message has none that can be used.
    """
    kinds = {tuple(message.name): None for message in messages}
    known = {given: tuple(renamed(given)) for given in kinds}
    names = tuple(dict.fromkeys(name for each in known.values() for name in each))
    places = {given: _places(each, names) for given, each in known.items()}
    table = np.full((len(messages), len(names)), np.nan)
    num_given = np.zeros(len(names), int)
    doubled: set[int] = set()
    for row, message in enumerate(messages):
        place, values = places[tuple(message.name)], np.asarray(message.position, np.float64)
        table[row, place.columns] = values[place.first]
        num_given[place.columns] += 1
        for column, at in place.doubled:
            if np.ptp(values[at]) > 0:
                table[row, column] = np.nan
                doubled.add(column)
    table[~np.isfinite(table)] = np.nan
    unusable = num_given - np.isfinite(table).sum(axis=0)
    wanted = set(names if robot is None else robot.joint_names) - set(constants)
    found: dict[str, list[str]] = {}
    for column in np.flatnonzero(unusable):
        if names[column] in wanted:
            why = 'named twice with different positions' if column in doubled else 'not finite'
            text = f'{why} in {unusable[column]} of {num_given[column]} messages'
            found.setdefault(text, []).append(names[column])
            if unusable[column] == num_given[column]:
                joint = names[column]
                begin = f"'{topic}': joint '{joint}' is {text}"
                raise EpisodeError(_without_positions(begin, joint, column in doubled))
    warnings += [_stands_in(topic, joints, text) for text, joints in found.items()]
    return names, table


def _own_columns(
    names: tuple[str, ...],
    table: FloatArray,
    robot: RobotModel | None,
    constants: Mapping[str, float],
) -> tuple[tuple[str, ...], FloatArray]:
    """Set constants; leave out joints of others where all of the robot's are there."""
    for joint, value in constants.items():
        if joint not in names:
            names, table = (*names, joint), np.column_stack([table, np.zeros(len(table))])
        table[:, names.index(joint)] = value
    used = np.isfinite(table).any(axis=0)
    if robot is not None and set(robot.joint_names) <= set(names):
        used &= np.isin(names, robot.joint_names)
    return tuple(np.array(names, object)[used]), table[:, used]


def _stands_in(what: str, joints: Sequence[str], text: str) -> str:
    """Return the note on unusable positions of joints, which their neighbours replace."""
    quoted = ', '.join(f"'{joint}'" for joint in joints)
    named = f'joint {quoted} is' if len(joints) == 1 else f'joints {quoted} are'
    return f"'{what}': {named} {text}; the positions before and after stand in"


def _without_positions(text: str, joint: str, is_doubled: bool) -> str:
    if is_doubled:
        return f'{text}: it cannot be told which of them is measured; publish the joint once'
    return (
        f'{text}, so that it has no position at all. Where it is not measured, give its position '
        f"in the mapping (--topics): 'constants: {{{joint}: 0.0}}'"
    )


def _places(known: Sequence[str], names: Sequence[str]) -> _Names:
    at: dict[str, list[int]] = {}
    for place, name in enumerate(known):
        at.setdefault(name, []).append(place)
    columns = [names.index(name) for name in at]
    doubled = [(names.index(name), all_) for name, all_ in at.items() if len(all_) > 1]
    first = np.array([all_[0] for all_ in at.values()], np.intp)
    return _Names(np.array(columns, np.intp), first, tuple(doubled))


def _filled(
    topic: str,
    stamps: Stamps,
    names: Sequence[str],
    table: FloatArray,
    grippers: Sequence[str],
    warnings: list[str],
) -> tuple[Stamps, FloatArray]:
    """Hold last positions; drop rows before every joint has one, but for grippers."""
    given = np.isfinite(table)
    firsts = given.argmax(axis=0)
    begin = max(
        (int(f) for f, n in zip(firsts, names, strict=True) if n not in grippers), default=0
    )
    for column, name in enumerate(names):
        _warn_of_holding(topic, name, stamps, given[:, column], warnings)
        late_s = (stamps[firsts[column]] - stamps[begin]) / NANO if len(stamps) else 0.0
        if firsts[column] > begin:
            value = table[firsts[column], column]
            table[begin : firsts[column], column] = value
            if late_s > HELD_S / 10:
                warnings.append(
                    f"'{topic}': joint '{name}' has no position for the first {late_s:.3g} s; its "
                    f'first one, {value:.4g}, stands in'
                )
    lost_s = (stamps[begin] - stamps[0]) / NANO if len(stamps) else 0.0
    if lost_s > HELD_S / 10:
        late = [n for f, n in zip(firsts, names, strict=True) if f == begin]
        warnings.append(
            f"'{topic}': joint '{late[0]}' has no position for the first {lost_s:.3g} s; the "
            f'{begin} messages before are left out'
        )
    rows = np.arange(len(table))[:, None]
    last = np.maximum.accumulate(np.where(np.isfinite(table), rows, 0), axis=0)
    held = np.take_along_axis(table, last, axis=0)
    return stamps[begin:], held[begin:]


def _warn_of_holding(
    topic: str, name: str, stamps: Stamps, given: BoolArray, warnings: list[str]
) -> None:
    """Say where a joint is no longer published while others are."""
    at = stamps[given]
    if len(at) < 2:
        return
    gaps = np.diff(np.append(at, stamps[-1])) / NANO
    longest = int(gaps.argmax())
    if gaps[longest] > max(HELD_S, HELD_PERIODS * float(np.median(np.diff(at))) / NANO):
        others = stamps[(stamps > at[longest]) & ~given]
        if len(others) > 1:
            warnings.append(
                f"'{topic}': joint '{name}' has no position for {gaps[longest]:.3g} s from "
                f'{(at[longest] - stamps[0]) / NANO:.3g} s on, while other joints have; its last '
                'one is held'
            )


def _warn_of_repeats(topic: str, stamps: Stamps, given: BoolArray, warnings: list[str]) -> None:
    """Say how often a joint has two positions at one stamp."""
    repeated = int(((np.diff(stamps) == 0) & (given[1:] & given[:-1]).any(axis=1)).sum())
    if repeated:
        warnings.append(f"'{topic}': {repeated} stamps came twice; the later message was kept")
