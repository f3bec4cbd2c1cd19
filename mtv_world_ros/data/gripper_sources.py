"""Measured gripper positions of two publishers, and grippers that never leave one position.

The joints of an arm are checked by how far they can move (`JointReach`); drivers of grippers
report steps, so that a single jump of a gripper means nothing. Two publishers that contradict
each other show as positions that go forth and back between messages. N samples.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.robot.model import RobotModel


@dataclass(frozen=True, slots=True)
class GripperSettings:
    """Thresholds of the tests of measured grippers."""

    #: distance of two positions that are not one [fraction of the travel]
    apart_ratio: float = 0.1
    #: time within which no gripper opens and closes again [s]
    back_s: float = 0.5
    #: minimum number of times that a position goes forth and back
    least_turns: int = 8
    #: the same as a fraction of the samples
    turns_ratio: float = 0.03
    #: number of newest samples that the live node tests
    window: int = 256
    #: motion below which a gripper stands still [fraction of the travel]
    still_ratio: float = 0.01
    #: motion from which the commands of a gripper move it [fraction of the travel]
    commanded_ratio: float = 0.25
    #: fraction of a publisher's samples that contradict the other one, from which all are its own
    other_ratio: float = 0.2


SETTINGS = GripperSettings()


def travels(robot: RobotModel) -> dict[str, float]:
    """Return the travel of each gripper's joint [rad or m]."""
    return {
        tool.gripper_joint: abs(tool.gripper_open - tool.gripper_closed)
        for tool in robot.tools
        if tool.gripper_joint
    }


def num_turns(
    times: FloatArray, positions: FloatArray, travel: float, settings: GripperSettings = SETTINGS
) -> int:
    """Return how often a gripper's positions go forth and back faster than a gripper can.

    Args:
        times: (N,) times of the samples [s], in increasing order.
        positions: (N,) positions [rad or m].
        travel: travel of the gripper [rad or m].
        settings: thresholds.
    """
    steps = np.diff(positions)
    is_step = np.abs(steps) > settings.apart_ratio * travel
    goes_back = is_step[1:] & is_step[:-1] & (steps[1:] * steps[:-1] < 0)
    return int((goes_back & (times[2:] - times[:-2] < settings.back_s)).sum())


def has_turns(count: int, num_samples: int, settings: GripperSettings = SETTINGS) -> bool:
    """Return True if the number of reversals shows two publishers."""
    return count >= settings.least_turns and count > settings.turns_ratio * num_samples


def settle_grippers(
    topic: str,
    stamps_ns: NDArray[np.int64],
    names: Sequence[str],
    table: FloatArray,
    senders: Sequence[tuple[str, ...]],
    robot: RobotModel,
) -> list[str]:
    """Remove from a table the gripper positions of a second publisher that stands still.

    Args:
        topic: topic, for texts.
        stamps_ns: (N,) stamps in increasing order [ns].
        names: names of the columns.
        table: (N, C) positions [rad or m], NaN = not in the message; changed in place.
        senders: names in each message (N,), which tell publishers apart.
        robot: robot whose grippers are looked at.

    Returns:
        What was removed, one line a gripper.

    Raises:
        EpisodeError: it cannot be told which publisher is the gripper.
    """
    notes = []
    for joint, travel in travels(robot).items():
        if joint not in names:
            continue
        column = names.index(joint)
        rows = np.flatnonzero(np.isfinite(table[:, column]))
        times = (stamps_ns[rows] - stamps_ns[0]) * 1e-9
        positions = table[rows, column]
        if not has_turns(num_turns(times, positions, travel), len(rows)):
            continue
        others, at = _standing_still(topic, joint, times, positions, travel)
        others = _whole_senders(others, [senders[row] for row in rows.tolist()])
        table[rows[others], column] = np.nan
        notes.append(
            f"'{topic}': joint '{joint}' has two publishers: {int(others.sum())} of {len(rows)} "
            f'positions stand still at {at:.4g} and were left out, those that move were taken'
        )
    return notes


def _standing_still(
    topic: str, joint: str, times: FloatArray, positions: FloatArray, travel: float
) -> tuple[BoolArray, float]:
    """Return the samples (N,) of the publisher that stands still, and where.

    Raises:
        EpisodeError: neither stands still, or both do.
    """
    sources = _two_sources(positions)
    ranges = [np.ptp(np.quantile(positions[sources == n], (0.1, 0.9))) for n in (0, 1)]
    is_still = [bool(spread <= SETTINGS.still_ratio * travel) for spread in ranges]
    if is_still[0] == is_still[1]:
        ends = ' and '.join(f'{np.median(positions[sources == n]):.4g}' for n in (0, 1))
        raise EpisodeError(
            f"'{topic}': joint '{joint}' has two publishers, whose positions alternate around "
            f'{ends}, and it cannot be told which of them is the gripper: leave one out, by '
            "'joint_states' in the mapping (--topics) with the topics that have it once, or "
            'record again'
        )
    still = sources == is_still.index(True)
    return still, float(np.median(positions[still]))


def _two_sources(positions: FloatArray) -> NDArray[np.intp]:
    """Return the source (N,), 0 or 1, of each position: that whose last position is nearest."""
    found = np.zeros(len(positions), np.intp)
    first = int(np.argmax(np.abs(np.diff(positions))))
    last = [float(positions[first]), float(positions[first + 1])]
    for row in range(first, -1, -1):  # back from where both are known to be apart
        found[row] = int(abs(positions[row] - last[1]) < abs(positions[row] - last[0]))
        last[found[row]] = float(positions[row])
    last = [float(positions[first]), float(positions[first + 1])]
    for row in range(first, len(positions)):
        found[row] = int(abs(positions[row] - last[1]) < abs(positions[row] - last[0]))
        last[found[row]] = float(positions[row])
    return found


def _whole_senders(others: BoolArray, senders: Sequence[tuple[str, ...]]) -> BoolArray:
    """Return the samples (N,) of the publishers that the samples in `others` are of.

    Two publishers at one place cannot be told apart by positions; the names in a message can
    tell them apart.
    """
    shares = {
        sender: float(others[[each == sender for each in senders]].mean())
        for sender in dict.fromkeys(senders)
    }
    is_other = {sender: share > SETTINGS.other_ratio for sender, share in shares.items()}
    if len(shares) < 2 or all(is_other.values()):
        return others
    return np.array([is_other[sender] for sender in senders])


def resting_grippers(
    positions: FloatArray, commanded: Sequence[FloatArray], robot: RobotModel
) -> dict[str, str]:
    """Return notes on grippers that do not move while their commands do.

    Args:
        positions: (N, J) measured positions in the robot's order [rad or m].
        commanded: (T, J) commanded positions of each plan.
        robot: the robot.
    """
    if not commanded or not len(positions):
        return {}
    wanted = np.concatenate(list(commanded))
    found = {}
    for joint, travel in travels(robot).items():
        column = robot.joint_names.index(joint)
        measured, commands = positions[:, column], wanted[:, column]
        moves = np.ptp(commands) > SETTINGS.commanded_ratio * travel
        if moves and np.ptp(measured) < SETTINGS.still_ratio * travel:
            found[joint] = (
                f"joint '{joint}' stays at {np.median(measured):.4g} while its commands move "
                f'from {commands.min():.4g} to {commands.max():.4g}'
            )
    return found


class GripperWatch:
    """The test of two publishers for samples that arrive one by one, as in the live node.

    Args:
        travel: travel of each gripper's joint [rad or m].
    """

    def __init__(self, travel: Mapping[str, float]) -> None:
        self._travels = dict(travel)
        self._samples: dict[str, deque[tuple[float, float]]] = {}

    def clear(self) -> None:
        """Forget all samples."""
        self._samples.clear()

    def add(self, name: str, seconds: float, position: float) -> None:
        """Take a sample of a joint, in the order received; others than grippers are ignored."""
        if name in self._travels:
            empty: deque[tuple[float, float]] = deque(maxlen=SETTINGS.window)
            self._samples.setdefault(name, empty).append((seconds, position))

    def contradiction(self) -> str:
        """Return which grippers are reported at two places in turn, or ''."""
        for name, samples in self._samples.items():
            times, positions = np.array(samples).T
            count = num_turns(times, positions, self._travels[name])
            if has_turns(count, len(samples)):
                low, high = positions.min(), positions.max()
                return (
                    f"joint states contradict each other: '{name}' goes forth and back between "
                    f'{low:.4g} and {high:.4g} {count} times in its last {len(samples)} samples; '
                    'do two nodes publish it?'
                )
        return ''
