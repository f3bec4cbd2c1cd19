"""Checks of the frames that a later plan starts from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.core.data_types import ObjectMasks
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.vision.frame_check import check_frames, check_stretch, frame_doubt, lost_objects


@pytest.fixture(scope='module')
def pipeline():
    return Pipeline.load(num_threads=1)


@pytest.fixture(scope='module')
def recording(pipeline):
    return load_recording(share_path('resource', 'demo_episode'), pipeline.spec, pipeline.robot)


def _checked(pipeline, recording, frames=None, row=40):
    first, later = recording.observation(0), recording.observation(row)
    checker = pipeline.judge.camera_checker
    later = later if frames is None else replace(later, frames=frames)
    return check_frames(later, first, checker.check(first), checker)


def test_later_frames_of_the_same_cameras_are_evidence(pipeline, recording):
    for row in range(0, len(recording.times), 20):
        assert _checked(pipeline, recording, row=row) == ()


def test_a_blank_picture_is_named_with_its_camera(pipeline, recording):
    frames = recording.observation(40).frames.copy()
    frames[1] = 255
    (reason,) = _checked(pipeline, recording, frames)
    assert reason.startswith("camera 'high' shows a blank picture")


def test_a_frozen_picture_is_named_without_the_arms_outline(pipeline, recording):
    first, later = recording.observation(0), recording.observation(40)
    frozen = replace(later, frames=first.frames)
    begun = pipeline.judge.camera_checker.check(first)
    reasons = check_frames(frozen, first, begun, None)
    assert len(reasons) == 2 and all('although the arm has moved' in text for text in reasons)


def test_a_picture_of_an_arm_that_rests_may_stay_the_same(pipeline, recording):
    first = recording.observation(0)
    begun = pipeline.judge.camera_checker.check(first)
    assert check_frames(first, first, begun, pipeline.judge.camera_checker) == ()


def test_a_camera_that_could_not_be_checked_at_first_is_not_doubted_later(pipeline, recording):
    later = recording.observation(40)
    mirrored = replace(later, frames=later.frames[:, :, ::-1])
    first = recording.observation(0)
    blind = pipeline.judge.camera_checker.check(replace(first, frames=np.zeros_like(first.frames)))
    assert {fit.status for fit in blind.fits} == {'unchecked'}
    assert check_frames(mirrored, first, blind, pipeline.judge.camera_checker) == ()


@pytest.fixture
def stretch(recording):
    """Twelve frames at 5 Hz while the arm moves, whose second camera freezes at the sixth."""
    rows = slice(10, 22)
    frames, positions = recording.frames[:, rows].copy(), recording.positions[rows]
    frames[1, 6:] = frames[1, 5:6]
    return frames, positions


def _stretches(frames, positions, num):
    still, found = None, []
    for start in range(0, len(positions), num):
        rows = slice(start, start + num)
        reasons, still = check_stretch(
            frames[:, rows], positions[rows], 0.2, ['low', 'high'], still
        )
        found += reasons
    return found


@pytest.mark.parametrize('num', [1, 2, 6])
def test_a_camera_that_freezes_is_named_however_few_frames_come_at_once(stretch, num):
    frames, positions = stretch
    found = _stretches(frames, positions, num)
    assert found
    assert {reason.split(' shows')[0] for reason in found} == {"camera 'high'"}


@pytest.mark.parametrize('num', [1, 3, 12])
def test_frames_that_change_are_evidence_however_few_come_at_once(recording, num):
    assert not _stretches(recording.frames, recording.positions, num)


def test_a_slow_camera_and_an_arm_that_rests_are_not_frozen(stretch, recording):
    frames, positions = stretch
    assert not _stretches(frames, positions[:1].repeat(len(positions), 0), 1)
    frames = recording.frames[:, 10:22].copy()
    frames[:, 1::2] = frames[:, ::2]  # each picture twice
    assert not _stretches(frames, positions, 1)


def test_an_object_in_no_view_is_lost_and_one_in_a_single_view_is_not():
    masks = np.zeros((2, 2, 1, 4, 4), bool)
    masks[1, 0, 0, 1, 1] = True
    found = ObjectMasks(names=('cup', 'plate'), masks=masks, status=(('ok', 'ok'), ('ok', 'ok')))
    assert lost_objects(found) == ('plate',)
    assert frame_doubt((), ('plate',)) == "no view shows 'plate' where this plan starts"
    assert frame_doubt((), ()) == ''
