"""Glitches: temporary errors of a policy's commands, drawn at random.

A glitch lasts for a while, somewhere in the plan. Lengths, depths and frequencies are drawn evenly
over orders of magnitude, so that a few hundred episodes cover faults of many kinds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.faults.signals import Commands, crossed

#: between the points of a trajectory that a policy publishes [s]
_POINTS_S = 0.1
#: ranges of its duration, its onset, and the pause between repetitions [s]
_LENGTH_S, _ONSET_S, _EVERY_S = (0.06, 3.0), (0.02, 0.5), (0.3, 2.0)
#: share of the glitches that are repeated to the end
_REPEATED = 0.3
#: ranges of the standard deviation of joint errors [rad], and of their frequency [Hz]
_OFF_RAD, _SWING_HZ = (0.005, 0.25), (0.2, 6.0)
#: shares of joint glitches that oscillate, and that only one joint has
_SWINGS, _ALONE = 0.5, 0.4
#: ranges of the factor of time, and of the time for which a command is held [s]
_SPEED, _HELD_S = (0.3, 4.0), (0.05, 1.5)
#: range of the share by which a resting arm follows another one, and its largest delay [s]
_SHARE, _LAG_S = (0.3, 1.3), 1.0


def with_glitches(commands: Commands, count: int, rng: np.random.Generator) -> FloatArray:
    """Returns the positions (T, J) with `count` glitches; they may leave the joints' limits."""
    changed = commands
    for _ in range(count):
        glitch = _GLITCHES[int(rng.choice(len(_GLITCHES), p=_OFTEN))]
        changed = replace(changed, positions=glitch(changed, rng))
    return _published(commands, changed.positions)


def _published(commands: Commands, changed: FloatArray) -> FloatArray:
    """(T, J) at the rate of the published points, linear between them where something changed."""
    rows = np.arange(len(changed))
    points = np.append(rows[:: round(_POINTS_S / commands.period)], rows[-1])
    straight = np.stack([np.interp(rows, points, c[points]) for c in changed.T], axis=1)
    differs = np.abs(changed - commands.positions).max(axis=1) > 0
    between = np.searchsorted(points, rows, side='right')
    return np.where(np.isin(between, between[differs])[:, None], straight, commands.positions)


def _log_uniform(bounds: tuple[float, float], rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(bounds))))


def _presence(commands: Commands, rng: np.random.Generator) -> FloatArray:
    """(T, 1) weight of the glitch, 0 to 1."""
    times = np.arange(len(commands.positions)) * commands.period
    begin, length = rng.uniform(0.0, 0.95) * times[-1], _log_uniform(_LENGTH_S, rng)
    onset, pause = _log_uniform(_ONSET_S, rng), _log_uniform(_EVERY_S, rng)
    since = times - begin
    if rng.random() < _REPEATED:
        since = np.where(since > 0, since % (length + 2 * onset + pause), since)
    shape = np.interp(since, np.cumsum([0.0, onset, length, onset]), [0.0, 1.0, 1.0, 0.0])
    return np.asarray(shape)[:, None]


def _gripper(commands: Commands, rng: np.random.Generator) -> FloatArray:
    """One gripper or all are as far open as drawn; without one, joints are off."""
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
    """Joints are off, or swing."""
    rows, joints = commands.positions.shape
    off = _log_uniform(_OFF_RAD, rng) * rng.normal(size=joints)
    if rng.random() < _ALONE:
        off *= np.arange(joints) == rng.choice(np.delete(np.arange(joints), commands.grippers))
    off[commands.grippers] = 0.0
    frequency, phases = _log_uniform(_SWING_HZ, rng), rng.uniform(0.0, 2 * np.pi, joints)
    if rng.random() < _SWINGS:
        times = np.arange(rows)[:, None] * commands.period
        wave = np.sin(2 * np.pi * frequency * times + phases)
        # swings go on
        return commands.positions + _set_in(_presence(commands, rng), rng) * wave * off
    return commands.positions + _presence(commands, rng) * off


def _set_in(presence: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Half of the glitches stay once they have set in."""
    return np.maximum.accumulate(presence) if rng.random() < 0.5 else presence


def _time(commands: Commands, rng: np.random.Generator) -> FloatArray:
    """For some time, time runs faster or slower or jumps, or commands are held."""
    rows, period = len(commands.positions), commands.period
    at = np.arange(rows, dtype=np.float64)
    begin = int(rng.uniform(0.05, 0.9) * rows)
    length = max(round(_log_uniform(_LENGTH_S, rng) / period), 2)
    during = slice(begin, begin + length)
    match int(rng.integers(4)):
        case 0:  # what follows is so much later, or earlier
            rates = np.ones(rows)
            rates[during] = _log_uniform(_SPEED, rng)
            at = np.cumsum(rates) - rates[0]
        case 1:  # commands are lost, and the last one held
            at[during] = begin
        case 2:  # left out, or carried out again
            at[begin:] += length * rng.choice((-1.0, 1.0))
        case _:
            held = max(round(_log_uniform(_HELD_S, rng) / period), 2)
            span = slice(begin, None) if rng.random() < 0.5 else during
            at[span] = at[span] // held * held
    at = np.clip(at, 0, rows - 1)
    ramp = max(round(_log_uniform(_ONSET_S, rng) / period), 1)
    warped = np.stack([np.interp(at, np.arange(rows), c) for c in commands.positions.T], axis=1)
    before = np.repeat(warped[:1], ramp - 1, axis=0)
    padded = np.concatenate([before, warped])
    return np.lib.stride_tricks.sliding_window_view(padded, ramp, axis=0).mean(axis=-1)


def _other_arm(commands: Commands, rng: np.random.Generator) -> FloatArray:
    """An arm that rests moves as another does, to this side or that, as some joints do anyway.

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
    late = np.maximum(np.arange(len(ways)) - int(rng.uniform(0, _LAG_S) / commands.period), 0)
    resting = (np.abs(ways) < 1e-9).all(axis=0) | (rng.random(joints) < 0.3)
    there = (ways == 0) | resting
    error = rng.uniform(*_SHARE) * signs * crossed(positions, to_next)[late]
    num = max(round(_log_uniform(_ONSET_S, rng) / commands.period), 1)
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
