"""Glitches: temporary errors of a policy's commands, drawn at random.

A glitch lasts for a while, somewhere in the plan. Lengths, depths and frequencies are drawn evenly
over orders of magnitude, so that a few hundred episodes cover faults of many kinds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.faults.signals import Commands, crossed


@dataclass(frozen=True, slots=True)
class GlitchSettings:
    """Settings of random glitches.

    Attributes:
        point_period_s: time between the points of a policy's trajectory [s].
        duration_s: range of the duration of a glitch [s].
        onset_s: range of the onset of a glitch [s].
        pause_s: range of the pause between repetitions [s].
        repeated_fraction: fraction of glitches that are repeated to the end.
        joint_error_rad: range of the standard deviation of joint errors [rad].
        oscillation_hz: range of the frequency of joint errors [Hz].
        oscillating_fraction: fraction of joint glitches that oscillate.
        single_joint_fraction: fraction of joint glitches of one joint only.
        speed_factor: range of the factor on the speed.
        hold_s: range of the time for which a command is held [s].
        mirror_gain: range of the gain of a resting arm that follows another arm.
        max_mirror_delay_s: largest delay of an arm that follows another arm [s].
    """

    point_period_s: float = 0.1
    duration_s: tuple[float, float] = (0.06, 3.0)
    onset_s: tuple[float, float] = (0.02, 0.5)
    pause_s: tuple[float, float] = (0.3, 2.0)
    repeated_fraction: float = 0.3
    joint_error_rad: tuple[float, float] = (0.005, 0.25)
    oscillation_hz: tuple[float, float] = (0.2, 6.0)
    oscillating_fraction: float = 0.5
    single_joint_fraction: float = 0.4
    speed_factor: tuple[float, float] = (0.3, 4.0)
    hold_s: tuple[float, float] = (0.05, 1.5)
    mirror_gain: tuple[float, float] = (0.3, 1.3)
    max_mirror_delay_s: float = 1.0


_SETTINGS = GlitchSettings()


def with_glitches(commands: Commands, count: int, rng: np.random.Generator) -> FloatArray:
    """Return the positions (T, J) with `count` glitches; they may exceed the joint limits."""
    changed = commands
    for _ in range(count):
        glitch = _GLITCHES[int(rng.choice(len(_GLITCHES), p=_OFTEN))]
        changed = replace(changed, positions=glitch(changed, rng))
    return _published(commands, changed.positions)


def _published(commands: Commands, changed: FloatArray) -> FloatArray:
    """Return commands (T, J) with changed parts interpolated linearly between published points."""
    rows = np.arange(len(changed))
    points = np.append(rows[:: round(_SETTINGS.point_period_s / commands.period)], rows[-1])
    straight = np.stack([np.interp(rows, points, c[points]) for c in changed.T], axis=1)
    differs = np.abs(changed - commands.positions).max(axis=1) > 0
    between = np.searchsorted(points, rows, side='right')
    return np.where(np.isin(between, between[differs])[:, None], straight, commands.positions)


def _log_uniform(bounds: tuple[float, float], rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(bounds))))


def _presence(commands: Commands, rng: np.random.Generator) -> FloatArray:
    """Return the weight (T, 1) of the glitch, 0 to 1."""
    times = np.arange(len(commands.positions)) * commands.period
    begin, length = rng.uniform(0.0, 0.95) * times[-1], _log_uniform(_SETTINGS.duration_s, rng)
    onset, pause = _log_uniform(_SETTINGS.onset_s, rng), _log_uniform(_SETTINGS.pause_s, rng)
    since = times - begin
    if rng.random() < _SETTINGS.repeated_fraction:
        since = np.where(since > 0, since % (length + 2 * onset + pause), since)
    shape = np.interp(since, np.cumsum([0.0, onset, length, onset]), [0.0, 1.0, 1.0, 0.0])
    return np.asarray(shape)[:, None]


def _gripper(commands: Commands, rng: np.random.Generator) -> FloatArray:
    """Set one or more grippers to a random opening; without a gripper, change joints."""
    if not commands.grippers:
        return _joints(commands, rng)
    there = _presence(commands, rng)
    chosen = rng.random(len(commands.grippers)) < 0.5
    chosen[rng.integers(len(chosen))] = True
    off = commands.closed + rng.uniform() * commands.travel
    positions, columns = commands.positions.copy(), np.array(commands.grippers)[chosen]
    positions[:, columns] += there * (off[chosen] - positions[:, columns])
    return positions


def _joints(commands: Commands, rng: np.random.Generator) -> FloatArray:
    """Add a constant or an oscillating error to joints."""
    rows, joints = commands.positions.shape
    off = _log_uniform(_SETTINGS.joint_error_rad, rng) * rng.normal(size=joints)
    if rng.random() < _SETTINGS.single_joint_fraction:
        off *= np.arange(joints) == rng.choice(np.delete(np.arange(joints), commands.grippers))
    off[commands.grippers] = 0.0
    frequency, phases = (
        _log_uniform(_SETTINGS.oscillation_hz, rng),
        rng.uniform(0.0, 2 * np.pi, joints),
    )
    if rng.random() < _SETTINGS.oscillating_fraction:
        times = np.arange(rows)[:, None] * commands.period
        wave = np.sin(2 * np.pi * frequency * times + phases)
        # swings go on
        return commands.positions + _set_in(_presence(commands, rng), rng) * wave * off
    return commands.positions + _presence(commands, rng) * off


def _set_in(presence: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the presence of a glitch; half of the glitches last to the end."""
    return np.maximum.accumulate(presence) if rng.random() < 0.5 else presence


def _time(commands: Commands, rng: np.random.Generator) -> FloatArray:
    """Change the speed of time for a while, jump in time, or hold commands."""
    rows, period = len(commands.positions), commands.period
    at = np.arange(rows, dtype=np.float64)
    begin = int(rng.uniform(0.05, 0.9) * rows)
    length = max(round(_log_uniform(_SETTINGS.duration_s, rng) / period), 2)
    during = slice(begin, begin + length)
    match int(rng.integers(4)):
        case 0:  # the rest of the plan is delayed or advanced
            rates = np.ones(rows)
            rates[during] = _log_uniform(_SETTINGS.speed_factor, rng)
            at = np.cumsum(rates) - rates[0]
        case 1:  # commands are lost, and the last one held
            at[during] = begin
        case 2:  # left out, or carried out again
            at[begin:] += length * rng.choice((-1.0, 1.0))
        case _:
            held = max(round(_log_uniform(_SETTINGS.hold_s, rng) / period), 2)
            span = slice(begin, None) if rng.random() < 0.5 else during
            at[span] = at[span] // held * held
    at = np.clip(at, 0, rows - 1)
    ramp = max(round(_log_uniform(_SETTINGS.onset_s, rng) / period), 1)
    warped = np.stack([np.interp(at, np.arange(rows), c) for c in commands.positions.T], axis=1)
    before = np.repeat(warped[:1], ramp - 1, axis=0)
    padded = np.concatenate([before, warped])
    return np.lib.stride_tricks.sliding_window_view(padded, ramp, axis=0).mean(axis=-1)


def _other_arm(commands: Commands, rng: np.random.Generator) -> FloatArray:
    """Move a resting arm, and some other joints, like another arm, in the same or mirrored sense.

    With one arm alone, joints are off.
    """
    if commands.num_arms < 2:
        return _joints(commands, rng)
    positions = commands.positions
    joints = positions.shape[1]
    to_next = joints // commands.num_arms * int(rng.integers(1, commands.num_arms))
    ways, signs = positions - positions[0], np.ones(joints)
    if rng.random() < 0.5:
        signs = rng.choice((-1.0, 1.0), joints, p=(0.2, 0.8))
    late = np.maximum(
        np.arange(len(ways)) - int(rng.uniform(0, _SETTINGS.max_mirror_delay_s) / commands.period),
        0,
    )
    resting = (np.abs(ways) < 1e-9).all(axis=0) | (rng.random(joints) < 0.3)
    there = (ways == 0) | resting
    error = rng.uniform(*_SETTINGS.mirror_gain) * signs * crossed(positions, to_next)[late]
    num = max(round(_log_uniform(_SETTINGS.onset_s, rng) / commands.period), 1)
    sets_in = [np.convolve(column, np.ones(num) / num, 'same') for column in there.T]
    error = error * np.stack(sets_in, axis=1, dtype=np.float64)
    error[:, commands.grippers] = 0.0
    return positions + error


_GLITCHES: tuple[Callable[[Commands, np.random.Generator], FloatArray], ...] = (
    _gripper,
    _joints,
    _time,
    _other_arm,
)
_OFTEN = (0.35, 0.3, 0.2, 0.15)
