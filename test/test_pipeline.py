"""The main path on the bundled episode: clocks, chaining, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtv_world_ros.assembly import assemble
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.data_types import JointTrajectory, Observation, WorldModelSpec
from mtv_world_ros.errors import CheckpointError, ObservationError, TrajectoryError
from mtv_world_ros.evaluation.baselines import PersistenceWorldModel
from mtv_world_ros.files import share_path
from mtv_world_ros.geometry.robot_file import load_robot
from mtv_world_ros.history import History
from mtv_world_ros.pipeline import Pipeline

SPEC = WorldModelSpec(
    views=('low', 'high'), fps=5.0, num_frames=8, width=64, height=48, robot='yam_bimanual'
)
CARD = {'robot': 'yam_bimanual', 'rendering': {}, 'object_mask': True}


class CountingWorldModel(PersistenceWorldModel):
    """Frame k is the start frame made k grey levels brighter; remembers what it was given."""

    def __init__(self, spec: WorldModelSpec) -> None:
        super().__init__(spec)
        self.trajectories: list[np.ndarray] = []
        self.seeds: list[int] = []
        self.num_steps: list[int] = []
        self.histories: list[History] = []

    def predict(self, start_frame, trajectory_frames, *, seed, history, **options):
        self.histories.append(history)
        self.trajectories.append(trajectory_frames)
        self.seeds.append(seed)
        self.num_steps.append(options['num_inference_steps'])
        held = super().predict(start_frame, trajectory_frames, seed=seed, **options)
        steps = np.arange(1, held.shape[1] + 1)[None, :, None, None, None]
        return np.minimum(held.astype(int) + steps, 255).astype(np.uint8)


@pytest.fixture(scope='module')
def recording() -> Recording:
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))
    return load_recording(share_path('resource', 'demo_episode'), SPEC, robot)


@pytest.fixture
def world_model() -> CountingWorldModel:
    return CountingWorldModel(SPEC)


@pytest.fixture
def pipeline(world_model: CountingWorldModel) -> Pipeline:
    return assemble(CARD, world_model)


def observe(recording: Recording) -> Observation:
    return Observation(
        cameras=recording.cameras,
        frames=recording.frames[:, 0],
        positions=recording.positions[0],
        stamp_ns=recording.stamp_ns,
    )


def commands(recording: Recording, seconds: float) -> JointTrajectory:
    whole = recording.commands
    kept = (whole.times > 1e-6) & (whole.times <= seconds + 1e-9)
    return JointTrajectory(
        joint_names=whole.joint_names, times=whole.times[kept], positions=whole.positions[kept]
    )


def imagine(pipeline: Pipeline, recording: Recording, seconds: float, **options):
    return list(
        pipeline.imagine(
            observe(recording),
            commands(recording, seconds),
            instruction=recording.instruction,
            **options,
        )
    )


@pytest.mark.parametrize(
    ('seconds', 'lengths'), [(1.6, [8]), (0.5, [3]), (3.2, [8, 8]), (2.0, [8, 2])]
)
def test_predicts_just_as_far_as_the_trajectory_goes(
    pipeline: Pipeline, recording: Recording, seconds: float, lengths: list[int]
) -> None:
    chunks = imagine(pipeline, recording, seconds)
    assert [len(chunk.rollout.video.times) for chunk in chunks] == lengths
    times = np.concatenate([chunk.rollout.video.times for chunk in chunks])
    np.testing.assert_allclose(times, np.arange(1, sum(lengths) + 1) / SPEC.fps)


def test_each_chunk_goes_on_from_the_last_frame_of_the_one_before(
    pipeline: Pipeline, recording: Recording
) -> None:
    first, second = imagine(pipeline, recording, 3.2)
    assert np.array_equal(second.rollout.start_frame, first.rollout.video.frames[:, -1])
    assert np.array_equal(first.end_observation.frames, second.rollout.start_frame)
    end_ns = recording.stamp_ns + 1_600_000_000
    assert first.end_observation.stamp_ns == end_ns


@pytest.mark.parametrize(('asked', 'made_for', 'expected'), [(0, 2, 2), (7, 2, 7), (0, 4, 4)])
def test_denoises_in_the_steps_that_the_model_is_made_for_unless_told_otherwise(
    recording: Recording, asked: int, made_for: int, expected: int
) -> None:
    world_model = CountingWorldModel(replace(SPEC, num_inference_steps=made_for))
    options = {'num_inference_steps': asked} if asked else {}
    (chunk,) = imagine(assemble(CARD, world_model), recording, 1.6, **options)
    assert world_model.num_steps == [expected]
    assert chunk.num_inference_steps == expected


def test_chunks_of_one_rollout_have_seeds_of_their_own(
    pipeline: Pipeline, world_model: CountingWorldModel, recording: Recording
) -> None:
    imagine(pipeline, recording, 3.2, seed=7)
    assert world_model.seeds == [7, 8]


@pytest.mark.parametrize('num_history', [0, 5, 12])
def test_history_is_the_frames_before_the_start_and_the_first_one_stays_the_anchor(
    recording: Recording, num_history: int
) -> None:
    model = CountingWorldModel(replace(SPEC, num_history=num_history))
    chunks = imagine(assemble(CARD, model), recording, 4.8)
    first = recording.frames[:, 0]
    shown = np.concatenate([first[:, None], *(c.rollout.video.frames for c in chunks)], axis=1)
    assert len(model.histories) == 3
    for chunk, history in enumerate(model.histories):
        start = 8 * chunk  # the frame that the chunk starts from is no part of its history
        assert np.array_equal(history.frames, shown[:, max(start - num_history, 0) : start])
        assert np.array_equal(history.anchor, first)


def test_a_rollout_that_goes_on_is_the_one_that_never_stopped(recording: Recording) -> None:
    """Chunks asked for one by one: the clock, the history and the anchor are those of one."""
    model = CountingWorldModel(replace(SPEC, num_history=5))
    pipeline = assemble(CARD, model)
    whole = imagine(pipeline, recording, 4.8)
    seen, history, parts = observe(recording), None, []
    asked = commands(recording, 4.8)
    for chunk in range(3):
        mine = (asked.times > 1.6 * chunk + 1e-6) & (asked.times <= 1.6 * (chunk + 1) + 1e-6)
        trajectory = JointTrajectory(
            joint_names=asked.joint_names,
            times=asked.times[mine] - 1.6 * chunk,
            positions=asked.positions[mine],
        )
        (part,) = pipeline.imagine(
            seen, trajectory, instruction=recording.instruction, history=history
        )
        seen, history = part.end_observation, part.end_history
        parts.append(part)
    for one, other in zip(parts, whole, strict=True):
        assert np.array_equal(one.rollout.video.frames, other.rollout.video.frames)
        assert one.end_observation.stamp_ns == other.end_observation.stamp_ns
        np.testing.assert_allclose(one.rollout.positions, other.rollout.positions, atol=1e-9)
    for one, other in zip(model.histories[3:], model.histories[:3], strict=True):
        assert np.array_equal(one.frames, other.frames)
        assert np.array_equal(one.anchor, other.anchor)


def test_a_history_of_another_size_is_refused(pipeline: Pipeline, recording: Recording) -> None:
    other = History.begin(np.zeros((2, 24, 32, 3), np.uint8))
    with pytest.raises(ObservationError, match=r'\(2, 24, 32, 3\).*\(2, 48, 64, 3\)'):
        list(pipeline.imagine(observe(recording), commands(recording, 1.6), history=other))


def test_control_frame_zero_shows_the_observed_state(
    pipeline: Pipeline, world_model: CountingWorldModel, recording: Recording
) -> None:
    """And frame k the state after command k: a later start shifts the frames, not the first."""
    (chunk,) = imagine(pipeline, recording, 1.6)
    drawn = pipeline.draw(
        recording.cameras,
        np.stack([recording.positions[0], chunk.rollout.positions[0]]),
        np.array([0.0, 0.2]),
        chunk.start_masks,
    )
    assert np.array_equal(world_model.trajectories[0][:, :2], drawn.frames)


def test_the_objects_are_those_of_the_instruction(
    pipeline: Pipeline, recording: Recording
) -> None:
    (chunk,) = imagine(pipeline, recording, 1.6)
    assert chunk.start_masks.names == recording.objects[:2]
    assert chunk.start_masks.masks.any(axis=(2, 3, 4)).all()


def test_without_object_masks_the_control_is_dark_but_for_the_trails(
    world_model: CountingWorldModel, recording: Recording
) -> None:
    imagine(assemble({**CARD, 'object_mask': False}, world_model), recording, 1.6)
    imagine(assemble(CARD, world_model), recording, 1.6)
    without, with_masks = (np.count_nonzero(t) for t in world_model.trajectories)
    assert 0 < without < with_masks


def test_a_larger_observation_is_brought_to_the_models_size(
    pipeline: Pipeline, recording: Recording
) -> None:
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual.yaml'))
    large = load_recording(
        share_path('resource', 'demo_episode'), replace(SPEC, width=384, height=288), robot
    )
    chunks = list(
        pipeline.imagine(observe(large), commands(large, 1.6), instruction=large.instruction)
    )
    np.testing.assert_allclose(chunks[0].cameras[0].K, recording.cameras[0].K)
    difference = np.abs(chunks[0].rollout.start_frame.astype(int) - recording.frames[:, 0])
    assert difference.max() <= 1


def test_views_in_another_order_are_refused(pipeline: Pipeline, recording: Recording) -> None:
    seen = observe(recording)
    turned = Observation(
        cameras=seen.cameras[::-1],
        frames=seen.frames[::-1],
        positions=seen.positions,
        stamp_ns=seen.stamp_ns,
    )
    with pytest.raises(ObservationError, match=r"\['high', 'low'\].*\['low', 'high'\]"):
        list(pipeline.imagine(turned, commands(recording, 1.6)))


def test_positions_outside_the_limits_are_refused(
    pipeline: Pipeline, recording: Recording
) -> None:
    good = commands(recording, 1.6)
    positions = good.positions.copy()
    positions[3, 1] = 9.0
    bad = replace(good, positions=positions)
    with pytest.raises(TrajectoryError, match='left_joint2.* is 9 '):
        list(pipeline.imagine(observe(recording), bad))


def test_a_checkpoint_of_another_robot_is_refused(world_model: CountingWorldModel) -> None:
    yam = share_path('config', 'robots', 'yam_bimanual.yaml')
    with pytest.raises(CheckpointError, match="trained with robot 'other'"):
        assemble({**CARD, 'robot': 'other'}, world_model, robot=yam)
