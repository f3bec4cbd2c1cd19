"""One check of measured joints: single bad joints, doubled names, jumps that no joint can make."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.bag import messages
from mtv_world_ros.data.measured_joints import (
    find_unreachable,
    JointReach,
    mend_rows,
    merge_joint_states,
    read_sample,
)
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel

RATE = 50
HOME = np.array([0, -0.4, 0, -2.2, 0, 1.9, 0.785, 0.03])


@pytest.fixture(scope='module')
def franka() -> RobotModel:
    return load_robot(share_path('config', 'robots', 'franka', 'robot.yaml'))


def motion(seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps [ns] and positions of a slow motion of three joints."""
    times = np.arange(round(seconds * RATE)) / RATE
    rows = np.tile(HOME, (len(times), 1))
    rows[:, 0] += 0.4 * np.sin(0.9 * times)
    rows[:, 3] += 0.25 * np.sin(1.1 * times + 1) - 0.2
    rows[:, 5] += 0.2 * np.sin(1.7 * times)
    return np.round(times * 1e9).astype(np.int64), rows


def recorded(robot: RobotModel, stamps: np.ndarray, rows: np.ndarray) -> list[tuple[int, object]]:
    names = list(robot.joint_names)
    pairs = zip(stamps.tolist(), rows, strict=True)
    return [(s, messages.make_joint_state(s, names, row)) for s, row in pairs]


def merged(robot: RobotModel, items: list[tuple[int, object]], **how):
    warnings: list[str] = []
    states = merge_joint_states('/joint_states', items, warnings, robot, **how)
    return states, warnings


def test_a_sample_keeps_the_joints_that_can_be_used():
    sample = read_sample(['a', 'b', 'c', 'b'], [0.1, 0.2, math.nan, 0.3])
    assert sample.positions == {'a': 0.1}
    assert sample.faults == {
        'b': 'it is named twice, at 0.2 and at 0.3', 'c': 'its position is nan',
    }  # fmt: skip


def test_joints_of_others_do_not_matter_whatever_they_hold():
    names, values = ['a', 'wheel', 'wheel', 'b'], [0.1, math.nan, 2.0, 0.2]
    assert read_sample(names, values, {'a', 'b'}) == ({'a': 0.1, 'b': 0.2}, {})


def test_a_name_twice_with_one_position_is_one_joint():
    assert read_sample(['a', 'a'], [0.1, 0.1]) == ({'a': 0.1}, {})


def test_a_clean_recording_is_not_changed(franka):
    stamps, rows = motion()
    states, warnings = merged(franka, recorded(franka, stamps, rows))
    assert warnings == []
    np.testing.assert_array_equal(states.positions, rows)
    np.testing.assert_array_equal(states.stamps_ns, stamps)


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_one_joint_without_a_number_leaves_the_others(franka, bad):
    stamps, rows = motion()
    given = rows.copy()
    given[40:50, 7] = bad
    states, warnings = merged(franka, recorded(franka, stamps, given))
    np.testing.assert_array_equal(states.positions, rows)  # the gripper stands still
    (text,) = warnings
    assert "joint 'panda_finger_joint1' is not finite in 10 of 200 messages" in text
    assert 'the positions before and after stand in' in text


def test_a_gripper_that_starts_late_does_not_take_the_arm_with_it(franka):
    stamps, rows = motion()
    given = rows.copy()
    given[:50, 7] = math.nan
    states, warnings = merged(franka, recorded(franka, stamps, given))
    np.testing.assert_array_equal(states.positions, rows)
    assert 'no position for the first 1 s; its first one, 0.03, stands in' in warnings[1]


def test_an_arm_joint_that_starts_late_is_not_made_up(franka):
    stamps, rows = motion()
    given = rows.copy()
    given[:50, 2] = math.nan
    states, warnings = merged(franka, recorded(franka, stamps, given))
    assert states.stamps_ns[0] == 1_000_000_000
    assert 'the 50 messages before are left out' in warnings[1]


@pytest.mark.parametrize('bad', ['nan', 'twice'])
def test_a_joint_that_never_has_a_position_is_refused_by_name(franka, bad):
    stamps, rows = motion(0.2)
    items = recorded(franka, stamps, rows)
    for _, message in items:
        if bad == 'nan':
            message.position[7] = math.nan
        else:
            message.name.append('panda_finger_joint1')
            message.position = np.append(message.position, 0.01)
    with pytest.raises(EpisodeError, match=r"'panda_finger_joint1' is .* in 10 of 10 messages"):
        merged(franka, items)
    states, warnings = merged(franka, items, constants={'panda_finger_joint1': 0.02})
    assert warnings == []
    assert set(states.positions[:, 7]) == {0.02}


def test_joints_of_another_device_do_not_shorten_the_recording(franka):
    stamps, rows = motion(1.0)
    items = recorded(franka, stamps, rows)
    items.insert(30, (stamps[30], messages.make_joint_state(stamps[30], ['head_pan'], [0.1])))
    states, warnings = merged(franka, items)
    assert (states.joint_names, warnings) == (franka.joint_names, [])
    assert len(states.stamps_ns) == 50


def test_a_spike_is_left_out_and_named(franka):
    stamps, rows = motion()
    given = rows.copy()
    given[100, 0] += 1.2
    states, warnings = merged(franka, recorded(franka, stamps, given))
    np.testing.assert_array_equal(states.positions, np.delete(rows, 100, axis=0))
    (text,) = warnings
    assert '1 of 200 messages are out of reach of the others and were left out' in text
    assert "joint 'panda_joint1' jumps from 0.3911 to 1.59 within 0.02 s at 2 s" in text


def test_a_spike_at_the_start_does_not_take_the_rest_for_wrong(franka):
    stamps, rows = motion()
    given = rows.copy()
    given[:3, 0] += 1.2
    states, warnings = merged(franka, recorded(franka, stamps, given))
    np.testing.assert_array_equal(states.positions, rows[3:])
    assert '3 of 200 messages' in warnings[0]


@pytest.mark.parametrize('delay_ns', [0, 5_000_000], ids=['equal stamps', 'between'])
@pytest.mark.parametrize('every', [5, 1])
def test_a_second_publisher_that_stands_still_is_left_out(franka, every, delay_ns):
    """The moving one is the robot, also where the other publishes more."""
    stamps, rows = motion()
    rest = HOME + [0.3, 0.2, 0, 0.8, 0, 0.3, 0, 0]
    others = recorded(franka, stamps[::every] + delay_ns, np.tile(rest, (len(stamps[::every]), 1)))
    items = sorted([*recorded(franka, stamps, rows), *others], key=lambda item: item[0])
    states, warnings = merged(franka, items)
    np.testing.assert_array_equal(states.positions, rows)
    assert f'{len(others)} of {len(items)} messages are out of reach' in warnings[0]


def test_two_publishers_that_both_move_are_refused(franka):
    stamps, rows = motion()
    others = recorded(franka, stamps + 5_000_000, -0.5 * rows + HOME)
    with pytest.raises(EpisodeError, match='200 and 200 of 400 messages belong together'):
        merged(franka, [*recorded(franka, stamps, rows), *others])


def test_an_encoder_whose_zero_changes_is_named_with_time_and_size(franka):
    stamps, rows = motion()
    rows[150:, 1] += 0.5
    states, warnings = merged(franka, recorded(franka, stamps, rows))
    np.testing.assert_array_equal(states.positions, rows)
    (text,) = warnings
    assert "'panda_joint2' jumps from -0.4 to 0.1 within 0.02 s at 3 s" in text
    assert 'all messages are kept' in text


def test_grippers_may_report_steps(franka):
    stamps, rows = motion()
    rows[:, 7] = np.where(np.arange(len(rows)) // 60 % 2, 0.0, 0.04)
    states, warnings = merged(franka, recorded(franka, stamps, rows))
    assert warnings == []
    np.testing.assert_array_equal(states.positions, rows)


def test_a_pause_in_the_recording_is_no_jump(franka):
    stamps, rows = motion(6.0)
    kept = np.r_[0:50, 200:300]
    _, warnings = merged(franka, recorded(franka, stamps[kept], rows[kept]))
    assert warnings == []


def test_a_joint_that_turns_without_end_may_wrap(franka):
    reach = JointReach(franka)
    reach.is_endless[6] = True
    stamps, rows = motion()
    rows[:, 6] = (np.linspace(2.5, 4.5, len(rows)) + np.pi) % (2 * np.pi) - np.pi
    assert find_unreachable('/joint_states', stamps, rows, reach).text == ''
    reach.is_endless[6] = False
    found = find_unreachable('/joint_states', stamps, rows, reach)
    assert "joint 'panda_joint7' jumps from" in found.text and not found.rows.any()


def test_a_joint_that_is_no_longer_published_is_named(franka):
    stamps, rows = motion(6.0)
    items = recorded(franka, stamps, rows)
    for _, message in items[50:]:
        message.name, message.position = message.name[:7], message.position[:7]
        message.velocity = np.empty(0)
    states, warnings = merged(franka, items)
    assert len(states.stamps_ns) == 300
    (text,) = warnings
    assert "'panda_finger_joint1' has no position for 5 s from 0.98 s on, while" in text
    assert 'its last one is held' in text


def test_a_gripper_in_messages_of_its_own_does_not_repeat_a_stamp(franka):
    stamps, rows = motion(1.0)
    names = list(franka.joint_names)
    items = []
    for stamp, row in zip(stamps.tolist(), rows, strict=True):
        items.append((stamp, messages.make_joint_state(stamp, names[:7], row[:7])))
        items.append((stamp, messages.make_joint_state(stamp, names[7:], row[7:])))
    states, warnings = merged(franka, items)
    assert warnings == []
    np.testing.assert_array_equal(states.positions, rows)


def test_joints_in_degrees_are_named_as_that(franka):
    """Every step is too large; the check of limits refuses them."""
    stamps, rows = motion()
    rows = np.rad2deg(rows + np.cumsum(np.full_like(rows, 0.02), axis=0))
    states, warnings = merged(franka, recorded(franka, stamps, rows))
    assert len(states.stamps_ns) == len(rows)
    assert 'nearly every step does (degrees instead of radians?)' in warnings[0]


def test_rows_of_a_table_without_a_number_are_between_their_neighbours(franka):
    stamps, rows = motion(2.0)
    given = rows.copy()
    given[40, 3] = math.nan
    given[60, :] = math.inf
    mended, notes = mend_rows('observation.state', stamps * 1e-9, given, franka)
    np.testing.assert_allclose(mended, rows, atol=2e-4)
    assert mended[40, 3] == pytest.approx((rows[39, 3] + rows[41, 3]) / 2)
    assert len(notes) == 2
    assert "joint 'panda_joint4' is not finite in 2 of 100 rows" in ' '.join(notes)
    assert "joints 'panda_joint1', 'panda_joint2'" in ' '.join(notes)


def test_a_spike_in_the_rows_of_a_table_is_left_out_and_named(franka):
    stamps, rows = motion(2.0)
    given = rows.copy()
    given[50, 1] += 1.2
    mended, (note,) = mend_rows('observation.state', stamps * 1e-9, given, franka)
    np.testing.assert_allclose(mended, rows, atol=2e-4)
    assert '1 of 100 rows are out of reach of the others and were made of those' in note
    with pytest.raises(EpisodeError, match='it has no position at all'):
        mend_rows('observation.state', stamps * 1e-9, np.full_like(rows, math.nan), franka)


def moved_to(robot: RobotModel, joint: int, values: np.ndarray) -> list[tuple[int, object]]:
    """Return messages of a motion in which one joint has other positions."""
    stamps, rows = motion(len(values) / RATE)
    rows[:, joint] = values
    return recorded(robot, stamps, rows)


def test_a_joint_that_is_faster_than_its_stated_limit_moves_and_the_remedy_is_named(franka):
    """Limits of descriptions are placeholders at times: .5 rad/s for fingers that do 6."""
    times = np.arange(200) / RATE
    values = HOME[3] + 1.3 * np.sin(2 * np.pi * 1.4 * np.clip(times - 1, 0, 1))
    states, warnings = merged(franka, moved_to(franka, 3, values))
    top = np.abs(np.diff(values)).max() * RATE
    assert 11.4 < top < 11.5
    np.testing.assert_array_equal(states.positions[:, 3], values)
    (text,) = warnings
    assert f"joint 'panda_joint4' moves at up to {top:.3g} a second, its speed limit is" in text
    assert "'speed_limits: {panda_joint4: 11.5}'" in text


def test_a_spike_of_several_samples_is_no_motion(franka):
    stamps, rows = motion()
    given = rows.copy()
    given[100:104, 0] += [0.4, 0.9, 0.9, 0.4]  # rises and falls in steps of one sign each
    given[150, 0] += 1.0
    states, warnings = merged(franka, recorded(franka, stamps, given))
    assert any('glitches of a sensor' in text for text in warnings)
    assert len(states.stamps_ns) < len(stamps)


def test_a_joint_that_is_measured_less_often_than_there_are_rows_makes_no_jumps(franka):
    """A hand that answers at 10 Hz in a table of 50 rows a second shows five steps in one."""
    times = np.arange(200) / RATE
    speed = 2.5 * franka.velocity_limits[3]
    way = HOME[3] + speed / 6 * np.sin(6 * times)
    held = np.repeat(way[::5], 5)
    assert np.abs(np.diff(held)).max() > 0.05 + 3 * franka.velocity_limits[3] / RATE
    states, warnings = merged(franka, moved_to(franka, 3, held))
    assert warnings == []
    np.testing.assert_array_equal(states.positions[:, 3], held)


def test_a_spike_of_a_joint_that_rests_is_still_one(franka):
    """Rests repeat a position, too; a spike after them takes no time."""
    values = np.full(200, HOME[3])
    values[60:80] += np.linspace(0, 0.2, 20)
    values[80:] += 0.2
    values[150] += 0.7
    states, (text,) = merged(franka, moved_to(franka, 3, values))
    assert '1 of 200 messages are out of reach' in text
    assert len(states.stamps_ns) == 199


def test_rows_that_contradict_each_other_are_refused_in_words_of_tables(franka):
    _, rows = motion()
    both = np.empty((2 * len(rows), rows.shape[1]))
    both[::2], both[1::2] = rows, -0.5 * rows + HOME
    times = np.arange(len(both)) * 0.5 / RATE
    with pytest.raises(EpisodeError) as caught:
        mend_rows('observation.state', times, both, franka)
    assert '200 and 200 of 400 rows belong together' in str(caught.value)
    assert "'speed_limits'" in str(caught.value) and '--topics' not in str(caught.value)
