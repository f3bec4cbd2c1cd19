"""The main path on the bundled episode: clocks, chaining, and what is refused."""

from __future__ import annotations

from dataclasses import replace
import re

import numpy as np
import pytest

from mtv_world_ros.cameras.camera import project
from mtv_world_ros.cameras.mask_geometry import centroids, locate
from mtv_world_ros.cameras.motion import Motion
from mtv_world_ros.control.arm_pictures import arm_pictures
from mtv_world_ros.control.control import ControlScene
from mtv_world_ros.control.trajectory_video import TrajectoryVideoConfig
from mtv_world_ros.core.data_types import (
    History,
    JointTrajectory,
    ObjectMasks,
    Observation,
    WorldModelSpec,
)
from mtv_world_ros.core.errors import (
    CalibrationError,
    ObservationError,
    RolloutPreempted,
    TrajectoryError,
)
from mtv_world_ros.core.files import share_path
from mtv_world_ros.core.images import resize_frames
from mtv_world_ros.data.recording import load_recording, Recording
from mtv_world_ros.data.recordings import cached_recording
from mtv_world_ros.evaluation.imagined_stretches import (
    imagine_stretch,
    last_chunk,
    observe_stretch,
    stretches,
)
from mtv_world_ros.model.card import read_card
from mtv_world_ros.physics import solid_foresight
from mtv_world_ros.physics.checkpoint_files import load_foresight
from mtv_world_ros.physics.object_motion import ObjectMotion
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.robot.shape import load_shape
from mtv_world_ros.rollout.observed_episode import ObservedEpisode
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.pipeline import Pipeline
from mtv_world_ros.rollout.state import Followed
from mtv_world_ros.success.calibration import Fits, load_fits
from mtv_world_ros.success.doubts import Grounds
from mtv_world_ros.vision.describers.describer import DescribedObject
from mtv_world_ros.vision.jaccard import jaccard
from test.support.pipelines import assembled
from test.support.small_episodes import PersistenceWorldModel

SPEC = WorldModelSpec(
    views=('low', 'high'), fps=5.0, num_frames=8, width=64, height=48, robot='yam_bimanual'
)
YAM = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
CARD = read_card(share_path('resource', 'checkpoint')).replace(rendering={})


class CountingWorldModel(PersistenceWorldModel):
    """Frame k is the start frame made k grey levels brighter; remembers what it was given."""

    def __init__(self, spec: WorldModelSpec) -> None:
        super().__init__(spec)
        self.trajectories: list[np.ndarray] = []
        self.seeds: list[int] = []
        self.num_steps: list[int] = []
        self.histories: list[History] = []

    def predict(self, start_frame, control, *, seed, history, **options):
        self.histories.append(history)
        self.trajectories.append(control.video)
        self.seeds.append(seed)
        self.num_steps.append(options['num_inference_steps'])
        held = super().predict(start_frame, control, seed=seed, **options)
        steps = np.arange(1, held.shape[1] + 1)[None, :, None, None, None]
        return np.minimum(held.astype(int) + steps, 255).astype(np.uint8)


@pytest.fixture(scope='module')
def recording() -> Recording:
    return load_recording(share_path('resource', 'demo_episode'), SPEC, YAM)


@pytest.fixture
def world_model() -> CountingWorldModel:
    return CountingWorldModel(SPEC)


@pytest.fixture
def pipeline(world_model) -> Pipeline:
    return assembled(CARD, world_model, YAM)


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


def draw(pipeline: Pipeline, motion: Motion, times: np.ndarray, masks: ObjectMasks) -> np.ndarray:
    scene = ControlScene(
        motion=motion,
        times=times,
        start_frames=np.zeros((len(motion.cameras), SPEC.height, SPEC.width, 3), np.uint8),
        masks=masks.masks[:, :, 0],
    )
    video = pipeline.control.make(scene).video
    assert video is not None
    return video


def with_motion(world_model: CountingWorldModel, object_motion) -> Pipeline:
    """A pipeline that shows the model where objects go."""
    card = CARD.replace(rendering={'object_motion': True})
    return assembled(card, world_model, YAM, object_motion=object_motion)


def imagine(pipeline: Pipeline, recording: Recording, seconds: float, **options):
    episode = pipeline.begin(
        observe(recording), RolloutOptions(instruction=recording.instruction, **options)
    )
    return list(episode.extend(commands(recording, seconds)))


@pytest.mark.parametrize(
    ('seconds', 'lengths'), [(1.6, [8]), (0.5, [3]), (3.2, [8, 8]), (2.0, [8, 2])]
)
def test_predicts_just_as_far_as_the_trajectory_goes(pipeline, recording, seconds, lengths):
    chunks = imagine(pipeline, recording, seconds)
    assert [len(chunk.video.times) for chunk in chunks] == lengths
    times = np.concatenate([chunk.video.times for chunk in chunks])
    np.testing.assert_allclose(times, np.arange(1, sum(lengths) + 1) / SPEC.fps)


def test_each_chunk_goes_on_from_the_last_frame_of_the_one_before(pipeline, recording):
    episode = pipeline.begin(observe(recording))
    stands_at = []
    for prediction in episode.extend(commands(recording, 3.2)):
        assert np.array_equal(episode.observation.frames, prediction.video.frames[:, -1])
        assert np.array_equal(episode.observation.positions, prediction.positions[-1])
        stands_at.append((prediction.start, episode.observation))
    (first, after_first), (second, _) = stands_at
    assert second is after_first
    assert np.array_equal(first.frames, recording.frames[:, 0])
    assert after_first.stamp_ns == recording.stamp_ns + 1_600_000_000
    assert episode.num_chunks == 2


@pytest.mark.parametrize(('asked', 'made_for', 'expected'), [(0, 2, 2), (7, 2, 7), (0, 4, 4)])
def test_denoises_in_the_steps_that_the_model_is_made_for_unless_told_otherwise(
    recording, asked, made_for, expected
):
    world_model = CountingWorldModel(replace(SPEC, num_inference_steps=made_for))
    options = {'num_inference_steps': asked} if asked else {}
    (chunk,) = imagine(assembled(CARD, world_model, YAM), recording, 1.6, **options)
    assert world_model.num_steps == [expected]
    assert chunk.num_inference_steps == expected


def test_chunks_of_one_rollout_have_seeds_of_their_own(pipeline, world_model, recording):
    imagine(pipeline, recording, 3.2, seed=7)
    assert world_model.seeds == [7, 8]


@pytest.mark.parametrize('num_history', [0, 5, 12])
def test_history_is_the_frames_before_the_start_and_the_first_one_stays_the_anchor(
    recording, num_history
):
    model = CountingWorldModel(replace(SPEC, num_history=num_history))
    chunks = imagine(assembled(CARD, model, YAM), recording, 4.8)
    first = recording.frames[:, 0]
    shown = np.concatenate([first[:, None], *(c.video.frames for c in chunks)], axis=1)
    assert len(model.histories) == 3
    for chunk, history in enumerate(model.histories):
        start = 8 * chunk  # the frame that the chunk starts from is no part of its history
        assert np.array_equal(history.frames, shown[:, max(start - num_history, 0) : start])
        assert np.array_equal(history.anchor, first)


def part_of(asked: JointTrajectory, begin_s: float, end_s: float) -> JointTrajectory:
    mine = (asked.times > begin_s + 1e-6) & (asked.times <= end_s + 1e-6)
    return JointTrajectory(
        joint_names=asked.joint_names,
        times=asked.times[mine] - begin_s,
        positions=asked.positions[mine],
    )


@pytest.mark.parametrize('num_seeds', [1, 2])
def test_chained_extends_are_one_long_extend(recording, num_seeds):
    """The clock, seeds, history, anchor and memory are those of an episode without stops."""
    model = CountingWorldModel(replace(SPEC, num_history=5))
    pipeline = assembled(CARD, model, YAM)
    whole = imagine(pipeline, recording, 4.8, seed=3, num_seeds=num_seeds)
    asked = commands(recording, 4.8)
    episode = pipeline.begin(
        observe(recording),
        RolloutOptions(instruction=recording.instruction, seed=3, num_seeds=num_seeds),
    )
    for chunk, other in enumerate(whole):
        (one,) = episode.extend(part_of(asked, 1.6 * chunk, 1.6 * (chunk + 1)))
        assert np.array_equal(one.video.frames, other.video.frames)
        assert one.seed == other.seed
        assert one.start.stamp_ns == other.start.stamp_ns
        np.testing.assert_allclose(one.positions, other.positions, atol=1e-9)
        assert one.imagined_seconds == other.imagined_seconds
        assert one.success.probability == pytest.approx(other.success.probability, abs=1e-6)
        assert one.success.features == pytest.approx(other.success.features, abs=1e-6, nan_ok=True)
    half = 3 * num_seeds
    assert model.seeds[half:] == model.seeds[:half]
    for one, other in zip(model.histories[half:], model.histories[:half], strict=True):
        assert np.array_equal(one.frames, other.frames)
        assert np.array_equal(one.anchor, other.anchor)


def test_what_has_changed_holds_from_the_next_extend_on(pipeline, world_model, recording):
    episode = pipeline.begin(observe(recording), RolloutOptions(instruction='pick the red block'))
    list(episode.extend(commands(recording, 1.6)))
    episode.options = RolloutOptions(instruction=recording.instruction, seed=40)
    (chunk,) = episode.extend(part_of(commands(recording, 3.2), 1.6, 3.2))
    assert chunk.masks.names == recording.objects[:2]
    assert world_model.seeds == [0, 41]


class StoppingWorldModel(CountingWorldModel):
    """Is stopped in its third chunk."""

    def predict(self, *frames, **options):
        if len(self.seeds) == 2:
            raise RolloutPreempted('stopped')
        return super().predict(*frames, **options)


@pytest.mark.parametrize('num_seeds', [1, 2])
def test_a_stop_in_mid_chunk_leaves_the_episode_where_it_was(recording, num_seeds):
    model = StoppingWorldModel(SPEC)
    episode = assembled(CARD, model, YAM).begin(
        observe(recording), RolloutOptions(num_seeds=num_seeds)
    )
    done = []
    with pytest.raises(RolloutPreempted):
        for prediction in episode.extend(commands(recording, 4.8)):
            done.append((prediction, episode.observation))
    last, stands_at = done[-1]
    assert episode.num_chunks == len(done) == 2 // num_seeds
    assert episode.observation is stands_at
    model.seeds.clear()
    (after,) = episode.extend(commands(recording, 1.6))
    assert np.array_equal(after.start.frames, last.video.frames[:, -1])
    assert after.seed == last.seed + 1


def test_a_stop_between_chunks_keeps_those_that_are_done(pipeline, recording):
    done: list[int] = []
    episode = pipeline.begin(
        observe(recording), RolloutOptions(should_stop=lambda: len(done) == 2)
    )
    with pytest.raises(RolloutPreempted):
        for prediction in episode.extend(commands(recording, 4.8)):
            done.append(prediction.chunk)
    assert done == [0, 1] and episode.num_chunks == 2


class NoisyWorldModel(CountingWorldModel):
    """Draws its frames from the seed alone."""

    def predict(self, start_frame, control, *, seed, **options):
        held = super().predict(start_frame, control, seed=seed, **options)
        return np.random.default_rng(seed).integers(0, 256, held.shape, np.uint8)


def test_the_same_seed_twice_gives_the_same_frames(recording):
    pipeline = assembled(CARD, NoisyWorldModel(SPEC), YAM)
    first, again, other = (
        np.concatenate([c.video.frames for c in imagine(pipeline, recording, 3.2, seed=seed)], 1)
        for seed in (5, 5, 6)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_real_frames_are_judged_as_imagined_ones_are(pipeline, recording):
    """Observing what was imagined: masks and estimate are the same, chunk after chunk."""
    imagined = imagine(pipeline, recording, 3.2)
    episode = pipeline.begin(observe(recording), RolloutOptions(instruction=recording.instruction))
    for chunk in imagined:
        positions = np.concatenate([chunk.start.positions[None], chunk.positions])
        found = episode.observe(chunk.video.frames, positions)
        assert np.array_equal(found.masks.masks, chunk.masks.masks)
        assert found.success.reasons == chunk.success.reasons
        np.testing.assert_equal(dict(found.success.features), dict(chunk.success.features))
    assert episode.observation.stamp_ns == recording.stamp_ns + 3_200_000_000
    assert np.array_equal(episode.observation.frames, imagined[-1].video.frames[:, -1])


def test_imagining_goes_on_from_what_was_observed(recording):
    model = CountingWorldModel(replace(SPEC, num_history=5))
    episode = assembled(CARD, model, YAM).begin(
        observe(recording), RolloutOptions(instruction=recording.instruction)
    )
    real = recording.frames[:, :9]
    episode.observe(real[:, 1:], recording.positions[:9])
    (chunk,) = episode.extend(part_of(commands(recording, 3.2), 1.6, 3.2))
    assert np.array_equal(chunk.start.frames, real[:, 8])
    assert np.array_equal(model.histories[0].frames, real[:, 3:8])
    assert chunk.imagined_seconds == pytest.approx(1.6)  # since the last real frame


def test_a_recorded_frame_is_seen_at_its_own_size(recording, tmp_path):
    frames, cameras = recording.seen_at(3)
    assert frames.shape[1] > SPEC.height
    assert {(c.height, c.width) for c in cameras} == {frames.shape[1:3]}
    small = resize_frames(frames, SPEC.width, SPEC.height)
    assert np.array_equal(small, recording.frames[:, 3])
    for kept in range(2):  # made, and read again
        cached = cached_recording(recording.path, SPEC, YAM, tmp_path)
        assert not cached.recorded and len(list(tmp_path.iterdir())) == 1, kept
        frames, cameras = cached.seen_at(3)
        assert np.array_equal(frames, recording.frames[:, 3]) and cameras == cached.cameras


def test_a_recording_is_judged_by_its_own_frames(pipeline, recording):
    """A model that holds its frame shows no move; the recorded frames do."""
    (stretch,) = stretches(recording, SPEC, 'imagine')
    seen = observe_stretch(pipeline, recording, stretch)
    *_, last = imagine(pipeline, recording, stretch.num_frames / SPEC.fps)
    assert seen.features['moved'] == 1.0 > last.success.features['moved']
    assert seen.probability > 0.5 > last.success.probability


def test_the_last_chunk_alone_is_imagined_from_what_was_seen(pipeline, world_model, recording):
    (stretch,) = stretches(recording, SPEC, 'imagine')
    first, *_ = stretches(recording, SPEC, 'observe')
    assert last_chunk(recording, first, SPEC) is None
    last = last_chunk(recording, stretch, SPEC)
    (chunk,) = imagine_stretch(
        pipeline, recording, last, actions=recording, seed=3, num_inference_steps=1
    )
    found = chunk.success
    # that it moved was seen; what moves in the last chunk, this model does not know
    assert found.features['moved'] == 1.0 and np.isnan(found.features['foreseen'])
    assert world_model.seeds == [3]
    drawn = world_model.trajectories[0][:, 0].astype(int)
    masks = pipeline.segmenter.segment(stretch.frames[:, :1], ())
    motions = [Motion.of(YAM, recording.cameras, row[None]) for row in stretch.positions]
    away = [
        np.abs(draw(pipeline, motion, np.zeros(1), masks)[:, 0] - drawn).mean()
        for motion in motions
    ]
    assert np.argmin(away) == stretch.num_frames - SPEC.num_frames


class ThreeWays:
    """Objects that go along x in the first second; how far, in each of three motions [m]."""

    step_s, commands_a_step, reasons, refusal, doubts = 0.1, 1, (), '', {}
    is_fitted = True
    sizes = np.full((3, 2, 3), 0.04)
    fingers = None

    def __init__(self, *ways: float) -> None:
        self._ways = ways

    def find(self, names, masks, cameras, poses):
        return self

    def with_fingers(self, fingers):
        return self

    def advance(self, positions, should_stop=None):
        turns = np.broadcast_to(np.eye(3), (len(positions), 2, 3, 3))
        motions = []
        for way in self._ways:
            points = np.full((len(positions), 2, 3), (0.0, 0.3, 0.02))
            points[..., 0] += way * np.clip(np.arange(len(positions)) / 10, 0, 1)[:, None]
            start = points[0].copy()
            motions.append(ObjectMotion(reference=start, points=points, rotations=turns))
        return tuple(motions), self


def test_pictures_show_what_most_of_the_motions_say(recording):
    def shown(*ways: float) -> np.ndarray:
        world_model = CountingWorldModel(SPEC)
        imagine(with_motion(world_model, ThreeWays(*ways)), recording, 1.6)
        return world_model.trajectories[0]

    still, moved = shown(0.0, 0.0, 0.0), shown(0.06, 0.06, 0.06)
    assert not np.array_equal(still, moved)
    assert np.array_equal(shown(0.06, 0.0, 0.0), still)
    assert np.array_equal(shown(0.0, 0.06, 0.06), moved)


def test_a_plan_is_foreseen_chunk_by_chunk(recording, world_model):
    """So that its first chunk does not wait for the others."""
    log: list[int] = []
    pipeline = with_motion(world_model, DriftingObjects(log))
    episode = pipeline.begin(observe(recording), RolloutOptions(instruction=recording.instruction))
    long = JointTrajectory(
        joint_names=YAM.joint_names,
        times=np.array([20.0]),
        positions=episode.observation.positions[None],
    )
    chunks = episode.extend(long)
    next(chunks)
    assert log == [0, 16]
    list(chunks)
    assert log == [0, *range(16, 209, 16)] and len(world_model.trajectories) == 13


class DriftingObjects:
    """Objects that move by 1 cm along x at every step."""

    step_s, commands_a_step, reasons, refusal, doubts = 0.1, 1, (), '', {}
    is_fitted = True
    sizes = np.full((1, 2, 3), 0.04)

    def __init__(
        self, log: list[int], num_steps: int = 0, same: tuple[bool, bool] = (True, True)
    ) -> None:
        self._log, self._num_steps, self._same = log, num_steps, same
        self.given, self.fingers = [], None

    def with_fingers(self, fingers):
        self.given.append(fingers)
        return self

    def find(self, names, masks, cameras, poses):
        assert masks.shape[:2] == (len(cameras), 2) and len(poses) == len(cameras)
        self._log.append(0)
        return self

    def find_again(self, whole, names, masks, cameras, poses, kept=(), held=()):
        assert whole is self and masks.shape[:2] == (len(cameras), 2)
        self._log.append(1)
        return self, np.array(self._same), np.array([True, False])

    def advance(self, positions, should_stop=None):
        count = len(positions) - 1
        points = np.zeros((count + 1, 2, 3))
        points[..., 0] = 0.01 * (self._num_steps + np.arange(count + 1))[:, None]
        turns = np.broadcast_to(np.eye(3), (count + 1, 2, 3, 3))
        motion = ObjectMotion(reference=np.zeros((2, 3)), points=points, rotations=turns)
        self._log.append(self._num_steps + count)
        return (motion,), DriftingObjects(self._log, self._num_steps + count)


def test_objects_move_on_from_chunk_to_chunk_and_are_found_again_in_real_frames(
    recording, world_model
):
    log: list[int] = []
    pipeline = with_motion(world_model, DriftingObjects(log))
    episode = pipeline.begin(observe(recording), RolloutOptions(instruction=recording.instruction))
    list(episode.extend(commands(recording, 3.2)))
    assert log == [0, 16, 32]  # found once; two chunks of 1.6 s in steps of 0.1 s
    first, second = world_model.trajectories
    assert not np.array_equal(first[:, -1], second[:, -1])
    episode.observe(recording.frames[:, 17:25], recording.positions[16:25])
    list(episode.extend(part_of(commands(recording, 3.2), 1.6, 3.2)))
    assert log == [0, 16, 32, 1, 16]


def test_objects_are_foreseen_with_how_the_fingers_moved_in_the_real_frames(
    recording, world_model
):
    objects = DriftingObjects([])
    pipeline = with_motion(world_model, objects)
    episode = pipeline.begin(observe(recording), RolloutOptions(instruction=recording.instruction))
    column = YAM.joint_names.index(YAM.tools[0].gripper_joint)
    positions, ends = recording.positions[:9].copy(), YAM.tools[0]
    half = (ends.gripper_open + ends.gripper_closed) / 2
    positions[:, column] = [ends.gripper_open, *[half] * 8]
    list(episode.extend(commands(recording, 1.6)))
    episode.observe(recording.frames[:, 1:9], positions)
    list(episode.extend(part_of(commands(recording, 3.2), 1.6, 3.2)))
    unknown, fingers = objects.given
    assert unknown is None and fingers.are_stopped().tolist() == [True, False]
    assert fingers.widest[0] == 1.0 and fingers.rest[0] == pytest.approx(0.5)
    assert fingers.rest_s[0] == pytest.approx(7 / SPEC.fps)
    # commands that are followed tell nothing more, such that are not hold from the start
    again = pipeline.begin(observe(recording), RolloutOptions(instruction=recording.instruction))
    shut = positions.copy()
    shut[:, column] = ends.gripper_closed
    positions[:, column] = half
    again.observe(recording.frames[:, 1:9], positions, commands=positions)
    assert not again._states[0].evidence.objects.fingers.are_stopped().any()
    again.observe(recording.frames[:, 1:9], positions, commands=shut)
    assert again._states[0].evidence.objects.fingers.are_stopped().tolist() == [True, False]


@pytest.mark.parametrize('found_again', [True, False])
def test_what_is_hidden_by_now_is_shown_and_foreseen_as_it_was_when_it_was_whole(
    recording, world_model, found_again
):
    pipeline = with_motion(world_model, DriftingObjects([], same=(True, found_again)))
    begun = pipeline.begin(observe(recording), RolloutOptions(instruction=recording.instruction))
    begun.observe(recording.frames[:, 1:9], recording.positions[:9])
    now = Observation(
        cameras=recording.cameras,
        frames=np.full_like(recording.frames[:, 8], 7),
        positions=recording.positions[8],
        stamp_ns=recording.stamp_ns + 1_600_000_000,
    )
    episode = begun.branch(now)
    (chunk,) = episode.extend(part_of(commands(recording, 3.2), 1.6, 3.2))
    first = pipeline.segmenter.segment(recording.frames[:, :1], begun.names).masks[:, :, 0]
    objects = episode._states[0].evidence.objects.found
    # nothing of it is seen now; of the other one neither, which does not count as hidden
    np.testing.assert_array_equal(objects.cuts[:, 0, ..., 3] > 0, first[:, 0])
    assert first[:, 1].any() and not objects.cuts[:, 1, ..., 3].any()
    shown = objects.cuts[:, 0][first[:, 0]][:, :3]
    np.testing.assert_array_equal(shown, recording.frames[:, 0][first[:, 0]])
    assert np.isfinite(chunk.success.features['foreseen']) == found_again


def test_an_episode_in_which_nobody_names_an_object_is_imagined(recording, world_model):
    foresight = load_foresight(share_path('resource', 'checkpoint', 'object_motion'), YAM)
    episode = with_motion(world_model, foresight).begin(observe(recording))
    chunks = list(episode.extend(commands(recording, 3.2)))
    assert len(chunks) == 2 and chunks[-1].masks.names == ()


def misplaced(monkeypatch, change) -> None:
    """Objects are found in masks as `change` has them."""
    fit = solid_foresight.fit_solid

    def found(*given):
        solid = fit(*given)
        return None if solid is None else replace(solid, centre=change(solid.centre))

    monkeypatch.setattr(solid_foresight, 'fit_solid', found)


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (lambda centre: np.array([0.3, 0.0, centre[2]]), 'seem to be in one place'),
        (lambda centre: centre + [0, 0, 0.3], 'seems to float'),
        (lambda centre: centre + [3.0, 0, 0], 'seems to lie off the table'),
    ],
)
def test_objects_that_cannot_be_where_they_were_found_are_named_and_there_is_no_verdict(
    recording, world_model, monkeypatch, change, said
):
    foresight = load_foresight(share_path('resource', 'checkpoint', 'object_motion'), YAM)
    pipeline = with_motion(world_model, foresight)
    with monkeypatch.context() as context:
        misplaced(context, change)
        refused = imagine(pipeline, recording, 1.6)[-1].success
    assert np.isnan(refused.probability)
    assert said in refused.reasons[0] and f"'{recording.objects[0]}'" in refused.reasons[0]
    assert np.isfinite(imagine(pipeline, recording, 1.6)[-1].success.probability)


def test_objects_that_one_view_alone_shows_are_named_and_there_is_no_verdict(
    recording, world_model
):
    foresight = load_foresight(share_path('resource', 'checkpoint', 'object_motion'), YAM)
    seen = observe(recording)
    frames = seen.frames.copy()
    frames[1] = 128
    episode = with_motion(world_model, foresight).begin(
        replace(seen, frames=frames), RolloutOptions(instruction=recording.instruction)
    )
    (chunk,) = episode.extend(commands(recording, 1.6))
    assert np.isnan(chunk.success.probability)
    assert f"'{recording.objects[0]}' is seen by one view alone" in chunk.success.reasons[0]


def test_an_engine_that_diverges_is_named_and_there_is_no_verdict(
    recording, world_model, monkeypatch
):
    foresight = load_foresight(share_path('resource', 'checkpoint', 'object_motion'), YAM)
    monkeypatch.setattr(foresight.engine, 'run', lambda *given: given[-1].fill(np.nan))
    chunks = imagine(with_motion(world_model, foresight), recording, 3.2)
    last = chunks[-1].success
    assert np.isnan(last.probability) and 'foreseen futures are implausible' in last.reasons[0]
    assert any('the engine diverged' in reason for reason in last.reasons)


def test_control_frame_zero_shows_the_observed_state(pipeline, world_model, recording):
    """And frame k the state after command k: a later start shifts the frames, not the first."""
    (chunk,) = imagine(pipeline, recording, 1.6)
    rows = np.stack([recording.positions[0], chunk.positions[0]])
    motion = Motion.of(YAM, recording.cameras, rows)
    drawn = draw(pipeline, motion, np.array([0.0, 0.2]), chunk.start_masks)
    assert np.array_equal(world_model.trajectories[0][:, :2], drawn)


def test_arms_are_drawn_as_the_frame_that_each_chunk_starts_from_shows_them(
    world_model, recording
):
    card = CARD.replace(rendering={'arm_pictures': True})
    chunks = imagine(assembled(card, world_model, YAM), recording, 3.2)
    parts = load_shape(YAM).parts
    for chunk, control in zip(chunks, world_model.trajectories, strict=True):
        start = chunk.start.frames
        rows, links = chunk.start.positions[None], {part.link for part in parts}
        arms = arm_pictures(parts, Motion.of(YAM, chunk.start.cameras, rows, links), start)
        (visible,) = np.moveaxis(arms[:, :, ..., 3] > 0, 1, 0)
        assert visible.mean() > 0.05
        # trails and objects lie over some of it
        assert (control[:, 0][visible] == start[visible]).all(axis=-1).mean() > 0.7


def test_forward_kinematics_run_once_for_the_frames_of_a_chunk_and_once_for_its_trails(
    world_model, recording, monkeypatch
):
    """Whoever draws, checks or judges takes the same poses, also of a camera on the wrist."""
    passes, whole = [], RobotModel._placements

    def counted(self, positions, *more):
        passes.append(len(positions))
        return whole(self, positions, *more)

    monkeypatch.setattr(RobotModel, '_placements', counted)
    card = CARD.replace(rendering={'link_width_m': 0.02, 'finger_width_m': 0.01})
    pipeline = assembled(card, world_model, YAM)
    start = observe(recording)
    wrist = replace(start.cameras[1], mount_link=YAM.tools[0].link)
    rollout = pipeline.begin(replace(start, cameras=(start.cameras[0], wrist)))
    list(rollout.extend(commands(recording, 1.6)))
    dense = 1 + SPEC.num_frames * TrajectoryVideoConfig().points_per_frame
    assert passes == [1 + SPEC.num_frames, dense]


def test_the_objects_are_those_of_the_instruction(pipeline, recording):
    (chunk,) = imagine(pipeline, recording, 1.6)
    assert chunk.start_masks.names == recording.objects[:2]
    assert chunk.start_masks.masks.any(axis=(2, 3, 4)).all()


def test_without_object_masks_the_control_is_dark_but_for_the_trails(world_model, recording):
    imagine(assembled(CARD.replace(object_mask=False), world_model, YAM), recording, 1.6)
    imagine(assembled(CARD, world_model, YAM), recording, 1.6)
    without, with_masks = (np.count_nonzero(t) for t in world_model.trajectories)
    assert 0 < without < with_masks


def test_a_larger_observation_is_brought_to_the_models_size(pipeline, recording):
    robot = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
    large = load_recording(
        share_path('resource', 'demo_episode'), replace(SPEC, width=384, height=288), robot
    )
    (chunk,) = imagine(pipeline, large, 1.6)
    np.testing.assert_allclose(chunk.start.cameras[0].K, recording.cameras[0].K)
    difference = np.abs(chunk.start.frames.astype(int) - recording.frames[:, 0])
    assert difference.max() <= 1


def test_views_in_another_order_are_refused(pipeline, recording):
    seen = observe(recording)
    turned = Observation(
        cameras=seen.cameras[::-1],
        frames=seen.frames[::-1],
        positions=seen.positions,
        stamp_ns=seen.stamp_ns,
    )
    with pytest.raises(ObservationError, match=r"\['high', 'low'\].*\['low', 'high'\]"):
        pipeline.begin(turned)


def test_two_views_for_a_model_of_one_are_refused(recording):
    card = CARD.replace(views=('low',))
    model = CountingWorldModel(replace(SPEC, views=('low',)))
    pipeline = assembled(card, model, YAM)
    said = r"views \['low', 'high'\], the model was trained on \['low'\].*train --views"
    with pytest.raises(ObservationError, match=said):
        pipeline.begin(observe(recording))


def test_positions_outside_the_limits_are_refused(pipeline, recording):
    good = commands(recording, 1.6)
    positions = good.positions.copy()
    positions[3, 1] = 9.0
    bad = replace(good, positions=positions)
    with pytest.raises(TrajectoryError, match='left_joint2.* is 9 '):
        list(pipeline.begin(observe(recording)).extend(bad))


class SlidingObjects:
    """Moves every object 1 cm along x in each step of 0.1 s; remembers how often it was asked."""

    step_s, commands_a_step, reasons, refusal, doubts = 0.1, 1, (), '', {}
    is_fitted = True
    fingers = None

    def __init__(self, points: np.ndarray, steps: int = 0) -> None:
        self.points, self.steps = points, steps

    def with_fingers(self, fingers):
        return self

    @property
    def sizes(self) -> np.ndarray:
        return np.full((1, len(self.points), 3), 0.04)

    def advance(
        self, positions: np.ndarray, should_stop=None
    ) -> tuple[tuple[ObjectMotion], SlidingObjects]:
        steps = self.steps + np.arange(len(positions))
        way = np.zeros((len(steps), 1, 3))
        way[:, 0, 0] = 0.01 * steps
        turns = np.tile(np.eye(3), (len(steps), len(self.points), 1, 1))
        motion = ObjectMotion(reference=self.points, points=self.points + way, rotations=turns)
        return (motion,), SlidingObjects(self.points, int(steps[-1]))


class SlidingModel:
    """Finds objects where their masks are; remembers the sizes of the masks."""

    is_fitted = True

    def __init__(self) -> None:
        self.sizes: list[tuple[int, ...]] = []

    def find(self, names, masks, cameras, poses) -> SlidingObjects:
        self.sizes.append(masks.shape)
        pixels = centroids(masks)
        points = np.full((masks.shape[1], 3), np.nan)
        for item in range(len(points)):
            if (place := locate(cameras, poses, pixels[:, item])) is not None:
                points[item] = place.point
        return SlidingObjects(points)


def test_objects_are_shown_where_they_go_and_that_goes_on_from_chunk_to_chunk(
    world_model, recording
):
    model = SlidingModel()
    pipeline = with_motion(world_model, model)
    episode = pipeline.begin(observe(recording), RolloutOptions(instruction=recording.instruction))
    chunks = list(episode.extend(commands(recording, 3.2)))
    num_objects = len(chunks[0].masks.names)
    assert model.sizes == [(2, num_objects, *recording.frames.shape[2:4])]
    point = (
        SlidingModel()
        .find(
            chunks[0].masks.names,
            chunks[0].start_masks.masks[:, :, 0],
            chunks[0].start.cameras,
            [camera.T_mount_camera for camera in chunks[0].start.cameras],
        )
        .points[0]
    )
    camera = chunks[0].start.cameras[1]
    for chunk, seconds in zip(chunks, (0.0, 1.6), strict=True):
        for frame in (0, 4):
            there = point + [0.1 * (seconds + frame / SPEC.fps), 0, 0]
            (x, y), _ = project(camera, camera.T_mount_camera, there)
            shown = chunk.trajectory_video.frames[1, frame, round(y), round(x)].astype(int)
            (u, v), _ = project(camera, camera.T_mount_camera, point)
            colour = recording.frames[1, 0, round(v), round(u)].astype(int)
            assert np.abs(shown - colour).max() < 60
    episode.options = RolloutOptions(instruction='pick the red block')
    (chunk,) = episode.extend(part_of(commands(recording, 4.8), 3.2, 4.8))
    assert model.sizes[1:] == [(2, len(chunk.masks.names), *recording.frames.shape[2:4])]


# real frames between plans


LARGE = replace(SPEC, width=96, height=72)


@pytest.fixture(scope='module')
def large_recording() -> Recording:
    return load_recording(share_path('resource', 'demo_episode'), LARGE, YAM)


@pytest.fixture
def observed() -> ObservedEpisode:
    return ObservedEpisode(assembled(CARD, PersistenceWorldModel(LARGE), YAM))


def seen_at(recording: Recording, frame: int) -> Observation:
    return Observation(
        cameras=recording.cameras,
        frames=recording.frames[:, frame],
        positions=recording.positions[frame],
        stamp_ns=recording.stamp_ns + frame * 200_000_000,
    )


def judge(observed: ObservedEpisode, recording: Recording, frame: int, instruction: str = ''):
    """The estimate of a plan that does nothing, at a frame."""
    now = seen_at(recording, frame)
    stay = JointTrajectory(joint_names=YAM.joint_names, times=[1.6], positions=now.positions[None])
    episode = observed.begin(now, RolloutOptions(instruction=instruction or recording.instruction))
    (chunk,) = episode.extend(stay)
    assert np.array_equal(chunk.start.frames, now.frames)
    return chunk.success


def live(observed: ObservedEpisode, recording: Recording, first: int, last: int) -> None:
    for frame in range(first + 1, last):
        assert observed.is_due(recording.stamp_ns + frame * 200_000_000)
        observed.see(seen_at(recording, frame))


def test_a_grasp_seen_two_plans_ago_counts(observed, large_recording):
    """At the recording's end the blocks are stacked: whether a grasp did it, only memory knows."""
    last = len(large_recording.times) - 1
    for first, then in ((0, 16), (16, 32), (32, last)):
        judge(observed, large_recording, first)
        live(observed, large_recording, first, then)
    known = judge(observed, large_recording, last)
    assert known.features['moved'] == 1.0 and known.features['grasp'] > 0.0
    observed.forget()
    unknown = judge(observed, large_recording, last)
    assert unknown.features['moved'] == 0.0
    assert known.probability > 0.5 > unknown.probability


def test_another_instruction_or_a_reset_begins_a_new_episode(observed, large_recording):
    def judged(instruction: str = '') -> float:
        return judge(observed, large_recording, 40, instruction).features['moved']

    def live_again() -> None:
        observed.forget()
        judge(observed, large_recording, 0)
        live(observed, large_recording, 0, 40)

    live_again()
    assert judged() == 1.0
    other = f'{large_recording.instruction}.'
    live_again()
    assert judged(other) == 0.0  # the same task in other words, told at frame 40
    live_again()
    observed.forget()
    assert judged() == 0.0


def test_frames_between_those_of_the_model_and_before_the_first_plan_are_not_kept(
    observed, large_recording
):
    start_ns = large_recording.stamp_ns
    assert not observed.is_due(start_ns)
    judge(observed, large_recording, 0)
    due = [ms for ms in range(1, 1000, 33) if observed.is_due(start_ns + ms * 1_000_000)]
    assert due[0] == pytest.approx(200, abs=33)
    assert not observed.is_behind
    live(observed, large_recording, 0, 1 + LARGE.num_frames)
    assert observed.is_behind
    observed.catch_up()
    assert not observed.is_behind
    assert not observed.is_due(start_ns + LARGE.num_frames * 200_000_000 + 100_000_000)


def test_a_motion_that_no_view_shows_is_said_and_counted(pipeline, recording):
    (seen,) = imagine(pipeline, recording, 1.6)
    assert (seen.in_view > 0.5).all()
    assert not any('no view' in reason for reason in seen.success.reasons)
    away = observe(recording)
    cameras = []
    for camera in away.cameras:
        T = camera.T_mount_camera.copy()
        T[:3, 3] += 5 * T[:3, 2]  # looks past the robot from behind it
        cameras.append(replace(camera, T_mount_camera=T))
    episode = pipeline.begin(replace(away, cameras=tuple(cameras)))
    (unseen,) = episode.extend(commands(recording, 1.6))
    assert (unseen.in_view == 0).all()
    assert unseen.success.reasons[-1] == 'no view shows a tool at any time'


def test_a_lens_that_moves_the_tools_out_of_the_image_is_refused(pipeline, recording):
    start = observe(recording)
    wrong = replace(
        start.cameras[0], distortion_model='plumb_bob', distortion=np.array([300.0, 0, 0, 0])
    )
    episode = pipeline.begin(replace(start, cameras=(wrong, start.cameras[1])))
    with pytest.raises(CalibrationError, match="in the middle of view 'low', but its distortion"):
        list(episode.extend(commands(recording, 1.6)))


def test_a_describer_is_asked_once_about_the_first_real_frame(pipeline, recording):
    shown = []

    class Describer:
        def describe(self, first_frame, instruction):
            shown.append((first_frame, instruction))
            return (DescribedObject(id='a', name='blue block'),)

    asking = replace(pipeline, describer=Describer())
    observed = ObservedEpisode(asking)
    for k in range(2):
        moment = replace(observe(recording), stamp_ns=recording.stamp_ns + k)
        episode = observed.begin(moment, RolloutOptions(instruction='tidy up'))
        chunks = list(episode.extend(commands(recording, 2.0)))
        assert all(chunk.masks.names == ('blue block',) for chunk in chunks)
    frame, instruction = shown[0]
    assert len(shown) == 1 and instruction == 'tidy up'
    np.testing.assert_array_equal(frame, recording.frames[0, 0])
    episode.options = RolloutOptions(
        instruction='stop'
    )  # goes on in the imagined frames, which are not shown
    list(episode.extend(commands(recording, 1.0)))
    np.testing.assert_array_equal(shown[1][0], recording.frames[0, 0])
    named = asking.begin(
        observe(recording), RolloutOptions(instruction='tidy up', objects=('red block',))
    )
    assert named.names == ('red block',) and len(shown) == 2


def test_without_foresight_a_model_is_drawn_what_it_was_trained_with(recording, world_model):
    """Fills of the first masks are drawn for models that were trained with them alone."""
    foresight = load_foresight(share_path('resource', 'checkpoint', 'object_motion'), YAM)
    trained = with_motion(world_model, foresight)
    blind = assembled(CARD.replace(object_mask=False), world_model, YAM)
    paper = assembled(CARD, world_model, YAM)
    drawn = []
    for pipeline in (trained.without_foresight(), blind, paper.without_foresight(), paper):
        imagine(pipeline, recording, 1.6)
        drawn.append(world_model.trajectories.pop())
    np.testing.assert_array_equal(drawn[0], drawn[1])
    np.testing.assert_array_equal(drawn[2], drawn[3])
    assert not np.array_equal(drawn[1], drawn[2])


def test_without_foresight_the_fits_to_such_rollouts_are_used(recording, world_model):
    foresight = load_foresight(share_path('resource', 'checkpoint', 'object_motion'), YAM)
    bare = with_motion(world_model, foresight)
    assert bare.without_foresight().judge.estimator is bare.judge.estimator
    assert bare.without_foresight().judge.grounds == Grounds()
    usual = load_fits(share_path('resource', 'checkpoint'))
    own = usual.calibration.replace(bias=3.0, fitted_to=None)
    judge = replace(
        bare.judge,
        estimator=bare.judge.estimator.with_calibration(usual.calibration),
        horizon=usual.horizon,
        picture_fits=Fits(own, None),
    )
    whole = replace(bare, judge=judge)
    alone = whole.without_foresight()
    assert alone.judge.object_motion is None and alone.judge.horizon is None
    assert alone.judge.estimator.calibration is own
    assert whole.judge.estimator.calibration is usual.calibration
    assert alone.without_foresight() is alone
    unfitted = replace(bare, judge=replace(judge, picture_fits=Fits()))
    (chunk,) = imagine(unfitted.without_foresight(), recording, 1.6)
    assert np.isnan(chunk.success.probability)
    assert 'never calibrated' in chunk.success.reasons[0]


def test_what_went_to_the_judge_is_named_with_its_place(pipeline):
    with pytest.raises(AttributeError, match=r"'estimator': it is judge\.estimator now"):
        _ = pipeline.estimator
    with pytest.raises(TypeError, match=r'judge=replace\(pipeline\.judge, object_motion=\.\.\.\)'):
        replace(pipeline, object_motion=None)
    with pytest.raises(AttributeError, match="no attribute 'estimate'$"):
        _ = pipeline.estimate


def test_the_bundled_checkpoint_has_a_fit_to_rollouts_without_foresight():
    folder = share_path('resource', 'checkpoint')
    usual, alone = load_fits(folder), load_fits(folder, of_pictures=True)
    assert alone.calibration.is_of_pictures and not usual.calibration.is_of_pictures
    assert alone.calibration.num_episodes == usual.calibration.num_episodes  # the same data
    assert re.match(r'\d+% of the failures', alone.calibration.optimism)
    assert alone.horizon.trusted_seconds(0.8) < usual.horizon.trusted_seconds(0.8)


@pytest.mark.slow
def test_every_switch_that_takes_foresight_away_uses_the_fit_of_its_own_kind():
    whole = Pipeline.load(segmenter='colour', num_threads=1)
    switched = whole.without_foresight()
    loaded = Pipeline.load(segmenter='colour', num_threads=1, foresight=False)
    own = load_fits(share_path('resource', 'checkpoint'), of_pictures=True)
    for alone in (switched.judge, loaded.judge):
        assert alone.estimator.calibration == own.calibration
        assert alone.horizon == own.horizon
        assert alone.grounds == Grounds.of('', True)


class FollowsOnly:
    """Segmenter that finds the first object in no frame by itself, but follows it."""

    def __init__(self, segmenter) -> None:
        self._own, self.name = segmenter, segmenter.name

    def segment(self, frames, names, first_masks=None, first_frames=None):
        found = self._own.segment(frames, names, first_masks, first_frames)
        if first_masks is not None:
            return found
        masks = np.array(found.masks)
        masks[:, 0] = False
        return replace(
            found, masks=masks, status=tuple(('absent', *row[1:]) for row in found.status)
        )


@pytest.mark.parametrize(('later', 'is_found'), [(8, True), (14, False)])
def test_what_a_search_misses_is_where_it_was_followed_to(pipeline, recording, later, is_found):
    options = RolloutOptions(instruction=recording.instruction)
    whole = pipeline.begin(observe(recording), options)
    seen = whole.observe(recording.frames[:, 1:9], recording.positions[:9])
    hidden = replace(pipeline, segmenter=FollowsOnly(pipeline.segmenter))
    episode = hidden.begin(observe(recording), options)
    episode._states = tuple(
        replace(state, followed=Followed(masks=seen.masks.last(), frames=state.observation.frames))
        for state in whole._states
    )
    now = episode.branch(
        replace(
            observe(recording),
            frames=recording.frames[:, later],
            stamp_ns=recording.stamp_ns + round(1e9 * later / SPEC.fps),
        )
    )
    found = hidden.find(now._states[0], replace(options, objects=now.names))
    assert found.masks[:, 0].any() == is_found
    if is_found:
        assert (jaccard(found.masks[:, 0, 0], seen.masks.masks[:, 0, -1]) > 0.9).all()
