"""Contact parameters of another robot cell: open verdicts until executed plans confirm them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.core.data_types import Observation
from mtv_world_ros.core.estimate_words import NOT_FITTED_HERE
from mtv_world_ros.robot.plan import Plan
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.success.doubts import ContactTrust
from mtv_world_ros.success.estimator import verdict_word

WAITING = ContactTrust(text='contact of this cell is not confirmed: 4 of 10 ends as foreseen')
CONFIRMED = ContactTrust(
    is_confirmed=True, text='contact of this cell is confirmed: 10 of 10 ends as foreseen'
)


def observed(recording, place):
    """Return the first observation in a robot cell."""
    return Observation(
        cameras=recording.cameras,
        frames=recording.frames[:, 0],
        positions=recording.positions[0],
        stamp_ns=1,
        place=place,
    )


def options(recording, contact):
    return RolloutOptions(
        instruction=recording.instruction, num_inference_steps=1, contact=contact
    )


def plan(recording):
    """Return the recorded commands."""
    commands = recording.commands
    kept = commands.times > 1e-6
    return replace(commands, times=commands.times[kept], positions=commands.positions[kept])


def imagined(pipeline, recording, place, contact):
    """Return the predictions of the recorded commands in a robot cell."""
    begun = pipeline.begin(observed(recording, place), options(recording, contact))
    return list(begun.extend(plan(recording)))


def word(prediction):
    success = prediction.success
    return verdict_word(success.probability, success.interval)


@pytest.mark.slow
def test_a_verdict_is_open_in_another_cell_until_its_contact_is_confirmed(pipeline, recording):
    fitted = imagined(pipeline, recording, 'simulator/nominal', ContactTrust())
    waiting = imagined(pipeline, recording, 'cell 3', WAITING)
    confirmed = imagined(pipeline, recording, 'cell 3', CONFIRMED)
    assert [word(chunks[-1]) for chunks in (fitted, waiting, confirmed)] == [
        'success', 'open', 'success'
    ]  # fmt: skip
    said = waiting[-1].success.reasons
    assert said[-2] == f'open: {WAITING.text}' and said[-1].startswith(NOT_FITTED_HERE)
    assert "'simulator/nominal', not in 'cell 3'" in said[-1]
    # what is confirmed is what was fitted: futures and estimate are the same
    last, expected = confirmed[-1].success, fitted[-1].success
    assert last.probability == expected.probability and last.interval == expected.interval
    assert last.is_calibrated and last.reasons == (
        *expected.reasons[:-1],
        CONFIRMED.text,
        expected.trust,
    )


@pytest.mark.slow
def test_later_plans_of_an_episode_follow_a_confirmation_and_its_withdrawal(pipeline, recording):
    start = observed(recording, 'cell 3')
    begun, words = pipeline.begin(start, options(recording, WAITING)), []
    for contact in (WAITING, CONFIRMED, WAITING):
        later = begun.branch(replace(start, stamp_ns=2))
        later.options = options(recording, contact)
        words.append(word(list(later.extend(plan(recording)))[-1]))
    assert words == ['open', 'success', 'open']


@pytest.mark.slow
def test_executed_plans_are_compared_with_futures_of_the_fitted_parameters(pipeline, recording):
    """Futures of the prior would foresee nearly everything."""
    fitted = imagined(pipeline, recording, 'simulator/nominal', ContactTrust())
    elsewhere = imagined(pipeline, recording, 'cell 3', ContactTrust())
    model = pipeline.judge.object_motion.with_robot(pipeline.robot)
    start = replace(elsewhere[0].start, stamp_ns=1)
    chunks = Plan.of(plan(recording), pipeline.robot, start).chunks(pipeline.spec)
    for number, (one, other) in enumerate(zip(elsewhere, fitted, strict=True), start=1):
        found = one.objects.ends_by(model, chunks[:number])
        np.testing.assert_allclose(found, other.foreseen, atol=1e-9)
        assert not np.allclose(one.foreseen, other.foreseen, atol=1e-3)
