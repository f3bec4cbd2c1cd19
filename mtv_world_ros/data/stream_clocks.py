"""One clock for all streams of a recording: header stamps are compared with receive times.

The receive times of a bag come from one computer and only grow, while the stamps of each topic
come from the clock of whatever sent it. Where a stream's offset, stamp minus receive time, changes
at once and stays changed, that clock was set, started over or wrapped. Where the offsets of two
streams differ, their clocks do. N messages of a stream.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from mtv_world_ros.core.data_types import BoolArray, FloatArray
from mtv_world_ros.core.errors import EpisodeError

Stamps = NDArray[np.int64]
NANO = 1_000_000_000
#: spans after which a counter of 32 bits starts over [ns], by the name of its unit
WRAPS = {'millisecond': 2**32 * 1_000_000, 'microsecond': 2**32 * 1_000}


@dataclass(frozen=True, slots=True)
class ClockSettings:
    """Thresholds of the comparison of stamps with receive times."""

    #: the least step back of a clock [s]; messages that overtake each other are no step
    step_back_s: float = 0.03
    #: the least step ahead [s]; late messages that come at once look like smaller ones
    step_ahead_s: float = 0.3
    #: time before and after a step in which it is measured [s]
    window_s: float = 0.5
    #: minimum number of messages in that window
    window_messages: int = 5
    #: window before a step ahead; longer than any pause of the recorder [s]
    long_window_s: float = 5.0
    #: minimum number of messages in that window
    long_window_messages: int = 50
    #: a stretch between steps that is shorter holds wrong stamps, not another clock [s]
    stretch_s: float = 0.25
    stretch_messages: int = 3
    #: a single stamp that is off by more is wrong, not late [s]: ahead, behind
    wrong_ahead_s: float = 1.0
    wrong_behind_s: float = 10.0
    #: steps of two streams within this time are one [s]
    same_moment_s: float = 0.5
    #: difference of two steps that are of one clock [s], and as a fraction of their size
    same_size_s: float = 0.1
    same_size_ratio: float = 0.1
    #: tolerance of a step that equals the range of a wrapping counter [s]
    wrap_s: float = 0.5
    #: offset against the reference that is named [s]: ahead, which no delay explains, and behind
    named_ahead_s: float = 0.1
    named_behind_s: float = 0.5
    #: offset that is refused [s]: ahead and behind
    refused_ahead_s: float = 0.5
    refused_behind_s: float = 2.0
    #: plans may be stamped this far ahead, to start together with others [s]
    plan_ahead_s: float = 10.0
    #: parts of a recording that are shorter are left out [s]
    part_s: float = 0.5


CLOCKS = ClockSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class StampedStream:
    """Stamps and receive times of the messages of one sender.

    Attributes:
        name: name of the topic.
        key: view or stream of the mapping, e.g. `front` or `joint_states`.
        stamps_ns: (N,) stamps of the headers [ns]; 0 = not stamped.
        received_ns: (N,) when the messages were recorded [ns].
        spans_ns: (N,) lengths of plans [ns]; None = the messages are no plans. The stamp of a
            plan is its start, which may lie ahead; 0 = at once.
        use_received: whether receive times are taken in place of the stamps, as the user said.
    """

    name: str
    key: str
    stamps_ns: Stamps
    received_ns: Stamps
    spans_ns: Stamps | None = None
    use_received: bool = False

    @property
    def offsets_s(self) -> FloatArray:
        """(N,) stamps minus receive times [s]."""
        return np.asarray((self.stamps_ns - self.received_ns) * 1e-9, np.float64)


class ClockStep(NamedTuple):
    """A clock that changes at once.

    Attributes:
        before_ns: receive time of the last message before the change [ns].
        after_ns: receive time of the first message after the change [ns].
        size_s: change of the offset [s]; negative = back.
    """

    before_ns: int
    after_ns: int
    size_s: float


class Window(NamedTuple):
    """A part of a recording, by receive times [ns]: begin <= time < end."""

    begin_ns: int
    end_ns: int

    def has(self, received_ns: int) -> bool:
        """Return whether a message received at a time is in it."""
        return self.begin_ns <= received_ns < self.end_ns


WHOLE = Window(-(2**62), 2**62)


class ClockBreakError(EpisodeError):
    """All clocks of a recording change at once: it is several recordings.

    Attributes:
        windows: parts of the recording, each with one clock.
    """

    def __init__(self, text: str, windows: Sequence[Window]) -> None:
        super().__init__(text)
        self.windows = tuple(windows)


@dataclass(slots=True)
class SettledClocks:
    """Stamps of all streams on one clock.

    Attributes:
        stamps_ns: (N,) stamps of each stream.
        is_kept: (N,) whether each message of a stream is kept; the others have impossible stamps.
        offset_s: offset of the clock against the receive times, at the middle of the recording.
        notes: repairs and oddities, one line each.
    """

    stamps_ns: list[Stamps] = field(default_factory=list)
    is_kept: list[BoolArray] = field(default_factory=list)
    offset_s: float = 0.0
    notes: list[str] = field(default_factory=list)


def settle_clocks(
    streams: Sequence[StampedStream], settings: ClockSettings = CLOCKS
) -> SettledClocks:
    """Bring the stamps of all streams of a recording onto one clock.

    Wrapped counters are continued, missing stamps made of receive times, single wrong stamps left
    out. Each is a note.

    Args:
        streams: images, joint states and commands, in the order of the recording.
        settings: thresholds of steps, gaps and offsets.

    Raises:
        ClockBreakError: all clocks change at once.
        EpisodeError: one clock changes, or two clocks differ.
    """
    found = SettledClocks()
    used: list[StampedStream] = []
    steps: list[list[ClockStep]] = []
    begin_ns = min((int(s.received_ns.min()) for s in streams if len(s.received_ns)), default=0)
    for stream in streams:
        mended, is_kept, own = _mend(stream, begin_ns, found.notes, settings)
        found.stamps_ns.append(mended)
        found.is_kept.append(is_kept)
        used.append(_part(stream, mended, is_kept))
        steps.append(own)
    if any(steps):
        _refuse_steps(used, steps, begin_ns, settings)
    reference = _reference(used)
    if reference is None:
        return found
    middle = np.array([np.median(reference.received_ns)])
    found.offset_s = float(_offset_at(reference, middle.astype(np.int64))[0])
    for index, stream in enumerate(streams):
        at_once = stream.stamps_ns == 0 if stream.spans_ns is not None else np.zeros(0, bool)
        if _takes_received(stream) and len(stream.stamps_ns) or at_once.any():
            moved = _from_received(stream, reference, found.notes, settings)
            kept = found.stamps_ns[index]
            found.stamps_ns[index] = np.where(at_once, moved, kept) if at_once.any() else moved
    found.notes += _check_offsets(used, reference, settings)
    return found


def _part(stream: StampedStream, stamps: Stamps, rows: BoolArray) -> StampedStream:
    """Return the rows of a stream, with mended stamps."""
    return replace(
        stream,
        stamps_ns=stamps[rows],
        received_ns=stream.received_ns[rows],
        spans_ns=None if stream.spans_ns is None else stream.spans_ns[rows],
        use_received=_takes_received(stream),
    )


def _takes_received(stream: StampedStream) -> bool:
    return stream.use_received or not stream.stamps_ns.any()


def _mend(
    stream: StampedStream, begin_ns: int, notes: list[str], settings: ClockSettings
) -> tuple[Stamps, BoolArray, list[ClockStep]]:
    """Return mended stamps [ns] of one stream, True for each row that is kept, and its steps."""
    stamps, all_rows = stream.stamps_ns.copy(), np.ones(len(stream.stamps_ns), bool)
    is_plan = stream.spans_ns is not None
    if is_plan or _takes_received(stream) or len(stamps) < settings.stretch_messages:
        missing = stamps == 0
        stamps[missing | stream.use_received] = stream.received_ns[missing | stream.use_received]
        if stream.use_received:
            notes.append(f"'{stream.name}': receive times are used, as the mapping says")
        elif missing.any():
            notes.append(f"'{stream.name}': headers without stamp; log times are used")
        return stamps, all_rows, []
    stamps = _with_missing(stream, stamps, notes)
    order = np.argsort(stream.received_ns, kind='stable')
    received = stream.received_ns[order]
    own = find_steps(stamps[order], received, settings)
    stamps[order], own = _unwrapped(
        stream.name, stamps[order], received, own, begin_ns, notes, settings
    )
    is_wrong = np.zeros(len(order), bool)
    is_wrong[order] = _wrong_stamps(stamps[order], received, own, settings)
    if is_wrong.any():
        first = int(np.flatnonzero(is_wrong)[0])
        offsets = (stamps - stream.received_ns) * 1e-9
        off_s = float(offsets[first] - np.median(offsets[~is_wrong]))
        notes.append(
            f"'{stream.name}': {int(is_wrong.sum())} of {len(order)} messages have wrong stamps "
            f'and were left out, the first by {_signed(off_s)} s at '
            f'{(stream.received_ns[first] - begin_ns) / NANO:.3f} s of the recording'
        )
        kept = ~is_wrong[order]
        own = find_steps(stamps[order][kept], received[kept], settings)
    return stamps, ~is_wrong, own


def _with_missing(stream: StampedStream, stamps: Stamps, notes: list[str]) -> Stamps:
    """Return stamps, with those that are 0 made of receive times and the offsets around them."""
    missing = stamps == 0
    if missing.any():
        known = np.flatnonzero(~missing)
        known = known[np.argsort(stream.received_ns[known], kind='stable')]
        at = (stream.received_ns - stream.received_ns[0]) * 1e-9
        offsets = np.interp(at[missing], at[known], stream.offsets_s[known])
        stamps[missing] = stream.received_ns[missing] + np.round(offsets * 1e9).astype(np.int64)
        notes.append(
            f"'{stream.name}': {int(missing.sum())} of {len(stamps)} headers are without stamp; "
            'their log times and the offset of the stamps around them are used'
        )
    return stamps


def arrival_times(
    received: Mapping[str, Stamps], index: Mapping[str, NDArray[np.int64]]
) -> dict[str, Stamps]:
    """Return receive times that go on where the recorder's own clock was set back.

    Where every topic goes back at one place of the file, into times that it had before, what
    follows is moved behind what was there. Files that are not in the order of time are left.

    Args:
        received: (N,) receive times by topic, in the order of the file [ns].
        index: (N,) places in the file of the same messages.
    """
    falls, able = [], 0
    for topic, times in received.items():
        steps = np.diff(times)
        rows = np.flatnonzero(steps < -CLOCKS.step_back_s * NANO) + 1
        least = CLOCKS.stretch_messages
        if len(times) < 2 * least:
            continue
        able += 1
        if len(rows) == 1 and least <= rows[0] <= len(times) - least:
            row = int(rows[0])
            if times[row] > times[:row].min():
                falls.append((int(index[topic][row]), topic, row))
    if not falls or len(falls) < able:
        return dict(received)
    place = min(at for at, _, _ in falls)
    last = max(int(received[topic][:row].max()) for _, topic, row in falls)
    first = min(int(received[topic][row:].min()) for _, topic, row in falls)
    shift = last - first + 1_000_000
    return {t: np.where(index[t] >= place, ns + shift, ns) for t, ns in received.items()}


def find_steps(
    stamps: Stamps, received: Stamps, settings: ClockSettings = CLOCKS
) -> list[ClockStep]:
    """Return where the offset of a stream changes at once and stays changed.

    Args:
        stamps: (N,) stamps in the order received [ns].
        received: (N,) receive times, not decreasing [ns].
        settings: thresholds of a step.
    """
    ds, dr = np.diff(stamps) * 1e-9, np.diff(received) * 1e-9
    if len(ds) < 1 or not received[-1] > received[0]:
        return []
    speed = _speed(stamps, received)
    period = max(float(np.median(np.abs(ds))), 0.0)
    ahead = ds - max(speed, 1.0) * dr
    is_ahead = (ahead > settings.step_ahead_s) & (ds > 3 * period)
    seconds = (received - received[0]) * 1e-9
    offsets = (stamps - stamps[0]) * 1e-9 - speed * seconds
    steps: list[ClockStep] = []
    begin = 0
    for row in np.flatnonzero((ds < 0) | is_ahead) + 1:
        if min(row - begin, len(stamps) - row) < settings.stretch_messages:
            continue
        after = _level_after(offsets, seconds, int(row), settings)
        is_long = bool(is_ahead[row - 1])
        before = _level_before(offsets, seconds, begin, int(row), is_long, settings)
        size, scatter = after - before, _scatter(offsets, seconds, begin, int(row), settings)
        least = settings.step_ahead_s if is_long else settings.step_back_s
        if (size if is_long else -size) > least + scatter:
            steps.append(ClockStep(int(received[row - 1]), int(received[row]), size))
            begin = int(row)
    return steps


def _speed(stamps: Stamps, received: Stamps) -> float:
    """Return the stamped seconds a received second: that of simulated time.

    1 where the latter are odd.
    """
    lag = max(1, len(stamps) // 8)
    later = (received[lag:] - received[:-lag]).astype(np.float64)
    if not (later > 0).all():
        return 1.0
    speed = float(np.median((stamps[lag:] - stamps[:-lag]) / later))
    return speed if 0.01 < speed < 100 else 1.0


def _level_after(
    offsets: FloatArray, seconds: FloatArray, row: int, settings: ClockSettings
) -> float:
    last = int(np.searchsorted(seconds, seconds[row] + settings.window_s))
    return _upper(offsets[row : max(last, row + settings.window_messages)])


def _level_before(
    offsets: FloatArray,
    seconds: FloatArray,
    begin: int,
    row: int,
    is_long: bool,
    settings: ClockSettings,
) -> float:
    span, count = (
        (settings.long_window_s, settings.long_window_messages)
        if is_long
        else (settings.window_s, settings.window_messages)
    )
    first = int(np.searchsorted(seconds, seconds[row - 1] - span))
    return _upper(offsets[max(begin, min(first, row - count)) : row])


def _scatter(
    offsets: FloatArray, seconds: FloatArray, begin: int, row: int, settings: ClockSettings
) -> float:
    """Return the usual differences of delay before a step [s]."""
    first = int(np.searchsorted(seconds, seconds[row - 1] - settings.long_window_s))
    before = offsets[max(begin, min(first, row - settings.long_window_messages)) : row]
    low, high = np.quantile(before, (0.1, 0.9))
    return float(high - low)


def _upper(offsets: FloatArray) -> float:
    """Return the offset of messages that are neither late nor wrong: delays only lower it."""
    return float(np.quantile(offsets, 0.8, method='lower'))


def _unwrapped(
    name: str,
    stamps: Stamps,
    received: Stamps,
    steps: list[ClockStep],
    begin_ns: int,
    notes: list[str],
    settings: ClockSettings,
) -> tuple[Stamps, list[ClockStep]]:
    """Continue counters of 32 bits that started over; other steps are left."""
    left = []
    for step in steps:
        unit = next(
            (u for u, ns in WRAPS.items() if abs(step.size_s + ns * 1e-9) < settings.wrap_s), None
        )
        if unit is None:
            left.append(step)
            continue
        later = received >= step.after_ns
        stamps = np.where(later, stamps + WRAPS[unit], stamps)
        notes.append(
            f"'{name}': its {unit} counter of 32 bits starts over at "
            f'{(step.after_ns - begin_ns) / NANO:.3f} s of the recording; '
            f'{WRAPS[unit] * 1e-9:.3f} s were added to the {int(later.sum())} stamps after that'
        )
    return stamps, left


def _wrong_stamps(
    stamps: Stamps, received: Stamps, steps: Sequence[ClockStep], settings: ClockSettings
) -> BoolArray:
    """(N,) single stamps that are far from those around them, and stretches that are too short."""
    ds, dr = np.diff(stamps) * 1e-9, np.diff(received) * 1e-9
    is_wrong = np.zeros(len(stamps), bool)
    if not ((ds < 0) | (ds - dr > settings.step_ahead_s)).any():
        return is_wrong
    edges = [0, *(int(np.searchsorted(received, s.after_ns)) for s in steps), len(stamps)]
    for first, last in zip(edges, edges[1:], strict=False):
        span_s = (received[last - 1] - received[first]) * 1e-9 if last > first else 0.0
        is_short = last - first < settings.stretch_messages or span_s < settings.stretch_s
        if is_short and len(edges) > 2:
            is_wrong[first:last] = True
            continue
        offsets = (stamps[first:last] - received[first:last]) * 1e-9
        away = offsets - median_filter(offsets, 4 * settings.window_messages + 1, mode='reflect')
        is_wrong[first:last] = (away > settings.wrong_ahead_s) | (away < -settings.wrong_behind_s)
    return is_wrong


def _refuse_steps(
    streams: Sequence[StampedStream],
    steps: Sequence[Sequence[ClockStep]],
    begin_ns: int,
    settings: ClockSettings,
) -> None:
    """Raise that the recording is several, or that one clock changes.

    Raises:
        ClockBreakError: all clocks change.
        EpisodeError: one clock changes.
    """
    pairs = [(stream, step) for stream, own in zip(streams, steps, strict=True) for step in own]
    pairs.sort(key=lambda pair: pair[1].after_ns)
    cuts: list[int] = []
    texts: list[str] = []
    while pairs:
        stream, step = pairs[0]
        group = [(s, p) for s, p in pairs if _is_same_step(p, step, settings)]
        pairs = [pair for pair in pairs if pair not in group]
        others = [s for s in streams if s.name not in {g.name for g, _ in group}]
        at = f'{(step.after_ns - begin_ns) / NANO:.3f} s of the recording'
        contrary = [s for s in others if not _follows(s, step, settings)]
        if contrary:
            raise EpisodeError(
                f"'{stream.name}': its clock jumps by {_signed(step.size_s)} s at {at}, while "
                f"that of '{contrary[0].name}' does not (stamps against receive times). Cut the "
                f"recording there, or take receive times: 'received_times: [{stream.key}]' in the "
                'mapping (--topics)'
            )
        last = max(p.before_ns for _, p in group)
        first = min(p.after_ns for _, p in group)
        cuts.append((last + first) // 2 if last < first else first)
        texts.append(f'by {_signed(step.size_s)} s at {at}')
    names = ', '.join(
        dict.fromkeys(f"'{s.name}'" for s, own in zip(streams, steps, strict=True) if own)
    )
    end_ns = max(int(stream.received_ns.max()) for stream in streams if len(stream.received_ns))
    ends = [begin_ns, *cuts, end_ns]
    windows = [
        Window(WHOLE.begin_ns if a == begin_ns else a, WHOLE.end_ns if b == end_ns else b)
        for a, b in zip(ends, ends[1:], strict=False)
        if (b - a) * 1e-9 >= settings.part_s
    ]
    short = len(ends) - 1 - len(windows)
    left_out = f' {short} shorter than {settings.part_s:g} s are left out.' if short else ''
    raise ClockBreakError(
        f'the clocks of {names} jump {", ".join(texts)} (stamps against receive times): simulated '
        'time that started over, or a clock that was set. These are '
        f'{len(ends) - 1} recordings; mtv-world import bag makes an episode of each.{left_out}',
        windows,
    )


def _is_same_step(one: ClockStep, other: ClockStep, settings: ClockSettings) -> bool:
    gap_s = (max(one.before_ns, other.before_ns) - min(one.after_ns, other.after_ns)) * 1e-9
    return gap_s <= settings.same_moment_s and _is_same_size(one.size_s, other.size_s, settings)


def _is_same_size(one: float, other: float, settings: ClockSettings) -> bool:
    return abs(one - other) <= max(settings.same_size_s, settings.same_size_ratio * abs(one))


def _follows(stream: StampedStream, step: ClockStep, settings: ClockSettings) -> bool:
    """Return True if a step agrees with a stream in which none was found.

    Slow streams and plans agree with any step.
    """
    before = stream.received_ns <= step.before_ns
    after = stream.received_ns >= step.after_ns
    least = settings.stretch_messages
    if stream.spans_ns is not None or before.sum() < least or after.sum() < least:
        return True
    if _takes_received(stream):
        return True
    offsets, count = stream.offsets_s, settings.window_messages
    change = float(np.median(offsets[after][:count]) - np.median(offsets[before][-count:]))
    return _is_same_size(change, step.size_s, settings)


def _reference(streams: Sequence[StampedStream]) -> StampedStream | None:
    """Return the stream whose clock the others are compared with: joint states, else images."""
    able = [
        s
        for s in streams
        if s.spans_ns is None and not _takes_received(s) and len(s.stamps_ns) > 2
        and len(np.unique(s.received_ns)) > 1
    ]  # fmt: skip
    return next((s for s in able if s.key == 'joint_states'), able[0] if able else None)


def _offset_at(stream: StampedStream, received_ns: Stamps) -> FloatArray:
    """Return the offsets of a stream [s] at receive times."""
    order = np.argsort(stream.received_ns, kind='stable')
    zero = stream.received_ns[order[0]]
    known = (stream.received_ns[order] - zero) * 1e-9
    return np.interp((received_ns - zero) * 1e-9, known, stream.offsets_s[order])


def _from_received(
    stream: StampedStream,
    reference: StampedStream,
    notes: list[str],
    settings: ClockSettings,
) -> Stamps:
    """Receive times on the clock of the reference, where that is another one."""
    offsets = _offset_at(reference, stream.received_ns)
    usual = float(np.median(offsets))
    if -settings.refused_behind_s < usual < settings.refused_ahead_s:
        return stream.received_ns.copy()
    notes.append(
        f"'{stream.name}': {_signed(usual)} s were added to its receive times, the offset of the "
        f"clock of '{reference.name}'"
    )
    return stream.received_ns + np.round(offsets * 1e9).astype(np.int64)


def _check_offsets(
    streams: Sequence[StampedStream], reference: StampedStream, settings: ClockSettings
) -> list[str]:
    """Return what is odd about the offsets of streams against the reference.

    Raises:
        EpisodeError: they are not of one clock.
    """
    others = [s for s in streams if s is not reference and not _takes_received(s)]
    known = [(s, ahead) for s in others if (ahead := _offset(s, reference)) is not None]
    wrong = [(s, ahead) for s, ahead in known if not _is_possible(s, ahead, settings)]
    if wrong:
        size = wrong[0][1]
        same = [s for s, ahead in wrong if _is_same_size(size, ahead, settings)]
        alone = len(known) > 1 and len(same) == len(known)  # the reference is the odd one
        odd, rest = ([reference], same) if alone else (same, [reference])
        raise EpisodeError(
            f'{_quoted(odd)} {"is" if len(odd) == 1 else "are"} not of the clock of '
            f'{_quoted(rest)}: by their receive times, the stamps of the former are '
            f'{_words(-size if alone else size)} those of the latter. Set the clocks of the '
            "computers (NTP; 'use_sim_time' for all nodes or for none), or take receive times: "
            f"'received_times: [{', '.join(dict.fromkeys(s.key for s in odd))}]' in the mapping "
            '(--topics)'
        )
    notes = []
    for stream, ahead in known:
        if stream.spans_ns is None and ahead > settings.named_ahead_s:
            notes.append(
                f"by their receive times, the stamps of '{stream.name}' are {_words(ahead)} those "
                f"of '{reference.name}': the clocks of two computers differ; they are used as "
                'they are'
            )
        elif stream.spans_ns is None and ahead < -settings.named_behind_s:
            notes.append(
                f"messages of '{stream.name}' come {-ahead:.3g} s later after their stamps than "
                f"those of '{reference.name}': a slow camera, or another clock"
            )
    return notes


def _offset(stream: StampedStream, reference: StampedStream) -> float | None:
    """Return the median offset against the reference [s]; None = they are not comparable."""
    low, high = reference.received_ns.min(), reference.received_ns.max()
    inside = (stream.received_ns >= low) & (stream.received_ns <= high)
    if not inside.any() or len(np.unique(stream.received_ns)) < min(len(stream.received_ns), 2):
        return None
    apart = stream.offsets_s[inside] - _offset_at(reference, stream.received_ns[inside])
    return float(np.median(apart))


def _is_possible(stream: StampedStream, ahead_s: float, settings: ClockSettings) -> bool:
    """Return True if a delay, or the start of a plan, explains an offset [s]."""
    if stream.spans_ns is None:
        return -settings.refused_behind_s <= ahead_s <= settings.refused_ahead_s
    length_s = float(np.median(stream.spans_ns)) / NANO
    return -max(length_s, settings.refused_behind_s) <= ahead_s <= settings.plan_ahead_s


def _quoted(streams: Sequence[StampedStream]) -> str:
    return ', '.join(f"'{stream.name}'" for stream in streams)


def _words(ahead_s: float) -> str:
    return f'{_number(abs(ahead_s))} s {"ahead of" if ahead_s > 0 else "behind"}'


def _number(seconds: float) -> str:
    return f'{seconds:.1f}' if abs(seconds) >= 1e5 else f'{seconds:.4g}'


def _signed(seconds: float) -> str:
    return f'{"+" if seconds > 0 else ""}{_number(seconds)}'


def check_row_times(times: FloatArray, what: str, rate_hz: float | None = None) -> list[str]:
    """Check the times of the rows of a table, which has no receive times but the rows' order.

    Args:
        times: (N,) times of the rows [s].
        what: name of the column, e.g. `timestamp`.
        rate_hz: rows a second by other information; None = not known.

    Returns:
        What is odd, one line each.

    Raises:
        EpisodeError: they do not increase, are no numbers, or of another unit.
    """
    if len(times) < 2:
        raise EpisodeError(f"'{what}' has {len(times)} rows, at least 2 are needed")
    if not np.isfinite(times).all():
        row = int(np.flatnonzero(~np.isfinite(times))[0])
        raise EpisodeError(f"'{what}' is {times[row]} at row {row}; every row needs a time [s]")
    steps = np.diff(times)
    period = float(np.median(steps))
    if (steps <= 0).any():
        row = int(np.flatnonzero(steps <= 0)[0]) + 1
        raise EpisodeError(f"'{what}' {_fall(times, row)}; {int((steps <= 0).sum())} of "
                           f'{len(steps)} steps do not increase')  # fmt: skip
    for name, factor in (('ms', 1e3), ('us', 1e6), ('ns', 1e9)):
        if rate_hz is not None and 0.5 < period * rate_hz / factor < 2:
            raise EpisodeError(
                f"'{what}' has a step of {period:g} from row to row at {rate_hz:g} rows a second: "
                f'it is in {name}, and must be in s'
            )
    row = int(steps.argmax())
    if steps[row] > max(1.0, 20 * period):
        text = (
            f"'{what}' jumps ahead by {steps[row]:.6g} s at row {row + 1}, usual is {period:.3g}"
        )
        return [f'{text} s: a pause of the recording, or a clock that was set']
    return []


def _fall(times: FloatArray, row: int) -> str:
    """Return a text on how, and why, times do not increase at a row."""
    size = float(times[row - 1] - times[row])
    if not np.ptp(times) and times[0] > 2**24:
        return (
            f'is {times[0]:g} in all {len(times)} rows: seconds since 1970 do not fit a number of '
            "32 bits; store them from the recording's start on"
        )
    if not np.ptp(times):
        return f'is {times[0]:g} in all {len(times)} rows: the recorder set no times'
    if size == 0:
        return f'is {times[row]:.6g} s in rows {row - 1} and {row}: a row that was written twice'
    text = (
        f'goes back by {size:.6g} s at row {row}, from {times[row - 1]:.6g} to {times[row]:.6g} s'
    )
    for unit, span in WRAPS.items():
        if abs(size - span * 1e-9) < CLOCKS.wrap_s:
            return f'{text}: a {unit} counter of 32 bits that started over'
    return f'{text}: a clock that was set or started over; make two recordings of it'
