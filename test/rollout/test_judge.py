"""The estimate on real frames, and the names at the door of the package."""

from __future__ import annotations

from dataclasses import replace

import pytest

import mtv_world_ros
from mtv_world_ros.core.errors import EpisodeError
from mtv_world_ros.vision.describers.describer import objects_from_instruction
from mtv_world_ros.vision.segmenters.colour import ColourSegmenter


def test_a_recorded_success_is_judged_as_one_and_its_beginning_is_not(pipeline, recording):
    assert recording.outcome == 'success'
    assert mtv_world_ros.judge(pipeline, recording).probability > 0.75
    early = recording.times < 3.0  # the arm still carries the block
    cut = replace(
        recording,
        times=recording.times[early],
        frames=recording.frames[:, early],
        positions=recording.positions[early],
    )
    assert mtv_world_ros.judge(pipeline, cut).probability < 0.5


def test_objects_stored_with_the_episode_are_judged_unless_others_are_named(pipeline, recording):
    """The instruction names objects by colour; the episode has them under other names."""
    seen = []

    class Watched(ColourSegmenter):
        def segment(self, frames, names, **more):
            seen.append(tuple(names))
            return super().segment(frames, names, **more)

    watching = replace(pipeline, segmenter=Watched())
    short = replace(
        recording, times=recording.times[:12], frames=recording.frames[:, :12],
        positions=recording.positions[:12], objects=('red block', 'green block'),
    )  # fmt: skip
    mtv_world_ros.judge(watching, short)
    assert set(seen) == {('red block', 'green block')}
    seen.clear()
    mtv_world_ros.judge(replace(watching, objects=('blue block',)), short)
    assert set(seen) == {('blue block',)}
    seen.clear()
    mtv_world_ros.judge(watching, replace(short, objects=()))
    assert set(seen) == {objects_from_instruction(short.instruction)}


def test_a_recording_with_a_gap_is_refused(pipeline, recording):
    times = recording.times.copy()
    times[40:] += 2.0
    with pytest.raises(EpisodeError, match='has a gap'):
        mtv_world_ros.judge(pipeline, replace(recording, times=times))


def test_what_the_robot_saw_at_a_frame_is_an_observation(recording):
    seen = recording.observation(7)
    assert seen.stamp_ns == recording.stamp_ns + round(float(recording.times[7]) * 1e9)
    assert (seen.positions == recording.positions[7]).all()
    assert tuple(camera.view for camera in seen.cameras) == ('low', 'high')


def test_the_verdict_of_futures_is_there_before_the_model_runs(pipeline, recording):
    """Frames can only widen it."""
    order = []

    class Watched:
        spec = pipeline.spec

        def predict(self, *inputs, **options):
            order.append('model')
            return pipeline.world_model.predict(*inputs, **options)

    def take(plan, success):
        order.append((plan.chunk, success))

    episode = replace(pipeline, world_model=Watched()).begin(
        recording.observation(0),
        mtv_world_ros.RolloutOptions(
            instruction=recording.instruction, num_inference_steps=1, on_foreseen=take
        ),
    )
    commands = mtv_world_ros.commands_from(recording, 0)
    final = [chunk.success for chunk in episode.extend(commands)]
    assert order[1::2] == ['model'] * len(final)
    early = order[::2]
    assert [chunk for chunk, _ in early] == list(range(len(final)))
    for (_, success), after in zip(early, final, strict=True):
        assert success.futures.outcomes == after.futures.outcomes
        assert after.interval[0] <= success.interval[0] <= success.interval[1] <= after.interval[1]
        assert success.trust == after.trust and any('foreseen: ' in r for r in success.reasons)
