"""One clock for all streams: breaks, offsets, wraps and missing stamps against receive times."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.data.stream_clocks import (
    arrival_times,
    check_row_times,
    ClockBreakError,
    find_steps,
    settle_clocks,
    StampedStream,
)

NANO = 1_000_000_000
START = 1_750_000_000 * NANO
MS = 1_000_000


def seconds(count: float, rate: float, delay_s: float = 0.0) -> np.ndarray:
    return np.arange(round(count * rate)) / rate + delay_s


def stream(key: str, times: np.ndarray, stamps=None, plan_s: float | None = None, **how):
    """A stream received at times [s]; its stamps are these 2 ms earlier, or as given [ns]."""
    received = START + np.round(times * NANO).astype(np.int64)
    given = received - 2 * MS if stamps is None else np.asarray(stamps, np.int64)
    spans = None if plan_s is None else np.full(len(times), round(plan_s * NANO), np.int64)
    names = {'joint_states': '/joint_states', 'action': '/joint_trajectory'}
    name = names.get(key, f'/{key}/image_raw')
    return StampedStream(
        name=name, key=key, stamps_ns=given, received_ns=received, spans_ns=spans, **how
    )


def moved(one: StampedStream, move) -> StampedStream:
    """The stream with stamps of `move(stamps, seconds since the start)`."""
    since = (one.received_ns - START) / NANO
    stamps = move(one.stamps_ns.copy(), since)
    return StampedStream(
        name=one.name, key=one.key, stamps_ns=stamps, received_ns=one.received_ns,
        spans_ns=one.spans_ns,
    )  # fmt: skip


@pytest.fixture
def recording() -> dict[str, StampedStream]:
    return {
        'front': stream('front', seconds(6, 10, 0.003)),
        'joint_states': stream('joint_states', seconds(6, 50)),
        'action': stream('action', np.array([0.004, 2.004, 4.004]), plan_s=2.0),
    }


def settle(recording, **changes):
    return settle_clocks([*{**recording, **changes}.values()])


def test_one_clock_is_left_as_it_is(recording):
    found = settle(recording)
    assert found.notes == []
    for given, stamps, kept in zip(
        recording.values(), found.stamps_ns, found.is_kept, strict=True
    ):
        np.testing.assert_array_equal(stamps, given.stamps_ns)
        assert kept.all()


@pytest.mark.parametrize('size_s', [-3.0, -0.2, 40.0, -1_749_999_000.0])
def test_clocks_that_all_jump_divide_the_recording(recording, size_s):
    """Simulated time that starts over, a clock that is set."""

    def jump(stamps, since):
        return stamps + np.where(since >= 3, round(size_s * NANO), 0)

    jumping = {key: moved(one, jump) for key, one in recording.items()}
    with pytest.raises(ClockBreakError, match=r'at 3.000 s of the recording') as found:
        settle_clocks([*jumping.values()])
    first, second = found.value.windows
    assert first.end_ns == second.begin_ns
    assert START + 2.98 * NANO < first.end_ns <= START + 3 * NANO
    assert first.has(START) and not first.has(START + 4 * NANO)
    assert second.has(START + 6 * NANO)


def test_a_recording_with_two_jumps_has_three_parts_and_short_ones_are_left_out(recording):
    def jumps(stamps, since):
        return stamps - np.where(since >= 2, 2 * NANO, 0) - np.where(since >= 5.7, 2 * NANO, 0)

    with pytest.raises(ClockBreakError, match='These are 3 recordings') as found:
        settle_clocks([moved(one, jumps) for one in recording.values()])
    assert len(found.value.windows) == 2
    assert '1 shorter than 0.5 s are left out' in str(found.value)


def test_a_clock_that_jumps_alone_is_refused_with_topic_time_size_and_fix(recording):
    front = moved(recording['front'], lambda s, since: s - np.where(since >= 3, 5 * NANO, 0))
    text = (
        r"'/front/image_raw': its clock jumps by -5 s at 3.003 s .* '/joint_states' does not"
        r".*'received_times: \[front\]'"
    )
    with pytest.raises(EpisodeError, match=text) as found:
        settle(recording, front=front)
    assert not isinstance(found.value, ClockBreakError)


@pytest.mark.parametrize(('unit', 'tick_ns'), [('millisecond', MS), ('microsecond', 1_000)])
def test_a_counter_of_32_bits_that_wraps_is_continued_and_said(recording, unit, tick_ns):
    span = 2**32 * tick_ns
    front = moved(recording['front'], lambda s, since: s - np.where(since >= 3, span, 0))
    found = settle(recording, front=front)
    np.testing.assert_array_equal(found.stamps_ns[0], recording['front'].stamps_ns)
    (note,) = found.notes
    assert f"'/front/image_raw': its {unit} counter of 32 bits starts over at 3.003 s" in note
    assert f'{span / NANO:.3f} s were added to the 30 stamps' in note


@pytest.mark.parametrize(
    ('key', 'offset_s', 'others'),
    [
        ('front', 40.0, '/joint_states'),
        ('front', -3.0, '/joint_states'),
        ('front', 0.7, '/joint_states'),
        ('front', -1_749_999_995.0, '/joint_states'),
        ('joint_states', 1e4, '/front/image_raw'),
        ('action', -10.0, '/joint_states'),
        ('action', 60.0, '/joint_states'),
    ],
)
def test_a_stream_of_another_clock_is_refused_with_the_offset_and_the_fix(
    recording, key, offset_s, others
):
    other = moved(recording[key], lambda s, _: s + round(offset_s * NANO))
    with pytest.raises(EpisodeError) as found:
        settle(recording, **{key: other})
    text = str(found.value)
    assert text.startswith(f"'{other.name}' is not of the clock of '{others}'"), text
    assert ('ahead of' if offset_s > 0 else 'behind') in text
    assert f"'received_times: [{key}]'" in text


def test_receive_times_are_taken_where_the_user_says_so(recording):
    """On the clock of the others, which may be simulated."""
    simulated = {
        key: moved(one, lambda s, _: s - START + NANO)
        for key, one in recording.items()
        if key != 'front'
    }
    times = seconds(6, 10, 0.003)
    front = stream('front', times, np.round(times * NANO) + 5, use_received=True)
    found = settle_clocks([front, *simulated.values()])
    away = found.stamps_ns[0] - np.round((times + 1) * NANO)
    assert np.abs(away).max() <= 3 * MS
    assert 'receive times are used, as the mapping says' in found.notes[0]
    assert 'the offset of the clock of' in found.notes[1]


@pytest.mark.parametrize(('offset_s', 'said'), [(0.2, '0.2 s ahead of'), (-0.8, '0.801 s later')])
def test_a_small_offset_is_said(recording, offset_s, said):
    front = moved(recording['front'], lambda s, _: s + round(offset_s * NANO) - MS)
    found = settle(recording, front=front)
    np.testing.assert_array_equal(found.stamps_ns[0], front.stamps_ns)
    (note,) = found.notes
    assert said.replace('0.2 s', '0.199 s') in note


def test_messages_without_stamp_among_others_get_one(recording):
    front = moved(recording['front'], lambda s, _: np.where(np.arange(len(s)) % 7 == 0, 0, s))
    found = settle(recording, front=front)
    np.testing.assert_allclose(found.stamps_ns[0], recording['front'].stamps_ns, atol=1000)
    assert '9 of 60 headers are without stamp' in found.notes[0]


def test_a_stream_without_stamps_is_put_on_the_simulated_clock_of_the_others(recording):
    simulated = {k: moved(s, lambda s, _: s - START + NANO) for k, s in recording.items()}
    simulated['front'] = moved(recording['front'], lambda s, _: 0 * s)
    found = settle_clocks([*simulated.values()])
    away = found.stamps_ns[0] - (recording['front'].received_ns - START + NANO)
    assert np.abs(away).max() <= 3 * MS
    assert 'headers without stamp; log times are used' in found.notes[0]
    assert '-1749999999.0 s were added to its receive times' in found.notes[1]
    assert "the offset of the clock of '/joint_states'" in found.notes[1]


@pytest.mark.parametrize('row', [0, 30, 59])
@pytest.mark.parametrize('size_s', [3600.0, -3600.0])
def test_a_single_wrong_stamp_is_left_out_and_named(recording, row, size_s):
    def one_wrong(stamps, since):
        stamps[row] += round(size_s * NANO)
        return stamps

    found = settle(recording, front=moved(recording['front'], one_wrong))
    assert np.flatnonzero(~found.is_kept[0]).tolist() == [row]
    assert (
        f'1 of 60 messages have wrong stamps and were left out, the first by {size_s:+.0f} s'
        in (found.notes[0])
    )


def test_late_and_overtaking_messages_are_no_break(recording):
    rng = np.random.default_rng(0)
    sent = seconds(6, 30)
    late = sent + 0.4 * rng.random(len(sent))
    front = stream('front', late, START + np.round(sent * NANO))
    assert settle(recording, front=front).notes == []
    pairs = np.arange(60).reshape(-1, 2)[:, ::-1].ravel()
    front = stream('front', seconds(6, 10), START + pairs * 100 * MS)
    assert find_steps(front.stamps_ns, front.received_ns) == []


def test_a_recorder_that_stalls_is_no_break(recording):
    """What was sent within a second arrives at once, and the queue has lost a part of it."""

    def stalled(one):
        since = (one.received_ns - START) / NANO
        at = np.where((since >= 2) & (since < 3), 3.0, since)
        kept = (since < 2) | (since >= 2.7) | (np.arange(len(since)) % 3 == 0) & (since < 2.2)
        return StampedStream(
            name=one.name, key=one.key, stamps_ns=one.stamps_ns[kept], spans_ns=None,
            received_ns=START + np.round(at[kept] * NANO).astype(np.int64),
        )  # fmt: skip

    streams = [stalled(recording[key]) for key in ('front', 'joint_states')]
    assert settle_clocks(streams).notes == []


@pytest.mark.parametrize('factor', [0.1, 3.0], ids=['fast', 'slow'])
def test_simulated_time_may_run_faster_or_slower(recording, factor):
    def recorded(one):
        since = one.received_ns - START
        return StampedStream(
            name=one.name, key=one.key, stamps_ns=since + NANO, spans_ns=one.spans_ns,
            received_ns=START + np.round(since * factor).astype(np.int64),
        )  # fmt: skip

    assert settle_clocks([recorded(one) for one in recording.values()]).notes == []


def test_a_simulation_that_pauses_is_no_break(recording):
    def paused(one):
        since = one.received_ns - START
        later = np.where(since >= 3 * NANO, since + 20 * NANO, since)
        return StampedStream(
            name=one.name, key=one.key, stamps_ns=since + NANO, spans_ns=one.spans_ns,
            received_ns=START + later,
        )  # fmt: skip

    assert settle_clocks([paused(one) for one in recording.values()]).notes == []


def test_receive_times_that_say_nothing_are_not_compared(recording):
    """All equal, or of a conversion that wrote one topic after the other."""
    same = [
        StampedStream(
            name=one.name, key=one.key, stamps_ns=one.stamps_ns, spans_ns=one.spans_ns,
            received_ns=np.full(len(one.stamps_ns), START),
        )
        for one in recording.values()
    ]  # fmt: skip
    assert settle_clocks(same).notes == []
    begin, each = START, []
    for one in recording.values():
        count = len(one.stamps_ns)
        received = begin + MS * np.arange(count)
        begin += MS * count
        each.append(
            StampedStream(
                name=one.name, key=one.key, stamps_ns=one.stamps_ns, spans_ns=one.spans_ns,
                received_ns=received,
            )
        )  # fmt: skip
    assert settle_clocks(each).notes == []


def test_a_recorder_whose_own_clock_is_set_back_goes_on(recording):
    keys = ('front', 'joint_states')
    times = {k: recording[k].received_ns - np.where(
        recording[k].received_ns >= START + 3 * NANO, NANO, 0) for k in keys}  # fmt: skip
    order = np.argsort(np.concatenate([recording[k].received_ns for k in keys]), kind='stable')
    places = np.empty(len(order), np.int64)
    places[order] = np.arange(len(order))
    index = dict(zip(keys, np.split(places, [60]), strict=True))
    arrived = arrival_times(times, index)
    for key in keys:
        assert (np.diff(arrived[key]) > 0).all()
    ordered = {k: np.sort(recording[k].received_ns) for k in keys}
    assert arrival_times(ordered, index) == ordered


def test_files_that_are_not_in_the_order_of_time_are_left(recording):
    times = {'front': np.r_[START + 3 * NANO + np.arange(30), START + np.arange(30)]}
    found = arrival_times(times, {'front': np.arange(60)})
    np.testing.assert_array_equal(found['front'], times['front'])


@pytest.mark.parametrize(
    ('times', 'text'),
    [
        ([0.0] * 9, 'is 0 in all 9 rows: the recorder set no times'),
        (np.float32(1.75e9 + np.arange(9) / 10), 'seconds since 1970 do not fit'),
        ([0.0, 0.1, 0.1, 0.2], 'is 0.1 s in rows 1 and 2: a row that was written twice'),
        ([5.0, 5.1, 5.2, 2.0, 2.1], 'goes back by 3.2 s at row 3, from 5.2 to 2 s'),
        (np.r_[4294967.2, 0.004, 0.104], 'a millisecond counter of 32 bits'),
        ([0.0, np.nan, 0.2], 'is nan at row 1'),
        ([0.0], 'has 1 rows'),
        (np.arange(9) * 100.0, 'it is in ms'),
        (np.arange(9) * 1e8, 'it is in ns'),
    ],
)
def test_times_of_rows_that_cannot_be_are_refused_with_row_and_size(times, text):
    with pytest.raises(EpisodeError, match=text):
        check_row_times(np.asarray(times, float), 'timestamp', 10.0)


def test_a_pause_in_the_times_of_rows_is_said():
    times = np.r_[np.arange(10) / 10, 41 + np.arange(10) / 10]
    (note,) = check_row_times(times, 'timestamp', 10.0)
    assert "'timestamp' jumps ahead by 40.1 s at row 10" in note
    assert check_row_times(np.arange(20) / 10, 'timestamp', 10.0) == []
