"""Stops of fingers, held and not held, as evidence of contact, on a hand that slides up."""

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.physics.arms.arms import Arms
from mtv_world_ros.physics.contact_settings import (
    ContactOrigin,
    ContactSettings,
    hold_line,
    MAX_HOLD_FACTOR,
)
from mtv_world_ros.physics.engine.engine import Engine
from mtv_world_ros.physics.fitting.contact_fit import find_holds
from mtv_world_ros.physics.fitting.stop_trials import ObservedStop, StopTrial
from mtv_world_ros.physics.solids import Solid
from test.support import small_scene

#: between fingers, 25 mm wide along their way
BLOCK = Solid(centre=np.array([0.0, 0.0, 0.02]), size=np.array([0.03, 0.05, 0.04]))
STOP = ObservedStop(arm=0, item=0, closed_s=0.62, opened_s=2.2, is_held=True)


def picking():
    """Measured positions (N, 2) of a pick and a lift; the fingers stop at 0.025 m."""
    times = np.arange(0, 3.01, 0.02)
    height = 0.02 + 0.1 * np.clip((times - 1) / 0.5, 0, 1)
    closing = 0.04 - 0.015 * np.clip((times - 0.3) / 0.3, 0, 1)
    return np.stack([height, np.where(times < 2.2, closing, 0.04)], -1)


def trial_of(lift, stop=STOP, solid=BLOCK, moved=0.0):
    ways = np.zeros((31, 3))
    ways[:, 1] = moved
    return StopTrial.of(stop, lift, picking(), ways, solid, 0.0)


def of_friction(lift, trial, *values):
    tried = [
        small_scene.SETTINGS.model_copy(update={'grip_friction': value, 'squeeze': 0.1})
        for value in values
    ]
    engine = Engine(Arms(lift, None))
    return trial.likelihoods(engine, tried, np.zeros((len(tried), 3)))


def test_a_held_stop_speaks_for_friction_and_one_that_is_not_held_against_it(lift):
    slippery, rough = of_friction(lift, trial_of(lift), 0.01, 2.0)
    assert rough > slippery + 2
    slippery, rough = of_friction(lift, trial_of(lift, replace(STOP, is_held=False)), 0.01, 2.0)
    assert slippery > rough + 2


def test_what_was_held_is_put_between_the_fingers(lift):
    trial = trial_of(lift, moved=0.03)
    assert trial is not None and trial.solid.centre[1] == pytest.approx(0.0, abs=1e-9)
    # what was not held is where masks show it
    trial = trial_of(lift, replace(STOP, is_held=False), moved=0.03)
    assert trial is not None and trial.solid.centre[1] == pytest.approx(0.03)


@pytest.mark.parametrize(('seen_m', 'fitted_m'), [(0.045, 0.05), (0.05, 0.05), (0.1, 0.1)])
def test_what_was_held_is_as_wide_as_the_gap_of_the_fingers(lift, seen_m, fitted_m):
    """Fingers stop 25 mm from the tool; of a block twice as wide they hold a part."""
    solid = replace(BLOCK, size=np.array([0.03, seen_m, 0.04]))
    trial = trial_of(lift, solid=solid)
    assert trial is not None and trial.solid.size == pytest.approx([0.03, fitted_m, 0.04])
    # what was not held may be touched by one finger alone
    trial = trial_of(lift, replace(STOP, is_held=False), solid)
    assert trial is not None and trial.solid.size == pytest.approx(solid.size)


@pytest.mark.parametrize(
    ('stop', 'solid'),
    [
        (replace(STOP, opened_s=0.9), BLOCK),  # opens again before the hand moves
        (STOP, replace(BLOCK, size=np.array([0.2, 0.2, 0.02]))),  # wider than the gripper
        (replace(STOP, closed_s=0.1), BLOCK),  # the fingers never were wider
    ],
)
def test_stops_that_tell_nothing_are_left_out(lift, stop, solid):
    assert trial_of(lift, stop, solid) is None


def test_the_share_of_stops_that_hold_counts_both(lift):
    held, missed = STOP, replace(STOP, is_held=False)
    found = find_holds([held] * 5 + [missed])
    assert found.value == pytest.approx(6 / 8)
    assert found.low < found.value < found.high
    assert '5 of 6 stops' in str(found)


def test_a_recording_in_which_nothing_is_ever_held_says_so():
    assert find_holds([replace(STOP, is_held=False)] * 4).value == pytest.approx(1 / 6)
    assert '0 of 4 stops' in str(find_holds([replace(STOP, is_held=False)] * 4))
    assert '0 of 0 stops' in str(find_holds([]))


@pytest.mark.parametrize(('factor', 'is_enough'), [(0.9, True), (1.1, False)])
def test_verdicts_rest_on_how_well_slipping_is_known(factor, is_enough):
    hold = (2.0, 2.0 * factor * MAX_HOLD_FACTOR)
    origin = ContactOrigin(by='test', recordings=9, telling=1, hold=hold)
    settings: ContactSettings = small_scene.SETTINGS.model_copy(update={'fitted': origin})
    assert (settings.doubt == '') == is_enough
    assert settings.doubt in ('', hold_line(*hold))
    assert ('verdicts may rest on it' in hold_line(*hold)) == is_enough
