"""Several seeds of one plan."""

from __future__ import annotations

import numpy as np
import pytest

from mtv_world_ros.core.data_types import JointTrajectory, Observation, WorldModelSpec
from mtv_world_ros.core.files import share_path
from mtv_world_ros.data.recording import load_recording
from mtv_world_ros.model.card import read_card
from mtv_world_ros.robot.file import load_robot
from mtv_world_ros.rollout.options import RolloutOptions
from mtv_world_ros.rollout.rollout import SEED_STEP
from mtv_world_ros.success.calibration import HorizonCurve
from test.support.pipelines import assembled
from test.support.small_episodes import PersistenceWorldModel

SPEC = WorldModelSpec(
    views=('low', 'high'), fps=5.0, num_frames=4, width=64, height=48, robot='yam_bimanual'
)
YAM = load_robot(share_path('config', 'robots', 'yam_bimanual', 'robot.yaml'))
CARD = read_card(share_path('resource', 'checkpoint')).replace(rendering={})


class SeededWorldModel(PersistenceWorldModel):
    """Remembers seeds; adds one grey level a chunk where the seed is not the first one's."""

    def __init__(self, spec):
        super().__init__(spec)
        self.asked = []

    def predict(self, start_frame, control, *, seed, **options):
        self.asked.append((seed, int(start_frame[0, 0, 0, 0])))
        held = super().predict(start_frame, control, seed=seed, **options)
        return held + np.uint8(seed >= SEED_STEP)


@pytest.fixture(scope='module')
def recording():
    return load_recording(share_path('resource', 'demo_episode'), SPEC, YAM)


def imagine(recording, num_seeds, horizon=None):
    model = SeededWorldModel(SPEC)
    whole = recording.commands
    kept = (whole.times > 1e-6) & (whole.times <= 1.6)
    observation = Observation(
        cameras=recording.cameras,
        frames=recording.frames[:, 0],
        positions=recording.positions[0],
        stamp_ns=recording.stamp_ns,
    )
    trajectory = JointTrajectory(
        joint_names=whole.joint_names, times=whole.times[kept], positions=whole.positions[kept]
    )
    episode = assembled(CARD, model, YAM, horizon=horizon).begin(
        observation, RolloutOptions(instruction=recording.instruction, seed=3, num_seeds=num_seeds)
    )
    return model, list(episode.extend(trajectory))


def test_every_seed_chains_its_own_chunks_and_the_first_is_shown(recording):
    model, chunks = imagine(recording, 3)
    pixel = int(recording.frames[0, 0, 0, 0, 0])
    seeds = [3, 3 + SEED_STEP, 3 + 2 * SEED_STEP]
    assert model.asked[:3] == [(seed, pixel) for seed in seeds]
    # their second chunks start from what each of them imagined itself
    assert model.asked[3:] == [(s + 1, pixel + (s >= SEED_STEP)) for s in seeds]
    assert [chunk.seed for chunk in chunks] == [3, 4]
    assert all(chunk.success.num_seeds == 3 for chunk in chunks)


def test_one_seed_is_what_the_pipeline_gives(recording):
    model, chunks = imagine(recording, 1)
    assert [seed for seed, _ in model.asked] == [3, 4]
    assert chunks[-1].success.num_seeds == 1


def test_predictions_know_how_far_they_are_to_be_trusted(recording):
    _, chunks = imagine(recording, 1)
    assert [chunk.imagined_seconds for chunk in chunks] == pytest.approx([0.8, 1.6])
    assert np.isnan(chunks[0].trusted_seconds(0.7))
    curve = HorizonCurve(
        period_s=0.2, values=(0.9,) * 5, lower=(0.9, 0.8, 0.75, 0.6, 0.5), segmenter='colour',
        num_episodes=3,
    )  # fmt: skip
    _, chunks = imagine(recording, 1, curve)
    assert chunks[0].trusted_seconds(0.7) == pytest.approx(0.6)
    other = HorizonCurve(
        period_s=0.2, values=(0.9,), lower=(0.9,), segmenter='sam2', num_episodes=3
    )
    _, chunks = imagine(recording, 1, other)
    assert np.isnan(chunks[0].trusted_seconds(0.7))
