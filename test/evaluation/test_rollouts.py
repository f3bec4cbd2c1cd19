from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from mtv_world_ros.evaluation.imagined_stretches import (
    imagine_stretch,
    observe_stretch,
    predicted_frames,
    stretches,
)
from mtv_world_ros.rollout.rollout import Rollout


def test_observed_stretches_are_chunks_from_real_frames(recordings, make_pipeline):
    spec = make_pipeline().spec
    found = stretches(recordings[0], spec, 'observe')
    assert [(s.start, s.num_frames) for s in found] == [(0, 4), (8, 4)]
    assert (found[1].frames[:, 0] == recordings[0].frames[:, 8]).all()
    assert (found[1].frames[:, 4] == recordings[0].frames[:, 16]).all()
    np.testing.assert_array_equal(found[1].positions, recordings[0].positions[8:17:2])


def test_recorded_frames_are_judged_with_the_joints_that_were_measured(
    recordings, make_pipeline, monkeypatch
):
    """What stops a gripper shows there, and not in the commands."""
    judged = []

    def observe(self, frames, positions, commands=None):
        judged.append((frames, positions))
        return SimpleNamespace(success='estimate')

    monkeypatch.setattr(Rollout, 'observe', observe)
    pipeline = make_pipeline()
    stretch = stretches(recordings[0], pipeline.spec, 'observe')[1]
    assert observe_stretch(pipeline, recordings[0], stretch) == 'estimate'
    (before, positions_before), (frames, positions) = judged
    # as a node's, its estimate remembers what was seen before
    np.testing.assert_array_equal(before, recordings[0].frames[:, 2:9:2])
    np.testing.assert_array_equal(positions_before, recordings[0].positions[:9:2])
    np.testing.assert_array_equal(frames, stretch.frames[:, 1:])
    np.testing.assert_array_equal(positions, recordings[0].positions[8:17:2])


def test_last_stretch_of_at_least_half_a_chunk_is_kept(recordings, make_pipeline):
    spec = replace(make_pipeline().spec, num_frames=6)
    found = stretches(recordings[0], spec, 'observe')
    assert [s.num_frames for s in found] == [6, 3]


def test_imagined_stretch_is_the_whole_episode(recordings, make_pipeline):
    found = stretches(recordings[0], make_pipeline().spec, 'imagine')
    assert [(s.start, s.num_frames) for s in found] == [(0, 9)]


def test_rollout_has_as_many_frames_as_the_stretch(recordings, make_pipeline, oracle):
    pipeline, recording = make_pipeline(oracle), recordings[0]
    stretch = stretches(recording, pipeline.spec, 'imagine')[0]
    chunks = imagine_stretch(
        pipeline, recording, stretch, actions=recording, seed=3, num_inference_steps=1
    )
    assert len(chunks) == 3
    frames = predicted_frames(chunks)
    assert (frames == stretch.frames[:, 1:]).all()
    assert [chunk.seed for chunk in chunks] == [3, 4, 5]
    assert chunks[0].stamp_ns == recording.stamp_ns


def test_actions_of_another_episode_are_executed_from_the_same_start(recordings, make_pipeline):
    pipeline = make_pipeline()
    stretch = stretches(recordings[0], pipeline.spec, 'observe')[1]
    own, other = (
        imagine_stretch(
            pipeline, recordings[0], stretch, actions=source, seed=0, num_inference_steps=1
        )[0]
        for source in (recordings[0], recordings[2])
    )
    assert not np.allclose(own.positions, other.positions)
    assert (own.start.frames == other.start.frames).all()
