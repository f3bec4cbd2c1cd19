"""Changes of the commands of a plan, of which faults consist.

Shape letters: T commands, J joints, A arms, G grippers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial, wraps

import numpy as np

from mtv_world_ros.core.data_types import FloatArray
from mtv_world_ros.simulation.faults.glitches import with_glitches
from mtv_world_ros.simulation.faults.signals import Commands, crossed


@dataclass(frozen=True, slots=True)
class CommandFaultSettings:
    """Settings of the command faults.

    Attributes:
        jump_s: duration of a jump of the commands [s].
        onset_s: duration of the onset of a constant error [s].
        event_window: part of a plan in which a single event happens [fraction of its duration].
        twitch_period_s: period of gripper jerks [s].
        flicker_s: range of the durations between flickers of a gripper [s].
        num_flickers: number of flickers.
        before_flicker_s: time of rest before a gripper passes its middle [s].
        flinch_opening: gripper opening at which arms flinch [fraction of the range].
        max_still_change: largest change of the opening between commands at rest [fraction].
        flinch_speed: speed factor of the motion backwards.
        num_wrist_joints: number of wrist joints, the last joints of an arm.
        max_rest_travel_m: tool travel up to which an arm is at rest [m].
        chunk_s: duration of a chunk of commands [s].
        num_losses: number of gaps with lost commands.
        damping_ratio: damping of swinging arms [fraction of critical damping].
        swap_s: onset, duration and end of a swap of commands [s].
        num_waves: periods of a wavy error over one turn of a joint.
        slump_s: durations of sinking, lying and rising of arms [s].
        heave_period_s: period of vertical waves [s].
        derivative_step_rad: step of the numerical derivative of tool heights [rad].
        min_squared_slope: smallest squared derivative of a tool height [m2/rad2].
        num_spikes: number of outliers.
        spike_s: duration of an outlier [s].
        tremor_hz: frequency of a tremor [Hz].
        drift_knot_s: time between the samples that a slow error is interpolated from [s].
    """

    jump_s: float = 0.1
    onset_s: float = 1.0
    event_window: tuple[float, float] = (0.1, 0.7)
    twitch_period_s: float = 0.8
    flicker_s: tuple[float, float] = (0.1, 0.3)
    num_flickers: int = 30
    before_flicker_s: float = 0.6
    flinch_opening: float = 0.1
    max_still_change: float = 1e-3
    flinch_speed: int = 2
    num_wrist_joints: int = 3
    max_rest_travel_m: float = 1e-6
    chunk_s: float = 0.8
    num_losses: int = 3
    damping_ratio: float = 0.2
    swap_s: tuple[float, float, float] = (0.2, 0.4, 0.2)
    num_waves: int = 4
    slump_s: tuple[float, float, float] = (0.3, 0.4, 0.6)
    heave_period_s: float = 2.0
    derivative_step_rad: float = 1e-4
    min_squared_slope: float = 1e-3
    num_spikes: int = 3
    spike_s: float = 0.4
    tremor_hz: float = 2.5
    drift_knot_s: float = 0.5


_SETTINGS = CommandFaultSettings()

Rng = np.random.Generator
#: returns changed positions (T, J) by the size of a fault
CommandChange = Callable[[Commands, float, Rng], FloatArray]


def _own(rng: Rng) -> Rng:
    """Return a generator of the fault's own, so that later faults draw the same numbers."""
    return np.random.default_rng(rng.integers(2**32))


def _read(at: FloatArray, positions: FloatArray) -> FloatArray:
    """Return positions (N, J): the rows (T, J), interpolated at row numbers (N,)."""
    rows = np.arange(len(positions))
    return np.stack([np.interp(at, rows, column) for column in positions.T], axis=1)


def _blended(before: FloatArray, rest: FloatArray, num: int) -> FloatArray:
    """Return (N, J) `rest`, to which a row before (J,) passes within `num` rows."""
    whole, num = rest.copy(), min(num, len(rest))
    blend = (np.arange(1, num + 1) / num)[:, None] if num else np.zeros((0, 1))
    whole[:num] = (1 - blend) * before + blend * whole[:num]
    return whole


def delay(c: Commands, size: float, rng: Rng, *, only: str = '') -> FloatArray:
    """Delay the grippers by `size` [s]; `only` where they open: `opening`."""
    whole, late = c.delayed(c.num(size))
    opens, follows = np.sign(c.travel), late[:, c.grippers]
    if only == 'opening':
        follows = np.minimum(whole[:, c.grippers] * opens, follows * opens) * opens
    whole[:, c.grippers] = follows
    return whole


def lead(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Advance the grippers before the arms by `size` [s]."""
    ahead = np.minimum(np.arange(len(c.positions)) + c.num(size), len(c.positions) - 1)
    return c.grippers_of(c.positions[ahead][:, c.grippers])


def _followed(c: Commands, rule: Callable[[FloatArray, FloatArray], FloatArray]) -> FloatArray:
    """Return (T, J) of joints whose next position follows from their last one and the command."""
    whole = c.positions.copy()
    for row in range(1, len(whole)):
        whole[row] = rule(whole[row - 1], c.positions[row])
    return whole


def lag(c: Commands, size: float, rng: Rng, *, joints: str) -> FloatArray:
    """Apply a first-order lag with time constant `size` [s] to `grippers` or `wrists`."""
    share = 1 - np.exp(-1 / (size / c.period))
    late = _followed(c, lambda last, now: last + share * (now - last))
    if joints == 'grippers':
        return c.grippers_of(late[:, c.grippers])
    whole, columns = c.positions.copy(), c.arms[:, -_SETTINGS.num_wrist_joints :].ravel()
    whole[:, columns] = late[:, columns]
    return whole


def give_way(
    c: Commands, size: float, rng: Rng, *, by: Callable[[Commands], FloatArray]
) -> FloatArray:
    """Open grippers to at least a fraction of their range, with a weight (T, G or 1)."""
    opens = np.sign(c.travel)
    least = c.closed + np.minimum(size * by(c), 1.0) * c.travel
    return c.grippers_of(np.maximum(c.positions[:, c.grippers] * opens, least * opens) * opens)


def twitches(c: Commands) -> FloatArray:
    """Return jerks (T, 1), 0 to 1; 0 most of the time."""
    knots = _SETTINGS.jump_s * np.arange(4)
    return np.interp(c.times % _SETTINGS.twitch_period_s, knots, [0.0, 1.0, 1.0, 0.0])[:, None]


def haste(c: Commands) -> FloatArray:
    """Return the speed (T, G) of the arm of each gripper, as a fraction of its top speed."""
    steps = np.gradient(c.positions, axis=0)
    steps[:, c.grippers] = 0.0
    speeds = np.linalg.norm(steps.reshape(len(steps), c.num_arms, -1), axis=2)
    top = speeds.max(axis=0)
    return (speeds / np.where(top > 0, top, 1.0))[:, _arms_of_grippers(c)]


def reach(c: Commands) -> FloatArray:
    """Return the horizontal reach (T, G) of the arm of each gripper [fraction of its maximum]."""
    tools = np.stack([poses[:, :2, 3] for poses in c.robot.tool_poses(c.positions)], axis=1)
    ways = np.linalg.norm(tools - tools[0], axis=2)
    most = ways.max(axis=0)
    return (ways / np.where(most > _SETTINGS.max_rest_travel_m, most, 1.0))[
        :, _arms_of_grippers(c)
    ]


def _arms_of_grippers(c: Commands) -> np.ndarray:
    return np.array(c.grippers) // (c.positions.shape[1] // c.num_arms)


def time_shut(c: Commands) -> FloatArray:
    """Return the time (T, G) since a gripper was last more than half open [s]."""
    is_open = (c.positions[:, c.grippers] - c.middles) * np.sign(c.travel) > 0
    rows = c.rows[:, None]
    return (rows - np.maximum.accumulate(np.where(is_open, rows, 0))) * c.period


def _passes(c: Commands) -> list[tuple[int, float, int]]:
    """Return column, middle and row of each event at which a gripper passes its middle."""
    return [
        (column, float(middle), int(row) + 1)
        for column, middle in zip(c.grippers, c.middles, strict=True)
        for row in np.flatnonzero(np.diff(c.positions[:, column] > middle))
    ]


def flicker(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Move a gripper back and forth for `size` [s] after it passes its middle."""
    own, whole = _own(rng), c.positions.copy()
    for column, _, row in _passes(c):
        since = c.times - c.times[row]
        knots = np.cumsum(own.uniform(*_SETTINGS.flicker_s, size=_SETTINGS.num_flickers))
        back = np.interp(since, knots, np.arange(_SETTINGS.num_flickers) % 2)
        back *= np.clip((size - since) / _SETTINGS.jump_s + 1, 0.0, 1.0)
        before = c.positions[max(row - c.num(_SETTINGS.before_flicker_s), 0), column]
        whole[:, column] += back * (before - whole[:, column])
    return whole


def pause_half_way(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Stop a gripper for `size` [s] whenever it passes its middle."""
    whole = c.positions.copy()
    for column, middle, row in _passes(c):
        after = np.maximum(np.arange(len(whole) - row) - c.num(size), 0)
        blend = np.minimum(after * c.period / _SETTINGS.jump_s, 1.0)
        whole[row:, column] = middle + blend * (c.positions[row:, column] - middle)
    return whole


def hurry(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Speed up the plan by a fraction while a gripper is closed."""
    is_shut = c.robot.gripper_openings(c.positions).min(axis=0) < 0.5
    times = np.cumsum(np.where(is_shut, 1 / (1 + size), 1.0)) - 1
    at = np.interp(np.arange(int(times[-1]) + 1), times, c.rows)
    return _read(at, c.positions)


def pause(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Delay the arms relative to the grippers by `size` [s], from a random time on."""
    first, num = int(_own(rng).uniform(0.15, 0.6) * len(c.positions)), c.num(size)
    stands = np.repeat(c.positions[first : first + 1], num, axis=0)
    arms = np.concatenate([c.positions[:first], stands, c.positions[first:]])
    arms[:, c.grippers] = c.delayed(num)[0][:, c.grippers]
    return arms


def jump(
    c: Commands, size: float, rng: Rng, *, between: Sequence[float], back: bool, seconds: float
) -> FloatArray:
    """Jump ahead or back in the plan [s] once, at a random time within a part of it."""
    at = int(float(_own(rng).uniform(between[0], between[1])) * len(c.positions))
    to = max(at - c.num(size), 0) if back else at + c.num(size)
    rest = _blended(c.positions[at - 1], c.positions[to:], c.num(seconds))
    return np.concatenate([c.positions[:at], rest])


def flinch(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Move the arms back along their path by `size` [s] and return, once as a gripper moves.

    The gripper completes its motion and rests until the arms are back at the same place.
    """
    own, ways = _own(rng), []
    for opening in c.robot.gripper_openings(c.positions):
        stands = np.append(np.abs(np.diff(opening)) < _SETTINGS.max_still_change, True)
        for change in np.flatnonzero(np.diff(opening > _SETTINGS.flinch_opening)):
            begin = int(change - np.argmax(stands[change::-1]))
            ways.append((begin, int(change + np.argmax(stands[change:]))))
    if not ways:
        return c.positions
    begin, end = ways[int(own.integers(len(ways)))]
    back = np.arange(begin, max(begin - c.num(size), 0), -_SETTINGS.flinch_speed)
    rows = np.arange(len(c.positions))
    whole = c.positions[np.insert(rows, begin, [*back, *back[::-1]])]
    hands = np.insert(rows, end, np.full(2 * len(back), end))
    whole[:, c.grippers] = c.positions[hands][:, c.grippers]
    return whole


def mix(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Average the commands with delayed ones; the delay is random, up to `size` [s]."""
    whole, late = c.delayed(c.num(_own(rng).uniform() * size))
    return (whole + late) / 2


def restart(c: Commands, size: float, rng: Rng, *, seconds: float) -> FloatArray:
    """Go back and restart the plan once, at a random fraction of it up to `size`."""
    share, num = float(size * _own(rng).uniform()), c.num(seconds)
    end = 1 + int(share * (len(c.positions) - 1))
    back = np.repeat(c.positions[:1], num, axis=0)
    back = _blended(c.positions[end - 1], back, num)
    return np.concatenate([c.positions[:end], back, c.positions[1:]])


def shuffle(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Exchange two consecutive chunks of `size` [s] once."""
    share, rows = float(_own(rng).uniform()), np.arange(len(c.positions))
    num = min(c.num(size), (len(rows) - 1) // 2)
    begin = 1 + int(share * (len(rows) - 1 - 2 * num))
    middle, end = begin + num, begin + 2 * num
    order = np.concatenate([rows[:begin], rows[middle:end], rows[begin:middle], rows[end:]])
    whole, num = c.positions[order], min(c.num(_SETTINGS.jump_s), num)
    for first in (begin, middle, end):
        after = whole[first : first + num].copy()
        blend = (np.arange(1, len(after) + 1) / num)[:, None]
        whole[first : first + num] = (1 - blend) * whole[first - 1] + blend * after
    return whole


def seams(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Shift each chunk of commands except the first in time, by up to `size` [s]."""
    own, most = _own(rng), size / c.period
    whole, _ = c.delayed(int(np.ceil(most)))
    rows, num = np.arange(len(whole)), c.num(_SETTINGS.chunk_s)
    chunks = rows // num
    ahead = np.rint(most * own.uniform(-1.0, 1.0, chunks[-1] + 1)).astype(int)
    ahead[0] = 0
    before, now = (
        whole[np.clip(rows + ahead[numbers], 0, len(whole) - 1)]
        for numbers in (np.maximum(chunks - 1, 0), chunks)
    )
    blend = np.minimum((rows % num + 1) * c.period / _SETTINGS.jump_s, 1.0)[:, None]
    return (1 - blend) * before + blend * now


def delay_each(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Delay each arm joint by a time of its own, up to `size` [s]."""
    own, most = _own(rng), size / c.period
    whole, _ = c.delayed(int(np.ceil(most)))
    rows, behind = np.arange(len(whole)), most * own.uniform(size=whole.shape[1])
    behind[c.grippers] = 0.0
    columns = zip(behind, whole.T, strict=True)
    return np.stack([np.interp(rows - by, rows, column) for by, column in columns], axis=1)


def gripper_tempo(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Speed up or slow down the grippers relative to the arms, by a fraction up to `size`."""
    share = size * _own(rng).uniform(-1.0, 1.0)
    tempo = 1 + share if share > 0 else 1 / (1 - share)
    whole, _ = c.delayed(int(np.ceil(max(-share, 0.0) * len(c.positions))))
    rows = np.arange(len(whole))
    for column in c.grippers:
        whole[:, column] = np.interp(tempo * rows, rows, whole[:, column])
    return whole


def hold_all(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Hold the first command of each period of `size` [s] until the next period."""
    num = c.num(size)
    if num < 2:
        return c.positions
    rows = np.arange(len(c.positions))
    held = rows // num * num
    blend = np.minimum((rows - held + 1) * c.period / _SETTINGS.jump_s, 1.0)[:, None]
    return (1 - blend) * c.positions[np.maximum(held - num, 0)] + blend * c.positions[held]


def _average(positions: FloatArray, num: int) -> FloatArray:
    """Return the moving average (T, J) over `num` rows."""
    if num < 2:
        return positions
    before = np.repeat(positions[:1], num // 2, axis=0)
    after = np.repeat(positions[-1:], num - 1 - num // 2, axis=0)
    padded = np.concatenate([before, positions, after])
    return np.lib.stride_tricks.sliding_window_view(padded, num, axis=0).mean(axis=-1)


def quantise(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Round the arms to multiples of `size` [rad] from the first row, with jumps between them."""
    steps = size * np.rint((c.positions - c.positions[0]) / size)
    return c.arms_of(_average(c.positions[0] + steps, c.num(_SETTINGS.jump_s)))


def play(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Apply a backlash of `size` [rad] to each arm joint."""
    slack = size / 2
    return c.arms_of(_followed(c, lambda last, now: np.clip(last, now - slack, now + slack)))


def stick(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Apply stiction to each arm joint: it rests until its command is over `size` [rad] off."""
    whole = _followed(c, lambda last, now: np.where(np.abs(now - last) <= size, last, now))
    return c.arms_of(_average(whole, c.num(_SETTINGS.jump_s)))


def _of_one(
    change: Callable[[Commands, FloatArray, float, Rng], FloatArray],
) -> Callable[[Commands, float, Rng], FloatArray]:
    """Return a primitive that changes the positions (T,) of a random moving arm joint."""

    @wraps(change)
    def primitive(c: Commands, size: float, rng: Rng) -> FloatArray:
        own, whole = _own(rng), c.positions.copy()
        joint = c.moving(own)
        whole[:, joint] = change(c, whole[:, joint].copy(), size, own)
        return whole

    return primitive


@_of_one
def scale_one(c: Commands, way: FloatArray, size: float, rng: Rng) -> FloatArray:
    """Scale the motion of the joint down by a fraction."""
    return way - size * (way - way[0])


@_of_one
def stop_one(c: Commands, way: FloatArray, size: float, rng: Rng) -> FloatArray:
    """Stop the joint for `size` [s]; it then catches up."""
    first = int(rng.uniform(*_SETTINGS.event_window) * len(way))
    after = np.maximum(np.arange(len(way)) - first - c.num(size), 0)
    blend = np.minimum(after * c.period / _SETTINGS.jump_s, 1.0)
    return np.where(c.rows < first, way, way[first] + blend * (way - way[first]))


@_of_one
def limit_one(c: Commands, way: FloatArray, size: float, rng: Rng) -> FloatArray:
    """Limit the joint to a part of its travel, short of both ends by a fraction."""
    far = way - way[0]
    return way[0] + np.clip(far, (1 - size) * far.min(), (1 - size) * far.max())


@_of_one
def bind_one(c: Commands, way: FloatArray, size: float, rng: Rng) -> FloatArray:
    """Stop the joint at one position until its command is `size` further [rad]."""
    away = way - rng.uniform(way.min(), way.max())
    side = away[0]
    for row, far in enumerate(away):
        if far * side < 0 and abs(far) < size:
            way[row] -= far
        elif far:
            side = far
    return _average(way[:, None], c.num(_SETTINGS.jump_s))[:, 0]


@_of_one
def slip_one(c: Commands, way: FloatArray, size: float, rng: Rng) -> FloatArray:
    """Shift the joint by `size` [rad] to one side, from a random time to the end."""
    first = int(rng.uniform(*_SETTINGS.event_window) * len(way))
    return way + rng.choice((-size, size)) * c.ramp(_SETTINGS.jump_s, c.times[first])


def tow(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Couple each joint to the next joint of its arm by a fraction, with a random sign."""
    own, whole, ways = _own(rng), c.positions.copy(), size * (c.positions - c.positions[0])
    for arm in c.arms:
        whole[:, arm[1:]] += ways[:, arm[:-1]] * own.choice((-1.0, 1.0), len(arm) - 1)
    return whole


def lose_one_way(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Lose a fraction of an arm joint's motion in a random direction; the error accumulates."""
    sides = _own(rng).choice((-1.0, 1.0), c.positions.shape[1])
    steps, whole = np.diff(c.positions, axis=0), c.positions.copy()
    whole[1:] -= np.cumsum(np.where(steps * sides > 0, size * steps, 0.0), axis=0)
    return c.arms_of(whole)


def average(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Average the commands of the arms over `size` [s]."""
    return c.arms_of(_average(c.positions, c.num(size)))


def limit_speed(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Limit each arm joint to its top speed less a fraction, so that it lags behind."""
    most = (1 - size) * np.abs(np.diff(c.positions, axis=0)).max(axis=0)
    return c.arms_of(_followed(c, lambda last, now: last + np.clip(now - last, -most, most)))


def lose_steps(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Drop the motion of the arms over `size` [s] once, without a later correction."""
    share = float(_own(rng).uniform(*_SETTINGS.event_window))
    begin, num = int(share * len(c.positions)), c.num(size)
    steps, lost = np.diff(c.positions, axis=0), np.zeros_like(c.positions)
    lost[begin + 1 : begin + 1 + num] = steps[begin : begin + num]
    return c.arms_of(c.positions - np.cumsum(lost, axis=0))


def sink_once(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Lower all tools by `size` [m] once, and raise them again."""
    share = float(_own(rng).uniform(*_SETTINGS.event_window))
    return _lowered(c, size * c.pulse(share * len(c.positions), *_SETTINGS.slump_s))


def heave(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Add vertical waves of amplitude `size` [m] to all tools, after an onset."""
    phase = float(_own(rng).uniform(0.0, 2 * np.pi))
    waves = np.sin(2 * np.pi * c.times / _SETTINGS.heave_period_s + phase)
    return _lowered(c, size * c.ramp(_SETTINGS.onset_s) * waves)


def _lowered(c: Commands, sunk: FloatArray) -> FloatArray:
    """Return positions (T, J) with all tools lowered by `sunk` (T,) [m].

    A joint gives way by as much as its arm's weight turns it: by how much it lowers the tool.
    """

    def heights(at: FloatArray) -> FloatArray:
        return np.stack([poses[:, 2, 3] for poses in c.robot.tool_poses(at)], axis=1)

    now, slopes = heights(c.positions), np.zeros((c.num_arms, *c.positions.shape))
    for joint in c.arms.ravel():
        step = _SETTINGS.derivative_step_rad * (np.arange(c.positions.shape[1]) == joint)
        slopes[:, :, joint] = (
            (heights(c.positions + step) - now) / _SETTINGS.derivative_step_rad
        ).T
    squares = np.maximum((slopes**2).sum(axis=2, keepdims=True), _SETTINGS.min_squared_slope)
    return c.positions - (sunk[:, None] * slopes / squares).sum(axis=0)


def fade(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Scale down the motion of all arm joints with time, by a fraction at the end."""
    shares = np.linspace(0.0, size, len(c.positions))[:, None]
    return c.arms_of(c.positions - shares * (c.positions - c.positions[0]))


def warp(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Add a periodic error over an arm joint's angle [rad]; the first command is unchanged."""
    phases = _own(rng).uniform(0.0, 2 * np.pi, c.positions.shape[1])
    waves = np.sin(_SETTINGS.num_waves * c.positions + phases)
    return c.arms_of(c.positions + size * (waves - waves[0]))


def swap_arms(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Mix a fraction of the commands of the arms with each other's once."""
    first = int(float(_own(rng).uniform(0.1, 0.9)) * len(c.positions))
    weights = size * c.pulse(first, *_SETTINGS.swap_s)[:, None]
    others = c.positions[0] + crossed(c.positions, c.positions.shape[1] // c.num_arms)
    return c.positions + weights * (others - c.positions)


def swing(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Filter the arms as masses on springs with a period of `size` [s]."""
    angle = 2 * np.pi * c.period / size
    damped = angle * np.sqrt(1 - _SETTINGS.damping_ratio**2)
    decay, cos, sin = np.exp(-_SETTINGS.damping_ratio * angle), np.cos(damped), np.sin(damped)
    part = _SETTINGS.damping_ratio * angle / damped
    whole, speed = c.positions.copy(), np.zeros_like(c.positions[0])
    for row in range(1, len(whole)):
        away = whole[row - 1] - c.positions[row]
        whole[row] += decay * ((cos + part * sin) * away + sin / damped * speed)
        speed = decay * ((cos - part * sin) * speed - angle**2 / damped * sin * away)
    return c.arms_of(whole)


def freeze(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Drop the commands of `size` [s] at a few random times and hold the last one."""
    held, own = np.arange(len(c.positions)), _own(rng)
    for first in (own.uniform(0.1, 0.9, _SETTINGS.num_losses) * len(held)).astype(int):
        held[first : first + c.num(size)] = held[first]
    return c.positions[held]


def glitches(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Add a number of random glitches."""
    return with_glitches(c, round(size), _own(rng))


def error(c: Commands, size: float, rng: Rng, *, of: CommandChange) -> FloatArray:
    """Add an error (T, J) to the commands of the arms."""
    added = of(c, size, rng)
    added[:, c.grippers] = 0.0
    return c.positions + added


def offsets(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Return a constant error of each joint, after an onset."""
    drawn = _own(rng).normal(0.0, size, c.positions.shape[1])
    return c.ramp(_SETTINGS.onset_s)[:, None] * drawn


def drifts(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Return an error of each joint that grows with time, by `size` [rad/s]."""
    return c.times[:, None] * _own(rng).normal(0.0, size, c.positions.shape[1])


def mirrored_arm(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Mirror the motion of an arm in the next arm, in the order of joints, if that one rests."""
    is_still = (c.positions == c.positions[0]).astype(np.float64)
    at_rest = _average(is_still, c.num(_SETTINGS.onset_s))
    return size * at_rest * crossed(c.positions, c.positions.shape[1] // c.num_arms)


def tremors(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Return a fast oscillation of each joint, after an onset."""
    phases = _own(rng).uniform(0.0, 2 * np.pi, c.positions.shape[1])
    waves = np.sin(2 * np.pi * _SETTINGS.tremor_hz * c.times[:, None] + phases)
    return size * c.ramp(_SETTINGS.onset_s)[:, None] * waves


def spikes(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Return a few short outliers of each joint."""
    own = _own(rng)
    middles = own.uniform(0.1, 0.9, _SETTINGS.num_spikes) * len(c.positions)
    return _triangles(c, middles, c.positions.shape[1], size, own)


def kicks(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Jerk the arm of a gripper once, whenever the gripper opens or closes."""
    is_open, own = c.robot.gripper_openings(c.positions) > 0.5, _own(rng)
    arm = c.positions.shape[1] // len(is_open)
    changes = (np.flatnonzero(np.diff(one)).astype(np.float64) for one in is_open)
    return np.hstack([_triangles(c, rows, arm, size, own) for rows in changes])


def _triangles(
    c: Commands, middles: FloatArray, num_joints: int, deviation: float, rng: Rng
) -> FloatArray:
    """Return short triangles (T, J) at some rows, with a random height for each joint."""
    away = np.abs(c.rows[:, None] - middles) * c.period / (_SETTINGS.spike_s / 2)
    return np.maximum(1 - away, 0.0) @ rng.normal(0.0, deviation, (len(middles), num_joints))


def gripper_errors(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Return an error of each joint of an arm that grows as its gripper closes."""
    shut = 1 - c.robot.gripper_openings(c.positions).T
    drawn = _own(rng).normal(0.0, size, c.positions.shape[1])
    return np.repeat(shut, c.positions.shape[1] // c.num_arms, axis=1) * drawn


def slow_noise(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Return a slow error (T, J), zero at first: random every half second, linear in between."""
    knots = np.arange(0.0, c.times[-1] + 2 * _SETTINGS.drift_knot_s, _SETTINGS.drift_knot_s)
    drawn = rng.normal(0.0, size, (len(knots), c.positions.shape[1]))
    drawn[0] = 0.0
    return np.stack([np.interp(c.times, knots, column) for column in drawn.T], axis=1)


def tempo(c: Commands, size: float, rng: Rng, *, faster: bool) -> FloatArray:
    """Speed up or slow down the plan by a fraction; its end is cut off or held."""
    last, speed = len(c.positions) - 1, 1 + size if faster else 1 / (1 + size)
    return _read(np.minimum(np.arange(last + 1) * speed, last), c.positions)


def opening_noise(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Add a slow error to the openings of the grippers [fraction of their range]."""
    added = slow_noise(c, size, rng)[:, c.grippers] * c.travel
    return c.grippers_of(c.positions[:, c.grippers] + added)


def stop(c: Commands, size: float, rng: Rng) -> FloatArray:
    """Stop all joints after a fraction of the plan."""
    whole, last = c.positions.copy(), int(size * (len(c.positions) - 1))
    whole[last:] = whole[last]
    return whole


#: changes in the order in which those of a policy with several faults are made
COMMANDS: tuple[Callable[..., FloatArray], ...] = (
    *(delay, lead, lag, give_way, flicker, pause_half_way, hurry, pause, jump, flinch, mix),
    *(restart, shuffle, seams, delay_each, gripper_tempo, hold_all, quantise, play, stick),
    *(scale_one, stop_one, limit_one, bind_one, slip_one, tow, lose_one_way, average),
    *(limit_speed, lose_steps, sink_once, heave, fade, warp, swap_arms, swing, freeze),
    *(glitches, error, tempo, opening_noise, stop),
)


def order_of(change: CommandChange) -> int:
    """Return the place of a change, with or without given options, in `COMMANDS`."""
    return COMMANDS.index(change.func if isinstance(change, partial) else change)
