"""Clock checks: gaps, skew, streams of different clocks, and delays that are put in."""

import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory
from mtv_world_ros.data.episode import JointStates, Track
from mtv_world_ros.inspection.clocks import (
    check_commands,
    check_joint_states,
    check_rate,
    check_skew,
    JointTrack,
    response,
)

START = 1_700_000_000_000_000_000
FRAMES = START + np.arange(60) * 100_000_000  # 10 Hz, 5.9 s


def angle(seconds):
    return 0.5 * np.sin(1.3 * seconds)


def joints(robot, *, start=START, late_s=0.0, hz=50, seconds=6.0):
    """The first joint swings, seen `late_s` after it was commanded; the others stand still."""
    times = np.arange(round(seconds * hz)) / hz
    positions = np.full((len(times), len(robot.joint_names)), 0.01)
    positions[:, 0] = angle(times - late_s)
    states = JointStates(
        stamps_ns=start + (times * 1e9).astype(np.int64),
        joint_names=robot.joint_names,
        positions=positions,
    )
    return JointTrack(states, robot)


def commands(robot):
    times = np.arange(1, 60) * 0.1
    positions = np.full((len(times), len(robot.joint_names)), 0.01)
    positions[:, 0] = angle(times)
    return JointTrajectory(joint_names=robot.joint_names, times=times, positions=positions)


def test_a_steady_stream_has_its_rate_and_no_findings():
    measures, findings = check_rate('frames', FRAMES)
    assert measures == {'frames rate': '10 Hz, 60 messages'}
    assert findings == []


def test_a_gap_is_found_with_its_place():
    _, findings = check_rate('frames', np.delete(FRAMES, [20, 21, 22]))
    assert [f.verdict for f in findings] == ['suspicious']
    assert '1 gaps, the longest of 0.4 s at 1.9 s' in findings[0].text


def test_a_single_message_is_broken():
    assert check_rate('frames', FRAMES[:1])[1][0].verdict == 'broken'


@pytest.mark.parametrize(
    ('late_ns', 'verdicts'), [(20_000_000, []), (-30_000_000, []), (120_000_000, ['suspicious'])]
)
def test_views_that_are_apart_are_found(late_ns, verdicts):
    frames = FRAMES[::2]  # at 5 Hz 120 ms are 80 ms to the next frame
    images = {'low': Track(frames, np.zeros(30)), 'high': Track(frames - late_ns, np.zeros(30))}
    _, findings = check_skew('high', images)
    assert [f.verdict for f in findings] == verdicts


def test_views_of_different_clocks_are_broken():
    images = {'low': Track(FRAMES, np.zeros(60)), 'high': Track(FRAMES - 10**12, np.zeros(60))}
    assert check_skew('high', images)[1][0].verdict == 'broken'


def test_joint_states_of_another_clock_are_broken(robot):
    _, findings = check_joint_states(FRAMES, joints(robot, start=START - 10**12))
    assert findings[0].verdict == 'broken'
    assert 'same clock' in findings[0].text


def test_joint_states_that_end_early_are_suspicious(robot):
    measures, findings = check_joint_states(FRAMES, joints(robot, seconds=4.5))
    # frames 0 .. 44 of 60 lie at or before the last joint state at 4.48 s
    assert measures['frames within the joint states'] == '75%'
    assert [f.verdict for f in findings] == ['suspicious', 'suspicious']
    assert 'a frame is 1.42 s away' in findings[1].text


@pytest.mark.parametrize('late_s', [0.0, 0.24, 0.8])
def test_the_delay_of_the_joints_is_measured(robot, late_s):
    measured, rest = response(commands(robot), START, joints(robot, late_s=late_s))
    assert measured == pytest.approx(late_s, abs=0.021)
    assert rest < 0.01


def test_commands_are_judged_by_delay_and_cover(robot):
    def verdicts(given, **options):
        track = joints(robot, **options)
        return [f.verdict for f in check_commands(given, START, FRAMES, track)[1]]

    assert verdicts(commands(robot)) == []
    assert verdicts(commands(robot), late_s=0.8) == ['suspicious']
    assert verdicts(None) == ['suspicious']
    whole = commands(robot)
    short = JointTrajectory(
        joint_names=whole.joint_names, times=whole.times[:20], positions=whole.positions[:20]
    )
    assert verdicts(short) == ['broken']
