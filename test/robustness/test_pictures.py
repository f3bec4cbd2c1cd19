"""Frames that go wrong after an episode's first plan never make its verdict surer."""

from __future__ import annotations

from math import isfinite

import numpy as np
import pytest

from mtv_world_ros.core.data_types import SuccessEstimate
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import frame_indices, load_recording
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from robustness.pictures import damages, Row, run
from test.support.tiers import rest_slow

_FAST = ('black', 'delayed by 1 s', 'shifted by a tenth')
#: damages that leave the pictures readable
_READABLE = ('JPEG of quality 4',)
_NAMES = (
    'black', 'noise', 'frozen at the first frame', 'delayed by 1 s', 'upside down',
    'turned by 10 degrees', 'mirrored', 'shifted by a quarter', 'shifted by a tenth',
    'cameras exchanged', 'a hand before the lens', 'JPEG of quality 4', 'overexposed',
)  # fmt: skip


@pytest.fixture(scope='module')
def pipeline():
    return Pipeline.load(num_threads=1)


@pytest.fixture(scope='module')
def recording(pipeline):
    return load_recording(share_path('resource', 'demo_episode'), pipeline.spec, pipeline.robot)


@pytest.fixture(scope='module')
def real(pipeline, recording):
    return Row(name='real frames', views='', success=run(pipeline, recording, 1))


def test_real_frames_of_a_later_plan_get_their_verdict(real):
    assert real.word == 'success'


def test_every_damage_is_tried(recording):
    assert set(_NAMES) == set(damages(recording, None))


@pytest.mark.parametrize('name', rest_slow(_NAMES, _FAST))
def test_damaged_pictures_are_never_surer_and_the_camera_is_named(pipeline, recording, real, name):
    damage = damages(recording, None)[name]
    for views in ((0, 1), (0,)):
        found = run(pipeline, recording, 1, damage, views)
        row = Row(name=name, views='', success=found)
        assert not row.is_surer_than(real), row.line(real)
        if name in _READABLE:
            assert not isfinite(found.probability) or row.word == real.word
        else:
            assert not isfinite(found.probability)
            assert found.trust.startswith("cannot tell, because camera 'low'"), found.reasons[0]


def test_undamaged_pictures_through_the_same_path_are_no_damage(pipeline, recording, real):
    found = run(pipeline, recording, 1, lambda frames, rows: frames, (0, 1))
    assert found.probability == real.success.probability


def _row(probability: float, interval: tuple[float, float]) -> Row:
    estimate = SuccessEstimate(
        probability=probability, interval=interval, reasons=(), jaccard=np.full((1, 1), np.nan)
    )
    return Row(name='', views='', success=estimate)


def test_surer_is_narrower_with_another_answer():
    real = _row(0.98, (0.87, 1.0))
    assert _row(0.05, (0.01, 0.09)).is_surer_than(real)
    assert _row(0.05, (0.0, 0.6)).is_surer_than(real)  # the opposite verdict
    assert not _row(0.6, (0.1, 0.9)).is_surer_than(real)
    assert not _row(0.98, (0.96, 0.99)).is_surer_than(real)
    assert not _row(np.nan, (np.nan, np.nan)).is_surer_than(real)


@pytest.mark.slow
def test_frames_that_freeze_after_the_second_plan_are_no_evidence(pipeline, recording):
    damage = damages(recording, None)['frozen at the first frame']
    found = run(pipeline, recording, 2, damage, (0, 1), first_plan=1)
    assert not isfinite(found.probability)
    assert 'one picture all the time' in found.reasons[0]


@pytest.mark.parametrize('name', ['black', 'frozen at the first frame'])
def test_an_estimate_of_executed_frames_rests_on_no_damaged_ones(pipeline, recording, name):
    rows = frame_indices(recording, 0, pipeline.spec, pipeline.spec.num_frames)
    frames = damages(recording, None)[name](recording.frames[:, rows[1:]], rows[1:])
    options = RolloutOptions(instruction=recording.instruction)
    episode = pipeline.begin(recording.observation(0), options)
    seen = episode.observe(frames, recording.positions[rows])
    assert not isfinite(seen.success.probability)
    assert "camera 'low'" in seen.success.reasons[0]
